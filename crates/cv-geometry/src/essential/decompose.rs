//! Decomposition of essential matrices into poses.

use crate::epipolar::second_epipole;
use crate::error::{Degeneracy, EstimateError};
use cv_core::{Camera, Correspondence, Matrix3, Pose, Rotation3, Vector3};
use cv_numeric::svd3;

/// Converts a fundamental matrix to the nearest essential matrix: `Kᵦᵀ F Kₐ` with its singular values set to (1, 1, 0)
/// (Hartley & Zisserman, §11.7.3). F relates undistorted pixels.
///
/// # Errors
/// [`EstimateError::Degenerate`] if F is zero or not finite.
pub fn essential_from_fundamental(f: &Matrix3<f64>, a: &Camera, b: &Camera) -> Result<Matrix3<f64>, EstimateError> {
    let degenerate = EstimateError::Degenerate { kind: Degeneracy::Coincident };
    let svd = svd3(&(b.matrix().transpose() * f * a.matrix())).map_err(|_| degenerate)?;
    if svd.s[0] <= 0.0 {
        return Err(degenerate);
    }
    Ok(svd.u.column(0) * svd.v.column(0).transpose() + svd.u.column(1) * svd.v.column(1).transpose())
}

/// Computes the essential matrix `[t]× R` of a relative pose, which maps coordinates of the first camera to those of
/// the second.
pub fn essential_from_pose(pose: &Pose) -> Matrix3<f64> {
    pose.translation.cross_matrix() * pose.rotation.matrix()
}

/// Decomposes an essential matrix into its four poses with translations of length one: both rotations with `t`, then
/// both with `−t` (Hartley & Zisserman, result 9.19).
///
/// # Errors
/// [`EstimateError::Degenerate`] if E is zero or not finite.
pub fn decompose_essential(e: &Matrix3<f64>) -> Result<[Pose; 4], EstimateError> {
    let degenerate = EstimateError::Degenerate { kind: Degeneracy::Coincident };
    let svd = svd3(e).map_err(|_| degenerate)?;
    if svd.s[0] <= 0.0 {
        return Err(degenerate);
    }
    let w = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    // U and V are proper rotations, so these are rotations.
    let r1 = Rotation3::from_matrix_unchecked(svd.u * w * svd.v.transpose());
    let r2 = Rotation3::from_matrix_unchecked(svd.u * w.transpose() * svd.v.transpose());
    let t: Vector3<f64> = svd.u.column(2).into_owned();
    Ok([Pose::new(r1, t), Pose::new(r2, t), Pose::new(r1, -t), Pose::new(r2, -t)])
}

/// Computes the two rotations and the unit translation (up to sign) of an exact essential matrix of any scale, in
/// closed form (Horn, "Recovering baseline and orientation from essential matrix", 1990).
#[inline]
pub(crate) fn rotations_and_translation(e: &Matrix3<f64>) -> (Matrix3<f64>, Matrix3<f64>, Vector3<f64>) {
    let direction = second_epipole(e).normalize();
    let length2 = 0.5 * e.norm_squared();
    let t = direction * length2.sqrt();
    let row = |i: usize| e.row(i).transpose();
    let cofactors = Matrix3::from_rows(&[
        row(1).cross(&row(2)).transpose(),
        row(2).cross(&row(0)).transpose(),
        row(0).cross(&row(1)).transpose(),
    ]);
    let te = t.cross_matrix() * e;
    ((cofactors - te) / length2, (cofactors + te) / length2, direction)
}

/// Tests the cheirality constraint: whether the rays `a` and `b` of a match intersect in front of both cameras.
#[inline]
pub(crate) fn in_front(r: &Matrix3<f64>, t: &Vector3<f64>, a: &Vector3<f64>, b: &Vector3<f64>) -> bool {
    // λ₂ b = λ₁ R a + t, crossed with b and with R a.
    let ra = r * a;
    let n = b.cross(&ra);
    n.dot(&b.cross(t)) < 0.0 && n.dot(&ra.cross(t)) < 0.0
}

/// The pose selected by the cheirality constraint.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RecoveredPose {
    /// First camera frame to second, translation of length one.
    pub pose: Pose,
    /// Indices of the matches in front of both cameras, ascending.
    pub in_front: Vec<usize>,
    /// Number of points in front for the second-best pose. If it is close to that of `in_front`, the choice is
    /// unreliable, because of low parallax.
    pub runner_up: usize,
}

/// Selects the pose of an essential matrix with most points in front of both cameras (cheirality). Matches in
/// normalized coordinates.
///
/// # Errors
/// [`EstimateError`]: no matches, or E is zero or not finite.
pub fn recover_pose(e: &Matrix3<f64>, matches: &[Correspondence]) -> Result<RecoveredPose, EstimateError> {
    if matches.is_empty() {
        return Err(EstimateError::NotEnoughMatches { got: 0, needed: 1 });
    }
    let poses = decompose_essential(e)?;
    let front = poses.map(|pose| {
        let (r, t) = (pose.rotation.matrix(), &pose.translation);
        let is_in_front = |m: &Correspondence| in_front(r, t, &m.a.to_homogeneous(), &m.b.to_homogeneous());
        (0..matches.len()).filter(|&i| is_in_front(&matches[i])).collect::<Vec<_>>()
    });
    let mut best = 0;
    for i in 1..4 {
        if front[i].len() > front[best].len() {
            best = i;
        }
    }
    let runner_up = (0..4).filter(|&i| i != best).map(|i| front[i].len()).max().unwrap_or(0);
    Ok(RecoveredPose { pose: poses[best], in_front: front[best].clone(), runner_up })
}
