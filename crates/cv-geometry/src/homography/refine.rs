//! Refinement of a homography on the symmetric transfer error.

use crate::match_blocks::{Halves, LANES, PairBlocks, load_half, sum_lanes};
use crate::ransac::{BlockLosses, Scorer};
use cv_core::Matrix3;
use cv_numeric::{LeastSquares, LmOptions, NormalEquations, levenberg_marquardt};
use fearless_simd::{Level, dispatch, f64x8, prelude::*};
use nalgebra::{Const, SMatrix, SVector};

/// Minimizes the robust symmetric transfer error `Σ ρ((d₁² + d₂²)/2 / threshold²)` over the eight entries other than
/// `H[2][2] = 1`. `d₂` is the distance from `b` to `H a`, `d₁` that from `a` to `H⁻¹ b`.
pub(crate) struct TransferProblem<'a> {
    pub(crate) pairs: &'a PairBlocks,
    pub(crate) scorer: &'a dyn Scorer,
    pub(crate) threshold: f64,
}

/// Normal equations of one transfer direction, by the nine entries of the matrix that maps `p`, as the moments `Σ k u^i
/// v^j p pᵀ`; the lanes are summed separately.
struct TransferSums<S: Simd> {
    /// Σ k, Σ k u, Σ k v, Σ k (u² + v²); of each for xx, xy, yy, x, y, 1.
    moments: [[f64x8<S>; 6]; 4],
    /// Gradient of half the cost by the nine entries, row-major.
    gradient: [f64x8<S>; 9],
}

impl<S: Simd> TransferSums<S> {
    #[inline(always)]
    fn new(simd: S) -> Self {
        let zero = f64x8::splat(simd, 0.0);
        Self { moments: [[zero; 6]; 4], gradient: [zero; 9] }
    }

    /// Adds points `(x, y)` that map to `mapped`, with the targets `(s, t)`.
    #[inline(always)]
    fn add(&mut self, [x, y]: [f64x8<S>; 2], mapped: &Mapped<S>, [s, t]: [f64x8<S>; 2], weight: f64x8<S>) {
        let (zero, one) = (f64x8::splat(x.simd, 0.0), f64x8::splat(x.simd, 1.0));
        // Terms beyond the cutoff may be infinite or NaN, which a weight of 0 does not remove.
        let is_unused = weight.simd_eq(zero);
        let (u, v) = (is_unused.select(zero, mapped.u), is_unused.select(zero, mapped.v));
        let inverse_w = is_unused.select(zero, mapped.inverse_w);
        let g = weight * inverse_w;
        let k = g * inverse_w;
        let p = [x * x, x * y, y * y, x, y, one];
        for (sums, factor) in self.moments.iter_mut().zip([k, k * u, k * v, k * (u * u + v * v)]) {
            for (sum, p) in sums.iter_mut().zip(p) {
                *sum += factor * p;
            }
        }
        let (ru, rv) = (u - s, v - t);
        for (sums, row) in self.gradient.chunks_exact_mut(3).zip([g * ru, g * rv, -g * (u * ru + v * rv)]) {
            for (sum, p) in sums.iter_mut().zip([x, y, one]) {
                *sum += row * p;
            }
        }
    }

    /// Sums the lanes.
    #[inline(always)]
    fn total(&self) -> TransferEquations {
        let moments = std::array::from_fn(|k| std::array::from_fn(|i| sum_lanes(self.moments[k][i])));
        TransferEquations { moments, gradient: std::array::from_fn(|i| sum_lanes(self.gradient[i])) }
    }
}

/// The sum of all lanes of [`TransferSums`].
struct TransferEquations {
    moments: [[f64; 6]; 4],
    gradient: [f64; 9],
}

