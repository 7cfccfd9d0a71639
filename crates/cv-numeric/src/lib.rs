//! Dense and sparse linear algebra, polynomial roots and least squares for vision.
//!
//! The only user of faer in the workspace. Small matrices of fixed size use nalgebra or closed forms, which are faster
//! there.
//!
//! ```
//! use cv_numeric::{svd3, smallest_eigenvector};
//! use nalgebra::{Matrix3, Vector3};
//!
//! let m = Matrix3::from_diagonal(&Vector3::new(1.0, 5.0, 2.0));
//! assert_eq!(svd3(&m)?.s, Vector3::new(5.0, 2.0, 1.0));
//! assert!((smallest_eigenvector(&m)? - Vector3::x()).norm() < 1e-12);
//! # Ok::<(), cv_numeric::LinearError>(())
//! ```

pub mod adjust;
mod eigen;
mod levenberg_marquardt;
mod linear;
mod polynomial;
mod robust_loss;

pub use eigen::{null_vector_lu, real_quadratic_eigenvalues};
pub use levenberg_marquardt::{LeastSquares, LmOptions, LmReport, NormalEquations, levenberg_marquardt};
pub use linear::{
    LinearError, Svd3, null_space, null_vector, smallest_eigenvector, solve_positive_definite,
    solve_positive_definite_dense, svd3, symmetric_eigen,
};
pub use polynomial::{
    Roots, farthest_root_cubic, real_roots, real_roots_cubic, real_roots_quadratic, real_roots_quartic,
};
pub use robust_loss::RobustLoss;
