//! The Sampson error of epipolar geometry, and refinement by minimizing it.

use crate::match_blocks::{LANES, MatchBlock};
use crate::ransac::Scorer;
use cv_core::{Correspondence, Matrix3, Vector3};
use cv_numeric::{LeastSquares, LmOptions, NormalEquations, levenberg_marquardt};
use fearless_simd::{Level, dispatch};
use nalgebra::{Const, OMatrix, OVector, SMatrix, SVector};
use std::marker::PhantomData;

/// A parameterization with `N` degrees of freedom of matrices `F` with `bᵀ F a = 0`.
pub(crate) trait Epipolar<const N: usize>: Clone {
    /// Returns the matrix, of any scale.
    fn matrix(&self) -> Matrix3<f64>;

    /// Returns the Jacobian of the entries (row-major) by the degrees of freedom.
    fn tangent(&self) -> SMatrix<f64, 9, N>;

    /// Applies a step in the tangent space (retraction).
    fn step(&self, delta: &OVector<f64, Const<N>>) -> Self;
}

/// Minimizes the robust Sampson error `Σ ρ(sampson² / threshold²)` over a parameterization.
pub(crate) struct SampsonProblem<'a, M, const N: usize> {
    pub(crate) pairs: &'a [[f64; 4]],
    pub(crate) scorer: &'a dyn Scorer,
    pub(crate) threshold: f64,
    parameterization: PhantomData<M>,
}

impl<'a, M: Epipolar<N>, const N: usize> SampsonProblem<'a, M, N> {
    pub(crate) fn new(pairs: &'a [[f64; 4]], scorer: &'a dyn Scorer, threshold: f64) -> Self {
        Self { pairs, scorer, threshold, parameterization: PhantomData }
    }

    /// Computes the first two entries of `F a` and of `Fᵀ b`, `C = bᵀ F a`, `1/D` (D the sum of their squares), and
    /// `u`.
    #[inline(always)]
    fn terms(&self, f: &Matrix3<f64>, &[x, y, s, t]: &[f64; 4]) -> ([f64; 2], [f64; 2], f64, f64, f64) {
        let l0 = f[(0, 0)] * x + f[(0, 1)] * y + f[(0, 2)];
        let l1 = f[(1, 0)] * x + f[(1, 1)] * y + f[(1, 2)];
        let l2 = f[(2, 0)] * x + f[(2, 1)] * y + f[(2, 2)];
        let m0 = f[(0, 0)] * s + f[(1, 0)] * t + f[(2, 0)];
        let m1 = f[(0, 1)] * s + f[(1, 1)] * t + f[(2, 1)];
        let c = s * l0 + t * l1 + l2;
        let inverse = 1.0 / (l0 * l0 + l1 * l1 + m0 * m0 + m1 * m1);
        ([l0, l1], [m0, m1], c, inverse, c * c * inverse / (self.threshold * self.threshold))
    }

    /// Computes the cost.
    #[inline(always)]
    fn sum(&self, f: &Matrix3<f64>) -> f64 {
        let cutoff = self.scorer.cutoff();
        let mut cost = 0.0;
        for pair in self.pairs {
            let u = self.terms(f, pair).4;
            cost += if u < cutoff { f64::from(self.scorer.loss(u as f32)) } else { 1.0 };
        }
        cost
    }

    /// Computes the cost and the normal equations.
    #[inline(always)]
    fn sums(&self, f: &Matrix3<f64>) -> Sums {
        let (mut hessian, mut last, mut gradient) = ([[0.0; 8]; 8], [0.0; 8], [0.0; 8]);
        let (mut cost, mut sum, mut weighted) = (0.0, 0.0, 0.0);
        let cutoff = self.scorer.cutoff();
        for pair in self.pairs {
            let (l, m, c, inverse, u) = self.terms(f, pair);
            // False for NaN.
            let is_below_cutoff = u < cutoff;
            if !is_below_cutoff {
                cost += 1.0;
                continue;
            }
            cost += f64::from(self.scorer.loss(u as f32));
            let [x, y, s, t] = *pair;
            let weight = self.scorer.weight(u) * inverse;
            // r = C/√D: ∂r = (∂C − C ∂D/(2D))/√D; ∂D/2 = l ∂l + m ∂m.
            let k = c * inverse;
            let (p0, p1, q0, q1) = (s - k * l[0], t - k * l[1], k * m[0], k * m[1]);
            let g = [p0 * x - q0 * s, p0 * y - q1 * s, p0, p1 * x - q0 * t, p1 * y - q1 * t, p1, x - q0, y - q1];
            let w = g.map(|g| weight * g);
            for i in 0..8 {
                for j in 0..8 {
                    hessian[i][j] += w[i] * g[j];
                }
            }
            for j in 0..8 {
                last[j] += w[j];
                gradient[j] += w[j] * c;
            }
            sum += weight;
            weighted += weight * c;
        }
        Sums { cost, hessian, last, weight: sum, gradient, weighted }
    }
}

