//! The one RANSAC driver.

mod options;
mod sampler;
mod scorer;

pub use options::{RobustOptions, Sampling, Scoring};
pub use sampler::{Prosac, Sampler, Uniform};
pub(crate) use scorer::AllIn;
pub use scorer::{Marginal, Msac, Scorer};

use crate::EstimateError;
use crate::pairs::LANES;
use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

/// What a robust estimation has to know about a model.
///
/// Distances are in the estimator's own (normalised) unit; [`Estimator::unit`] says how many of them a unit of the caller's is.
pub trait Estimator: Sync {
    /// The model.
    type Model: Clone + Send + Sync;
    /// [`LANES`] data, coordinate by coordinate; missing data are NaN.
    type Block: Sync;
    /// A model made ready for [`Estimator::squared_residuals`].
    type Kernel;
    /// Size of a minimal sample.
    const SAMPLE: usize;
    /// Dimension of the residuals of right data: 1 for distances from a line, 2 for distances from a point.
    const RESIDUAL_DIMENSION: i32;
    /// Local optimisation starts at a threshold widened by 2 to this power, and halves it: for models whose minimal
    /// solutions are far off and whose loss has many local minima.
    const WIDENINGS: u32 = 0;

    /// Number of data.
    fn count(&self) -> usize;

    /// Estimator units per unit of the caller's threshold.
    fn unit(&self) -> f64;

    /// All data, in random order.
    fn blocks(&self) -> &[Self::Block];

    /// Appends the models through a minimal sample; none where the sample is degenerate or impossible.
    fn solve(&self, sample: &[u32], models: &mut Vec<Self::Model>);

    /// Makes a model ready.
    fn kernel(&self, model: &Self::Model) -> Self::Kernel;

    /// Squared residuals of a block. NaN means that the datum does not fit. Must be `#[inline(always)]`.
    fn squared_residuals(kernel: &Self::Kernel, block: &Self::Block) -> [f32; LANES];

    /// Lowers the sum of `scorer`'s loss, starting at `model`, by at most `iterations` steps.
    ///
    /// `threshold` is in estimator units. `None` where no step could be made.
    fn refine<C: Scorer>(
        &self,
        model: &Self::Model,
        scorer: &C,
        threshold: f64,
        iterations: usize,
    ) -> Option<Self::Model>;

    /// Appends models to try beside a new best `model`, made from `sample`, where that sample may be degenerate.
    ///
    /// `threshold` is in estimator units. By default, none.
    fn alternatives(&self, model: &Self::Model, sample: &[u32], threshold: f64, models: &mut Vec<Self::Model>) {
        let _ = (model, sample, threshold, models);
    }
}

/// How well a model fits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Score {
    /// Sum of losses, each 0 to 1.
    pub loss: f32,
    /// Data within the threshold.
    pub inliers: u32,
}

impl Score {
    const WORST: Self = Self { loss: f32::INFINITY, inliers: 0 };
}

/// What [`ransac()`] found.
#[derive(Debug, Clone)]
pub struct Consensus<M> {
    /// The model of least loss, refined.
    pub model: M,
    /// Its score.
    pub score: Score,
    /// Samples drawn.
    pub iterations: usize,
}

/// Sum of losses over all blocks, or [`Score::WORST`] as soon as it is certain to exceed `limit`.
///
/// Lanes are summed on their own in a fixed order and no product is fused, so every instruction set gives the same bits.
#[inline(always)]
fn score_blocks<E: Estimator, C: Scorer>(
    kernel: &E::Kernel,
    blocks: &[E::Block],
    padding: usize,
    scorer: &C,
    inverse_threshold2: f32,
    limit: f32,
) -> Score {
    // The losses of the padding lanes, 1 each, are known from the start.
    let limit = limit + padding as f32;
    let mut losses = [0f32; LANES];
    let mut inliers = [0u32; LANES];
    for run in blocks.chunks(4) {
        for block in run {
            let r2 = E::squared_residuals(kernel, block);
            for i in 0..LANES {
                let u = r2[i] * inverse_threshold2;
                losses[i] += scorer.loss(u);
                inliers[i] += u32::from(u < 1.0);
            }
        }
        if sum(&losses) > limit {
            return Score::WORST;
        }
    }
    Score { loss: sum(&losses) - padding as f32, inliers: inliers.iter().sum() }
}

