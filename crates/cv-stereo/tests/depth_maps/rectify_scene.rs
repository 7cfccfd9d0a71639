//! Rectification for a scene in any direction of the baseline.

use cv_core::{Camera, Distortion, Point3, Pose, Rotation3, StereoRig, Vector3};
use cv_stereo::{RectifyError, SceneRectification};
use proptest::prelude::*;

fn rig(angles: [f64; 3], center: Vector3<f64>) -> StereoRig {
    let mut left = Camera::pinhole(640, 480, 520.0, 515.0, 322.0, 236.0);
    left.distortion = Distortion::radial(-0.1, 0.02);
    let right = Camera::pinhole(600, 500, 530.0, 533.0, 310.0, 245.0);
    let rotation = Rotation3::from_euler_angles(angles[0], angles[1], angles[2]);
    StereoRig { left, right, right_from_left: Pose::new(rotation, -(rotation * center)) }
}

/// Points visible in both cameras.
fn points(rig: &StereoRig) -> Vec<Point3<f64>> {
    let inside = |camera: &Camera, p: &Point3<f64>| {
        camera.project(p).is_some_and(|q| {
            q.x > 0.0 && q.y > 0.0 && q.x < camera.width as f64 - 1.0 && q.y < camera.height as f64 - 1.0
        })
    };
    let grid = (0..1000).map(|i| {
        let at = |step: usize| ((i * step) % 997) as f64 / 997.0 - 0.5;
        let z = 5.0 + 4.0 * at(389);
        Point3::new(1.2 * z * at(101), z * at(211), z)
    });
    grid.filter(|p| inside(&rig.left, p) && inside(&rig.right, &rig.right_from_left.transform(p))).collect()
}

proptest! {
    #[test]
    fn scene_points_have_the_same_row_and_the_disparity_of_their_depth(
        angles in (-0.1..0.1f64, -0.1..0.1f64, -1.5..1.5f64), way in 0.0..std::f64::consts::TAU, ahead in -0.3..0.3f64,
    ) {
        // Any direction of the baseline across the optical axis, and any rotation.
        let rig = rig([angles.0, angles.1, angles.2], Vector3::new(way.cos(), way.sin(), ahead));
        let points = points(&rig);
        prop_assume!(points.len() > 200);
        let found = SceneRectification::new(&rig, &points).unwrap();
        let (min, n) = found.disparities;
        let views = &found.views;
        let mut outside = 0;
        for p in &points {
            let a = rig.left.project(p).and_then(|a| views.left.rectified_pixel(a)).unwrap();
            let b = rig.right.project(&rig.right_from_left.transform(p)).and_then(|b| views.right.rectified_pixel(b)).unwrap();
            // Undistorting stops at 1e-13 of the focal length; a thousand pixels lose three digits more.
            prop_assert!((a.y - b.y).abs() < 1e-8, "rows {} and {}", a.y, b.y);
            let depth = (views.left.rotation * p).z;
            prop_assert!((a.x - b.x - views.geometry.disparity(depth)).abs() < 1e-8);
            let shown = |q: cv_core::Point2<f64>, c: &Camera| {
                q.x > -1.0 && q.y > -1.0 && q.x < c.width as f64 && q.y < c.height as f64
            };
            let d = a.x - b.x - f64::from(min);
            outside += usize::from(!(shown(a, &views.left.camera) && shown(b, &views.right.camera) && d >= 0.0 && d < n as f64));
        }
        // All but one percent at either end are inside, and the margins contain most of those.
        prop_assert!(outside <= points.len() / 50, "{outside} of {}", points.len());
    }
}

#[test]
fn the_scale_of_the_views_is_that_of_the_originals() {
    let rig = rig([0.0, 0.3, 0.0], Vector3::new(-1.0, 0.2, 0.1));
    let all = points(&rig);
    let found = SceneRectification::new(&rig, &all).unwrap();
    let area = |camera: &dyn Fn(&Point3<f64>) -> cv_core::Point2<f64>, p: &Point3<f64>| {
        let h = 1e-4;
        // Along two directions perpendicular to the ray.
        let across = p.coords.cross(&Vector3::y()).normalize();
        let other = p.coords.cross(&across).normalize();
        let (u, v) = (camera(&(p + across * h)) - camera(p), camera(&(p + other * h)) - camera(p));
        (u.x * v.y - u.y * v.x).abs()
    };
    let mut ratios: Vec<f64> = all
        .iter()
        .map(|p| {
            let photo = area(&|q| rig.left.project(q).unwrap(), p);
            let view = area(&|q| found.views.left.camera.project(&(found.views.left.rotation * q)).unwrap(), p);
            (view / photo).sqrt()
        })
        .collect();
    ratios.sort_by(f64::total_cmp);
    // The median over both views is one; that of the left one differs by the viewing directions and the distortion.
    let median = ratios[ratios.len() / 2];
    assert!((0.8..1.25).contains(&median), "{median}");
}

#[test]
fn invalid_scenes_are_refused_with_the_reason() {
    let get = |center, points: &[Point3<f64>]| SceneRectification::new(&rig([0.0; 3], center), points).unwrap_err();
    let point = [Point3::new(0.0, 0.0, 5.0)];
    assert!(
        matches!(get(Vector3::new(0.1, 0.0, 1.0), &point), RectifyError::TooFarTurned { degrees, .. } if degrees > 80.0)
    );
    assert!(matches!(get(Vector3::z(), &point), RectifyError::TooFarTurned { degrees: 90.0, .. }));
    assert!(matches!(get(Vector3::zeros(), &point), RectifyError::NoBaseline { .. }));
    assert!(matches!(get(Vector3::x(), &[]), RectifyError::NoOverlap));
    assert!(matches!(get(Vector3::x(), &[Point3::new(0.0, 0.0, -5.0)]), RectifyError::NoOverlap));
    assert!(matches!(get(Vector3::x(), &[Point3::new(f64::NAN, 0.0, f64::NAN)]), RectifyError::NoOverlap));
    // One point has an empty range: only the margin remains.
    let found = SceneRectification::new(&rig([0.0; 3], Vector3::x()), &point).unwrap();
    assert!((9..=12).contains(&found.disparities.1), "{:?}", found.disparities);
}
