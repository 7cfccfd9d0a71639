//! Local optimization (LO-RANSAC; Chum, Matas & Kittler, "Locally optimized RANSAC", 2003).

use super::driver::{LOCAL_STEPS, ScoredModel};
use super::quality::Quality;
use super::sampler::draw_distinct;
use super::{Estimator, RansacData};
use cv_core::{Cancelled, Progress};
use rand_chacha::ChaCha8Rng;

/// Maximum number of samples of [`Quality::inner_ransac`] for one model.
const MAX_INNER_ITERATIONS: usize = 200;
/// Maximum ratio of losses that counts as another, better minimum, rather than progress in the same one.
const MIN_IMPROVEMENT: f32 = 0.9999;

impl<E: Estimator> Quality<'_, E> {
    /// Refines a model; keeps the result if its loss is lower.
    pub(super) fn refine_best(&self, best: &mut ScoredModel<E::Model>, iterations: usize) {
        if let Some(model) = self.estimator.refine(&best.model, self.scoring.scorer(), self.threshold, iterations) {
            let score = self.score(&model, best.score.loss);
            if score.loss < best.score.loss {
                *best = ScoredModel { model, score };
            }
        }
    }

    /// Runs the inner RANSAC of LO-RANSAC (Chum, Matas & Kittler, "Locally optimized RANSAC", 2003): draws samples from
    /// the data near the best model, which are mostly inliers, until [`Estimator::INNER_SAMPLES`] consecutive samples
    /// brought no improvement.
    ///
    /// A minimal model from a noisy sample or one with an outlier may be in the basin of another local minimum, which
    /// refinement alone does not leave.
    pub(super) fn inner_ransac(
        &self,
        best: &mut ScoredModel<E::Model>,
        rng: &mut ChaCha8Rng,
        models: &mut Vec<E::Model>,
        progress: &dyn Progress,
    ) -> Result<(), Cancelled> {
        let mut inliers = self.relaxed_inliers(&best.model);
        let mut remaining = E::INNER_SAMPLES;
        let mut limit = f32::INFINITY;
        for _ in 0..MAX_INNER_ITERATIONS {
            if remaining == 0 || inliers.len() <= E::SAMPLE_SIZE {
                return Ok(());
            }
            progress.report("local samples", E::INNER_SAMPLES - remaining, E::INNER_SAMPLES)?;
            remaining -= 1;
            let mut sample = [0u32; 8];
            draw_distinct(rng, inliers.len() as u32, &mut sample[..E::SAMPLE_SIZE]);
            sample[..E::SAMPLE_SIZE].iter_mut().for_each(|i| *i = inliers[*i as usize]);
            models.clear();
            self.estimator.solve(&sample[..E::SAMPLE_SIZE], models);
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
                    if candidate.score.loss < MIN_IMPROVEMENT * best.score.loss {
                        inliers = self.relaxed_inliers(&candidate.model);
                        remaining = E::INNER_SAMPLES;
                    }
                    *best = candidate;
                }
            }
        }
        Ok(())
    }

    /// Returns the indices of the data within twice the threshold.
    fn relaxed_inliers(&self, model: &E::Model) -> Vec<u32> {
        let kernel = self.estimator.kernel(model);
        let residuals = self.estimator.data().blocks().iter().flat_map(|block| E::squared_residuals(&kernel, block));
        let within = residuals.zip(self.estimator.data().order()).filter(|(r2, _)| *r2 * self.inverse_threshold2 < 4.0);
        within.map(|(_, i)| *i).collect()
    }
}
