//! Time of the undistortion and rectification of a 1 Mpx image with a precomputed map, and of the map.

use criterion::{Criterion, criterion_group, criterion_main};
use cv_core::{Camera, Distortion, Image, Rotation3, Silent, Vector3};
use cv_imgproc::{Pixel, WarpMap};
use cv_stereo::RectifiedView;

const SIZE: (usize, usize) = (1280, 800);

fn view() -> RectifiedView {
    let distortion = Distortion::radial_tangential5([-0.3, 0.1, 1e-3, -5e-4, 0.0]);
    let source = Camera { distortion, ..Camera::pinhole(SIZE.0, SIZE.1, 900.0, 902.0, 650.0, 390.0) };
    let camera = Camera { distortion: Distortion::NONE, ..source };
    RectifiedView { source, camera, rotation: Rotation3::new(Vector3::new(0.01, 0.02, 0.005)) }
}

fn frames<T: Pixel, const C: usize>(c: &mut Criterion, map: &WarpMap, name: &str, full: f32) {
    // Correctness: on a diagonal ramp, each gray level determines its source position.
    let value = |x: f64, y: f64| full * (x + y) as f32 / (SIZE.0 + SIZE.1) as f32;
    let frame = Image::<T, C>::from_fn(SIZE.0, SIZE.1, |x, y| [T::from_f32(value(x as f64, y as f64)); C]);
    let mut out = Image::new(SIZE.0, SIZE.1, [T::default(); C]);
    map.compute_into(frame.view(), &mut out).unwrap();
    let source = view().source_pixel(cv_core::Point2::new(700.0, 300.0)).unwrap();
    let error = out.at(700, 300)[0].to_f32() - value(source.x, source.y);
    println!("{name}: error {:.3} of 255 levels", 255.0 * error / full);
    c.bench_function(name, |b| b.iter(|| map.compute_into(frame.view(), &mut out)));
}

fn warp(c: &mut Criterion) {
    let map = view().map(&Silent).unwrap();
    frames::<u8, 1>(c, &map, "undistort 1280x800, gray bytes", 255.0);
    frames::<u8, 3>(c, &map, "undistort 1280x800, RGB bytes", 255.0);
    frames::<u16, 1>(c, &map, "undistort 1280x800, gray of 16 bits", 65535.0);
    frames::<f32, 1>(c, &map, "undistort 1280x800, gray f32", 1.0);
    c.bench_function("map of undistort 1280x800", |b| b.iter(|| view().map(&Silent)));
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(20);
    targets = warp
}
criterion_main!(benches);
