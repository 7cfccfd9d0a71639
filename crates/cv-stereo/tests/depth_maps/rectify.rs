//! Rectification of calibrated rigs.

use cv_core::{Camera, Distortion, OptionError, Point2, Point3, Pose, Rotation3, StereoRig, Vector3};
use cv_stereo::{Rectification, RectifyError, RectifyOptions};
use proptest::prelude::*;

fn rig(angles: (f64, f64, f64), center: Vector3<f64>, k1: f64) -> StereoRig {
    let mut left = Camera::pinhole(640, 480, 520.0, 515.0, 322.0, 236.0);
    left.distortion = Distortion::radial_tangential4([k1, 0.05, 0.001, -0.001]);
    let mut right = Camera::pinhole(640, 480, 530.0, 533.0, 310.0, 245.0);
    right.distortion = Distortion::radial(k1 * 0.9, 0.03);
    let rotation = Rotation3::from_euler_angles(angles.0, angles.1, angles.2);
    StereoRig { left, right, right_from_left: Pose::new(rotation, -(rotation * center)) }
}

proptest! {
    #[test]
    fn a_scene_point_has_the_same_row_and_the_disparity_of_its_depth(
        angles in (-0.1..0.1f64, -0.1..0.1f64, -0.1..0.1f64),
        offset in (-0.02..0.02f64, -0.02..0.02f64),
        vertical in any::<bool>(),
        alpha in 0.0..1.0f64,
        k1 in -0.2..0.05f64,
        p in (-0.4..0.4f64, -0.3..0.3f64, 2.0..6.0f64),
    ) {
        let center = if vertical { Vector3::new(offset.0, 0.2, offset.1) } else { Vector3::new(0.2, offset.0, offset.1) };
        let rig = rig(angles, center, k1);
        let rectified = Rectification::new(&rig, &RectifyOptions { alpha, size: None }).unwrap();
        prop_assert_eq!(rectified.vertical, vertical);
        let point = Point3::new(p.0, p.1, p.2);
        let (Some(a), Some(b)) = (rig.left.project(&point), rig.right.project(&rig.right_from_left.transform(&point))) else {
            return Ok(());
        };
        let a = rectified.left.rectified_pixel(a).unwrap();
        let b = rectified.right.rectified_pixel(b).unwrap();
        // Undistorting stops at 1e-13 of the focal length; a thousand pixels lose three digits more.
        prop_assert!((a.y - b.y).abs() < 1e-8, "rows {} and {}", a.y, b.y);
        let depth = (rectified.left.rotation * point).z;
        prop_assert!((a.x - b.x - rectified.geometry.disparity(depth)).abs() < 1e-8);
    }

    #[test]
    fn rectified_and_original_pixels_map_to_each_other(
        angles in (-0.1..0.1f64, -0.1..0.1f64, -0.1..0.1f64), x in 100.0..540.0f64, y in 100.0..380.0f64,
    ) {
        let rig = rig(angles, Vector3::new(0.1, 0.0, 0.0), -0.1);
        let rectified = Rectification::new(&rig, &RectifyOptions::default()).unwrap();
        for view in [&rectified.left, &rectified.right] {
            let there = view.rectified_pixel(Point2::new(x, y)).unwrap();
            let back = view.source_pixel(there).unwrap();
            prop_assert!((back - Point2::new(x, y)).norm() < 1e-8);
        }
    }
}

#[test]
fn alpha_0_has_no_invalid_pixels_and_alpha_1_keeps_every_pixel() {
    let rig = rig((0.02, -0.03, 0.01), Vector3::new(0.1, 0.005, -0.002), -0.15);
    let tight = Rectification::new(&rig, &RectifyOptions::default()).unwrap();
    assert_eq!(tight.valid_area(), (1.0, 1.0));
    let wide = Rectification::new(&rig, &RectifyOptions { alpha: 1.0, size: None }).unwrap();
    for view in [wide.left, wide.right] {
        for corner in [(0.0, 0.0), (639.0, 0.0), (0.0, 479.0), (639.0, 479.0), (320.0, 0.0), (0.0, 240.0)] {
            let p = view.rectified_pixel(Point2::new(corner.0, corner.1)).unwrap();
            // Rounding at the very border.
            assert!(p.x > -1e-9 && p.y > -1e-9 && p.x < 639.0 + 1e-9 && p.y < 479.0 + 1e-9, "{corner:?} to {p}");
        }
    }
    assert!(wide.valid_area().0 < 0.99 && wide.geometry.focal < tight.geometry.focal);
}