#[inline(always)]
fn sum(lanes: &[f32; LANES]) -> f32 {
    let mut half = [0f32; LANES / 2];
    for i in 0..LANES / 2 {
        half[i] = lanes[i] + lanes[i + LANES / 2];
    }
    ((half[0] + half[4]) + (half[1] + half[5])) + ((half[2] + half[6]) + (half[3] + half[7]))
}

/// Scores models of one estimator against its data.
struct Judge<'a, E: Estimator, C: Scorer> {
    estimator: &'a E,
    scorer: &'a C,
    /// In estimator units.
    threshold: f64,
    level: Level,
    inverse_threshold2: f32,
    padding: usize,
}

impl<'a, E: Estimator, C: Scorer> Judge<'a, E, C> {
    fn new(estimator: &'a E, scorer: &'a C, threshold: f64) -> Self {
        let threshold = threshold * estimator.unit();
        Self {
            estimator,
            scorer,
            threshold,
            level: Level::new(),
            inverse_threshold2: (1.0 / (threshold * threshold)) as f32,
            padding: estimator.blocks().len() * LANES - estimator.count(),
        }
    }

    /// The score, or [`Score::WORST`] where the loss is certain to exceed `limit`.
    fn score(&self, model: &E::Model, limit: f32) -> Score {
        let kernel = self.estimator.kernel(model);
        let (blocks, padding, scale) = (self.estimator.blocks(), self.padding, self.inverse_threshold2);
        dispatch!(self.level, _simd => score_blocks::<E, C>(&kernel, blocks, padding, self.scorer, scale, limit))
    }

    /// Local optimisation: `model` after refinement, where that lowered the loss below `score`'s.
    fn improve(&self, model: &mut E::Model, score: &mut Score, iterations: usize) {
        let mut start = model.clone();
        let widenings = if C::WIDENS { E::WIDENINGS } else { 0 };
        for k in (1..=widenings).rev() {
            let wide = self.threshold * f64::from(1u32 << k);
            if let Some(better) = self.estimator.refine(&start, self.scorer, wide, WIDE_STEPS) {
                start = better;
            }
        }
        if let Some(refined) = self.estimator.refine(&start, self.scorer, self.threshold, iterations) {
            let better = self.score(&refined, score.loss);
            if better.loss < score.loss {
                *model = refined;
                *score = better;
            }
        }
    }
}

/// The scale of Tukey's biweight, in standard deviations, at which it is 95 % as good as least squares on Gaussian errors (Huber &
/// Ronchetti, "Robust statistics", 2009).
const BIWEIGHT: f64 = 4.685;
/// Rounds of noise and refinement at the end; a third changes the model by less than a tenth of its deviation.
const POLISH: usize = 2;

