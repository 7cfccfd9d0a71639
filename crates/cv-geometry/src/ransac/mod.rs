//! RANSAC: driver, samplers, scorers, local optimization and a-contrario validation.

mod driver;
mod false_alarms;
mod local_optimization;
mod options;
mod quality;
mod sampler;
mod scorer;

pub use options::{LocalOptimization, RobustOptions, Sampling, Scoring};
pub use sampler::{Prosac, Sampler, Uniform};
pub(crate) use scorer::{BlockLosses, LeastSquaresLoss};
pub use scorer::{Msac, Scorer, TukeyBiweight};

use crate::EstimateError;
use crate::match_blocks::LANES;
use cv_core::Progress;
use driver::search;
use false_alarms::false_alarms;
use quality::Quality;

/// log₁₀ of the number of false alarms from which a model is rejected: at most one of a hundred sets of outliers has a
/// model. The usual bound, NFA < 1, would allow one such model in every set.
const MAX_LOG_NFA: f64 = -2.0;

/// The data of a robust estimation, in blocks for SIMD.
pub trait RansacData: Sync {
    /// [`LANES`] data as a structure of arrays; padding lanes are NaN.
    type Block: Sync;

    /// Returns the number of data.
    fn count(&self) -> usize;

    /// Returns all data, in random order.
    fn blocks(&self) -> &[Self::Block];

    /// Returns the index of the datum of each lane of the blocks. Only used if [`Estimator::INNER_SAMPLES`] is not 0.
    fn order(&self) -> &[u32] {
        &[]
    }

    /// Returns about `max_count` data of the background model, outliers by construction: recombined parts of different
    /// data. The number of false alarms is computed from the fraction of them that fits a model. By default none, and
    /// no number of false alarms is computed.
    fn background(&self, max_count: usize) -> Vec<Self::Block> {
        let _ = max_count;
        Vec::new()
    }
}

/// The block type of an estimator's data.
type BlockOf<E> = <<E as Estimator>::Data as RansacData>::Block;

/// A model type: minimal solver, residuals and refinement.
///
/// Residuals are in the estimator's (normalized) unit; [`Estimator::threshold_scale`] is the scale from the caller's unit.
pub trait Estimator: Sync {
    /// The model.
    type Model: Clone + Send + Sync;
    /// The data.
    type Data: RansacData;
    /// A model in the form that [`Estimator::squared_residuals`] evaluates.
    type Kernel;
    /// Size of a minimal sample.
    const SAMPLE_SIZE: usize;
    /// Dimension of the residuals: the codimension of the model, 1 for distances from a line, 2 for distances from a
    /// point.
    const RESIDUAL_DIMENSION: i32;
    /// Number of consecutive samples of inner RANSAC without improvement before it stops: for models whose minimal
    /// solutions are inaccurate and whose loss has many local minima. 0 (the default) disables inner RANSAC.
    const INNER_SAMPLES: usize = 0;

    /// Returns the data.
    fn data(&self) -> &Self::Data;

    /// Returns the scale from the caller's threshold to estimator units.
    fn threshold_scale(&self) -> f64;

    /// Solves for the models of a minimal sample and appends them; none if the sample is degenerate or has no real
    /// solution.
    fn solve(&self, sample: &[u32], models: &mut Vec<Self::Model>);

    /// Prepares a model for [`Estimator::squared_residuals`].
    fn kernel(&self, model: &Self::Model) -> Self::Kernel;

    /// Computes the squared residuals of a block. NaN counts as an outlier. Must be `#[inline(always)]`.
    fn squared_residuals(kernel: &Self::Kernel, block: &BlockOf<Self>) -> [f32; LANES];

    /// Minimizes the sum of `scorer`'s loss, starting at `model`, in at most `iterations` steps.
    ///
    /// `threshold` is in estimator units. `None` if no step reduced the loss.
    fn refine(
        &self,
        model: &Self::Model,
        scorer: &dyn Scorer,
        threshold: f64,
        iterations: usize,
    ) -> Option<Self::Model>;

    /// Appends alternative hypotheses to a new best `model` from `sample`, if that sample may be degenerate (DEGENSAC).
    ///
    /// `threshold` is in estimator units. By default, none.
    fn alternatives(&self, model: &Self::Model, sample: &[u32], threshold: f64, models: &mut Vec<Self::Model>) {
        let _ = (model, sample, threshold, models);
    }
}

/// The score of a model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Score {
    /// Sum of losses, each 0 to 1.
    pub loss: f32,
    /// Number of data within the threshold.
    pub inliers: u32,
}

impl Score {
    const WORST: Self = Self { loss: f32::INFINITY, inliers: 0 };
}

/// Result of [`ransac()`].
#[derive(Debug, Clone)]
pub struct Consensus<M> {
    /// The refined model of minimum loss.
    pub model: M,
    /// Its score.
    pub score: Score,
    /// Number of minimal samples drawn.
    pub iterations: usize,
    /// log₁₀ of the number of false alarms: the expected number of models with as much support among as many outliers;
    /// below −2. `None` if the estimator has no background model ([`RansacData::background`]), or there are no more
    /// data than the minimal sample.
    pub log_nfa: Option<f64>,
}

/// Estimates a model robustly: draws minimal samples until one is outlier-free with the given confidence, and refines
/// the model of minimum loss.
///
/// Every `estimate_…` function uses this driver; it accepts custom models. RANSAC (Fischler & Bolles 1981) with a
/// smooth loss (MSAC, Torr & Zisserman 2000; MAGSAC++, Barath et al. 2020) and local optimization (LO-RANSAC, Chum et
/// al. 2003) on the same loss. O(samples × data). Progress is reported in samples.
///
/// # Errors
/// [`EstimateError::Option`], [`EstimateError::NotEnoughMatches`] with fewer data than a sample has, and
/// [`EstimateError::NoConsensus`] if the number of false alarms of the best model is not below 0.01;
/// [`EstimateError::Cancelled`].
pub fn ransac<E: Estimator>(
    estimator: &E,
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<Consensus<E::Model>, EstimateError> {
    options.check()?;
    let n = estimator.data().count();
    if n < E::SAMPLE_SIZE {
        return Err(EstimateError::NotEnoughMatches { got: n, needed: E::SAMPLE_SIZE });
    }
    let quality = Quality::new(estimator, options.scoring, options.threshold * estimator.threshold_scale());
    let sampler: &mut dyn Sampler = match options.sampling {
        Sampling::Uniform => &mut Uniform::new(n, options.seed),
        Sampling::Prosac => &mut Prosac::new(n, E::SAMPLE_SIZE, options.max_iterations, options.seed),
    };
    let consensus = search(&quality, sampler, options, progress)?;
    // The data of the minimal sample always fit.
    let needed = if n > E::SAMPLE_SIZE { E::SAMPLE_SIZE + 1 } else { E::SAMPLE_SIZE };
    let no_consensus =
        |inliers, needed, iterations| EstimateError::NoConsensus { inliers, matches: n, needed, iterations };
    let Some(mut consensus) = consensus else { return Err(no_consensus(0, needed, options.max_iterations)) };
    let inliers = consensus.score.inliers as usize;
    let alarms = false_alarms(&quality, &consensus.model);
    match &alarms {
        Some(a) if a.log_nfa >= MAX_LOG_NFA => return Err(no_consensus(inliers, a.needed, consensus.iterations)),
        None if inliers < needed => return Err(no_consensus(inliers, needed, consensus.iterations)),
        _ => {}
    }
    consensus.log_nfa = alarms.map(|a| a.log_nfa);
    Ok(consensus)
}
