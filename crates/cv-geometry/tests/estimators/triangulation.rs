//! Triangulation of exact and noisy matches.

use crate::testing::TwoViews;
use cv_core::{Correspondence, Point2, Point3, Pose, Rotation3, Vector3};
use cv_geometry::{TriangulationError, correct_match, parallax_angle, triangulate, triangulate_linear};
use proptest::prelude::*;

fn reprojection2(point: &Point3<f64>, m: &Correspondence, pose: &Pose) -> f64 {
    let q = pose.transform(point);
    let p = Point2::new(point.x / point.z, point.y / point.z);
    (p - m.a).norm_squared() + (Point2::new(q.x / q.z, q.y / q.z) - m.b).norm_squared()
}

proptest! {
    #[test]
    fn exact_matches_triangulate_to_the_exact_point(seed: u64) {
        let views = TwoViews::random(seed);
        let (point, m) = views.point(None);
        let m = views.normalize(&m);
        prop_assume!(parallax_angle(&point, &views.pose) > 0.01);
        // Rounding of the rays divided by the parallax.
        prop_assert!((triangulate(&m, &views.pose).unwrap() - point).norm() < 1e-9);
        let linear = triangulate_linear(&[(m.a, Pose::identity()), (m.b, views.pose)]).unwrap();
        // The normal equations square the condition number.
        prop_assert!((linear - point).norm() < 1e-6);
    }

    #[test]
    fn the_point_is_a_minimum_of_the_reprojection_error(seed: u64) {
        let views = TwoViews::random(seed);
        let m = &views.normalized_matches(1, 2e-3)[0];
        let Ok(point) = triangulate(m, &views.pose) else { return Ok(()) };
        prop_assume!(parallax_angle(&point, &views.pose) > 0.02);
        let best = reprojection2(&point, m, &views.pose);
        for d in [Vector3::x(), Vector3::y(), Vector3::z()] {
            for s in [-1e-3, 1e-3] {
                // The correction is accurate to about 1e-6 of the error.
                prop_assert!(reprojection2(&(point + d * s), m, &views.pose) > best * (1.0 - 1e-5));
            }
        }
        let corrected = correct_match(&views.essential(), m);
        let e = views.essential();
        prop_assert!(corrected.b.to_homogeneous().dot(&(e * corrected.a.to_homogeneous())).abs() < 1e-9);
    }
}

#[test]
fn invalid_configurations_are_typed_errors() {
    let pose = Pose::new(Rotation3::identity(), Vector3::new(-1.0, 0.0, 0.0));
    let at = |x1: f64, x2: f64| triangulate(&Correspondence::new(x1, 0.0, x2, 0.0), &pose);
    // Disparity 0.1 at a baseline of 1: depth 10. Zero: at infinity. Negative: behind.
    assert!((at(0.1, 0.0).unwrap() - Point3::new(1.0, 0.0, 10.0)).norm() < 1e-12);
    assert_eq!(at(0.1, 0.1), Err(TriangulationError::Parallel));
    assert_eq!(at(0.0, 0.1), Err(TriangulationError::Behind));
    assert_eq!(at(f64::NAN, 0.1), Err(TriangulationError::Parallel));
    assert_eq!(triangulate_linear(&[]), Err(TriangulationError::TooFewViews { got: 0 }));
    let behind = [(Point2::new(0.0, 0.0), Pose::identity()), (Point2::new(0.1, 0.0), pose)];
    assert_eq!(triangulate_linear(&behind), Err(TriangulationError::Behind));
    // The point (0, 0, 1) is at −1/z in a camera one unit to the right: 45 degrees.
    assert!((parallax_angle(&Point3::new(0.0, 0.0, 1.0), &pose) - std::f64::consts::FRAC_PI_4).abs() < 1e-12);
}
