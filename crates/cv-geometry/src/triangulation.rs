//! Triangulation of points from two or more views.

use crate::essential::essential_from_pose;
use cv_core::{Correspondence, Matrix3, Point2, Point3, Pose, Vector3};
use cv_numeric::smallest_eigenvector;
use nalgebra::Matrix4;

/// Why a point could not be triangulated.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum TriangulationError {
    /// There are fewer than two views.
    #[error("{got} views of a point are too few: 2 are needed")]
    TooFewViews {
        /// Number of views.
        got: usize,
    },
    /// The rays are parallel, or a coordinate is not finite.
    #[error("the rays are parallel: the point is at infinity")]
    Parallel,
    /// The rays intersect behind a camera.
    #[error("the rays intersect behind a camera")]
    Behind,
}

/// Triangulates the point of minimum squared reprojection error in two views, in the frame of the first camera.
///
/// `m` in normalized coordinates; `pose` maps the first camera's frame to the second's. The match is corrected to the
/// nearest one that satisfies the epipolar constraint ([`correct_match`]), and its rays are intersected.
///
/// # Errors
/// [`TriangulationError`]: parallel rays, or rays that intersect behind a camera.
pub fn triangulate(m: &Correspondence, pose: &Pose) -> Result<Point3<f64>, TriangulationError> {
    let corrected = correct_match(&essential_from_pose(pose), m);
    intersect(&corrected, pose)
}

/// Computes the match nearest to `m`, in the sum of squared distances, with `bᵀ E a = 0`, in two iterations that are
/// accurate to about 1e-6 of the correction (Lindstrom, "Triangulation made easy", 2010, `niter2`).
pub fn correct_match(e: &Matrix3<f64>, m: &Correspondence) -> Correspondence {
    let (a, b) = (m.a.to_homogeneous(), m.b.to_homogeneous());
    let corner = e.fixed_view::<2, 2>(0, 0);
    let (mut n, mut k) = ((e * a).xy(), (e.transpose() * b).xy());
    let quadratic = n.dot(&(corner * k));
    let half = 0.5 * (n.norm_squared() + k.norm_squared());
    let c = b.dot(&(e * a));
    let d = (half * half - quadratic * c).max(0.0).sqrt();
    // Both points are epipoles: the constraint is satisfied.
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

/// Intersects the rays of an exact match; for noisy ones, the result is on the first ray.
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

/// Triangulates the point of minimum algebraic error in any number of views (DLT; Hartley & Zisserman, §12.2), in the
/// world frame.
///
/// Each view is a normalized image point and its pose (world to camera). An initial value for refinement;
/// [`triangulate`] is more accurate for two views.
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
            // Normalized, so that all cameras have the same weight.
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

/// Computes the parallax angle between the two rays to a point, in radians; the point is in the first camera's frame.
pub fn parallax_angle(point: &Point3<f64>, pose: &Pose) -> f64 {
    let (a, b) = (point.coords, point - pose.center());
    a.cross(&b).norm().atan2(a.dot(&b))
}
