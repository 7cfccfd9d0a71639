//! A planar map photographed from twelve viewpoints: the panorama is an orthophoto of it.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, Distortion, Matrix3, Point2, RgbU8, Silent, Vector2, Vector3};
use cv_pipeline::panorama_types::{CameraMotion, View};
use cv_pipeline::{PanoramaOptions, PanoramaPhoto, panorama};

const SIZE: (usize, usize) = (600, 400);
const FOCAL: f64 = 550.0;

/// Returns a random number from 0 to 1 for a vertex of a grid.
fn random(x: i64, y: i64, k: i64) -> f64 {
    let h = (x.wrapping_mul(0x9e37_79b9) ^ y.wrapping_mul(0x85eb_ca6b) ^ k.wrapping_mul(0xc2b2_ae35)) as u64;
    let h = (h ^ (h >> 15)).wrapping_mul(0x2545_f491_4f6c_dd1d);
    ((h ^ (h >> 29)) & 0xffff) as f64 / 65535.0
}

/// Returns the map's color: fields, woods and towns as smooth noise of several sizes.
fn map(x: f64, y: f64) -> [f64; 3] {
    let octave = |cells: f64, k: i64| {
        let (u, v) = (x * cells, y * cells);
        let (i, j) = (u.floor(), v.floor());
        let smooth = |t: f64| t * t * (3.0 - 2.0 * t);
        let (f, g) = (smooth(u - i), smooth(v - j));
        let at = |a: i64, b: i64| random(i as i64 + a, j as i64 + b, k);
        (at(0, 0) * (1.0 - f) + at(1, 0) * f) * (1.0 - g) + (at(0, 1) * (1.0 - f) + at(1, 1) * f) * g
    };
    let land = 0.4 * octave(7.0, 1) + 0.35 * octave(23.0, 2) + 0.25 * octave(61.0, 3);
    let woods = 0.5 * octave(11.0, 4) + 0.5 * octave(41.0, 5);
    [30.0 + 200.0 * land, 40.0 + 110.0 * land + 80.0 * woods, 50.0 + 140.0 * woods]
}

/// Cameras on a grid of 4 × 3 viewpoints, at heights of 0.85 to 1.15, tilted by up to ten degrees.
fn views(camera: Camera) -> Vec<View> {
    let tilt = |k: usize, m: usize| 0.18 * (((k * m) % 7) as f64 / 3.0 - 1.0);
    (0..12)
        .map(|k| {
            let (a, b, c) = (tilt(k, 3), tilt(k, 5), 0.5 * tilt(k, 2));
            let about_x = Matrix3::new(1.0, 0.0, 0.0, 0.0, a.cos(), -a.sin(), 0.0, a.sin(), a.cos());
            let about_y = Matrix3::new(b.cos(), 0.0, b.sin(), 0.0, 1.0, 0.0, -b.sin(), 0.0, b.cos());
            let about_z = Matrix3::new(c.cos(), -c.sin(), 0.0, c.sin(), c.cos(), 0.0, 0.0, 0.0, 1.0);
            let r = about_x * about_y * about_z;
            let from = Vector3::new(0.5 * (k % 4) as f64, 0.4 * (k / 4) as f64, -1.0 - 0.8 * tilt(k, 4));
            let from_world = Matrix3::from_columns(&[r.column(0).into(), r.column(1).into(), -(r * from)]);
            View { camera, from_world }
        })
        .collect()
}

/// Returns the position on the map of a pixel.
fn on_map(view: &View, pixel: Point2<f64>) -> Vector2<f64> {
    let ray = view.ray(pixel).unwrap();
    Vector2::new(ray.x / ray.z, ray.y / ray.z)
}

fn photograph(view: &View) -> RgbU8 {
    RgbU8::from_fn(SIZE.0, SIZE.1, |x, y| {
        let mut sum = [0.0; 3];
        for (i, j) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
            let p = on_map(view, Point2::new(x as f64 + i, y as f64 + j));
            sum.iter_mut().zip(map(p.x, p.y)).for_each(|(sum, v)| *sum += 0.25 * v);
        }
        sum.map(|v| v.round() as u8)
    })
}

#[test]
fn a_planar_map_of_twelve_views_becomes_an_orthophoto() {
    let camera = Camera { distortion: Distortion::radial(-0.08, 0.01), ..Camera::from_focal(SIZE.0, SIZE.1, FOCAL) };
    let truth = views(camera);
    let images: Vec<RgbU8> = truth.iter().map(photograph).collect();
    let photos: Vec<PanoramaPhoto<'_>> =
        images.iter().map(|p| PanoramaPhoto { camera: Some(camera), ..PanoramaPhoto::new(p.view()) }).collect();
    let plan = panorama(&photos, &PanoramaOptions::default(), &Silent).unwrap();
    // The matches show that the scene is planar.
    assert_eq!(plan.alignment.motion, CameraMotion::Homography);
    assert!(plan.images.iter().all(|image| image.used));
    // Corners of the photographs in the panorama and on the map, both in pixels.
    let (w, h) = (SIZE.0 as f64 - 1.0, SIZE.1 as f64 - 1.0);
    let corners = [(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)].map(|(x, y)| Point2::new(x, y));
    let places: Vec<(Vector2<f64>, Vector2<f64>)> = plan
        .alignment
        .used()
        .flat_map(|(i, view)| corners.map(|p| (i, *view, p)))
        .map(|(i, view, p)| {
            let drawn = plan.canvas.pixel(&view.ray(p).unwrap()).unwrap();
            (drawn.coords, on_map(&truth[i], p) * FOCAL)
        })
        .collect();
    assert_eq!(places.len(), 48);
    // The residual of the best similarity: position, scale and rotation of the panorama are arbitrary.
    let n = places.len() as f64;
    let mean = places.iter().fold((Vector2::zeros(), Vector2::zeros()), |m, p| (m.0 + p.0 / n, m.1 + p.1 / n));
    let centered: Vec<_> = places.iter().map(|p| (p.0 - mean.0, p.1 - mean.1)).collect();
    let square: f64 = centered.iter().map(|(a, _)| a.norm_squared()).sum();
    let along: f64 = centered.iter().map(|(a, b)| a.dot(b)).sum::<f64>() / square;
    let across: f64 = centered.iter().map(|(a, b)| a.x * b.y - a.y * b.x).sum::<f64>() / square;
    let drift =
        centered.iter().map(|(a, b)| (Vector2::new(along * a.x - across * a.y, across * a.x + along * a.y) - b).norm());
    let worst = drift.fold(0.0, f64::max);
    // The requirement: a pixel of the photographs, over a map of four of them.
    assert!(worst <= 1.0, "{worst}");
    // The scale of the photographs and upright, within the differences of heights and rotations.
    assert!((along.hypot(across) - 1.0).abs() < 0.1 && across.abs() < 0.1, "{along} {across}");
}
