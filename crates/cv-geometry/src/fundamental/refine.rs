//! Refinement of a fundamental matrix on the Sampson error.

use crate::ransac::Scorer;
use cv_core::{Matrix3, Rotation3, Vector3};
use cv_numeric::{LeastSquares, LmOptions, NormalEquations, levenberg_marquardt, svd3};
use nalgebra::{Const, SMatrix, SVector};

/// Minimises `Σ ρ(sampson² / threshold²)` over all matrices of rank two.
pub(crate) struct SampsonProblem<'a, C: Scorer> {
    pub(crate) pairs: &'a [[f64; 4]],
    pub(crate) scorer: &'a C,
    pub(crate) threshold: f64,
}

/// `F = U diag(1, s, 0) Vᵀ`: seven degrees of freedom, all of rank two (Bartoli & Sturm, "Nonlinear estimation of the
/// fundamental matrix with minimal parameters", 2004).
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

    pub(crate) fn matrix(&self) -> Matrix3<f64> {
        self.u.column(0) * self.v.column(0).transpose() + self.u.column(1) * self.v.column(1).transpose() * self.s
    }

    /// Derivatives of the entries, row by row, by the two rotations (applied on the right of U and V) and `s`.
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
}

impl<C: Scorer> SampsonProblem<'_, C> {
    /// Calls `f(pair, F a, Fᵀ b, C, 1/D, u)` for each pair within the cutoff; returns the number of the others.
    #[inline(always)]
    fn each(&self, f: &Matrix3<f64>, mut each: impl FnMut(&[f64; 4], [f64; 2], [f64; 2], f64, f64, f64)) -> f64 {
        let scale = 1.0 / (self.threshold * self.threshold);
        let mut outside = 0.0;
        for pair in self.pairs {
            let [x, y, s, t] = *pair;
            let l0 = f[(0, 0)] * x + f[(0, 1)] * y + f[(0, 2)];
            let l1 = f[(1, 0)] * x + f[(1, 1)] * y + f[(1, 2)];
            let l2 = f[(2, 0)] * x + f[(2, 1)] * y + f[(2, 2)];
            let m0 = f[(0, 0)] * s + f[(1, 0)] * t + f[(2, 0)];
            let m1 = f[(0, 1)] * s + f[(1, 1)] * t + f[(2, 1)];
            let c = s * l0 + t * l1 + l2;
            let inverse = 1.0 / (l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1);
            let u = c * c * inverse * scale;
            if u < self.scorer.cutoff() {
                each(pair, [l0, l1], [m0, m1], c, inverse, u);
            } else {
                outside += 1.0;
            }
        }
        outside
    }
}

impl<C: Scorer> LeastSquares for SampsonProblem<'_, C> {
    type Dim = Const<7>;
    type Params = RankTwo;

    fn dim(&self) -> Const<7> {
        Const
    }

    fn cost(&self, f: &RankTwo) -> f64 {
        let mut cost = 0.0;
        let outside = self.each(&f.matrix(), |_, _, _, _, _, u| cost += f64::from(self.scorer.loss(u as f32)));
        cost + outside
    }

    fn linearize(&self, f: &RankTwo) -> NormalEquations<Const<7>> {
        let mut cost = 0.0;
        let mut hessian = [[0.0; 9]; 9];
        let mut gradient = [0.0; 9];
        let outside = self.each(&f.matrix(), |&[x, y, s, t], l, m, c, inverse, u| {
            cost += f64::from(self.scorer.loss(u as f32));
            let weight = self.scorer.weight(u) * inverse;
            // r = C/√D: ∂r = (∂C − C ∂D/(2D))/√D; ∂D/2 = l ∂l + m ∂m.
            let k = c * inverse;
            let (p, q) = ([s, t, 1.0], [x, y, 1.0]);
            let (kl, km) = ([k * l[0], k * l[1], 0.0], [k * m[0], k * m[1], 0.0]);
            let mut g = [0.0; 9];
            for i in 0..3 {
                for j in 0..3 {
                    g[3 * i + j] = (p[i] - kl[i]) * q[j] - km[j] * p[i];
                }
            }
            for i in 0..9 {
                let w = weight * g[i];
                gradient[i] += w * c;
                for (h, g) in hessian[i].iter_mut().zip(g) {
                    *h += w * g;
                }
            }
        });
        let tangent = f.tangent();
        let hessian = SMatrix::<f64, 9, 9>::from_fn(|r, c| hessian[r][c]);
        NormalEquations {
            cost: cost + outside,
            hessian: tangent.transpose() * hessian * tangent,
            gradient: tangent.transpose() * SVector::from(gradient),
        }
    }

    fn step(&self, f: &RankTwo, d: &SVector<f64, 7>) -> RankTwo {
        let turn = |i: usize| Rotation3::new(Vector3::new(d[i], d[i + 1], d[i + 2])).into_inner();
        RankTwo { u: f.u * turn(0), v: f.v * turn(3), s: f.s + d[6] }
    }
}

/// At most `iterations` Levenberg–Marquardt steps from `f`. Of Frobenius norm 1.
pub(crate) fn refine_sampson<C: Scorer>(
    problem: &SampsonProblem<'_, C>,
    f: &Matrix3<f64>,
    iterations: usize,
) -> Option<Matrix3<f64>> {
    let start = RankTwo::new(f)?;
    let options = LmOptions { max_iterations: iterations, cost_tolerance: 1e-6, ..LmOptions::default() };
    let report = levenberg_marquardt(problem, start, &options);
    (report.cost < report.initial_cost).then(|| report.params.matrix().normalize())
}
