//! Decompositions, null spaces and positive definite systems.

use cv_numeric::{
    LinearError, null_space, null_vector, smallest_eigenvector, solve_positive_definite, solve_positive_definite_dense,
    svd3, symmetric_eigen,
};
use nalgebra::{DMatrix, DVector, Matrix3, SMatrix, SVector};
use proptest::prelude::*;

fn matrix3() -> impl Strategy<Value = Matrix3<f64>> {
    proptest::array::uniform9(-10.0..10.0f64).prop_map(|a| Matrix3::from_row_slice(&a))
}

proptest! {
    #[test]
    fn an_svd_reconstructs_its_matrix(m in matrix3(), rank in 1usize..4, scale in -100i32..100) {
        // Lower ranks by repeating a row; any scale that an f64 can square.
        let mut m = m * 10f64.powi(scale);
        for r in rank..3 {
            let copy = m.row(0) * (r as f64);
            m.set_row(r, &copy);
        }
        let svd = svd3(&m).unwrap();
        let back = svd.u * Matrix3::from_diagonal(&svd.s) * svd.v.transpose();
        // Backward stable: a few roundings of the largest entry.
        prop_assert!((back - m).norm() <= 1e-13 * m.norm());
        prop_assert!((svd.u.transpose() * svd.u - Matrix3::identity()).norm() < 1e-13);
        prop_assert!((svd.v.transpose() * svd.v - Matrix3::identity()).norm() < 1e-13);
        prop_assert!((svd.u.determinant() - 1.0).abs() < 1e-13 && (svd.v.determinant() - 1.0).abs() < 1e-13);
        prop_assert!(svd.s[0] >= svd.s[1] && svd.s[1] >= svd.s[2].abs() * (1.0 - 1e-12) - 1e-14 * svd.s[0]);
    }

    #[test]
    fn eigenvectors_diagonalize(values in proptest::array::uniform32(-1.0..1.0f64)) {
        let a = SMatrix::<f64, 6, 5>::from_iterator(values.into_iter().take(30));
        let m = a.transpose() * a;
        let (w, v) = symmetric_eigen(&m);
        let back = v * SMatrix::<f64, 5, 5>::from_diagonal(&w) * v.transpose();
        // A few roundings of the largest eigenvalue.
        prop_assert!((back - m).norm() < 1e-13 * (1.0 + m.norm()));
        prop_assert!(w.iter().zip(w.iter().skip(1)).all(|(a, b)| a <= b));
    }

    #[test]
    fn the_smallest_eigenvector_is_found(values in proptest::collection::vec(-1.0..1.0f64, 72)) {
        // Eight rows: a null space of dimension one, as in the eight-point algorithm.
        let a = SMatrix::<f64, 8, 9>::from_iterator(values);
        let v = smallest_eigenvector(&(a.transpose() * a)).unwrap();
        let exact = null_vector(&DMatrix::from_column_slice(8, 9, a.as_slice())).unwrap();
        let w = symmetric_eigen(&(a.transpose() * a)).0;
        // Rounding of AᵀA over the gap to the next eigenvalue.
        let tolerance = 1e-13 * w[8] / w[1];
        let cosine: f64 = (0..9).map(|i| v[i] * exact[i]).sum::<f64>().abs();
        prop_assert!(1.0 - cosine < tolerance.max(1e-14), "{cosine}");
    }
}

proptest! {
    #[test]
    fn null_spaces_are_null(values in proptest::collection::vec(-1.0..1.0f64, 63)) {
        let rows: [[f64; 9]; 7] = std::array::from_fn(|r| std::array::from_fn(|c| values[9 * r + c]));
        let basis: [[f64; 9]; 2] = null_space(rows).unwrap();
        for v in basis {
            let size = v.iter().map(|x| x * x).sum::<f64>().sqrt();
            for row in rows {
                // Rounding, magnified by the pivots' growth.
                prop_assert!(row.iter().zip(v).map(|(a, b)| a * b).sum::<f64>().abs() < 1e-10 * size);
            }
        }
    }
}

#[test]
fn rank_deficient_matrices_have_no_basis() {
    assert!(null_space::<2, 3, 1>([[1.0, 2.0, 3.0], [2.0, 4.0, 6.0]]).is_none());
    assert!(null_space::<2, 3, 1>([[1.0, 2.0, 3.0], [0.0; 3]]).is_none());
    assert!(null_space::<1, 2, 1>([[f64::NAN, f64::NAN]]).is_none());
    assert_eq!(null_space::<2, 3, 1>([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), Some([[1.0, 0.0, 0.0]]));
}

#[test]
fn equal_smallest_eigenvalues_give_a_unit_vector_of_their_eigenspace() {
    let m = SMatrix::<f64, 4, 4>::from_diagonal(&SVector::from([3.0, 1.0, 2.0, 1.0]));
    let v = smallest_eigenvector(&m).unwrap();
    assert!((v.norm() - 1.0).abs() < 1e-12 && (v.dot(&(m * v)) - 1.0).abs() < 1e-12);
}

#[test]
fn a_null_vector_of_a_wide_matrix_is_in_its_null_space() {
    let a = DMatrix::from_row_slice(2, 4, &[1.0, 2.0, 3.0, 4.0, 0.0, 1.0, 0.0, -1.0]);
    let v = null_vector(&a).unwrap();
    assert!((&a * &v).norm() < 1e-14 && (v.norm() - 1.0).abs() < 1e-14);
    assert_eq!(null_vector(&DMatrix::zeros(3, 0)), Err(LinearError::Empty));
    assert_eq!(null_vector(&DMatrix::from_element(2, 2, f64::NAN)), Err(LinearError::NotFinite));
}

#[test]
fn positive_definite_systems_are_solved_and_others_refused() {
    let m = DMatrix::from_row_slice(2, 2, &[4.0, 0.0, 2.0, 3.0]);
    let x = solve_positive_definite_dense(&m, &DVector::from_vec(vec![10.0, 11.0])).unwrap();
    // By hand: [[4, 2], [2, 3]] x = (10, 11) has the solution (1, 3).
    assert!((x - DVector::from_vec(vec![1.0, 3.0])).norm() < 1e-14);
    let m2 = nalgebra::Matrix2::new(4.0, 2.0, 2.0, 3.0);
    let x = solve_positive_definite(&m2, &nalgebra::Vector2::new(10.0, 11.0)).unwrap();
    assert!((x - nalgebra::Vector2::new(1.0, 3.0)).norm() < 1e-14);
    assert_eq!(solve_positive_definite(&-m2, &nalgebra::Vector2::zeros()), Err(LinearError::NotPositiveDefinite));
    assert_eq!(solve_positive_definite_dense(&-m, &DVector::zeros(2)), Err(LinearError::NotPositiveDefinite));
}
