//! Refinement of a homography on the symmetric transfer error.

use crate::ransac::Scorer;
use cv_core::Matrix3;
use cv_numeric::{LeastSquares, LmOptions, NormalEquations, levenberg_marquardt};
use fearless_simd::{Level, dispatch};
use nalgebra::{Const, SMatrix, SVector};

/// Minimizes the robust symmetric transfer error `Σ ρ((d₁² + d₂²)/2 / threshold²)` over the eight entries other than
/// `H[2][2] = 1`. `d₂` is the distance from `b` to `H a`, `d₁` that from `a` to `H⁻¹ b`.
pub(crate) struct TransferProblem<'a> {
    pub(crate) pairs: &'a [[f64; 4]],
    pub(crate) scorer: &'a dyn Scorer,
    pub(crate) threshold: f64,
}

/// Normal equations of one transfer direction, by the nine entries of the matrix that maps `p`, as the moments `Σ k u^i
/// v^j p pᵀ`.
#[derive(Clone, Copy)]
struct TransferSums {
    /// For each of xx, xy, yy, x, y, 1: Σ k, Σ k u, Σ k v, Σ k (u² + v²), in SIMD-friendly groups of four.
    moments: [[f64; 4]; 6],
    /// Gradient of half the cost by the nine entries, row-major.
    gradient: [f64; 9],
}

impl TransferSums {
    const ZERO: Self = Self { moments: [[0.0; 4]; 6], gradient: [0.0; 9] };

    /// Adds a point `(x, y)` that maps to `(u, v)` with denominator `w`, with the residual `(ru, rv)`.
    #[inline(always)]
    fn add(&mut self, [x, y]: [f64; 2], [u, v, inverse_w]: [f64; 3], [ru, rv]: [f64; 2], weight: f64) {
        let k = weight * inverse_w * inverse_w;
        let p = [x * x, x * y, y * y, x, y, 1.0];
        let factors = [k, k * u, k * v, k * (u * u + v * v)];
        for (m, q) in self.moments.iter_mut().zip(p) {
            for (sum, f) in m.iter_mut().zip(factors) {
                *sum += f * q;
            }
        }
        let g = weight * inverse_w;
        let rows = [g * ru, g * rv, -g * (u * ru + v * rv)];
        for (r, f) in rows.into_iter().enumerate() {
            self.gradient[3 * r] += f * x;
            self.gradient[3 * r + 1] += f * y;
            self.gradient[3 * r + 2] += f;
        }
    }

    /// Returns the Gauss–Newton Hessian.
    fn hessian(&self) -> SMatrix<f64, 9, 9> {
        let m = &self.moments;
        let block = |k: usize| {
            let [xx, xy, yy, x, y, one] = m.each_ref().map(|m| m[k]);
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
    /// Computes `H a`, `1/w`, `H⁻¹ b`, `1/w'`, and `u`, which is NaN if a point maps behind the camera.
    #[inline(always)]
    fn terms(&self, h: &Matrix3<f64>, g: &Matrix3<f64>, &[x, y, s, t]: &[f64; 4]) -> ([f64; 3], [f64; 3], f64) {
        let wa = 1.0 / (h[(2, 0)] * x + h[(2, 1)] * y + h[(2, 2)]);
        let wb = 1.0 / (g[(2, 0)] * s + g[(2, 1)] * t + g[(2, 2)]);
        let p = (h[(0, 0)] * x + h[(0, 1)] * y + h[(0, 2)]) * wa;
        let q = (h[(1, 0)] * x + h[(1, 1)] * y + h[(1, 2)]) * wa;
        let m = (g[(0, 0)] * s + g[(0, 1)] * t + g[(0, 2)]) * wb;
        let n = (g[(1, 0)] * s + g[(1, 1)] * t + g[(1, 2)]) * wb;
        let d2 = (p - s) * (p - s) + (q - t) * (q - t) + (m - x) * (m - x) + (n - y) * (n - y);
        let u = if wa > 0.0 && wb > 0.0 { d2 * (0.5 / (self.threshold * self.threshold)) } else { f64::NAN };
        ([p, q, wa], [m, n, wb], u)
    }

    /// Computes the cost.
    #[inline(always)]
    fn sum(&self, h: &Matrix3<f64>, g: &Matrix3<f64>) -> f64 {
        let cutoff = self.scorer.cutoff();
        let mut cost = 0.0;
        for pair in self.pairs {
            let u = self.terms(h, g, pair).2;
            cost += if u < cutoff { f64::from(self.scorer.loss(u as f32)) } else { 1.0 };
        }
        cost
    }

    /// Computes the cost and the normal equations of both directions.
    #[inline(always)]
    fn sums(&self, h: &Matrix3<f64>, g: &Matrix3<f64>) -> (f64, TransferSums, TransferSums) {
        let (mut forward, mut backward) = (TransferSums::ZERO, TransferSums::ZERO);
        let cutoff = self.scorer.cutoff();
        let mut cost = 0.0;
        for pair in self.pairs {
            let (a, b, u) = self.terms(h, g, pair);
            // False for NaN.
            if u < cutoff {
                let [x, y, s, t] = *pair;
                cost += f64::from(self.scorer.loss(u as f32));
                let weight = self.scorer.weight(u);
                forward.add([x, y], a, [a[0] - s, a[1] - t], weight);
                backward.add([s, t], b, [b[0] - x, b[1] - y], weight);
            } else {
                cost += 1.0;
            }
        }
        (cost, forward, backward)
    }
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
        dispatch!(Level::new(), _simd => self.sum(h, &g))
    }

    fn linearize(&self, h: &Matrix3<f64>) -> NormalEquations<Const<8>> {
        let mut equations = NormalEquations::zeros(Const);
        let Some(g) = inverse(h) else {
            equations.cost = f64::INFINITY;
            return equations;
        };
        // No product is fused, so all instruction sets give identical results.
        let (cost, forward, backward) = dispatch!(Level::new(), _simd => self.sums(h, &g));
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
