//! Disparity and depth maps as PNG.

use cv_core::GrayF32;
use cv_io::{Pixels, depth_mm, kitti, read_image, scaled, write_png};

#[test]
fn kitti_quantizes_to_1_256_px_and_counts_unrepresentable_values() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("d.png");
    let known = [0.0f32, 1.0, 127.25, 255.0, 65535.0 / 256.0];
    let mut data = known.to_vec();
    data.extend([f32::NAN, -1.0, 256.0, f32::INFINITY, 1e9]);
    let image = GrayF32::from_vec(10, 1, data).unwrap();
    assert_eq!(kitti::write(&path, image.view()).unwrap(), 4);
    let back = kitti::read(&path).unwrap();
    // Half a step of 1/256, but a valid zero is stored as one step.
    assert!(known.iter().zip(back.row(0)).all(|(a, b)| (a - b).abs() <= 1.0 / 256.0));
    assert_eq!(back.row(0)[1..4], known[1..4]);
    assert!(back.row(0)[5..].iter().all(|v| v.is_nan()));
    // The stored values by the format's definition.
    let Pixels::Gray16(raw) = read_image(&path).unwrap().pixels else { panic!("16 bits") };
    assert_eq!(raw.row(0), [1, 256, 32576, 65280, 65535, 0, 0, 0, 0, 0]);
}

#[test]
fn millimeters_and_scaled_disparities() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("d.png");
    let image = GrayF32::from_vec(4, 1, vec![0.5, 65.535, 65.6, f32::NAN]).unwrap();
    assert_eq!(depth_mm::write(&path, image.view()).unwrap(), 1);
    let back = depth_mm::read(&path).unwrap();
    assert_eq!(back.row(0)[..2], [0.5, 65.535]);
    assert!(back.row(0)[2].is_nan() && back.row(0)[3].is_nan());

    write_png(&path, cv_core::GrayU8::from_vec(3, 1, vec![0, 4, 255]).unwrap().view()).unwrap();
    let back = scaled::read(&path, 4.0).unwrap();
    assert!(back.row(0)[0].is_nan() && back.row(0)[1..] == [1.0, 63.75]);
    assert_eq!(scaled::write(&path, back.view(), 4.0).unwrap(), 0);
    assert_eq!(scaled::read(&path, 4.0).unwrap().row(0)[1..], [1.0, 63.75]);
    assert!(kitti::read(&path).unwrap_err().to_string().contains("8 bits"));
    assert!(scaled::read(&path, 0.0).is_err() && scaled::read(&path, f64::NAN).is_err());
}
