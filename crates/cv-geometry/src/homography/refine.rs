//! Refinement of a homography on the symmetric transfer error.

use crate::ransac::Scorer;
use cv_core::Matrix3;
use cv_numeric::{LeastSquares, LmOptions, NormalEquations, levenberg_marquardt};
use fearless_simd::{Level, dispatch};
use nalgebra::{Const, SMatrix, SVector};

/// Minimizes `Σ ρ((d₁² + d₂²)/2 / threshold²)` over the eight entries beside `H[2][2] = 1`, with `d₂` the distance from
/// `b` to `H a` and `d₁` that from `a` to `H⁻¹ b`.
pub(crate) struct TransferProblem<'a, C: Scorer> {
    pub(crate) pairs: &'a [[f64; 4]],
    pub(crate) scorer: &'a C,
    pub(crate) threshold: f64,
}

/// The sums of one direction: `Σ k u^i v^j p pᵀ` by the nine entries of the matrix that maps `p`.
#[derive(Clone, Copy)]
struct OneWay {
    /// Of xx, xy, yy, x, y, 1: Σ k, Σ k u, Σ k v, Σ k (u² + v²). Four side by side suit a vector unit.
    moments: [[f64; 4]; 6],
    /// Derivative of half the cost by the nine entries, row-major.
    gradient: [f64; 9],
}

impl OneWay {
    const ZERO: Self = Self { moments: [[0.0; 4]; 6], gradient: [0.0; 9] };

    /// Adds a point `(x, y)` that is mapped to `(u, v)` with denominator `w`, off by `(ru, rv)`.
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

impl<C: Scorer> TransferProblem<'_, C> {
    /// `H a`, `1/w`, `H⁻¹ b`, `1/w'`, and `u`, beyond the cutoff where a map sends its point behind.
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

    #[inline(always)]
    fn sum(&self, h: &Matrix3<f64>, g: &Matrix3<f64>) -> f64 {
        let mut cost = 0.0;
        for pair in self.pairs {
            let u = self.terms(h, g, pair).2;
            cost += if u < self.scorer.cutoff() { f64::from(self.scorer.loss(u as f32)) } else { 1.0 };
        }
        cost
    }

    #[inline(always)]
    fn sums(&self, h: &Matrix3<f64>, g: &Matrix3<f64>) -> (f64, OneWay, OneWay) {
        let (mut forth, mut back) = (OneWay::ZERO, OneWay::ZERO);
        let mut cost = 0.0;
        for pair in self.pairs {
            let (a, b, u) = self.terms(h, g, pair);
            // Not where it is NaN.
            if u < self.scorer.cutoff() {
                let [x, y, s, t] = *pair;
                cost += f64::from(self.scorer.loss(u as f32));
                let weight = self.scorer.weight(u);
                forth.add([x, y], a, [a[0] - s, a[1] - t], weight);
                back.add([s, t], b, [b[0] - x, b[1] - y], weight);
            } else {
                cost += 1.0;
            }
        }
        (cost, forth, back)
    }
}

/// The inverse of a homography with `H[2][2] = 1`, up to the sign that makes mapping back go to the front.
pub(crate) fn inverse(h: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    h.try_inverse()
}

impl<C: Scorer> LeastSquares for TransferProblem<'_, C> {
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
        // No product is fused, so every instruction set gives the same bits.
        let (cost, forth, back) = dispatch!(Level::new(), _simd => self.sums(h, &g));
        // dG = −G dH G, so by entries: dG[i][j] = −Σ G[i][k] G[l][j] dH[k][l].
        let turn = SMatrix::<f64, 9, 9>::from_fn(|r, c| -g[(r / 3, c / 3)] * g[(c % 3, r % 3)]);
        let hessian = forth.hessian() + turn.transpose() * back.hessian() * turn;
        let gradient = SVector::from(forth.gradient) + turn.transpose() * SVector::from(back.gradient);
        equations.cost = cost;
        equations.hessian.copy_from(&hessian.fixed_view::<8, 8>(0, 0));
        equations.gradient.copy_from(&gradient.fixed_rows::<8>(0));
        equations
    }

    fn step(&self, h: &Matrix3<f64>, delta: &SVector<f64, 8>) -> Matrix3<f64> {
        let mut moved = *h;
        for (i, d) in delta.iter().enumerate() {
            moved[(i / 3, i % 3)] += d;
        }
        moved
    }
}

/// At most `iterations` Levenberg–Marquardt steps from `h`, which need not be scaled.
pub(crate) fn refine_transfer<C: Scorer>(
    problem: &TransferProblem<'_, C>,
    h: &Matrix3<f64>,
    iterations: usize,
) -> Option<Matrix3<f64>> {
    // The origin is amid the points of the first image, where no homography that a camera could make has its horizon.
    if h[(2, 2)].abs() <= 1e-9 * h.norm() {
        return None;
    }
    let options = LmOptions { max_iterations: iterations, cost_tolerance: 1e-6, ..LmOptions::default() };
    let report = levenberg_marquardt(problem, h / h[(2, 2)], &options);
    (report.cost < report.initial_cost).then_some(report.params)
}
