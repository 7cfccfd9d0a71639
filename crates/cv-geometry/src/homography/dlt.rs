//! Homography by the normalized direct linear transform (DLT).

use crate::error::{Degeneracy, EstimateError};
use crate::match_blocks::{check_matches, hartley_normalization};
use cv_core::{Correspondence, Matrix3};
use cv_numeric::symmetric_eigen;
use nalgebra::{SMatrix, SVector};

/// Estimates the homography that maps `a` to `b` by the normalized DLT (Hartley & Zisserman, algorithm 4.2), scaled to
/// `H[2][2] = 1` (Frobenius norm 1 if that entry vanishes).
///
/// # Errors
/// [`EstimateError`]: fewer than four matches, a coordinate that is not finite, or coincident or collinear points.
pub fn homography_from_points(matches: &[Correspondence]) -> Result<Matrix3<f64>, EstimateError> {
    check_matches(matches, 4)?;
    let coincident = EstimateError::Degenerate { kind: Degeneracy::Coincident };
    let first = hartley_normalization(matches.iter().map(|m| m.a)).ok_or(coincident)?;
    let second = hartley_normalization(matches.iter().map(|m| m.b)).ok_or(coincident)?;
    let mut ata = SMatrix::<f64, 9, 9>::zeros();
    for m in matches {
        let (p, q) = (first.apply(m.a), second.apply(m.b));
        let (x, y, u, v) = (p.x, p.y, q.x, q.y);
        let rows = [
            SVector::<f64, 9>::from([x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y, -u]),
            SVector::<f64, 9>::from([0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y, -v]),
        ];
        for r in rows {
            ata.ger(1.0, &r, &r, 1.0);
        }
    }
    let (values, vectors) = symmetric_eigen(&ata);
    // A second null vector means a family of homographies. The eigenvalues are squared singular values: 1e-12
    // corresponds to 1e-6 of the coordinates, above rounding and below measurement noise.
    if values[1] <= 1e-12 * values[8] {
        return Err(EstimateError::Degenerate { kind: Degeneracy::Collinear });
    }
    let h = Matrix3::from_row_slice(vectors.column(0).as_slice());
    let h = second.inverse_matrix() * h * first.matrix();
    // Points that are collinear in one image only have a singular homography.
    if h.determinant().abs() <= 1e-12 * determinant_bound(&h) {
        return Err(EstimateError::Degenerate { kind: Degeneracy::Collinear });
    }
    Ok(normalize_scale(&h))
}

/// Computes the product of the row norms, an upper bound of the determinant (Hadamard).
fn determinant_bound(h: &Matrix3<f64>) -> f64 {
    (0..3).map(|r| h.row(r).norm()).product()
}

/// Scales a homography to `H[2][2] = 1`, or to Frobenius norm 1 if that entry vanishes.
pub(crate) fn normalize_scale(h: &Matrix3<f64>) -> Matrix3<f64> {
    let norm = h.norm();
    let corner = h[(2, 2)];
    if corner.abs() > 1e-12 * norm { h / corner } else { h / norm }
}
