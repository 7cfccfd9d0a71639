//! Eigenvalues of matrix polynomials, and null vectors.

use cv_numeric::{null_vector_lu, real_quadratic_eigenvalues};
use nalgebra::{DMatrix, DVector};
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
