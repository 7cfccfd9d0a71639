//! Absolute pose from six or more points by the direct linear transform (DLT).

use super::{WorldMatch, check_world};
use crate::error::{Degeneracy, EstimateError};
use cv_core::{Matrix3, Point3, Pose, Rotation3, Vector3};
use cv_numeric::{svd3, symmetric_eigen};
use nalgebra::{SMatrix, SVector};

/// Estimates the pose, world to camera, of minimum algebraic error from six or more matches in normalized coordinates
/// (DLT, Hartley & Zisserman, §7.1; the rotation is orthonormalized by SVD). An initial value for
/// [`refine_pose`](super::refine_pose).
///
/// # Errors
/// [`EstimateError`]: fewer than six matches, a coordinate that is not finite, or coincident or coplanar world points
/// (use [`pose_three_points`](super::pose_three_points) for coplanar ones).
pub fn pose_from_points(matches: &[WorldMatch]) -> Result<Pose, EstimateError> {
    check_world(matches, 6)?;
    let n = matches.len() as f64;
    let center = matches.iter().map(|m| m.world.coords).sum::<Vector3<f64>>() / n;
    let spread = matches.iter().map(|m| (m.world.coords - center).norm()).sum::<f64>() / n;
    if spread <= 1e-14 * (1.0 + center.norm()) {
        return Err(EstimateError::Degenerate { kind: Degeneracy::Coincident });
    }
    let mut ata = SMatrix::<f64, 12, 12>::zeros();
    for m in matches {
        let p = (m.world.coords - center) / spread;
        let q = [p.x, p.y, p.z, 1.0];
        for (row, coordinate) in [(0, m.image.x), (4, m.image.y)] {
            let mut r = SVector::<f64, 12>::zeros();
            for k in 0..4 {
                r[row + k] = q[k];
                r[8 + k] = -coordinate * q[k];
            }
            ata.ger(1.0, &r, &r, 1.0);
        }
    }
    let (values, vectors) = symmetric_eigen(&ata);
    // Coplanar points have a null space of dimension four. The eigenvalues are squared singular values: 1e-14
    // corresponds to a relative 1e-7.
    if values[1] <= 1e-14 * values[11] {
        return Err(EstimateError::Degenerate { kind: Degeneracy::Planar });
    }
    let v = vectors.column(0);
    let left = Matrix3::from_fn(|i, j| v[4 * i + j]);
    let column = Vector3::new(v[3], v[7], v[11]);
    let planar = EstimateError::Degenerate { kind: Degeneracy::Planar };
    let svd = svd3(&left).map_err(|_| planar)?;
    // The left block is the rotation times a scale; its determinant has the sign of the scale.
    let sign = svd.s[2].signum();
    let scale = sign * (svd.s[0] + svd.s[1] + svd.s[2].abs()) / 3.0;
    // After removing the sign, all singular values are positive.
    let rotation = if sign > 0.0 { svd.u * svd.v.transpose() } else { flip(&svd.u) * svd.v.transpose() };
    let translation = column / scale * spread - rotation * center;
    let pose = Pose::new(Rotation3::from_matrix_unchecked(rotation), translation);
    let front = matches.iter().filter(|m| pose.transform(&Point3::from(m.world.coords)).z > 0.0).count();
    if 2 * front < matches.len() { Err(planar) } else { Ok(pose) }
}

/// Returns −U with its last column restored: the left singular vectors of −M, a proper rotation.
fn flip(u: &Matrix3<f64>) -> Matrix3<f64> {
    let mut flipped = -u;
    flipped.set_column(2, &u.column(2));
    flipped
}
