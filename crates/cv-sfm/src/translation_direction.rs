//! The translation direction of a pair of views with known relative rotation.

use cv_core::{Correspondence, Pose, Rotation3, Vector3};
use cv_geometry::{essential_from_pose, sampson, triangulate};
use cv_numeric::symmetric_eigen;
use nalgebra::Matrix3;

/// Iterations of iteratively reweighted least squares.
const IRLS_ITERATIONS: usize = 10;
/// Lower bound of |sin| of the angle between an epipolar plane and the direction in the L1 weights.
const MIN_SINE: f64 = 1e-3;

/// Estimates the relative pose with a given rotation from matches in normalized coordinates. Returns it with its inlier
/// ratio: matches within `threshold` (Sampson error) and in front of both cameras. `None` without matches or without
/// parallax.
///
/// The translation lies in the epipolar plane of each match: it is the direction most orthogonal to all plane normals
/// in the L1 sense, by iteratively reweighted least squares. O(matches).
pub(crate) fn pose_given_rotation(
    rotation: &Rotation3<f64>,
    matches: &[Correspondence],
    threshold: f64,
) -> Option<(Pose, f64)> {
    let normal = |m: &Correspondence| (rotation * m.a.to_homogeneous()).cross(&m.b.to_homogeneous());
    // Unit length, so that outliers, whose rays are far apart, have no larger weight. Matches without parallax have no
    // normal.
    let normals: Vec<Vector3<f64>> = matches.iter().filter_map(|m| normal(m).try_normalize(threshold)).collect();
    let mut weights = vec![1.0; normals.len()];
    let mut direction = Vector3::zeros();
    for _ in 0..IRLS_ITERATIONS {
        let sum: Matrix3<f64> = normals.iter().zip(&weights).map(|(n, w)| n * n.transpose() * *w).sum();
        let (values, vectors) = symmetric_eigen(&sum);
        // Also without matches.
        if values.max().partial_cmp(&0.0) != Some(std::cmp::Ordering::Greater) {
            return None;
        }
        direction = vectors.column(values.imin()).into_owned();
        weights.iter_mut().zip(&normals).for_each(|(w, n)| *w = 1.0 / n.dot(&direction).abs().max(MIN_SINE));
    }
    let with_inliers = |translation: Vector3<f64>| {
        let pose = Pose::new(*rotation, translation);
        let e = essential_from_pose(&pose);
        let is_inlier = |m: &&Correspondence| sampson(&e, m) <= threshold && triangulate(m, &pose).is_ok();
        (pose, matches.iter().filter(is_inlier).count())
    };
    let (one, other) = (with_inliers(direction), with_inliers(-direction));
    let (pose, count) = if one.1 >= other.1 { one } else { other };
    Some((pose, count as f64 / matches.len() as f64))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Point3;

    #[test]
    fn the_signed_direction_is_estimated_among_outliers() {
        let rotation = Rotation3::from_euler_angles(0.1, -0.3, 0.05);
        let pose = Pose::new(rotation, Vector3::new(0.6, 0.0, -0.8));
        let ray = |p: Point3<f64>| cv_core::Point2::new(p.x / p.z, p.y / p.z);
        let mut matches: Vec<Correspondence> = (0..60)
            .map(|k| Point3::new(f64::from(k % 8) - 4.0, f64::from(k / 8) - 3.0, 7.0 + f64::from(k % 5)))
            .map(|p| Correspondence { a: ray(p), b: ray(pose.transform(&p)) })
            .collect();
        // One match in four is an outlier.
        for k in (0..60).step_by(4) {
            matches[k].b = matches[(k + 31) % 60].b;
        }
        let (estimate, inlier_ratio) = pose_given_rotation(&rotation, &matches, 1e-3).unwrap();
        // Outliers, some tenths off, have some thousandths of an inlier's weight.
        assert!((estimate.translation - pose.translation).norm() < 0.01, "{}", estimate.translation);
        assert!((0.7..0.85).contains(&inlier_ratio), "{inlier_ratio}");
        // With another rotation, there are hardly any inliers.
        let other = Rotation3::from_euler_angles(0.1, 0.3, 0.4);
        assert!(pose_given_rotation(&other, &matches, 1e-3).is_none_or(|f| f.1 < 0.2));
        assert!(pose_given_rotation(&rotation, &[], 1e-3).is_none());
    }
}
