//! Levenberg–Marquardt over parameter blocks.

use super::error::AdjustError;
use super::factor::Analysis;
use super::normal::{DIAGONAL_FLOOR, Normal, POINTS_PER_TASK, Reduced};
use super::residual::{LossModel, ResidualSums, Values};
use super::structure::Structure;
use super::{Adjustment, GroupId};
use cv_parallel::prelude::*;
use std::ops::ControlFlow;

/// Termination criteria and initial damping of [`Adjustment::solve`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct AdjustOptions {
    /// Maximum number of linearizations. Default 100, that of COLMAP.
    pub max_iterations: usize,
    /// Initial damping, relative to the diagonal. Default 1e-4, as in Ceres.
    pub initial_damping: f64,
    /// Relative decrease of the cost below which the solver stops. Default 1e-9: parameters are then within about 3e-5 of their
    /// standard deviations.
    pub cost_tolerance: f64,
    /// Scaled gradient below which the solver stops: the largest cosine of the angle between the residuals and a column of their
    /// Jacobian. Default 1e-10.
    pub gradient_tolerance: f64,
    /// Largest entry of a step below which the solver stops, in the parameters' unit. Default 1e-14.
    pub step_tolerance: f64,
}

impl Default for AdjustOptions {
    fn default() -> Self {
        Self {
            max_iterations: 100,
            initial_damping: 1e-4,
            cost_tolerance: 1e-9,
            gradient_tolerance: 1e-10,
            step_tolerance: 1e-14,
        }
    }
}

/// State of the solver at a callback, before each step is computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdjustIteration {
    /// Steps tried so far.
    pub steps: usize,
    /// Linearizations so far, including the first.
    pub iterations: usize,
    /// Cost at the present parameters, the lowest so far.
    pub cost: f64,
    /// Damping of the next step, relative to the diagonal.
    pub damping: f64,
}

/// Why an adjustment ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Termination {
    /// The relative decrease of the cost was below [`AdjustOptions::cost_tolerance`].
    Cost,
    /// The gradient was below [`AdjustOptions::gradient_tolerance`].
    Gradient,
    /// The step was below [`AdjustOptions::step_tolerance`].
    Step,
    /// No step decreased the cost, even at maximum damping.
    NoStep,
    /// [`AdjustOptions::max_iterations`] was reached.
    Iterations,
    /// The callback stopped it.
    Stopped,
}

/// Result of [`Adjustment::solve`].
#[derive(Debug, Clone, PartialEq)]
pub struct AdjustReport {
    /// `Σ ρ(‖r‖²)` at the start.
    pub initial_cost: f64,
    /// The same at the end, never above the start.
    pub cost: f64,
    /// Linearizations.
    pub iterations: usize,
    /// Steps tried.
    pub steps: usize,
    /// Why it ended.
    pub termination: Termination,
}

impl AdjustReport {
    /// Whether a tolerance was met.
    pub fn converged(&self) -> bool {
        !matches!(self.termination, Termination::Iterations | Termination::Stopped)
    }
}

/// A candidate step and its predicted decrease.
pub(super) struct Step {
    /// Step of the reduced system's columns, and of the eliminated blocks in their original order.
    pub(super) columns: Vec<f64>,
    pub(super) points: Vec<f64>,
    /// Decrease of the cost that the quadratic model predicts.
    predicted: f64,
    largest: f64,
}

/// Relative decrease of the cost below which the curvature of the losses is used: near a minimum residuals hardly change, so the
/// curvature is reliable.
const CURVATURE_RELATIVE_GAIN: f64 = 0.01;
/// Gain ratio from which a step is extended, and the maximum extension factor. (On fountain-P11 with Cauchy loss, 9 iterations then
/// decrease the cost more than 24 without; at a factor of 4 most extensions are rejected.)
const MIN_EXTENSION_GAIN_RATIO: f64 = 1.25;
const MAX_STEP_EXTENSION: f64 = 1.7;
/// Bounds of the damping, relative to the diagonal.
const MIN_DAMPING: f64 = 1e-16;
const MAX_DAMPING: f64 = 1e16;