impl<E: Estimator, C: Scorer> Judge<'_, E, C> {
    /// Refines on the noise that the data show instead of the threshold that they were searched with: small noise leaves room for wrong
    /// data that happen to fit, large noise loses right ones.
    fn polish(&self, model: &mut E::Model) {
        for _ in 0..POLISH {
            let Some(sigma) = self.noise(model) else { return };
            let threshold = BIWEIGHT * sigma * self.threshold / Marginal.cutoff().sqrt();
            let Some(better) = self.estimator.refine(model, &Marginal, threshold, FINAL_STEPS) else { return };
            *model = better;
        }
    }

    /// Standard deviation of the residuals of right data in thresholds, by expectation maximisation on a mixture of a Gaussian and an even
    /// background (MLESAC, Torr & Zisserman 2000); the background is what is found from 3 to 10 thresholds away. At most one threshold.
    fn noise(&self, model: &E::Model) -> Option<f64> {
        let kernel = self.estimator.kernel(model);
        let scale = self.inverse_threshold2;
        let near: Vec<f64> = self
            .estimator
            .blocks()
            .iter()
            .flat_map(|block| E::squared_residuals(&kernel, block))
            .map(|r2| f64::from(r2 * scale))
            .filter(|u| *u < 100.0)
            .collect();
        let shell = near.iter().filter(|u| **u >= 9.0).count() as f64;
        let one = E::RESIDUAL_DIMENSION == 1;
        let density = shell / if one { 14.0 } else { 91.0 * std::f64::consts::PI };
        let mut sigma2 = 0.25;
        let mut inliers = 0.5 * near.len() as f64;
        for _ in 0..12 {
            let peak = inliers * (std::f64::consts::TAU * sigma2).powf(-0.5 * f64::from(E::RESIDUAL_DIMENSION));
            let (mut sum, mut weights) = (0.0, 0.0);
            for u in &near {
                let g = peak * (-0.5 * u / sigma2).exp();
                let w = g / (g + density + 1e-12);
                sum += w * u;
                weights += w;
            }
            if weights < E::SAMPLE as f64 {
                return None;
            }
            inliers = weights;
            sigma2 = (sum / (f64::from(E::RESIDUAL_DIMENSION) * weights)).clamp(1e-6, 1.0);
        }
        Some(sigma2.sqrt())
    }
}
/// Samples of one batch. A batch is judged as a whole, so the result does not depend on how it is spread over threads.
const BATCH: usize = 16;
/// Data from which on a batch is spread over threads: below, a batch is done before a thread wakes up.
const PARALLEL_FROM: usize = 8192;
/// Steps of a local optimisation inside the loop, and at the end.
const LOCAL_STEPS: usize = 4;
const FINAL_STEPS: usize = 20;
const WIDE_STEPS: usize = 3;

/// The loop.
///
/// Every model that is the best so far is locally optimised on the same loss it is judged by. A model is given up as
/// soon as its loss exceeds the best, which never changes the result.
fn search<E: Estimator, C: Scorer, S: Sampler>(
    judge: &Judge<'_, E, C>,
    sampler: &mut S,
    options: &RobustOptions,
) -> Option<Consensus<E::Model>> {
    let estimator = judge.estimator;
    let n = estimator.count();
    let mut best: Option<(E::Model, Score)> = None;
    let mut samples = vec![[0u32; 8]; BATCH];
    let mut models = Vec::new();
    let mut iterations = 0;
    let mut needed = options.max_iterations;
    while iterations < needed {
        let count = BATCH.min(needed - iterations);
        for sample in &mut samples[..count] {
            sampler.draw(&mut sample[..E::SAMPLE]);
        }
        iterations += count;
        let limit = best.as_ref().map_or(f32::INFINITY, |b| b.1.loss);
        let winner = if n < PARALLEL_FROM {
            best_of(judge, &samples[..count], limit, &mut models)
        } else {
            samples[..count]
                .par_iter()
                .map(|sample| best_of(judge, std::slice::from_ref(sample), limit, &mut Vec::new()))
                .reduce(
                    || None,
                    |a, b| match (&a, &b) {
                        // The earlier of two equals, as in one thread.
                        (Some(x), Some(y)) if y.score.loss < x.score.loss => b,
                        (None, _) => b,
                        _ => a,
                    },
                )
        };
        if let Some(Winner { mut model, mut score, sample }) = winner {
            models.clear();
            estimator.alternatives(&model, &sample[..E::SAMPLE], judge.threshold, &mut models);
            judge.improve(&mut model, &mut score, LOCAL_STEPS);
            // The best alternative is refined before it is compared: the model already was.
            let mut other: Option<(E::Model, Score)> = None;
            for candidate in models.drain(..) {
                let s = judge.score(&candidate, other.as_ref().map_or(f32::INFINITY, |o| o.1.loss));
                if other.as_ref().is_none_or(|o| s.loss < o.1.loss) {
                    other = Some((candidate, s));
                }
            }
            if let Some((mut candidate, mut s)) = other {
                judge.improve(&mut candidate, &mut s, LOCAL_STEPS);
                if s.loss < score.loss {
                    (model, score) = (candidate, s);
                }
            }
            best = Some((model, score));
            needed = options.needed(score.inliers as usize, n, E::SAMPLE);
        }
    }
    let (mut model, mut score) = best?;
    if E::WIDENINGS > 0 {
        judge.improve(&mut model, &mut score, FINAL_STEPS);
    }
    judge.polish(&mut model);
    score = judge.score(&model, f32::INFINITY);
    Some(Consensus { model, score, iterations })
}

