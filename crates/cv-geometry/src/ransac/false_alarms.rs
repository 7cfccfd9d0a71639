//! The number of false alarms of a model (a contrario): whether more data fit it than would fit some model if all were wrong.

use super::quality::Quality;
use super::{Estimator, MOST_FALSE_ALARMS, RansacData, Scorer};
use crate::match_blocks::LANES;

/// Wrong data that are looked at: enough for nearly all models, whose support leaves no doubt; and enough to count those of a homography of 3 px in a
/// picture of ten megapixels.
const WRONG: [usize; 2] = [1024, 16_384];
/// How many thresholds away they are counted: the nearer they are, the fewer there are to count.
const REACH: f64 = 4.0;
/// Residuals up to which data are counted: the threshold, and half of it so many times.
const LEVELS: usize = 7;

/// How a model compares with those of the background model, in which all data are wrong.
pub(super) struct FalseAlarms {
    /// log₁₀ of the number of false alarms: of models as well supported that are to be expected among so many wrong data.
    pub(super) log_nfa: f64,
    /// Fewest data within the threshold of which that number would be small enough; more than there are where no number of them would do. 0 where it is.
    pub(super) needed: usize,
}

/// The number of false alarms of a model of `n` data (Moisan & Stival, "A probabilistic criterion to detect rigid point matches between two images", IJCV
/// 2004; Moulon, Monasse & Marlet, "Adaptive structure from motion with a contrario model estimation", ACCV 2012): how many models, of all those
/// through `sample` of the data, have `k` data so near under the background model, where each is near with probability `p`.
///
/// `None` where the estimator knows no wrong data, or a sample is all there is.
pub(super) fn false_alarms<E: Estimator, C: Scorer>(
    quality: &Quality<'_, E, C>,
    model: &E::Model,
) -> Option<FalseAlarms> {
    let n = quality.estimator.data().count();
    if n <= E::SAMPLE {
        return None;
    }
    let levels: [u32; LEVELS] = quality.counts(model, quality.estimator.data().blocks(), 1.0);
    let of = |wrong: usize, deviations: f64| {
        let wrong = quality.estimator.data().background(wrong);
        let [fitting] = quality.counts(model, &wrong, REACH);
        // One more, or none found would be none possible.
        let fitting = f64::from(fitting + 1);
        let count = fitting + deviations * fitting.sqrt();
        // At the threshold.
        let p = count / (wrong.len() * LANES + 1) as f64 / REACH.powi(E::RESIDUAL_DIMENSION);
        // Each level is charged twice as much as the one before: the charges of all sum to one.
        let log = |k: usize, level: usize| {
            let half = 0.5f64.powi(level as i32);
            log_false_alarms(n, k, E::SAMPLE, p * half.powi(E::RESIDUAL_DIMENSION)) - (0.5 * half).log10()
        };
        let log_nfa = levels.iter().enumerate().map(|(level, k)| log(*k as usize, level)).fold(f64::INFINITY, f64::min);
        let needed = || (E::SAMPLE + 1..=n).find(|k| log(*k, 0) < MOST_FALSE_ALARMS).unwrap_or(n + 1);
        (!wrong.is_empty())
            .then(|| FalseAlarms { log_nfa, needed: if log_nfa < MOST_FALSE_ALARMS { 0 } else { needed() } })
    };
    // A first look, at what the count may be at most.
    let [few, many] = WRONG;
    match of(few, 3.0) {
        Some(found) if found.log_nfa >= MOST_FALSE_ALARMS => of(many, 0.0),
        other => other,
    }
}

/// log₁₀ of C(n, k) C(k, s) p^(k − s): sets of k of n data, samples among them, and the probability that the others fit too.
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

/// log₁₀ n! by Stirling's series, to 3e-4.
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
    fn factorials_are_the_products() {
        let mut product = 1.0f64;
        for n in 0..100 {
            product *= f64::from(n.max(1));
            // The next term of the series is 1/(360 n³).
            assert!((log_factorial(n as usize) - product.log10()).abs() < 2e-3, "{n}");
        }
        // C(10, 3) = 120 sets, C(3, 2) = 3 samples in each, one in a hundred.
        assert!((log_false_alarms(10, 3, 2, 0.01) - 3.6f64.log10()).abs() < 4e-3);
    }
}
