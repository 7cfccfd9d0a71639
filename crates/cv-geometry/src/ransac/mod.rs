//! The one RANSAC driver.

mod chance;
mod judge;
mod options;
mod sampler;
mod scorer;
mod search;

pub use options::{RobustOptions, Sampling, Scoring};
pub use sampler::{Prosac, Sampler, Uniform};
pub(crate) use scorer::AllIn;
pub use scorer::{Marginal, Msac, Scorer};

use crate::EstimateError;
use crate::pairs::LANES;
use chance::chance;
use judge::Judge;
use search::search;

/// What a robust estimation has to know about a model.
///
/// Distances are in the estimator's own (normalized) unit; [`Estimator::unit`] says how many of them a unit of the caller's is.
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
    /// Samples drawn from the data near each new best model, in a row without a better one: for models whose minimal solutions are far off
    /// and whose loss has many local minima. 0 by default.
    const RESAMPLES: usize = 0;

    /// Number of data.
    fn count(&self) -> usize;

    /// Estimator units per unit of the caller's threshold.
    fn unit(&self) -> f64;

    /// All data, in random order.
    fn blocks(&self) -> &[Self::Block];

    /// The datum of each lane of the blocks; those of [`Estimator::RESAMPLES`] that are 0 are not asked.
    fn order(&self) -> &[u32] {
        &[]
    }

    /// Up to some `most` data that are wrong for certain: parts of different data put together. Chance is judged by how many of them fit a model. By
    /// default none, and chance is not asked.
    fn wrong(&self, most: usize) -> Vec<Self::Block> {
        let _ = most;
        Vec::new()
    }

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
    /// log₁₀ of the number of models as well supported that chance would make of so many data, all wrong; below 0. `None` where the estimator knows no
    /// data that are wrong for certain ([`Estimator::wrong`]), or a sample is all there is.
    pub log_nfa: Option<f64>,
}

/// Draws samples until one without outliers was drawn with the stated confidence, keeps the model of least loss and refines it.
///
/// This is the loop behind every `estimate_…` function, for models of one's own: RANSAC (Fischler & Bolles 1981) with
/// a smooth loss (MSAC, Torr & Zisserman 2000; MAGSAC++, Barath et al. 2020) and local optimization (LO-RANSAC, Chum et
/// al. 2003) on the same loss. O(samples × data).
///
/// # Errors
/// [`EstimateError::Option`], [`EstimateError::NotEnoughMatches`] with fewer data than a sample has, and
/// [`EstimateError::NoConsensus`] where no model fits more data than chance would make fit.
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
    let judge = Judge::new(estimator, scorer, options.threshold * estimator.unit());
    let found = match options.sampling {
        Sampling::Uniform => search(&judge, &mut Uniform::new(n, options.seed), options),
        Sampling::Prosac => {
            search(&judge, &mut Prosac::new(n, E::SAMPLE, options.max_iterations, options.seed), options)
        }
    };
    // The sample itself always fits.
    let needed = if n > E::SAMPLE { E::SAMPLE + 1 } else { E::SAMPLE };
    let none = |inliers, needed, iterations| EstimateError::NoConsensus { inliers, matches: n, needed, iterations };
    let Some(mut found) = found else { return Err(none(0, needed, options.max_iterations)) };
    let inliers = found.score.inliers as usize;
    let chance = chance(&judge, &found.model);
    match &chance {
        Some(c) if c.log_nfa >= 0.0 => return Err(none(inliers, c.needed, found.iterations)),
        None if inliers < needed => return Err(none(inliers, needed, found.iterations)),
        _ => {}
    }
    found.log_nfa = chance.map(|c| c.log_nfa);
    Ok(found)
}
