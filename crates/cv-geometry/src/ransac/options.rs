//! Options of the robust estimators.

use super::Scorer;
use cv_core::OptionError;

/// How the fit of a model to all matches is summed up.
#[derive(Debug, Clone, Copy, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Scoring {
    /// The squared residual, cut off at the threshold (MSAC, Torr & Zisserman 2000).
    Msac,
    /// Tukey's biweight that ends at 2.5 thresholds: close to the average over noise levels (marginalization) of MAGSAC++ (Barath et al. 2020).
    #[default]
    TukeyBiweight,
    /// A loss of another crate. It is called through a pointer: several times as slow as ours.
    #[cfg_attr(feature = "serde", serde(skip))]
    Other(&'static dyn Scorer),
}

/// Losses of other crates are the same where they are one value.
impl PartialEq for Scoring {
    fn eq(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Msac, Self::Msac) | (Self::TukeyBiweight, Self::TukeyBiweight) => true,
            (Self::Other(a), Self::Other(b)) => std::ptr::addr_eq(*a, *b),
            _ => false,
        }
    }
}

/// How samples are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Sampling {
    /// Every sample is equally likely.
    #[default]
    Uniform,
    /// Matches come sorted, the best first, and samples grow from the top (PROSAC, Chum & Matas 2005).
    Prosac,
}

/// What is done with each new best model of a search (LO-RANSAC; Chum, Matas & Kittler, "Locally optimized RANSAC", 2003).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum LocalOptimization {
    /// It is refined on the loss it is judged by: a good model in a fraction of the time, for pairs among many.
    Iterative,
    /// As well, samples are drawn from the data near it: the loss of essential and fundamental matrices has many local minima.
    #[default]
    InnerRansac,
}

/// Options of `estimate_homography`, `estimate_fundamental` and their siblings.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct RobustOptions {
    /// Largest error of an inlier, in the unit of the matches (pixels). Above 0. Default 3, the usual value for
    /// homographies (OpenCV's `findHomography`); [`RobustOptions::fundamental`] has 1.
    pub threshold: f64,
    /// Probability with which a sample without outliers is drawn before the search stops, 0 to 1 exclusive. Default 0.999.
    pub confidence: f64,
    /// Fewest samples. Default 0: the confidence alone decides. (With the search near each new best model, more samples changed neither the errors
    /// nor their spread over seeds on generated homographies, fundamental matrices and poses.)
    pub min_iterations: usize,
    /// Most samples. Default 10 000.
    pub max_iterations: usize,
    /// Seed of the random samples. Default 0.
    pub seed: u64,
    /// How models are compared. Default [`Scoring::TukeyBiweight`].
    pub scoring: Scoring,
    /// How samples are drawn. Default [`Sampling::Uniform`].
    pub sampling: Sampling,
    /// What is done with each new best model. Default [`LocalOptimization::InnerRansac`].
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
    /// Defaults for homographies: threshold 3 px.
    pub fn homography() -> Self {
        Self::default()
    }

    /// Defaults for fundamental matrices: threshold 1 px, 20 000 samples at most (enough for seven tenths of wrong matches).
    pub fn fundamental() -> Self {
        Self { threshold: 1.0, max_iterations: 20_000, ..Self::default() }
    }

    /// Defaults for essential matrices and poses: threshold 1, to be multiplied by one over the focal length where matches are in normalized
    /// coordinates; 20 000 samples at most (enough for four fifths of wrong matches), judged by [`Scoring::Msac`]: of the two losses that
    /// with the smaller errors on generated poses with up to 95 % of wrong matches.
    pub fn essential() -> Self {
        Self { threshold: 1.0, max_iterations: 20_000, scoring: Scoring::Msac, ..Self::default() }
    }

    pub(crate) fn check(&self) -> Result<(), OptionError> {
        OptionError::check("threshold", self.threshold, "above 0 and finite", |v| v > 0.0 && v.is_finite())?;
        OptionError::check("confidence", self.confidence, "between 0 and 1", |v| v > 0.0 && v < 1.0)?;
        OptionError::check("max_iterations", self.max_iterations as f64, "at least 1", |v| v >= 1.0)
    }

    /// Samples needed where `inliers` of `n` matches are good: `log(1 − confidence) / log(1 − P(good sample))`.
    pub(crate) fn needed(&self, inliers: usize, n: usize, sample: usize) -> usize {
        // Without replacement.
        let good: f64 = (0..sample).map(|i| inliers.saturating_sub(i) as f64 / (n - i).max(1) as f64).product();
        let count = (1.0 - self.confidence).ln() / (-good).ln_1p();
        // NaN and infinity (no good sample at all) end at the maximum.
        let count = if count < self.max_iterations as f64 { count.ceil() as usize } else { self.max_iterations };
        count.max(self.min_iterations).clamp(1, self.max_iterations)
    }
}
