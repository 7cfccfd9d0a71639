//! Depth and points from disparities.

use cv_core::{GrayF32, Image};
use cv_stereo::{GeometryError, StereoGeometry};

const GEOMETRY: StereoGeometry = StereoGeometry { focal: 500.0, cx: 320.0, cy: 240.0, baseline: 0.12, offset: 3.0 };

#[test]
fn a_point_comes_back_from_its_two_projections() {
    // A point 2 m ahead, 0.5 m right, 0.3 m up, projected into both cameras of the geometry.
    let (x, y, z) = (0.5, -0.3, 2.0);
    let left = 500.0 * x / z + 320.0;
    let right = 500.0 * (x - 0.12) / z + 323.0;
    let row = 500.0 * y / z + 240.0;
    let d = left - right;
    let h = GEOMETRY.q() * nalgebra::Vector4::new(left, row, d, 1.0);
    // f64 arithmetic on numbers below a thousand.
    assert!((h.xyz() / h.w - nalgebra::Vector3::new(x, y, z)).norm() < 1e-12);
    assert!((GEOMETRY.depth(d as f32) - 2.0).abs() < 1e-5);
    assert!((GEOMETRY.disparity(2.0) - d).abs() < 1e-12);
}

#[test]
fn the_cloud_and_q_agree_and_holes_stay_out() {
    let mut d = GrayF32::new(4, 2, [27.0]);
    d.set(1, 1, [f32::NAN]);
    d.set(2, 1, [-3.0]);
    let rgb = Image::<u8, 3>::from_fn(4, 2, |x, y| [x as u8, y as u8, 9]);
    let depth = GEOMETRY.depth_map(d.view(), (0.1, 100.0));
    let cloud = GEOMETRY.cloud(depth.view(), rgb.view());
    assert_eq!(cloud.len(), 6);
    assert_eq!(cloud.colors[5], [3, 1, 9]);
    let h = GEOMETRY.q() * nalgebra::Vector4::new(3.0, 1.0, 27.0, 1.0);
    for (axis, p) in cloud.positions[5].iter().enumerate() {
        // Six digits of f32 on a value of at most 2.
        assert!((f64::from(*p) - h[axis] / h.w).abs() < 1e-6);
    }
    assert!(GEOMETRY.depth_map(d.view(), (2.5, 9.0)).as_slice().iter().all(|z| z.is_nan()));
}

#[test]
fn the_uncertainty_is_the_slope_of_depth() {
    let z = GEOMETRY.depth(20.0);
    let slope = (GEOMETRY.depth(19.99) - GEOMETRY.depth(20.01)) / 2.0;
    // A central difference over 0.01 px: relative truncation (0.01/23)², f32 rounding 1e-6 of 2.6 over 1e-3.
    assert!((GEOMETRY.depth_uncertainty(z, 0.01) / slope - 1.0).abs() < 1e-3);
}

#[test]
fn nonsense_is_named() {
    assert!(matches!(StereoGeometry::from_focal(4, 4, 0.0, 1.0), Err(GeometryError::NotPositive { focal: 0.0, .. })));
    assert!(matches!(StereoGeometry { cx: f64::NAN, ..GEOMETRY }.validate(), Err(GeometryError::NotFinite { .. })));
}
