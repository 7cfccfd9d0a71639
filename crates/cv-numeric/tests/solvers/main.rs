//! Linear algebra, roots and least squares against reference implementations. One binary: each further one takes as long to
//! link as its tests run. Tests of whole solvers are here and not in the library, which would be compiled twice for them.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod adjust;
mod eigen;
mod levenberg_marquardt;
mod linear;
mod polynomial;
mod robust_loss;
mod scene;
