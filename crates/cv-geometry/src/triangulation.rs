//! Points from two or more views.

use crate::essential::essential_from_pose;
use cv_core::{Correspondence, Matrix3, Point2, Point3, Pose, Vector3};
use cv_numeric::smallest_eigenvector;
use nalgebra::Matrix4;

/// Why a point could not be triangulated.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum TriangulationError {
    /// There is nothing to triangulate from.
    #[error("{got} views of a point are too few: 2 are needed")]
    TooFewViews {
        /// Number of views.
        got: usize,
    },
    /// The rays are parallel, or a coordinate is not finite: the point is at infinity.
    #[error("the rays are parallel: the point is infinitely far away")]
    Parallel,
    /// The rays meet behind a camera.
    #[error("the rays meet behind a camera")]
    Behind,
}

/// The point of least squared image error in two views, in the frame of the first.
///
/// `m` in normalized coordinates; `pose` maps the first camera's frame to the second's. The match is moved to the nearest one
/// (in the sum of squared distances) that obeys the epipolar geometry, in two steps that are exact to about 1e-6 of the error
/// (Lindstrom, "Triangulation made easy", 2010, `niter2`), and its rays are intersected.
///
/// # Errors
/// [`TriangulationError`]: parallel rays, or rays that meet behind a camera.
pub fn triangulate(m: &Correspondence, pose: &Pose) -> Result<Point3<f64>, TriangulationError> {
    let corrected = correct_match(&essential_from_pose(pose), m);
    intersect(&corrected, pose)
}

/// The match nearest to `m` with `bᵀ E a = 0`, in the sum of squared distances (Lindstrom 2010, `niter2`).
pub fn correct_match(e: &Matrix3<f64>, m: &Correspondence) -> Correspondence {
    let (a, b) = (m.a.to_homogeneous(), m.b.to_homogeneous());
    let corner = e.fixed_view::<2, 2>(0, 0);
    let (mut n, mut k) = ((e * a).xy(), (e.transpose() * b).xy());
    let quadratic = n.dot(&(corner * k));
    let half = 0.5 * (n.norm_squared() + k.norm_squared());
    let c = b.dot(&(e * a));
    let d = (half * half - quadratic * c).max(0.0).sqrt();
    // Both points are epipoles: nothing moves.
    if half + d <= 0.0 {
        return *m;
    }
    let mut lambda = c / (half + d);
    let (db, da) = (n * lambda, k * lambda);
    n -= corner * da;
    k -= corner.transpose() * db;
    lambda *= 2.0 * d / (n.norm_squared() + k.norm_squared());
    Correspondence { a: m.a - k * lambda, b: m.b - n * lambda }
}

/// The point where the rays of an exact match meet: for noisy ones, on the first ray, where the second passes it in the
/// least-squares sense.
fn intersect(m: &Correspondence, pose: &Pose) -> Result<Point3<f64>, TriangulationError> {
    let (a, b) = (m.a.to_homogeneous(), m.b.to_homogeneous());
    let ra = pose.rotation * a;
    let t = pose.translation;
    // λ₂ b = λ₁ R a + t, crossed with b and with R a.
    let n = b.cross(&ra);
    let n2 = n.norm_squared();
    // The squared sine of the angle between the rays: 1e-16 is 1e-8 radians, where f64 rays are parallel.
    if n2.is_nan() || n2 <= 1e-16 * ra.norm_squared() * b.norm_squared() {
        return Err(TriangulationError::Parallel);
    }
    let first = -n.dot(&b.cross(&t)) / n2;
    let second = -n.dot(&ra.cross(&t)) / n2;
    if first > 0.0 && second > 0.0 { Ok(Point3::from(a * first)) } else { Err(TriangulationError::Behind) }
}

/// The point of least algebraic error in any number of views (Hartley & Zisserman, §12.2), in the world's frame.
///
/// Each view is a normalized image point and its pose. A start for refinement: [`triangulate`] is better where there are two.
///
/// # Errors
/// [`TriangulationError`]: fewer than two views, parallel rays, or a point behind one of the cameras.
pub fn triangulate_linear(views: &[(Point2<f64>, Pose)]) -> Result<Point3<f64>, TriangulationError> {
    if views.len() < 2 {
        return Err(TriangulationError::TooFewViews { got: views.len() });
    }
    let mut ata = Matrix4::zeros();
    for (p, pose) in views {
        let m = pose.matrix();
        for row in [m.row(2) * p.x - m.row(0), m.row(2) * p.y - m.row(1)] {
            // Of unit length, so that far cameras do not outweigh near ones.
            let row = row.normalize();
            ata += row.transpose() * row;
        }
    }
    let v = smallest_eigenvector(&ata).map_err(|_| TriangulationError::Parallel)?;
    let x = Vector3::new(v[0], v[1], v[2]);
    if v[3].abs() <= 1e-12 * x.norm() {
        return Err(TriangulationError::Parallel);
    }
    let point = Point3::from(x / v[3]);
    let front = views.iter().all(|(_, pose)| pose.transform(&point).z > 0.0);
    if front { Ok(point) } else { Err(TriangulationError::Behind) }
}

