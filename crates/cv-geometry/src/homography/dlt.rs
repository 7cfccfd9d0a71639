//! Homography through many points by the normalized direct linear transform.

use crate::error::{Degeneracy, EstimateError};
use crate::match_blocks::{check, hartley};
use cv_core::{Correspondence, Matrix3};
use cv_numeric::symmetric_eigen;
use nalgebra::{SMatrix, SVector};

/// The homography that takes `a` to `b` in the algebraic least-squares sense (Hartley & Zisserman, algorithm 4.2),
/// scaled so that `H[2][2] = 1` (Frobenius norm 1 where that entry vanishes).
///
/// # Errors
/// [`EstimateError`] where there are fewer than four matches, a coordinate is not finite, or the points do not determine a
/// homography (coincident or collinear).
pub fn homography_from_points(matches: &[Correspondence]) -> Result<Matrix3<f64>, EstimateError> {
    check(matches, 4)?;
    let coincident = EstimateError::Degenerate { kind: Degeneracy::Coincident };
    let first = hartley(matches.iter().map(|m| m.a)).ok_or(coincident)?;
    let second = hartley(matches.iter().map(|m| m.b)).ok_or(coincident)?;
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
    // A second null vector means a family of homographies. Eigenvalues are squares: 1e-12 is a relative 1e-6 of the
    // coordinates, well above rounding and below any real measurement.
    if values[1] <= 1e-12 * values[8] {
        return Err(EstimateError::Degenerate { kind: Degeneracy::Collinear });
    }
    let h = Matrix3::from_row_slice(vectors.column(0).as_slice());
    let h = second.inverse_matrix() * h * first.matrix();
    // Collinear points that are not collinear in the other image are fitted by a map that flattens the plane.
    if h.determinant().abs() <= 1e-12 * scale_of_determinant(&h) {
        return Err(EstimateError::Degenerate { kind: Degeneracy::Collinear });
    }
    Ok(scaled(&h))
}

/// The product of the row norms: what the determinant would be if the rows were perpendicular.
fn scale_of_determinant(h: &Matrix3<f64>) -> f64 {
    (0..3).map(|r| h.row(r).norm()).product()
}

/// The same homography with `H[2][2] = 1`, or of Frobenius norm 1 where that entry vanishes.
pub(crate) fn scaled(h: &Matrix3<f64>) -> Matrix3<f64> {
    let norm = h.norm();
    let corner = h[(2, 2)];
    if corner.abs() > 1e-12 * norm { h / corner } else { h / norm }
}
