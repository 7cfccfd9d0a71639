//! Levenberg–Marquardt on normal equations.

use nalgebra::allocator::Allocator;
use nalgebra::{Cholesky, DefaultAllocator, Dim, OMatrix, OVector, U1};

/// The quadratic model of a cost at some parameters: `cost + 2 gᵀδ + δᵀHδ`, with `H = Σ w JᵀJ`, `g = Σ w Jᵀr`.
#[derive(Debug, Clone)]
pub struct NormalEquations<D: Dim>
where
    DefaultAllocator: Allocator<D, D> + Allocator<D>,
{
    /// `Σ ρ(r²)`.
    pub cost: f64,
    /// `Σ w JᵀJ`. Only the lower triangle is read.
    pub hessian: OMatrix<f64, D, D>,
    /// `Σ w Jᵀr`.
    pub gradient: OVector<f64, D>,
}

impl<D: Dim> NormalEquations<D>
where
    DefaultAllocator: Allocator<D, D> + Allocator<D>,
{
    /// All zero.
    pub fn zeros(dim: D) -> Self {
        Self { cost: 0.0, hessian: OMatrix::zeros_generic(dim, dim), gradient: OVector::zeros_generic(dim, U1) }
    }

    /// Adds one scalar residual `r` with its Jacobian and a weight.
    #[inline]
    pub fn add(&mut self, r: f64, jacobian: &OVector<f64, D>, weight: f64) {
        let n = jacobian.len();
        for j in 0..n {
            let wj = weight * jacobian[j];
            self.gradient[j] += wj * r;
            for i in j..n {
                self.hessian[(i, j)] += wj * jacobian[i];
            }
        }
    }
}

/// A non-linear least-squares problem.
///
/// The parameters may live on a manifold: the solver only updates them by [`LeastSquares::step`].
pub trait LeastSquares {
    /// Number of degrees of freedom: `nalgebra::Const<N>` or `nalgebra::Dyn`.
    type Dim: Dim;
    /// Parameters.
    type Params: Clone;

    /// Returns the number of degrees of freedom.
    fn dim(&self) -> Self::Dim;

    /// Computes the cost `Σ ρ(r²)`; where it is infinite or NaN the solver rejects the step.
    fn cost(&self, params: &Self::Params) -> f64;

    /// Computes cost, gradient and Gauss–Newton Hessian.
    fn linearize(&self, params: &Self::Params) -> NormalEquations<Self::Dim>
    where
        DefaultAllocator: Allocator<Self::Dim, Self::Dim> + Allocator<Self::Dim>;

    /// Updates `params` by `delta` in the tangent space used by [`LeastSquares::linearize`].
    fn step(&self, params: &Self::Params, delta: &OVector<f64, Self::Dim>) -> Self::Params
    where
        DefaultAllocator: Allocator<Self::Dim>;
}

/// Termination criteria and initial damping of [`levenberg_marquardt`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct LmOptions {
    /// Maximum number of linearizations. Default 25, far more than two-view problems need.
    pub max_iterations: usize,
    /// Initial damping relative to the diagonal. Default 1e-3 (Marquardt 1963).
    pub initial_damping: f64,
    /// Relative decrease of the cost below which the solver stops. Default 1e-10.
    pub cost_tolerance: f64,
    /// Largest entry of a step below which the solver stops, in the parameters' unit. Default 1e-12.
    pub step_tolerance: f64,
}

impl Default for LmOptions {
    fn default() -> Self {
        Self { max_iterations: 25, initial_damping: 1e-3, cost_tolerance: 1e-10, step_tolerance: 1e-12 }
    }
}

/// Result of [`levenberg_marquardt`].
#[derive(Debug, Clone)]
pub struct LmReport<P> {
    /// The parameters of lowest cost.
    pub params: P,
    /// Cost at the start.
    pub initial_cost: f64,
    /// Cost of `params`, never above `initial_cost`.
    pub cost: f64,
    /// Number of linearizations.
    pub iterations: usize,
    /// Whether a tolerance was met; false where the iterations ran out or no step was accepted.
    pub converged: bool,
}

/// Minimizes `problem` from `initial` by Levenberg–Marquardt with Marquardt's diagonal scaling.
///
/// The cost is never above that of the start. A start of non-finite cost is returned unchanged.
/// Each iteration costs one linearization and one Cholesky factorization of the Hessian, O(dim³).
pub fn levenberg_marquardt<T: LeastSquares>(problem: &T, initial: T::Params, options: &LmOptions) -> LmReport<T::Params>
where
    DefaultAllocator: Allocator<T::Dim, T::Dim> + Allocator<T::Dim>,
{
    const MIN_DAMPING: f64 = 1e-12;
    const MAX_DAMPING: f64 = 1e12;
    let mut params = initial;
    let mut model = problem.linearize(&params);
    let initial_cost = model.cost;
    let mut iterations = 1;
    let mut damping = options.initial_damping;
    let report = |params, cost, iterations, converged| LmReport { params, initial_cost, cost, iterations, converged };
    if !initial_cost.is_finite() {
        return report(params, initial_cost, iterations, false);
    }
    loop {
        let dim = model.gradient.len();
        // The floor also damps parameters that no residual depends on, whose diagonal is zero.
        let floor = 1e-12 * (0..dim).map(|i| model.hessian[(i, i)]).fold(0.0, f64::max);
        let mut damped = model.hessian.clone();
        for i in 0..dim {
            damped[(i, i)] += damping * damped[(i, i)].max(floor);
        }
        let delta = match Cholesky::new(damped) {
            Some(factor) => -factor.solve(&model.gradient),
            None if damping < MAX_DAMPING && floor > 0.0 => {
                damping = (damping * 10.0).max(1e-6);
                continue;
            }
            None => return report(params, model.cost, iterations, floor == 0.0),
        };
        let step = delta.amax();
        if step.is_nan() || step <= options.step_tolerance {
            return report(params, model.cost, iterations, true);
        }
        let candidate = problem.step(&params, &delta);
        let cost = problem.cost(&candidate);
        if cost < model.cost {
            let gain = model.cost - cost;
            let done = gain < options.cost_tolerance * model.cost;
            params = candidate;
            if done || iterations >= options.max_iterations {
                return report(params, cost, iterations, done);
            }
            model = problem.linearize(&params);
            model.cost = cost;
            iterations += 1;
            damping = (damping * 0.1).max(MIN_DAMPING);
        } else {
            damping *= 10.0;
            if damping > MAX_DAMPING {
                return report(params, model.cost, iterations, true);
            }
        }
    }
}
