//! The normalized eight-point algorithm.

use super::seven_point::epipolar_row;
use crate::error::{Degeneracy, EstimateError};
use crate::match_blocks::{check_matches, hartley_normalization};
use cv_core::{Correspondence, Matrix3};
use cv_numeric::{null_space, smallest_eigenvector, svd3, symmetric_eigen};
use nalgebra::{SMatrix, SVector};

/// Estimates the fundamental matrix of minimum algebraic error from eight or more matches by the normalized eight-point
/// algorithm (Hartley, "In defense of the eight-point algorithm", 1997). Rank 2 is enforced by SVD.
///
/// `bᵀ F a = 0`; Frobenius norm 1, the entry of largest magnitude positive.
///
/// # Errors
/// [`EstimateError`]: fewer than eight matches, a coordinate that is not finite, or a degenerate configuration:
/// coincident points, or a planar scene.
pub fn fundamental_eight_point(matches: &[Correspondence]) -> Result<Matrix3<f64>, EstimateError> {
    check_matches(matches, 8)?;
    let coincident = EstimateError::Degenerate { kind: Degeneracy::Coincident };
    let planar = EstimateError::Degenerate { kind: Degeneracy::Planar };
    let first = hartley_normalization(matches.iter().map(|m| m.a)).ok_or(coincident)?;
    let second = hartley_normalization(matches.iter().map(|m| m.b)).ok_or(coincident)?;
    let row = |m: &Correspondence| epipolar_row(first.apply(m.a), second.apply(m.b));
    let f = if let [m0, m1, m2, m3, m4, m5, m6, m7] = matches {
        let rows = [m0, m1, m2, m3, m4, m5, m6, m7].map(row);
        null_space::<8, 9, 1>(rows).ok_or(planar)?[0]
    } else {
        let mut ata = SMatrix::<f64, 9, 9>::zeros();
        for m in matches {
            let r = SVector::from(row(m));
            ata.ger(1.0, &r, &r, 1.0);
        }
        // A planar scene has a null space of dimension three. The eigenvalues are squared singular values: 1e-14
        // corresponds to a relative 1e-7.
        let values = symmetric_eigen(&ata).0;
        if values[1] <= 1e-14 * values[8] {
            return Err(planar);
        }
        smallest_eigenvector(&ata).map_err(|_| planar)?.into()
    };
    let rank_two = enforce_rank_two(&Matrix3::from_row_slice(&f)).ok_or(planar)?;
    Ok(normalize_scale_and_sign(&(second.matrix().transpose() * rank_two * first.matrix())))
}

/// Returns the nearest matrix of rank two in the Frobenius norm; `None` if the rank is below two.
pub(crate) fn enforce_rank_two(f: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let svd = svd3(f).ok()?;
    let smallest = svd.u.column(2) * svd.v.column(2).transpose() * svd.s[2];
    (svd.s[1] > 1e-14 * svd.s[0]).then(|| f - smallest)
}

/// Scales a matrix to Frobenius norm 1 and makes its entry of largest magnitude positive.
pub(crate) fn normalize_scale_and_sign(f: &Matrix3<f64>) -> Matrix3<f64> {
    let largest = f.iter().fold(0.0f64, |m, v| if v.abs() > m.abs() { *v } else { m });
    f * (1.0 / f.norm()).copysign(largest)
}