impl Adjustment<'_> {
    /// Minimizes `Σ ρ(‖r‖²)` from the present values, in place.
    ///
    /// Levenberg–Marquardt with the damping of Nielsen ("Damping parameter in Marquardt's method", 1999) relative to the diagonal. Robust
    /// losses enter by their weights (iteratively reweighted least squares), a majorizer of the cost from any start. That converges only
    /// linearly, so near the minimum their curvature along the residual is used too (Triggs et al., "Bundle adjustment — a modern
    /// synthesis", 2000, §4.3), bounded so that `Σ JᵀJ` stays definite. Covariances use the weights.
    /// The eliminated group is solved for by the Schur complement. Each iteration costs O(residuals) and the factorization
    /// of the reduced system, O(n³) for n parameters where that is dense.
    ///
    /// `on_iteration` is called before every step and may stop the solver. The cost is never above that of the start, and the values do
    /// not depend on the number of threads.
    ///
    /// # Errors
    /// [`AdjustError::NoResiduals`]; [`AdjustError::NotFinite`] and [`AdjustError::Undefined`] for the start. The values are then unchanged.
    pub fn solve(
        &mut self,
        options: &AdjustOptions,
        mut on_iteration: impl FnMut(&AdjustIteration) -> ControlFlow<()> + Send,
    ) -> Result<AdjustReport, AdjustError> {
        self.check_start()?;
        // Run on a thread of the pool, so that parallel loops need no hand-over to it.
        rayon::scope(|_| self.iterate(options, &mut on_iteration))
    }

    fn iterate(
        &mut self,
        options: &AdjustOptions,
        on_iteration: &mut (dyn FnMut(&AdjustIteration) -> ControlFlow<()> + Send),
    ) -> Result<AdjustReport, AdjustError> {
        let structure = Structure::new(&self.groups, &self.kinds, self.eliminated, false);
        let analysis = Analysis::new(&structure);
        let mut normal = Normal::default();
        let mut reduced = Reduced::default();
        normal.linearize(&self.kinds, &structure, &self.values, LossModel::Weight).map_err(|u| self.undefined(u))?;
        let initial_cost = self.kinds.iter().map(|k| k.cost(&self.values)).sum();
        let (mut damping, mut growth) = (options.initial_damping, 2.0);
        let mut model = LossModel::Weight;
        let mut moved = self.values.clone();
        let mut report = AdjustReport {
            initial_cost,
            cost: initial_cost,
            iterations: 1,
            steps: 0,
            termination: Termination::NoStep,
        };
        let end = |report: AdjustReport, termination| Ok(AdjustReport { termination, ..report });
        if normal.cosine(structure.points.as_ref().map_or(0, |p| p.size), report.cost) <= options.gradient_tolerance {
            return end(report, Termination::Gradient);
        }
        loop {
            let state =
                AdjustIteration { steps: report.steps, iterations: report.iterations, cost: report.cost, damping };
            if on_iteration(&state).is_break() {
                return end(report, Termination::Stopped);
            }
            report.steps += 1;
            let step = analysis.as_ref().and_then(|a| normal.step(&structure, a, damping, &mut reduced));
            let cost = match &step {
                Some(step) if step.largest <= options.step_tolerance => return end(report, Termination::Step),
                // The predicted decrease is below rounding.
                Some(step) if step.predicted <= f64::EPSILON * report.cost => return end(report, Termination::Cost),
                Some(step) => {
                    self.move_by(&structure, step, &mut moved);
                    self.kinds.iter().map(|k| k.cost(&moved)).sum()
                }
                None => f64::INFINITY,
            };
            let Some(mut step) = step.filter(|_| cost < report.cost) else {
                // The weights' quadratic majorizes the cost, so its step decreases it where that of the curvature model did not.
                if model == LossModel::Curvature {
                    model = LossModel::Weight;
                    if normal.linearize(&self.kinds, &structure, &self.values, model).is_ok() {
                        report.iterations += 1;
                        continue;
                    }
                    return end(report, Termination::NoStep);
                }
                damping *= growth;
                growth *= 2.0;
                if damping > MAX_DAMPING {
                    return end(report, Termination::NoStep);
                }
                continue;
            };
            let gain_ratio = (report.cost - cost) / step.predicted;
            let cost = self.extend_step(&structure, &mut step, gain_ratio, cost, &mut moved);
            let gain = report.cost - cost;
            std::mem::swap(&mut self.values, &mut moved);
            let done = gain < options.cost_tolerance * report.cost;
            report.cost = cost;
            if done || report.iterations >= options.max_iterations {
                return end(report, if done { Termination::Cost } else { Termination::Iterations });
            }
            damping *= (1.0 - (2.0 * gain_ratio - 1.0).powi(3)).max(1.0 / 3.0);
            damping = damping.max(MIN_DAMPING);
            growth = 2.0;
            // A low gain ratio shows that the curvature model is not reliable here.
            let near = gain < CURVATURE_RELATIVE_GAIN * report.cost && gain_ratio > 0.75;
            model = if near { LossModel::Curvature } else { LossModel::Weight };
            if normal.linearize(&self.kinds, &structure, &self.values, model).is_err() {
                // The cost is finite here: only a derivative can be undefined.
                return end(report, Termination::NoStep);
            }
            report.iterations += 1;
            let points = structure.points.as_ref().map_or(0, |p| p.size);
            if normal.cosine(points, report.cost) <= options.gradient_tolerance {
                return end(report, Termination::Gradient);
            }
        }
    }

    /// Extends a step with a high gain ratio, which led to `cost` at `moved`: to the minimum of the parabola through that cost and the initial
    /// slope, at most by [`MAX_STEP_EXTENSION`]. Keeps the better of both and returns the cost at `moved`.
    ///
    /// The weights' quadratic is more curved than the losses, so that steps of iteratively reweighted least squares are too short.
    fn extend_step(
        &self,
        structure: &Structure,
        step: &mut Step,
        gain_ratio: f64,
        cost: f64,
        moved: &mut Values,
    ) -> f64 {
        if gain_ratio < MIN_EXTENSION_GAIN_RATIO {
            return cost;
        }
        // Maximum of gain(α) = 2α − cα² in units of the predicted decrease, with gain(1) = gain_ratio.
        let factor = 1.0 / (2.0 - gain_ratio).max(1.0 / MAX_STEP_EXTENSION);
        step.columns.iter_mut().chain(&mut step.points).for_each(|d| *d *= factor);
        let mut further = self.values.clone();
        self.move_by(structure, step, &mut further);
        let beyond = self.kinds.iter().map(|k| k.cost(&further)).sum::<f64>();
        if beyond < cost {
            *moved = further;
            return beyond;
        }
        cost
    }

    /// Sums over the residuals at the present values, for each kind in the order of addition.
    ///
    /// # Errors
    /// As [`Adjustment::solve`].
    pub fn residual_sums(&self) -> Result<Vec<ResidualSums>, AdjustError> {
        self.check_start()?;
        let sum = |k: usize| self.kinds[k].sums(&self.values).map_err(|item| self.undefined((k, item)));
        rayon::scope(|_| (0..self.kinds.len()).map(sum).collect())
    }

    pub(super) fn check_start(&self) -> Result<(), AdjustError> {
        if self.kinds.iter().all(|k| k.len() == 0) {
            return Err(AdjustError::NoResiduals);
        }
        self.check_eliminated()?;
        for (g, group) in self.groups.iter().enumerate() {
            if let Some(i) = self.values.numbers[g].iter().position(|v| !v.is_finite()) {
                let block = i / self.values.ambient[g];
                return Err(AdjustError::NotFinite { group: group.name.clone(), block });
            }
        }
        Ok(())
    }

    pub(super) fn undefined(&self, (kind, item): (usize, usize)) -> AdjustError {
        AdjustError::Undefined { residuals: self.kinds[kind].name().to_owned(), item }
    }

    /// Applies a step to the present values and writes the result to `moved`.
    fn move_by(&self, structure: &Structure, step: &Step, moved: &mut Values) {
        for block in &structure.blocks {
            for member in &block.members {
                let group = &self.groups[member.group];
                let n = self.values.ambient[member.group];
                let free = &step.columns[block.column + member.within..][..member.width];
                let fixed = group.fixed[member.block as usize];
                let mut delta = [0.0; 64];
                let mut free = free.iter();
                for (k, d) in delta[..group.size].iter_mut().enumerate() {
                    if fixed >> k & 1 == 0 {
                        *d = free.next().copied().unwrap_or(0.0);
                    }
                }
                let x = self.values.block(member.group, member.block as usize);
                let to = &mut moved.numbers[member.group][member.block as usize * n..][..n];
                group.manifold.step(x, &delta[..group.size], to);
            }
        }
        if let Some(points) = &structure.points {
            let group = &self.groups[points.group];
            let n = self.values.ambient[points.group];
            let parts = moved.numbers[points.group].par_chunks_mut(POINTS_PER_TASK * n);
            let parts = parts.zip(self.values.numbers[points.group].par_chunks(POINTS_PER_TASK * n));
            parts.zip(step.points.par_chunks(POINTS_PER_TASK * points.size)).for_each(|((to, x), delta)| {
                let blocks = to.chunks_exact_mut(n).zip(x.chunks_exact(n)).zip(delta.chunks_exact(points.size));
                blocks.for_each(|((to, x), delta)| group.manifold.step(x, delta, to));
            });
        }
    }

    /// Returns the values of all blocks of a group, block after block.
    pub fn values(&self, group: GroupId) -> &[f64] {
        &self.values.numbers[group.0]
    }
}

