//! Minimal parameterization of fundamental matrices: rank two, seven degrees of freedom.

use crate::epipolar::Epipolar;
use cv_core::{Matrix3, Rotation3, Vector3};
use cv_numeric::svd3;
use nalgebra::{SMatrix, SVector};

/// `F = U diag(1, s, 0) Vᵀ` with rotations U and V: seven degrees of freedom (Bartoli & Sturm, "Nonlinear estimation of
/// the fundamental matrix with minimal parameters", 2004).
#[derive(Debug, Clone, Copy)]
pub(crate) struct RankTwo {
    u: Matrix3<f64>,
    v: Matrix3<f64>,
    s: f64,
}

impl RankTwo {
    pub(crate) fn new(f: &Matrix3<f64>) -> Option<Self> {
        let svd = svd3(f).ok()?;
        (svd.s[0] > 0.0).then(|| Self { u: svd.u, v: svd.v, s: svd.s[1] / svd.s[0] })
    }
}

impl Epipolar<7> for RankTwo {
    fn matrix(&self) -> Matrix3<f64> {
        self.u.column(0) * self.v.column(0).transpose() + self.u.column(1) * self.v.column(1).transpose() * self.s
    }

    /// The derivatives by the two rotation vectors (applied on the right of U and V) and `s`.
    fn tangent(&self) -> SMatrix<f64, 9, 7> {
        let (u, v, s) = (&self.u, &self.v, self.s);
        let flat = |m: Matrix3<f64>| SVector::<f64, 9>::from_fn(|i, _| m[(i / 3, i % 3)]);
        let outer = |i: usize, j: usize| u.column(i) * v.column(j).transpose();
        // U [e_k]× D Vᵀ for k = x, y, z; then U D [e_k]×ᵀ Vᵀ.
        SMatrix::from_columns(&[
            flat(outer(2, 1) * s),
            flat(-outer(2, 0)),
            flat(outer(1, 0) - outer(0, 1) * s),
            flat(outer(1, 2) * s),
            flat(-outer(0, 2)),
            flat(outer(0, 1) - outer(1, 0) * s),
            flat(outer(1, 1)),
        ])
    }

    fn step(&self, d: &SVector<f64, 7>) -> Self {
        let rotation = |i: usize| Rotation3::new(Vector3::new(d[i], d[i + 1], d[i + 2])).into_inner();
        Self { u: self.u * rotation(0), v: self.v * rotation(3), s: self.s + d[6] }
    }
}
