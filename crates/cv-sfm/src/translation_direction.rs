//! The direction between two views whose rotation is known.

use cv_core::{Correspondence, Pose, Rotation3, Vector3};
use cv_geometry::{essential_from_pose, sampson, triangulate};
use cv_numeric::symmetric_eigen;
use nalgebra::Matrix3;

/// Rounds of reweighting.
const ROUNDS: usize = 10;
/// The sine of an angle between a plane and the direction below which all planes count the same.
const NEAR: f64 = 1e-3;

/// The motion with a given rotation that most matches (in normalized coordinates) agree with, and the share of them that does: within `threshold`, in front of both cameras. `None` without
/// matches, or where they all are where the rotation alone puts them.
///
/// Each match says that the translation is in the plane of its two rays: the direction most nearly at right angles to all normals of such planes, those that it is far from counting less.
/// O(matches).
pub(crate) fn motion_of_rotation(
    rotation: &Rotation3<f64>,
    matches: &[Correspondence],
    threshold: f64,
) -> Option<(Pose, f64)> {
    let normal = |m: &Correspondence| (rotation * m.a.to_homogeneous()).cross(&m.b.to_homogeneous());
    // Of length one, so that wrong matches, whose rays are far apart, do not count more; matches that did not move say nothing.
    let normals: Vec<Vector3<f64>> = matches.iter().filter_map(|m| normal(m).try_normalize(threshold)).collect();
    let mut weights = vec![1.0; normals.len()];
    let mut direction = Vector3::zeros();
    for _ in 0..ROUNDS {
        let sum: Matrix3<f64> = normals.iter().zip(&weights).map(|(n, w)| n * n.transpose() * *w).sum();
        let (values, vectors) = symmetric_eigen(&sum);
        // Without matches, too.
        if values.max().partial_cmp(&0.0) != Some(std::cmp::Ordering::Greater) {
            return None;
        }
        direction = vectors.column(values.imin()).into_owned();
        weights.iter_mut().zip(&normals).for_each(|(w, n)| *w = 1.0 / n.dot(&direction).abs().max(NEAR));
    }
    let agreeing = |translation: Vector3<f64>| {
        let pose = Pose::new(*rotation, translation);
        let e = essential_from_pose(&pose);
        let agrees = |m: &&Correspondence| sampson(&e, m) <= threshold && triangulate(m, &pose).is_ok();
        (pose, matches.iter().filter(agrees).count())
    };
    let (one, other) = (agreeing(direction), agreeing(-direction));
    let (pose, count) = if one.1 >= other.1 { one } else { other };
    Some((pose, count as f64 / matches.len() as f64))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Point3;

    #[test]
    fn the_direction_is_found_among_wrong_matches_and_its_sign_too() {
        let rotation = Rotation3::from_euler_angles(0.1, -0.3, 0.05);
        let pose = Pose::new(rotation, Vector3::new(0.6, 0.0, -0.8));
        let ray = |p: Point3<f64>| cv_core::Point2::new(p.x / p.z, p.y / p.z);
        let mut matches: Vec<Correspondence> = (0..60)
            .map(|k| Point3::new(f64::from(k % 8) - 4.0, f64::from(k / 8) - 3.0, 7.0 + f64::from(k % 5)))
            .map(|p| Correspondence { a: ray(p), b: ray(pose.transform(&p)) })
            .collect();
        // One match in four is wrong.
        for k in (0..60).step_by(4) {
            matches[k].b = matches[(k + 31) % 60].b;
        }
        let (found, share) = motion_of_rotation(&rotation, &matches, 1e-3).unwrap();
        // Wrong matches, some tenths off, count some thousandths of right ones.
        assert!((found.translation - pose.translation).norm() < 0.01, "{}", found.translation);
        assert!((0.7..0.85).contains(&share), "{share}");
        // With another rotation, hardly any match agrees.
        let other = Rotation3::from_euler_angles(0.1, 0.3, 0.4);
        assert!(motion_of_rotation(&other, &matches, 1e-3).is_none_or(|f| f.1 < 0.2));
        assert!(motion_of_rotation(&rotation, &[], 1e-3).is_none());
    }
}
