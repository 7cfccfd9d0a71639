//! Refinement of a homography on the symmetric transfer error.

use crate::ransac::Scorer;
use cv_core::Matrix3;
use cv_numeric::{LeastSquares, LmOptions, NormalEquations, levenberg_marquardt};
use nalgebra::{Const, SMatrix, SVector};

/// Minimises `Σ ρ((d₁² + d₂²)/2 / threshold²)` over the eight entries beside `H[2][2] = 1`, with `d₂` the distance from
/// `b` to `H a` and `d₁` that from `a` to `H⁻¹ b`.
pub(crate) struct TransferProblem<'a, C: Scorer> {
    pub(crate) pairs: &'a [[f64; 4]],
    pub(crate) scorer: &'a C,
    pub(crate) threshold: f64,
}

/// The sums of one direction: `Σ k u^i v^j p pᵀ` by the nine entries of the matrix that maps `p`.
#[derive(Clone, Copy)]
struct OneWay {
    /// Σ k ppᵀ, Σ k u ppᵀ, Σ k v ppᵀ, Σ k (u² + v²) ppᵀ; each xx, xy, yy, x, y, 1.
    moments: [[f64; 6]; 4],
    /// Derivative of half the cost by the nine entries, row-major.
    gradient: [f64; 9],
}

impl OneWay {
    const ZERO: Self = Self { moments: [[0.0; 6]; 4], gradient: [0.0; 9] };

    /// Adds a point `(x, y)` that is mapped to `(u, v)` with denominator `w`, off by `(ru, rv)`.
    #[inline(always)]
    fn add(&mut self, [x, y]: [f64; 2], [u, v, inverse_w]: [f64; 3], [ru, rv]: [f64; 2], weight: f64) {
        let k = weight * inverse_w * inverse_w;
        let p = [x * x, x * y, y * y, x, y, 1.0];
        let factors = [k, k * u, k * v, k * (u * u + v * v)];
        for (m, f) in self.moments.iter_mut().zip(factors) {
            for (sum, q) in m.iter_mut().zip(p) {
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
        let block = |m: &[f64; 6]| Matrix3::new(m[0], m[1], m[3], m[1], m[2], m[4], m[3], m[4], m[5]);
        let [a, u, v, uv] = self.moments.each_ref().map(block);
        let mut h = SMatrix::<f64, 9, 9>::zeros();
        for (row, column, b) in [(0, 0, a), (3, 3, a), (6, 6, uv), (6, 0, -u), (0, 6, -u), (6, 3, -v), (3, 6, -v)] {
            h.fixed_view_mut::<3, 3>(row, column).copy_from(&b);
        }
        h
    }
}

impl<C: Scorer> TransferProblem<'_, C> {
    /// Calls `f(a, b, H a, H⁻¹ b, 1/w, 1/w', u)` for each pair that both maps send to the front.
    #[inline(always)]
    fn each(&self, h: &Matrix3<f64>, g: &Matrix3<f64>, mut f: impl FnMut(&[f64; 4], [f64; 6], f64)) -> f64 {
        let scale = 0.5 / (self.threshold * self.threshold);
        let mut outside = 0.0;
        for pair in self.pairs {
            let [x, y, s, t] = *pair;
            let wa = 1.0 / (h[(2, 0)] * x + h[(2, 1)] * y + h[(2, 2)]);
            let wb = 1.0 / (g[(2, 0)] * s + g[(2, 1)] * t + g[(2, 2)]);
            let p = (h[(0, 0)] * x + h[(0, 1)] * y + h[(0, 2)]) * wa;
            let q = (h[(1, 0)] * x + h[(1, 1)] * y + h[(1, 2)]) * wa;
            let m = (g[(0, 0)] * s + g[(0, 1)] * t + g[(0, 2)]) * wb;
            let n = (g[(1, 0)] * s + g[(1, 1)] * t + g[(1, 2)]) * wb;
            let d2 = (p - s) * (p - s) + (q - t) * (q - t) + (m - x) * (m - x) + (n - y) * (n - y);
            let u = d2 * scale;
            if wa > 0.0 && wb > 0.0 && u < self.scorer.cutoff() {
                f(pair, [p, q, wa, m, n, wb], u);
            } else {
                outside += 1.0;
            }
        }
        outside
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
        let mut cost = 0.0;
        let outside = self.each(h, &g, |_, _, u| cost += f64::from(self.scorer.loss(u as f32)));
        cost + outside
    }

    fn linearize(&self, h: &Matrix3<f64>) -> NormalEquations<Const<8>> {
        let mut equations = NormalEquations::zeros(Const);
        let Some(g) = inverse(h) else {
            equations.cost = f64::INFINITY;
            return equations;
        };
        let (mut forth, mut back) = (OneWay::ZERO, OneWay::ZERO);
        let mut cost = 0.0;
        let outside = self.each(h, &g, |&[x, y, s, t], [p, q, wa, m, n, wb], u| {
            cost += f64::from(self.scorer.loss(u as f32));
            let weight = self.scorer.weight(u);
            forth.add([x, y], [p, q, wa], [p - s, q - t], weight);
            back.add([s, t], [m, n, wb], [m - x, n - y], weight);
        });
        // dG = −G dH G, so by entries: dG[i][j] = −Σ G[i][k] G[l][j] dH[k][l].
        let turn = SMatrix::<f64, 9, 9>::from_fn(|r, c| -g[(r / 3, c / 3)] * g[(c % 3, r % 3)]);
        let hessian = forth.hessian() + turn.transpose() * back.hessian() * turn;
        let gradient = SVector::from(forth.gradient) + turn.transpose() * SVector::from(back.gradient);
        equations.cost = cost + outside;
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
