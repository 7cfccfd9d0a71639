//! Rotations kept rotations.

use nalgebra::{Matrix3, Rotation3};

/// The rotation next to a product of rotations that rounding, or a far step, has bent: the first column kept, the second made orthogonal to it.
///
/// `None` where that cannot be done: entries that are not finite, columns of no length or parallel. (nalgebra's own `renormalize` iterates without end on those.)
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
    fn what_rounding_bent_is_straight_again() {
        for k in 0..50 {
            let r = Rotation3::new(Vector3::new(0.3 * f64::from(k), -0.2, 0.1 * f64::from(k)));
            let bent = Rotation3::from_matrix_unchecked(r.matrix().map(|v| v * (1.0 + 1e-9)));
            let m = orthonormalized(&bent).unwrap().into_inner();
            // Two roundings of a unit vector, a few units in the last place each.
            assert!((m.transpose() * m - Matrix3::identity()).norm() < 1e-14);
            assert!((m - r.matrix()).norm() < 1e-8);
        }
    }

    #[test]
    fn what_is_no_rotation_is_refused_at_once() {
        let no = |m: Matrix3<f64>| orthonormalized(&Rotation3::from_matrix_unchecked(m)).is_none();
        assert!(no(Matrix3::from_element(f64::NAN)) && no(Matrix3::from_element(f64::INFINITY)));
        assert!(no(Matrix3::zeros()) && no(Matrix3::from_element(1.0)));
    }
}