impl TransferEquations {
    /// Returns the Gauss–Newton Hessian.
    fn hessian(&self) -> SMatrix<f64, 9, 9> {
        let block = |k: usize| {
            let [xx, xy, yy, x, y, one] = self.moments[k];
            Matrix3::new(xx, xy, x, xy, yy, y, x, y, one)
        };
        let [a, u, v, uv] = [0, 1, 2, 3].map(block);
        let mut h = SMatrix::<f64, 9, 9>::zeros();
        for (row, column, b) in [(0, 0, a), (3, 3, a), (6, 6, uv), (6, 0, -u), (0, 6, -u), (6, 3, -v), (3, 6, -v)] {
            h.fixed_view_mut::<3, 3>(row, column).copy_from(&b);
        }
        h
    }
}

impl TransferProblem<'_> {
    /// Computes the terms of a block, whose first `count` lanes hold pairs.
    #[inline(always)]
    fn terms<S: Simd>(&self, simd: S, h: &[f64; 9], g: &[f64; 9], block: &[Halves; 4], count: usize) -> Terms<S> {
        let scale = 0.5 / (self.threshold * self.threshold);
        let first = TermsHalf::new(simd, h, g, block, 0);
        let second = TermsHalf::new(simd, h, g, block, 1);
        let mut u = [0.0; LANES];
        let (u_first, u_second) = u.split_at_mut(LANES / 2);
        (first.squared_distances() * scale).store_slice(u_first);
        (second.squared_distances() * scale).store_slice(u_second);
        Terms { halves: [first, second], losses: BlockLosses::new(self.scorer, u, count) }
    }

    /// Computes the cost.
    #[inline(always)]
    fn sum<S: Simd>(&self, simd: S, h: &[f64; 9], g: &[f64; 9]) -> f64 {
        let mut cost = f64x8::splat(simd, 0.0);
        for (block, count) in self.pairs.iter() {
            cost += self.terms(simd, h, g, block, count).losses.sum(simd);
        }
        self.pairs.cost(cost)
    }

    /// Computes the cost and the normal equations of both directions.
    #[inline(always)]
    fn sums<S: Simd>(&self, simd: S, h: &[f64; 9], g: &[f64; 9]) -> (f64, TransferEquations, TransferEquations) {
        let (mut forward, mut backward) = (TransferSums::new(simd), TransferSums::new(simd));
        let mut cost = f64x8::splat(simd, 0.0);
        for (block, count) in self.pairs.iter() {
            let terms = self.terms(simd, h, g, block, count);
            cost += terms.losses.sum(simd);
            for (half, terms_half) in terms.halves.iter().enumerate() {
                let weight = terms.losses.weights(simd, half);
                let [x, y, s, t] = terms_half.pair;
                forward.add([x, y], &terms_half.forward, [s, t], weight);
                backward.add([s, t], &terms_half.backward, [x, y], weight);
            }
        }
        (self.pairs.cost(cost), forward.total(), backward.total())
    }
}

/// The terms of a block of pairs. The loss is 1 where a point maps behind the camera.
struct Terms<S: Simd> {
    halves: [TermsHalf<S>; 2],
    losses: BlockLosses,
}

/// The pairs, `H a` and `H⁻¹ b`.
struct TermsHalf<S: Simd> {
    pair: [f64x8<S>; 4],
    forward: Mapped<S>,
    backward: Mapped<S>,
}

impl<S: Simd> TermsHalf<S> {
    #[inline(always)]
    fn new(simd: S, h: &[f64; 9], g: &[f64; 9], block: &[Halves; 4], half: usize) -> Self {
        let [x, y, s, t] = load_half(simd, block, half);
        Self { pair: [x, y, s, t], forward: Mapped::new(h, x, y), backward: Mapped::new(g, s, t) }
    }

    /// Computes `d₁² + d₂²`; NaN where a point maps behind the camera.
    #[inline(always)]
    fn squared_distances(&self) -> f64x8<S> {
        let ([x, y, s, t], forward, backward) = (self.pair, &self.forward, &self.backward);
        let zero = f64x8::splat(x.simd, 0.0);
        let (p, q, m, n) = (forward.u - s, forward.v - t, backward.u - x, backward.v - y);
        let is_in_front = forward.inverse_w.simd_gt(zero) & backward.inverse_w.simd_gt(zero);
        is_in_front.select(p * p + q * q + m * m + n * n, f64x8::splat(x.simd, f64::NAN))
    }
}

