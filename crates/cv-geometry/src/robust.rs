//! The result of robust estimators.

use crate::ransac::Consensus;
use cv_core::Correspondence;

/// A model and its inliers.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RobustModel<M> {
    /// The model.
    pub model: M,
    /// Indices of the matches within the threshold, ascending.
    pub inliers: Vec<usize>,
    /// Root mean square residual of the inliers, in the unit of the matches; NaN without inliers.
    pub rms: f64,
    /// Number of minimal samples drawn.
    pub iterations: usize,
    /// log₁₀ of the number of false alarms (NFA): the expected number of models with as much support among as many
    /// random matches. Below −2; at −20, one in 10²⁰ sets of random matches has such a model. `None` if there are no
    /// more matches than the minimal sample.
    pub log_nfa: Option<f64>,
}

impl<M> RobustModel<M> {
    /// Converts the model to another parameterization.
    pub(crate) fn map<N>(self, f: impl FnOnce(M) -> N) -> RobustModel<N> {
        RobustModel {
            model: f(self.model),
            inliers: self.inliers,
            rms: self.rms,
            iterations: self.iterations,
            log_nfa: self.log_nfa,
        }
    }

    /// Computes inliers and RMS by `residual`; the other fields are those of `consensus`.
    pub(crate) fn new<N>(
        model: M,
        matches: &[Correspondence],
        threshold: f64,
        consensus: &Consensus<N>,
        residual: impl Fn(&M, &Correspondence) -> f64,
    ) -> Self {
        let mut inliers = Vec::new();
        let mut sum = 0.0;
        for (i, m) in matches.iter().enumerate() {
            let r = residual(&model, m);
            if r < threshold {
                inliers.push(i);
                sum += r * r;
            }
        }
        let rms = (sum / inliers.len() as f64).sqrt();
        Self { model, inliers, rms, iterations: consensus.iterations, log_nfa: consensus.log_nfa }
    }
}