#[test]
fn a_tilted_rig_has_the_largest_inscribed_view() {
    let camera = Camera::from_focal(641, 481, 500.0);
    for degrees in [0.0_f64, 2.0, 10.0, 30.0, 43.0, 50.0, 80.0] {
        let (sin, cos) = degrees.to_radians().sin_cos();
        let pose = Pose::new(Rotation3::identity(), -Vector3::new(0.1 * cos, 0.1 * sin, 0.0));
        let rig = StereoRig { left: camera, right: camera, right_from_left: pose };
        let rectified = Rectification::new(&rig, &RectifyOptions::default()).unwrap();
        assert_eq!(rectified.valid_area(), (1.0, 1.0), "{degrees}");
        // A rectangle of half the sides (w, h), turned, in one of (320, 240): each of its corners inside.
        let (w, h) = if rectified.vertical { (240.0, 320.0) } else { (320.0, 240.0) };
        let fits = (320.0 / (w * cos + h * sin)).min(240.0 / (w * sin + h * cos));
        // Undistorting is exact here; the border's points and a margin of 1e-9 are not.
        assert!(
            (rectified.geometry.focal / (500.0 / fits) - 1.0).abs() < 1e-8,
            "{degrees}: {}",
            rectified.geometry.focal
        );
    }
}

#[test]
fn a_rectified_pair_is_unchanged() {
    let camera = Camera::from_focal(320, 240, 300.0);
    let pose = Pose::new(Rotation3::identity(), Vector3::new(-0.1, 0.0, 0.0));
    let rig = StereoRig { left: camera, right: camera, right_from_left: pose };
    let rectified = Rectification::new(&rig, &RectifyOptions::default()).unwrap();
    let p = rectified.left.source_pixel(Point2::new(17.0, 200.0)).unwrap();
    assert!((p - Point2::new(17.0, 200.0)).norm() < 1e-9);
    assert!((rectified.geometry.baseline - 0.1).abs() < 1e-15 && (rectified.geometry.focal - 300.0).abs() < 1e-9);
}

#[test]
fn distances_are_printed_with_four_digits() {
    let text = |distance, vertical| RectifyError::Exchanged { distance, vertical }.to_string();
    assert_eq!(text(0.20000000000000004, true), "the second camera is 0.2 above the first: they are exchanged");
    assert!(text(123456.7, false).contains(" 123500 left of"));
}

#[test]
fn invalid_rigs_are_refused_with_the_reason() {
    let refuse =
        |angles, center| Rectification::new(&rig(angles, center, 0.0), &RectifyOptions::default()).unwrap_err();
    assert!(matches!(refuse((0.0, 0.0, 0.0), Vector3::zeros()), RectifyError::NoBaseline { baseline: 0.0 }));
    assert!(matches!(
        refuse((0.0, 0.0, 0.0), Vector3::new(-0.2, 0.0, 0.0)),
        RectifyError::Exchanged { vertical: false, .. }
    ));
    assert!(matches!(
        refuse((0.0, 0.0, 0.0), Vector3::new(0.0, -0.2, 0.0)),
        RectifyError::Exchanged { vertical: true, .. }
    ));
    assert!(matches!(refuse((0.0, 0.0, 0.0), Vector3::new(0.01, 0.0, 0.2)), RectifyError::TooFarTurned { .. }));
    assert!(matches!(refuse((0.0, 2.6, 0.0), Vector3::new(0.2, 0.0, 0.0)), RectifyError::TooFarTurned { .. }));
    let mut broken = rig((0.0, 0.0, 0.0), Vector3::new(0.2, 0.0, 0.0), 0.0);
    broken.right.fx = f64::NAN;
    assert!(matches!(
        Rectification::new(&broken, &RectifyOptions::default()),
        Err(RectifyError::Camera { side: "right", .. })
    ));
    let fine = rig((0.0, 0.0, 0.0), Vector3::new(0.2, 0.0, 0.0), 0.0);
    assert!(matches!(
        Rectification::new(&fine, &RectifyOptions { alpha: 1.5, size: None }),
        Err(RectifyError::Option(OptionError { name: "alpha", .. }))
    ));
}