impl Normal {
    /// Computes the largest cosine of the angle between the residuals and a column of the Jacobian, `|g_i| / √(H_ii · cost)`.
    fn cosine(&self, size: usize, cost: f64) -> f64 {
        let of = |g: f64, h: f64| if g == 0.0 { 0.0 } else { g.abs() / (h * cost).sqrt() };
        let columns = self.gradient.iter().zip(&self.diagonal).map(|(g, h)| of(*g, *h));
        let points = self.point_gradient.iter().enumerate().map(|(i, g)| {
            let (p, k) = (i / size, i % size);
            of(*g, self.v[p * size * size + k * size + k])
        });
        columns.chain(points).fold(0.0, f64::max)
    }

    /// Computes the damped step; `None` where the system is not positive definite.
    pub(super) fn step(
        &self,
        structure: &Structure,
        analysis: &Analysis,
        damping: f64,
        reduced: &mut Reduced,
    ) -> Option<Step> {
        self.reduce(structure, damping, reduced).ok()?;
        let mut columns: Vec<f64> = reduced.gradient.iter().map(|g| -g).collect();
        if !columns.is_empty() {
            analysis.factor(structure, &reduced.s)?.solve(columns.len(), &mut columns);
        }
        let by_rank = self.back_substitute(structure, reduced, &columns);
        // −2 gᵀδ − δᵀHδ of the damped system's solution (H + D) δ = −g is −gᵀδ + δᵀDδ.
        let added = self.damping_terms(damping);
        let mut predicted: f64 =
            columns.iter().zip(&self.gradient).zip(&added).map(|((d, g), a)| d * (a * d - g)).sum();
        let mut points = Vec::new();
        if let Some(eliminated) = &structure.points {
            let e = eliminated.size;
            points.reserve(by_rank.len());
            for rank in &eliminated.rank {
                points.extend_from_slice(&by_rank[*rank as usize * e..][..e]);
            }
            let gradients = self.point_gradient.chunks_exact(e).zip(self.v.chunks_exact(e * e));
            for (d, (g, v)) in by_rank.chunks_exact(e).zip(gradients) {
                let floor = DIAGONAL_FLOOR * (0..e).map(|k| v[k * e + k]).sum::<f64>();
                predicted += (0..e).map(|k| d[k] * ((damping * v[k * e + k] + floor) * d[k] - g[k])).sum::<f64>();
            }
        }
        let largest = columns.iter().chain(&points).fold(0.0, |m: f64, d| m.max(d.abs()));
        let finite = predicted.is_finite() && largest.is_finite();
        finite.then_some(Step { columns, points, predicted, largest })
    }
}
