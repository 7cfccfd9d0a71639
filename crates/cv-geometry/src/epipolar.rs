//! The Sampson error of epipolar geometry, and refinement by minimizing it.

use crate::match_blocks::{Halves, LANES, MatchBlock, PairBlocks, load_half, sum_lanes};
use crate::ransac::{BlockLosses, Scorer};
use cv_core::{Correspondence, Matrix3, Vector3};
use cv_numeric::{LeastSquares, LmOptions, NormalEquations, levenberg_marquardt};
use fearless_simd::{Level, dispatch, f64x8, prelude::*};
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
    pub(crate) pairs: &'a PairBlocks,
    pub(crate) scorer: &'a dyn Scorer,
    pub(crate) threshold: f64,
    parameterization: PhantomData<M>,
}

impl<'a, M: Epipolar<N>, const N: usize> SampsonProblem<'a, M, N> {
    pub(crate) fn new(pairs: &'a PairBlocks, scorer: &'a dyn Scorer, threshold: f64) -> Self {
        Self { pairs, scorer, threshold, parameterization: PhantomData }
    }

    /// Computes the terms of a block, whose first `count` lanes hold pairs.
    #[inline(always)]
    fn terms<S: Simd>(&self, simd: S, f: &[f64; 9], block: &[Halves; 4], count: usize) -> Terms<S> {
        let inverse_threshold2 = 1.0 / (self.threshold * self.threshold);
        let first = TermsHalf::new(simd, f, block, 0);
        let second = TermsHalf::new(simd, f, block, 1);
        let mut u = [0.0; LANES];
        let (u_first, u_second) = u.split_at_mut(LANES / 2);
        (first.c * first.c * first.inverse * inverse_threshold2).store_slice(u_first);
        (second.c * second.c * second.inverse * inverse_threshold2).store_slice(u_second);
        Terms { halves: [first, second], losses: BlockLosses::new(self.scorer, u, count) }
    }

    /// Computes the cost.
    #[inline(always)]
    fn sum<S: Simd>(&self, simd: S, f: &Matrix3<f64>) -> f64 {
        let f = std::array::from_fn(|i| f[(i / 3, i % 3)]);
        let mut cost = f64x8::splat(simd, 0.0);
        for (block, count) in self.pairs.iter() {
            let terms = self.terms(simd, &f, block, count);
            cost += terms.losses.sum(simd);
        }
        self.pairs.cost(cost)
    }

    /// Computes the cost and the normal equations.
    #[inline(always)]
    fn sums<S: Simd>(&self, simd: S, f: &Matrix3<f64>) -> Sums {
        let f = std::array::from_fn(|i| f[(i / 3, i % 3)]);
        let zero = f64x8::splat(simd, 0.0);
        let (mut cost, mut hessian, mut gradient) = (zero, [[zero; 9]; 9], [zero; 9]);
        for (block, count) in self.pairs.iter() {
            let terms = self.terms(simd, &f, block, count);
            cost += terms.losses.sum(simd);
            for (half, TermsHalf { pair: [x, y, s, t], l, m, c, inverse }) in terms.halves.into_iter().enumerate() {
                let weight = terms.losses.weights(simd, half);
                // Terms beyond the cutoff may be infinite or NaN, which a weight of 0 does not remove.
                let is_unused = weight.simd_eq(zero);
                // r = C/√D: ∂r = (∂C − C ∂D/(2D))/√D; ∂D/2 = l ∂l + m ∂m.
                let k = c * inverse;
                let (p0, p1) = (is_unused.select(zero, s - k * l[0]), is_unused.select(zero, t - k * l[1]));
                let (q0, q1) = (is_unused.select(zero, k * m[0]), is_unused.select(zero, k * m[1]));
                let one = f64x8::splat(simd, 1.0);
                let g =
                    [p0 * x - q0 * s, p0 * y - q1 * s, p0, p1 * x - q0 * t, p1 * y - q1 * t, p1, x - q0, y - q1, one];
                let (weight, c) = (is_unused.select(zero, weight * inverse), is_unused.select(zero, c));
                for i in 0..9 {
                    let w = weight * g[i];
                    for j in i..9 {
                        hessian[i][j] += w * g[j];
                    }
                    gradient[i] += w * c;
                }
            }
        }
        Sums {
            cost: self.pairs.cost(cost),
            hessian: std::array::from_fn(|i| std::array::from_fn(|j| sum_lanes(hessian[i][j]))),
            gradient: std::array::from_fn(|i| sum_lanes(gradient[i])),
        }
    }
}

/// The terms of a block of pairs.
struct Terms<S: Simd> {
    halves: [TermsHalf<S>; 2],
    losses: BlockLosses,
}

/// The pairs, the first two entries of `F a` and of `Fᵀ b`, `C = bᵀ F a`, and `1/D` (D the sum of the squares of the
/// four entries).
struct TermsHalf<S: Simd> {
    pair: [f64x8<S>; 4],
    l: [f64x8<S>; 2],
    m: [f64x8<S>; 2],
    c: f64x8<S>,
    inverse: f64x8<S>,
}

impl<S: Simd> TermsHalf<S> {
    #[inline(always)]
    fn new(simd: S, f: &[f64; 9], block: &[Halves; 4], half: usize) -> Self {
        let [x, y, s, t] = load_half(simd, block, half);
        let l = [x * f[0] + y * f[1] + f[2], x * f[3] + y * f[4] + f[5]];
        let m = [s * f[0] + t * f[3] + f[6], s * f[1] + t * f[4] + f[7]];
        let c = s * l[0] + t * l[1] + (x * f[6] + y * f[7] + f[8]);
        let inverse = 1.0 / (l[0] * l[0] + l[1] * l[1] + m[0] * m[0] + m[1] * m[1]);
        Self { pair: [x, y, s, t], l, m, c, inverse }
    }
}

/// Cost, gradient and Gauss–Newton Hessian (the upper triangle) by the nine entries of the matrix, row-major.
struct Sums {
    cost: f64,
    hessian: [[f64; 9]; 9],
    gradient: [f64; 9],
}

impl<M: Epipolar<N>, const N: usize> LeastSquares for SampsonProblem<'_, M, N> {
    type Dim = Const<N>;
    type Params = M;

    fn dim(&self) -> Const<N> {
        Const
    }

    fn cost(&self, f: &M) -> f64 {
        let matrix = f.matrix();
        dispatch!(Level::new(), simd => self.sum(simd, &matrix))
    }

    fn linearize(&self, f: &M) -> NormalEquations<Const<N>> {
        let matrix = f.matrix();
        // No product is fused, so all instruction sets give identical results.
        let sums = dispatch!(Level::new(), simd => self.sums(simd, &matrix));
        let tangent = f.tangent();
        let hessian = SMatrix::<f64, 9, 9>::from_fn(|r, c| sums.hessian[r.min(c)][r.max(c)]);
        let gradient = SVector::from(sums.gradient);
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