/// The best model of a batch.
struct Winner<M> {
    model: M,
    score: Score,
    sample: [u32; 8],
}

/// The model of least loss below `limit` of all samples; the earliest of equals.
fn best_of<E: Estimator, C: Scorer>(
    judge: &Judge<'_, E, C>,
    samples: &[[u32; 8]],
    mut limit: f32,
    models: &mut Vec<E::Model>,
) -> Option<Winner<E::Model>> {
    let mut best = None;
    for sample in samples {
        models.clear();
        judge.estimator.solve(&sample[..E::SAMPLE], models);
        for model in models.drain(..) {
            let score = judge.score(&model, limit);
            if score.loss < limit {
                limit = score.loss;
                best = Some(Winner { model, score, sample: *sample });
            }
        }
    }
    best
}

/// Draws samples until one without outliers was drawn with the stated confidence, keeps the model of least loss and refines it.
///
/// This is the loop behind every `estimate_…` function, for models of one's own: RANSAC (Fischler & Bolles 1981) with
/// a smooth loss (MSAC, Torr & Zisserman 2000; MAGSAC++, Barath et al. 2020) and local optimisation (LO-RANSAC, Chum et
/// al. 2003) on the same loss. O(samples × data).
///
/// # Errors
/// [`EstimateError::BadOption`], [`EstimateError::NotEnoughMatches`] with fewer data than a sample has, and
/// [`EstimateError::NoConsensus`] where no model fits more data than its own sample.
pub fn ransac<E: Estimator>(estimator: &E, options: &RobustOptions) -> Result<Consensus<E::Model>, EstimateError> {
    options.check()?;
    match options.scoring {
        Scoring::Msac => with_scorer(estimator, options, &Msac),
        Scoring::Marginal => with_scorer(estimator, options, &Marginal),
    }
}

fn with_scorer<E: Estimator, C: Scorer>(
    estimator: &E,
    options: &RobustOptions,
    scorer: &C,
) -> Result<Consensus<E::Model>, EstimateError> {
    let n = estimator.count();
    if n < E::SAMPLE {
        return Err(EstimateError::NotEnoughMatches { got: n, needed: E::SAMPLE });
    }
    let judge = Judge::new(estimator, scorer, options.threshold);
    let found = match options.sampling {
        Sampling::Uniform => search(&judge, &mut Uniform::new(n, options.seed), options),
        Sampling::Prosac => {
            search(&judge, &mut Prosac::new(n, E::SAMPLE, options.max_iterations, options.seed), options)
        }
    };
    // The sample itself always fits.
    let needed = if n > E::SAMPLE { E::SAMPLE + 1 } else { E::SAMPLE };
    let none = |inliers, iterations| EstimateError::NoConsensus { inliers, matches: n, needed, iterations };
    match found {
        None => Err(none(0, options.max_iterations)),
        Some(c) if (c.score.inliers as usize) < needed => Err(none(c.score.inliers as usize, c.iterations)),
        Some(c) => Ok(c),
    }
}
