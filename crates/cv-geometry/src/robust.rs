//! What robust estimators return.

use crate::ransac::Consensus;
use cv_core::Correspondence;

/// A model and the matches that fit it.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RobustModel<M> {
    /// The model.
    pub model: M,
    /// Indices of the matches within the threshold, ascending.
    pub inliers: Vec<usize>,
    /// Root mean square residual of the inliers, in the unit of the matches; NaN without inliers.
    pub rms: f64,
    /// Samples drawn.
    pub iterations: usize,
    /// log₁₀ of the number of false alarms: of models as well supported to be expected of so many wrong matches, below −2: −20 says that one in 10²⁰ such sets has
    /// one. `None` where there are no more matches than a sample takes.
    pub log_nfa: Option<f64>,
}

impl<M> RobustModel<M> {
    /// The same with another form of the model.
    pub(crate) fn map<N>(self, f: impl FnOnce(M) -> N) -> RobustModel<N> {
        RobustModel {
            model: f(self.model),
            inliers: self.inliers,
            rms: self.rms,
            iterations: self.iterations,
            log_nfa: self.log_nfa,
        }
    }

    /// With the inliers by `residual`, of what the search found.
    pub(crate) fn new<N>(
        model: M,
        matches: &[Correspondence],
        threshold: f64,
        found: &Consensus<N>,
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
        Self { model, inliers, rms, iterations: found.iterations, log_nfa: found.log_nfa }
    }
}