/// Cost, gradient and Gauss–Newton Hessian by the nine entries of the matrix. The last entry, whose derivative is 1, is
/// separate, so that the others fill SIMD vectors of four or eight.
struct Sums {
    cost: f64,
    hessian: [[f64; 8]; 8],
    /// The last column of the Hessian without the diagonal entry, which is `weight`.
    last: [f64; 8],
    weight: f64,
    gradient: [f64; 8],
    /// The last entry of the gradient.
    weighted: f64,
}

impl<M: Epipolar<N>, const N: usize> LeastSquares for SampsonProblem<'_, M, N> {
    type Dim = Const<N>;
    type Params = M;

    fn dim(&self) -> Const<N> {
        Const
    }

    fn cost(&self, f: &M) -> f64 {
        let matrix = f.matrix();
        dispatch!(Level::new(), _simd => self.sum(&matrix))
    }

    fn linearize(&self, f: &M) -> NormalEquations<Const<N>> {
        let matrix = f.matrix();
        // No product is fused, so all instruction sets give identical results.
        let sums = dispatch!(Level::new(), _simd => self.sums(&matrix));
        let tangent = f.tangent();
        let mut hessian = SMatrix::<f64, 9, 9>::zeros();
        let mut gradient = SVector::<f64, 9>::zeros();
        for i in 0..8 {
            for j in 0..8 {
                hessian[(i, j)] = sums.hessian[i][j];
            }
            (hessian[(i, 8)], hessian[(8, i)]) = (sums.last[i], sums.last[i]);
            gradient[i] = sums.gradient[i];
        }
        (hessian[(8, 8)], gradient[8]) = (sums.weight, sums.weighted);
        let gradient = tangent.transpose() * gradient;
        let hessian = tangent.transpose() * hessian * tangent;
        NormalEquations {
            cost: sums.cost,
            hessian: OMatrix::<f64, Const<N>, Const<N>>::from_fn(|r, c| hessian[(r, c)]),
            gradient: OVector::<f64, Const<N>>::from_fn(|r, _| gradient[r]),
        }
    }

    fn step(&self, f: &M, d: &OVector<f64, Const<N>>) -> M {
        f.step(d)
    }
}

/// Refines `start` by at most `iterations` Levenberg–Marquardt steps; `None` if none reduced the cost.
pub(crate) fn refine_sampson<M: Epipolar<N>, const N: usize>(
    problem: &SampsonProblem<'_, M, N>,
    start: M,
    iterations: usize,
) -> Option<M> {
    let options = LmOptions { max_iterations: iterations, cost_tolerance: 1e-6, ..LmOptions::default() };
    let report = levenberg_marquardt(problem, start, &options);
    (report.cost < report.initial_cost).then_some(report.params)
}

/// F in f32, row-major.
pub(crate) struct SampsonKernel([f32; 9]);

impl SampsonKernel {
    pub(crate) fn new(f: &Matrix3<f64>) -> Self {
        Self(std::array::from_fn(|i| f[(i / 3, i % 3)] as f32))
    }

    /// Computes the squared Sampson distances.
    #[inline(always)]
    pub(crate) fn squared_residuals(&self, block: &MatchBlock) -> [f32; LANES] {
        let f = &self.0;
        let mut out = [0f32; LANES];
        for (i, r2) in out.iter_mut().enumerate() {
            let (x, y, s, t) = (block.x1[i], block.y1[i], block.x2[i], block.y2[i]);
            let l0 = f[0] * x + f[1] * y + f[2];
            let l1 = f[3] * x + f[4] * y + f[5];
            let l2 = f[6] * x + f[7] * y + f[8];
            let m0 = f[0] * s + f[3] * t + f[6];
            let m1 = f[1] * s + f[4] * t + f[7];
            let c = s * l0 + t * l1 + l2;
            *r2 = c * c / ((l0 * l0 + l1 * l1) + (m0 * m0 + m1 * m1));
        }
        out
    }
}

/// Computes the Sampson distance of a match from the epipolar geometry `bᵀ F a = 0`, in the unit of the match: the
/// first-order approximation of the distance to the nearest pair of points that satisfies it (Hartley & Zisserman,
/// §11.4.3).
///
/// NaN if both points are epipoles (both epipolar lines vanish).
pub fn sampson(f: &Matrix3<f64>, m: &Correspondence) -> f64 {
    let (a, b) = (m.a.to_homogeneous(), m.b.to_homogeneous());
    let (l, k) = (f * a, f.transpose() * b);
    b.dot(&l).abs() / (l.x * l.x + l.y * l.y + k.x * k.x + k.y * k.y).sqrt()
}

/// Computes the epipole of the second image, `Fᵀ e = 0`, as the longest cross product of two columns; of any scale.
#[inline]
pub(crate) fn second_epipole(f: &Matrix3<f64>) -> Vector3<f64> {
    let c = [f.column(0), f.column(1), f.column(2)];
    let crosses = [c[0].cross(&c[1]), c[1].cross(&c[2]), c[2].cross(&c[0])];
    let mut best = crosses[0];
    for e in &crosses[1..] {
        if e.norm_squared() > best.norm_squared() {
            best = *e;
        }
    }
    best
}