/// Points mapped by a homography, with the inverse of their denominators.
struct Mapped<S: Simd> {
    u: f64x8<S>,
    v: f64x8<S>,
    inverse_w: f64x8<S>,
}

impl<S: Simd> Mapped<S> {
    #[inline(always)]
    fn new(h: &[f64; 9], x: f64x8<S>, y: f64x8<S>) -> Self {
        let inverse_w = 1.0 / (x * h[6] + y * h[7] + h[8]);
        let (u, v) = (x * h[0] + y * h[1] + h[2], x * h[3] + y * h[4] + h[5]);
        Self { u: u * inverse_w, v: v * inverse_w, inverse_w }
    }
}

/// Returns the entries, row-major.
fn entries(m: &Matrix3<f64>) -> [f64; 9] {
    std::array::from_fn(|i| m[(i / 3, i % 3)])
}

/// Inverts a homography with `H[2][2] = 1`; the denominators of the inverse are positive in front of the camera.
pub(crate) fn inverse(h: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    h.try_inverse()
}

impl LeastSquares for TransferProblem<'_> {
    type Dim = Const<8>;
    type Params = Matrix3<f64>;

    fn dim(&self) -> Const<8> {
        Const
    }

    fn cost(&self, h: &Matrix3<f64>) -> f64 {
        let Some(g) = inverse(h) else { return f64::INFINITY };
        let (h, g) = (entries(h), entries(&g));
        dispatch!(Level::new(), simd => self.sum(simd, &h, &g))
    }

    fn linearize(&self, h: &Matrix3<f64>) -> NormalEquations<Const<8>> {
        let mut equations = NormalEquations::zeros(Const);
        let Some(g) = inverse(h) else {
            equations.cost = f64::INFINITY;
            return equations;
        };
        // No product is fused, so all instruction sets give identical results.
        let (rows, inverse_rows) = (entries(h), entries(&g));
        let (cost, forward, backward) = dispatch!(Level::new(), simd => self.sums(simd, &rows, &inverse_rows));
        // dG = −G dH G: dG[i][j] = −Σ G[i][k] G[l][j] dH[k][l].
        let inverse_jacobian = SMatrix::<f64, 9, 9>::from_fn(|r, c| -g[(r / 3, c / 3)] * g[(c % 3, r % 3)]);
        let hessian = forward.hessian() + inverse_jacobian.transpose() * backward.hessian() * inverse_jacobian;
        let gradient =
            SVector::from(forward.gradient) + inverse_jacobian.transpose() * SVector::from(backward.gradient);
        equations.cost = cost;
        equations.hessian.copy_from(&hessian.fixed_view::<8, 8>(0, 0));
        equations.gradient.copy_from(&gradient.fixed_rows::<8>(0));
        equations
    }

    fn step(&self, h: &Matrix3<f64>, delta: &SVector<f64, 8>) -> Matrix3<f64> {
        let mut updated = *h;
        for (i, d) in delta.iter().enumerate() {
            updated[(i / 3, i % 3)] += d;
        }
        updated
    }
}

/// Refines `h` (of any scale) by at most `iterations` Levenberg–Marquardt steps; `None` if none reduced the cost.
pub(crate) fn refine_transfer(
    problem: &TransferProblem<'_>,
    h: &Matrix3<f64>,
    iterations: usize,
) -> Option<Matrix3<f64>> {
    // The origin is the center of the points in the first image; a valid homography does not map it to infinity.
    if h[(2, 2)].abs() <= 1e-9 * h.norm() {
        return None;
    }
    let options = LmOptions { max_iterations: iterations, cost_tolerance: 1e-6, ..LmOptions::default() };
    let report = levenberg_marquardt(problem, h / h[(2, 2)], &options);
    (report.cost < report.initial_cost).then_some(report.params)
}