/// The angle between the two rays to a point, in radians; the point in the first camera's frame.
pub fn parallax_angle(point: &Point3<f64>, pose: &Pose) -> f64 {
    let (a, b) = (point.coords, point - pose.center());
    a.cross(&b).norm().atan2(a.dot(&b))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::TwoViews;
    use proptest::prelude::*;

    fn reprojection2(point: &Point3<f64>, m: &Correspondence, pose: &Pose) -> f64 {
        let q = pose.transform(point);
        let p = Point2::new(point.x / point.z, point.y / point.z);
        (p - m.a).norm_squared() + (Point2::new(q.x / q.z, q.y / q.z) - m.b).norm_squared()
    }

    proptest! {
        #[test]
        fn exact_matches_give_the_exact_point(seed: u64) {
            let views = TwoViews::random(seed);
            let (point, m) = views.point(None);
            let m = views.normalize(&m);
            prop_assume!(parallax_angle(&point, &views.pose) > 0.01);
            // Rounding of the rays over the parallax.
            prop_assert!((triangulate(&m, &views.pose).unwrap() - point).norm() < 1e-9);
            let linear = triangulate_linear(&[(m.a, Pose::identity()), (m.b, views.pose)]).unwrap();
            // Squared condition.
            prop_assert!((linear - point).norm() < 1e-6);
        }

        #[test]
        fn nothing_near_it_fits_a_noisy_match_better(seed: u64) {
            let views = TwoViews::random(seed);
            let m = &views.normalized_matches(1, 2e-3)[0];
            let Ok(point) = triangulate(m, &views.pose) else { return Ok(()) };
            prop_assume!(parallax_angle(&point, &views.pose) > 0.02);
            let best = reprojection2(&point, m, &views.pose);
            for d in [Vector3::x(), Vector3::y(), Vector3::z()] {
                for s in [-1e-3, 1e-3] {
                    // The closed form is good to about 1e-6 of the error itself.
                    prop_assert!(reprojection2(&(point + d * s), m, &views.pose) > best * (1.0 - 1e-5));
                }
            }
            let corrected = correct_match(&views.essential(), m);
            let e = views.essential();
            prop_assert!(corrected.b.to_homogeneous().dot(&(e * corrected.a.to_homogeneous())).abs() < 1e-9);
        }
    }

    #[test]
    fn points_that_cannot_be_are_told() {
        let pose = Pose::new(cv_core::Rotation3::identity(), Vector3::new(-1.0, 0.0, 0.0));
        let at = |x1: f64, x2: f64| triangulate(&Correspondence::new(x1, 0.0, x2, 0.0), &pose);
        // Disparity 0.1 at a base line of 1: ten units away. None: infinitely far. Negative: behind.
        assert!((at(0.1, 0.0).unwrap() - Point3::new(1.0, 0.0, 10.0)).norm() < 1e-12);
        assert_eq!(at(0.1, 0.1), Err(TriangulationError::Parallel));
        assert_eq!(at(0.0, 0.1), Err(TriangulationError::Behind));
        assert_eq!(at(f64::NAN, 0.1), Err(TriangulationError::Parallel));
        assert_eq!(triangulate_linear(&[]), Err(TriangulationError::TooFewViews { got: 0 }));
        let behind = [(Point2::new(0.0, 0.0), Pose::identity()), (Point2::new(0.1, 0.0), pose)];
        assert_eq!(triangulate_linear(&behind), Err(TriangulationError::Behind));
        // A point straight ahead of a camera one unit to the right is seen at −1/z: at 45 degrees from (0, 0, 1).
        assert!((parallax_angle(&Point3::new(0.0, 0.0, 1.0), &pose) - std::f64::consts::FRAC_PI_4).abs() < 1e-12);
    }
}
