//! A-contrario validation: the number of false alarms (NFA) of a model.

use super::quality::Quality;
use super::{Estimator, MAX_LOG_NFA, RansacData};
use crate::match_blocks::LANES;

/// Numbers of background data: enough for clear decisions, and enough to estimate the probability for a homography with
/// a threshold of 3 px in a ten-megapixel image.
const BACKGROUND_COUNTS: [usize; 2] = [1024, 16_384];
/// Radius in thresholds within which background data are counted: a smaller one has fewer counts and a larger variance.
const BACKGROUND_RADIUS: f64 = 4.0;
/// Number of residual bounds at which data are counted: the threshold, halved successively.
const LEVELS: usize = 7;

/// Significance of a model under the background model, in which all data are outliers.
pub(super) struct FalseAlarms {
    /// log₁₀ of the number of false alarms: the expected number of models with as much support among as many outliers.
    pub(super) log_nfa: f64,
    /// Minimum number of inliers for an acceptable NFA; n + 1 if none is enough. 0 if the NFA is acceptable.
    pub(super) needed: usize,
}

/// Computes the number of false alarms of a model (Moisan & Stival, "A probabilistic criterion to detect rigid point
/// matches between two images", IJCV 2004; Moulon, Monasse & Marlet, "Adaptive structure from motion with a contrario
/// model estimation", ACCV 2012): the expected number of models, among those of all minimal samples, with `k` inliers
/// under the background model, in which each datum is an inlier with probability `p`.
///
/// `None` if the estimator has no background data, or there are no more data than the minimal sample.
pub(super) fn false_alarms<E: Estimator>(quality: &Quality<'_, E>, model: &E::Model) -> Option<FalseAlarms> {
    let n = quality.estimator.data().count();
    if n <= E::SAMPLE_SIZE {
        return None;
    }
    let levels: [u32; LEVELS] = quality.counts(model, quality.estimator.data().blocks(), 1.0);
    let evaluate = |background_count: usize, sigmas: f64| {
        let background = quality.estimator.data().background(background_count);
        let [fitting] = quality.counts(model, &background, BACKGROUND_RADIUS);
        // Plus one, so that the estimate of p is above zero.
        let fitting = f64::from(fitting + 1);
        let count = fitting + sigmas * fitting.sqrt();
        // The probability at the threshold.
        let p = count / (background.len() * LANES + 1) as f64 / BACKGROUND_RADIUS.powi(E::RESIDUAL_DIMENSION);
        // Correction for multiple tests: the weights 1/2, 1/4, … of the levels sum to one.
        let log = |k: usize, level: usize| {
            let half = 0.5f64.powi(level as i32);
            log_false_alarms(n, k, E::SAMPLE_SIZE, p * half.powi(E::RESIDUAL_DIMENSION)) - (0.5 * half).log10()
        };
        let log_nfa = levels.iter().enumerate().map(|(level, k)| log(*k as usize, level)).fold(f64::INFINITY, f64::min);
        let needed = || (E::SAMPLE_SIZE + 1..=n).find(|k| log(*k, 0) < MAX_LOG_NFA).unwrap_or(n + 1);
        (!background.is_empty())
            .then(|| FalseAlarms { log_nfa, needed: if log_nfa < MAX_LOG_NFA { 0 } else { needed() } })
    };
    // First with few background data and an upper bound (3σ) of the count; exactly only if that is not decisive.
    let [few, many] = BACKGROUND_COUNTS;
    match evaluate(few, 3.0) {
        Some(upper) if upper.log_nfa >= MAX_LOG_NFA => evaluate(many, 0.0),
        other => other,
    }
}

/// Computes log₁₀ of C(n, k) C(k, s) p^(k − s): the number of sets of k of n data, of minimal samples of size s among
/// them, and the probability that the others are inliers.
fn log_false_alarms(n: usize, k: usize, s: usize, p: f64) -> f64 {
    if k < s {
        return f64::INFINITY;
    }
    let choices = log_binomial(n, k) + log_binomial(k, s);
    choices + (k - s) as f64 * p.min(1.0).log10()
}

fn log_binomial(n: usize, k: usize) -> f64 {
    log_factorial(n) - log_factorial(k) - log_factorial(n - k)
}

/// Computes log₁₀ n! by Stirling's series, with an error below 3e-4.
fn log_factorial(n: usize) -> f64 {
    if n == 0 {
        return 0.0;
    }
    let x = n as f64;
    (x * x.ln() - x + 0.5 * (std::f64::consts::TAU * x).ln() + 1.0 / (12.0 * x)) * std::f64::consts::LOG10_E
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log_factorial_equals_the_product() {
        let mut product = 1.0f64;
        for n in 0..100 {
            product *= f64::from(n.max(1));
            // The next term of the series is 1/(360 n³).
            assert!((log_factorial(n as usize) - product.log10()).abs() < 2e-3, "{n}");
        }
        // C(10, 3) = 120 sets, C(3, 2) = 3 samples in each, p = 0.01.
        assert!((log_false_alarms(10, 3, 2, 0.01) - 3.6f64.log10()).abs() < 4e-3);
    }
}
