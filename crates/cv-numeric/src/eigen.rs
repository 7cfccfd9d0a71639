//! Quadratic eigenvalue problems, and null vectors by LU decomposition.

use nalgebra::{DMatrix, DVector, Schur};

/// Maximum number of QR iterations; two or three per eigenvalue are usual.
const MAX_QR_ITERATIONS: usize = 1000;

/// Solves the quadratic eigenvalue problem: the real `w`, ascending, at which `C(w) = c[0] + w c[1] + w² c[2]` is singular, for square
/// matrices of one size.
///
/// Substitutes `w = shift + 1/μ`, so that infinite eigenvalues become `μ = 0` and are left out, and computes the eigenvalues of the
/// companion matrix of twice the size (Kukelova, Bujnak & Pajdla, "Polynomial eigenvalue solutions to minimal problems in computer
/// vision", PAMI 2012). `shift` must not be a solution. Eigenvalues whose imaginary part is below `1e-6` of their modulus count as real:
/// a double root splits into a pair with half of the digits. Empty where `C(shift)` is singular or an entry is not finite. O(n³).
pub fn real_quadratic_eigenvalues(c: [&DMatrix<f64>; 3], shift: f64) -> Vec<f64> {
    let n = c[0].nrows();
    let at_shift = c[0] + c[1] * shift + c[2] * (shift * shift);
    let derivative = c[1] + c[2] * (2.0 * shift);
    if !at_shift.iter().all(|v| v.is_finite()) {
        return Vec::new();
    }
    let lu = at_shift.lu();
    let (Some(a), Some(b)) = (lu.solve(&derivative), lu.solve(c[2])) else { return Vec::new() };
    let companion = DMatrix::from_fn(2 * n, 2 * n, |i, j| match (i < n, j < n) {
        (true, true) => -a[(i, j)],
        (true, false) => -b[(i, j - n)],
        (false, _) => f64::from(u8::from(j + n == i)),
    });
    if !companion.iter().all(|v| v.is_finite()) {
        return Vec::new();
    }
    let Some(schur) = Schur::try_new(companion, 1e-15, MAX_QR_ITERATIONS) else { return Vec::new() };
    let values = schur.complex_eigenvalues();
    let largest = values.iter().map(|v| v.norm()).fold(0.0, f64::max);
    let mut real: Vec<f64> = values
        .iter()
        .filter(|v| v.im.abs() <= 1e-6 * v.norm() && v.re.abs() > 1e-12 * largest)
        .map(|v| shift + 1.0 / v.re)
        .collect();
    real.sort_by(f64::total_cmp);
    real
}

/// Computes the unit null vector of a square matrix of numerical rank n − 1, by LU decomposition with full pivoting. `None` where the rank
/// is lower, or an entry is not finite. O(n³), faster than [`crate::null_vector`].
pub fn null_vector_lu(m: &DMatrix<f64>) -> Option<DVector<f64>> {
    let n = m.nrows();
    let lu = m.clone().full_piv_lu();
    let u = lu.u();
    let last = n.checked_sub(1)?;
    let mut v = DVector::zeros(n);
    v[last] = 1.0;
    for i in (0..last).rev() {
        let pivot = u[(i, i)];
        if pivot.is_nan() || pivot.abs() <= 1e-13 * u[(0, 0)].abs() {
            return None;
        }
        let sum: f64 = (i + 1..n).map(|j| u[(i, j)] * v[j]).sum();
        v[i] = -sum / pivot;
    }
    lu.q().inv_permute_rows(&mut v);
    let norm = v.norm();
    (norm.is_finite() && norm > 0.0).then(|| v / norm)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A matrix with entries in −1 to 1.
    fn square(n: usize) -> impl Strategy<Value = DMatrix<f64>> {
        proptest::collection::vec(-1.0..1.0f64, n * n).prop_map(move |v| DMatrix::from_vec(n, n, v))
    }

    proptest! {
        #[test]
        fn a_pencil_equivalent_to_a_diagonal_one_has_its_roots(p in square(4), q in square(4), r in proptest::array::uniform4(0.5..3.0f64)) {
            prop_assume!(p.clone().lu().determinant().abs() > 0.05 && q.clone().lu().determinant().abs() > 0.05);
            // (w − r)(w + 7) on the first two, a linear w − r on the third, and w² + r on the fourth, which has no real root.
            let diagonal = |v: [f64; 4]| &p * DMatrix::from_diagonal(&DVector::from_column_slice(&v)) * &q;
            let c0 = diagonal([-7.0 * r[0], -7.0 * r[1], -r[2], r[3]]);
            let c1 = diagonal([7.0 - r[0], 7.0 - r[1], 1.0, 0.0]);
            let c2 = diagonal([1.0, 1.0, 0.0, 1.0]);
            let mut expected = vec![-7.0, -7.0, r[0], r[1], r[2]];
            expected.sort_by(f64::total_cmp);
            prop_assume!(expected.windows(2).skip(1).all(|w| w[1] - w[0] > 0.05));
            let found = real_quadratic_eigenvalues([&c0, &c1, &c2], -1.0);
            // The double root at −7 may come as a complex pair that is not quite real.
            let tail = |v: &[f64]| v.iter().copied().filter(|w| *w > 0.0).collect::<Vec<_>>();
            let (found, expected) = (tail(&found), tail(&expected));
            prop_assert_eq!(found.len(), expected.len());
            // Gaps of 0.05 and condition numbers up to a few thousand cost six of sixteen digits.
            prop_assert!(found.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-8), "{:?} {:?}", found, expected);
        }

        #[test]
        fn the_null_vector_is_mapped_to_zero(m in square(6), k in 0usize..6, weights in proptest::array::uniform6(-1.0..1.0f64)) {
            // One row a combination of the others.
            let mut m = m;
            let row = (0..6).filter(|i| *i != k).map(|i| m.row(i) * weights[i]).fold(m.row(k) * 0.0, |s, r| s + r);
            m.set_row(k, &row);
            prop_assume!(m.clone().svd(false, false).singular_values[4] > 1e-3);
            let v = null_vector_lu(&m).unwrap();
            prop_assert!((v.norm() - 1.0).abs() < 1e-12 && (m * v).norm() < 1e-11);
        }
    }

    #[test]
    fn singular_empty_and_non_finite_input_has_no_solution() {
        let (zero, nan) = (DMatrix::zeros(3, 3), DMatrix::from_element(3, 3, f64::NAN));
        let one = DMatrix::<f64>::identity(3, 3);
        assert!(real_quadratic_eigenvalues([&zero, &zero, &zero], 1.0).is_empty());
        assert!(real_quadratic_eigenvalues([&nan, &one, &one], 1.0).is_empty());
        // w² + 1 has no real root.
        assert!(real_quadratic_eigenvalues([&one, &zero, &one], 1.0).is_empty());
        assert!(null_vector_lu(&zero).is_none() && null_vector_lu(&nan).is_none());
        assert!(null_vector_lu(&DMatrix::zeros(0, 0)).is_none());
    }
}
