//! Local optimization (LO-RANSAC; Chum, Matas & Kittler, "Locally optimized RANSAC", 2003).

use super::driver::{LOCAL_STEPS, ScoredModel};
use super::quality::Quality;
use super::sampler::distinct;
use super::{Estimator, RansacData, Scorer};
use cv_core::{Cancelled, Progress};
use rand_chacha::ChaCha8Rng;

/// Most samples of [`Quality::inner_ransac`] on one model.
const MOST_RESAMPLES: usize = 200;
/// The factor by which a loss has to fall to count as a better minimum, not a better place in the same one.
const BETTER: f32 = 0.9999;

impl<E: Estimator, C: Scorer> Quality<'_, E, C> {
    /// Local optimization: the model after refinement, where that lowered its loss.
    pub(super) fn refine_best(&self, found: &mut ScoredModel<E::Model>, iterations: usize) {
        if let Some(model) = self.estimator.refine(&found.model, self.scorer, self.threshold, iterations) {
            let score = self.score(&model, found.score.loss);
            if score.loss < found.score.loss {
                *found = ScoredModel { model, score };
            }
        }
    }

    /// The inner search of LO-RANSAC (Chum, Matas & Kittler, "Locally optimized RANSAC", 2003): samples of the data near the best model, which are
    /// seldom wrong, until [`Estimator::RESAMPLES`] of them in a row led to nothing better.
    ///
    /// A minimal model with one wrong or noisy datum is in the basin of another minimum of the loss. Refinement does not leave it; this does.
    pub(super) fn inner_ransac(
        &self,
        best: &mut ScoredModel<E::Model>,
        rng: &mut ChaCha8Rng,
        models: &mut Vec<E::Model>,
        progress: &dyn Progress,
    ) -> Result<(), Cancelled> {
        let mut near = self.near(&best.model);
        let mut left = E::RESAMPLES;
        let mut limit = f32::INFINITY;
        for _ in 0..MOST_RESAMPLES {
            if left == 0 || near.len() <= E::SAMPLE {
                return Ok(());
            }
            progress.report("local samples", E::RESAMPLES - left, E::RESAMPLES)?;
            left -= 1;
            let mut sample = [0u32; 8];
            distinct(rng, near.len() as u32, &mut sample[..E::SAMPLE]);
            sample[..E::SAMPLE].iter_mut().for_each(|i| *i = near[*i as usize]);
            models.clear();
            self.estimator.solve(&sample[..E::SAMPLE], models);
            let mut candidate: Option<ScoredModel<E::Model>> = None;
            for model in models.drain(..) {
                let score = self.score(&model, limit);
                if score.loss < limit {
                    limit = score.loss;
                    candidate = Some(ScoredModel { model, score });
                }
            }
            if let Some(mut candidate) = candidate {
                self.refine_best(&mut candidate, LOCAL_STEPS);
                if candidate.score.loss < best.score.loss {
                    if candidate.score.loss < BETTER * best.score.loss {
                        near = self.near(&candidate.model);
                        left = E::RESAMPLES;
                    }
                    *best = candidate;
                }
            }
        }
        Ok(())
    }

    /// Data within twice the threshold.
    fn near(&self, model: &E::Model) -> Vec<u32> {
        let kernel = self.estimator.kernel(model);
        let residuals = self.estimator.data().blocks().iter().flat_map(|block| E::squared_residuals(&kernel, block));
        let within = residuals.zip(self.estimator.data().order()).filter(|(r2, _)| *r2 * self.inverse_threshold2 < 4.0);
        within.map(|(_, i)| *i).collect()
    }
}
