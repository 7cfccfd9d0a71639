//! The one RANSAC driver.

mod driver;
mod false_alarms;
mod local_optimization;
mod options;
mod quality;
mod sampler;
mod scorer;

pub use options::{LocalOptimization, RobustOptions, Sampling, Scoring};
pub use sampler::{Prosac, Sampler, Uniform};
pub(crate) use scorer::LeastSquaresLoss;
pub use scorer::{Msac, Scorer, TukeyBiweight};

use crate::EstimateError;
use crate::match_blocks::LANES;
use cv_core::Progress;
use driver::search;
use false_alarms::false_alarms;
use quality::Quality;

/// log₁₀ of the number of false alarms from which on a model is refused: of a hundred sets of wrong data, one at the most has a model. Below one, as
/// usual, would allow one such model in every set.
const MOST_FALSE_ALARMS: f64 = -2.0;

/// The data of a robust estimation, in blocks for vector units.
pub trait RansacData: Sync {
    /// [`LANES`] data, coordinate by coordinate; missing data are NaN.
    type Block: Sync;

    /// Number of data.
    fn count(&self) -> usize;

    /// All data, in random order.
    fn blocks(&self) -> &[Self::Block];

    /// The datum of each lane of the blocks; those of [`Estimator::RESAMPLES`] that are 0 are not asked.
    fn order(&self) -> &[u32] {
        &[]
    }

    /// Up to some `most` data of the background model, wrong for certain: parts of different data put together. The number of false alarms comes from how
    /// many of them fit a model. By default none, and no number of false alarms is computed.
    fn background(&self, most: usize) -> Vec<Self::Block> {
        let _ = most;
        Vec::new()
    }
}

/// The blocks of an estimator's data.
type BlockOf<E> = <<E as Estimator>::Data as RansacData>::Block;

/// What a robust estimation has to know about a model.
///
/// Distances are in the estimator's own (normalized) unit; [`Estimator::unit`] says how many of them a unit of the caller's is.
pub trait Estimator: Sync {
    /// The model.
    type Model: Clone + Send + Sync;
    /// What models are fitted to.
    type Data: RansacData;
    /// A model made ready for [`Estimator::squared_residuals`].
    type Kernel;
    /// Size of a minimal sample.
    const SAMPLE: usize;
    /// Dimension of the residuals of right data: 1 for distances from a line, 2 for distances from a point.
    const RESIDUAL_DIMENSION: i32;
    /// Samples drawn from the data near each new best model, in a row without a better one: for models whose minimal solutions are far off
    /// and whose loss has many local minima. 0 by default.
    const RESAMPLES: usize = 0;

    /// The data.
    fn data(&self) -> &Self::Data;

    /// Estimator units per unit of the caller's threshold.
    fn unit(&self) -> f64;

    /// Appends the models through a minimal sample; none where the sample is degenerate or impossible.
    fn solve(&self, sample: &[u32], models: &mut Vec<Self::Model>);

    /// Makes a model ready.
    fn kernel(&self, model: &Self::Model) -> Self::Kernel;

    /// Squared residuals of a block. NaN means that the datum does not fit. Must be `#[inline(always)]`.
    fn squared_residuals(kernel: &Self::Kernel, block: &BlockOf<Self>) -> [f32; LANES];

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
    /// log₁₀ of the number of false alarms: of models as well supported to be expected of so many data, all wrong; below −2. `None` where the estimator has no
    /// background model ([`RansacData::background`]), or a sample is all there is.
    pub log_nfa: Option<f64>,
}

/// Draws samples until one without outliers was drawn with the stated confidence, keeps the model of least loss and refines it.
///
/// This is the loop behind every `estimate_…` function, for models of one's own: RANSAC (Fischler & Bolles 1981) with
/// a smooth loss (MSAC, Torr & Zisserman 2000; MAGSAC++, Barath et al. 2020) and local optimization (LO-RANSAC, Chum et
/// al. 2003) on the same loss. O(samples × data). Reports the samples drawn.
///
/// # Errors
/// [`EstimateError::Option`], [`EstimateError::NotEnoughMatches`] with fewer data than a sample has, and
/// [`EstimateError::NoConsensus`] where the number of false alarms of the best model is not below a hundredth; [`EstimateError::Cancelled`].
pub fn ransac<E: Estimator>(
    estimator: &E,
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<Consensus<E::Model>, EstimateError> {
    options.check()?;
    match options.scoring {
        Scoring::Msac => with_scorer(estimator, options, &Msac, progress),
        Scoring::TukeyBiweight => with_scorer(estimator, options, &TukeyBiweight, progress),
        Scoring::Other(scorer) => with_scorer(estimator, options, &scorer, progress),
    }
}

fn with_scorer<E: Estimator, C: Scorer>(
    estimator: &E,
    options: &RobustOptions,
    scorer: &C,
    progress: &dyn Progress,
) -> Result<Consensus<E::Model>, EstimateError> {
    let n = estimator.data().count();
    if n < E::SAMPLE {
        return Err(EstimateError::NotEnoughMatches { got: n, needed: E::SAMPLE });
    }
    let quality = Quality::new(estimator, scorer, options.threshold * estimator.unit());
    let sampler: &mut dyn Sampler = match options.sampling {
        Sampling::Uniform => &mut Uniform::new(n, options.seed),
        Sampling::Prosac => &mut Prosac::new(n, E::SAMPLE, options.max_iterations, options.seed),
    };
    let found = search(&quality, sampler, options, progress)?;
    // The sample itself always fits.
    let needed = if n > E::SAMPLE { E::SAMPLE + 1 } else { E::SAMPLE };
    let none = |inliers, needed, iterations| EstimateError::NoConsensus { inliers, matches: n, needed, iterations };
    let Some(mut found) = found else { return Err(none(0, needed, options.max_iterations)) };
    let inliers = found.score.inliers as usize;
    let alarms = false_alarms(&quality, &found.model);
    match &alarms {
        Some(c) if c.log_nfa >= MOST_FALSE_ALARMS => return Err(none(inliers, c.needed, found.iterations)),
        None if inliers < needed => return Err(none(inliers, needed, found.iterations)),
        _ => {}
    }
    found.log_nfa = alarms.map(|c| c.log_nfa);
    Ok(found)
}
