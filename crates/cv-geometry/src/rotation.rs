//! Re-orthonormalization of rotation matrices.

use nalgebra::{Matrix3, Rotation3};

/// Restores the orthonormality of a rotation matrix after accumulated rounding: Gram–Schmidt on the columns.
///
/// `None` for entries that are not finite, and for zero or parallel columns. (nalgebra's `renormalize` does not
/// terminate on those.)
pub(crate) fn orthonormalized(r: &Rotation3<f64>) -> Option<Rotation3<f64>> {
    let m = r.matrix();
    let x = m.column(0).try_normalize(f64::MIN_POSITIVE)?;
    let y = m.column(1) - x * x.dot(&m.column(1));
    let y = y.try_normalize(1e-6)?;
    let out = Matrix3::from_columns(&[x, y, x.cross(&y)]);
    out.iter().all(|v| v.is_finite()).then(|| Rotation3::from_matrix_unchecked(out))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn orthonormality_is_restored() {
        for k in 0..50 {
            let r = Rotation3::new(Vector3::new(0.3 * f64::from(k), -0.2, 0.1 * f64::from(k)));
            let scaled = Rotation3::from_matrix_unchecked(r.matrix().map(|v| v * (1.0 + 1e-9)));
            let m = orthonormalized(&scaled).unwrap().into_inner();
            // Two roundings of a unit vector, a few units in the last place each.
            assert!((m.transpose() * m - Matrix3::identity()).norm() < 1e-14);
            assert!((m - r.matrix()).norm() < 1e-8);
        }
    }

    #[test]
    fn singular_and_non_finite_matrices_are_rejected() {
        let is_rejected = |m: Matrix3<f64>| orthonormalized(&Rotation3::from_matrix_unchecked(m)).is_none();
        assert!(is_rejected(Matrix3::from_element(f64::NAN)) && is_rejected(Matrix3::from_element(f64::INFINITY)));
        assert!(is_rejected(Matrix3::zeros()) && is_rejected(Matrix3::from_element(1.0)));
    }
}
