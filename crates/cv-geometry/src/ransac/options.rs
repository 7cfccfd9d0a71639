//! Options of the robust estimators.

use super::{Msac, Scorer, TukeyBiweight};
use cv_core::OptionError;

/// The robust loss by which models are scored.
#[derive(Debug, Clone, Copy, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Scoring {
    /// The squared residual, truncated at the threshold (MSAC, Torr & Zisserman 2000).
    Msac,
    /// Tukey's biweight with its cutoff at 2.5 thresholds: close to MAGSAC++'s marginalization over noise levels
    /// (Barath et al. 2020).
    #[default]
    TukeyBiweight,
    /// A custom loss. It is called for every residual: several times slower than the built-in losses.
    #[cfg_attr(feature = "serde", serde(skip))]
    Other(&'static dyn Scorer),
}

impl Scoring {
    /// Returns the loss.
    pub(super) fn scorer(self) -> &'static dyn Scorer {
        match self {
            Self::Msac => &Msac,
            Self::TukeyBiweight => &TukeyBiweight,
            Self::Other(scorer) => scorer,
        }
    }
}

/// Custom losses are equal if they are the same object.
impl PartialEq for Scoring {
    fn eq(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Msac, Self::Msac) | (Self::TukeyBiweight, Self::TukeyBiweight) => true,
            (Self::Other(a), Self::Other(b)) => std::ptr::addr_eq(*a, *b),
            _ => false,
        }
    }
}

/// The sampling strategy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Sampling {
    /// Uniform sampling.
    #[default]
    Uniform,
    /// Progressive sampling of matches sorted by decreasing quality (PROSAC, Chum & Matas 2005).
    Prosac,
}

/// The local optimization of each new best model (LO-RANSAC; Chum, Matas & Kittler, "Locally optimized RANSAC", 2003).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum LocalOptimization {
    /// Iterative refinement on the scoring loss only: a good model in a fraction of the time, for example for verifying
    /// many pairs.
    Iterative,
    /// Also inner RANSAC on the data near the model: the loss of essential and fundamental matrices has many local
    /// minima.
    #[default]
    InnerRansac,
}

/// Options of the robust estimators (`estimate_homography`, `estimate_fundamental`, …).
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct RobustOptions {
    /// Inlier threshold: maximum residual of an inlier, in the unit of the matches (pixels). Above 0. Default 3, the
    /// usual value for homographies (OpenCV's `findHomography`); [`RobustOptions::fundamental`] has 1.
    pub threshold: f64,
    /// Probability that at least one outlier-free sample is drawn before the search stops, 0 to 1 exclusive. Default
    /// 0.999.
    pub confidence: f64,
    /// Minimum number of samples. Default 0: the confidence alone decides. (With inner RANSAC, more samples changed
    /// neither the errors nor their variance over seeds on synthetic homographies, fundamental matrices and poses.)
    pub min_iterations: usize,
    /// Maximum number of samples. Default 10 000.
    pub max_iterations: usize,
    /// Seed of the random samples. Default 0.
    pub seed: u64,
    /// The scoring loss. Default [`Scoring::TukeyBiweight`].
    pub scoring: Scoring,
    /// The sampling strategy. Default [`Sampling::Uniform`].
    pub sampling: Sampling,
    /// The local optimization. Default [`LocalOptimization::InnerRansac`].
    pub local_optimization: LocalOptimization,
}

impl Default for RobustOptions {
    fn default() -> Self {
        Self {
            threshold: 3.0,
            confidence: 0.999,
            min_iterations: 0,
            max_iterations: 10_000,
            seed: 0,
            scoring: Scoring::default(),
            sampling: Sampling::default(),
            local_optimization: LocalOptimization::default(),
        }
    }
}

impl RobustOptions {
    /// Returns the defaults for homographies: threshold 3 px.
    pub fn homography() -> Self {
        Self::default()
    }

    /// Returns the defaults for fundamental matrices: threshold 1 px, at most 20 000 samples (enough for an outlier
    /// ratio of 0.7).
    pub fn fundamental() -> Self {
        Self { threshold: 1.0, max_iterations: 20_000, ..Self::default() }
    }

    /// Returns the defaults for essential matrices and poses: threshold 1 px (divide by the focal length for normalized
    /// coordinates), at most 20 000 samples (enough for an outlier ratio of 0.8), and [`Scoring::Msac`]: of the two
    /// losses, it has the smaller errors on synthetic poses with outlier ratios up to 0.95.
    pub fn essential() -> Self {
        Self { threshold: 1.0, max_iterations: 20_000, scoring: Scoring::Msac, ..Self::default() }
    }

    /// Checks the ranges.
    pub(crate) fn check(&self) -> Result<(), OptionError> {
        OptionError::check("threshold", self.threshold, "above 0 and finite", |v| v > 0.0 && v.is_finite())?;
        OptionError::check("confidence", self.confidence, "between 0 and 1", |v| v > 0.0 && v < 1.0)?;
        OptionError::check("max_iterations", self.max_iterations as f64, "at least 1", |v| v >= 1.0)
    }

    /// Computes the number of samples for `inliers` of `n` matches (the termination criterion): `log(1 − confidence) /
    /// log(1 − P(outlier-free sample))`.
    pub(crate) fn samples_needed(&self, inliers: usize, n: usize, sample_size: usize) -> usize {
        // Sampling without replacement.
        let p_outlier_free: f64 =
            (0..sample_size).map(|i| inliers.saturating_sub(i) as f64 / (n - i).max(1) as f64).product();
        let count = (1.0 - self.confidence).ln() / (-p_outlier_free).ln_1p();
        // NaN and infinity (no outlier-free sample) are clamped to the maximum.
        let count = if count < self.max_iterations as f64 { count.ceil() as usize } else { self.max_iterations };
        count.max(self.min_iterations).clamp(1, self.max_iterations)
    }
}
