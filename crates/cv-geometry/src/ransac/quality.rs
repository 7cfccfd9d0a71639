//! The quality of models: losses and inliers over all data, and the noise of the inliers.

use super::{BlockOf, Estimator, RansacData, Score, Scorer};
use crate::match_blocks::LANES;
use fearless_simd::{Level, dispatch};

/// Sum of losses over all blocks, or [`Score::WORST`] as soon as it is certain to exceed `limit`.
///
/// Lanes are summed on their own in a fixed order and no product is fused, so every instruction set gives the same bits.
#[inline(always)]
fn score_blocks<E: Estimator, C: Scorer>(
    kernel: &E::Kernel,
    blocks: &[BlockOf<E>],
    padding: usize,
    scorer: &C,
    inverse_threshold2: f32,
    limit: f32,
) -> Score {
    // The losses of the padding lanes, 1 each, are known from the start.
    let limit = limit + padding as f32;
    let mut losses = [0f32; LANES];
    let mut inliers = [0u32; LANES];
    for run in blocks.chunks(4) {
        for block in run {
            let r2 = E::squared_residuals(kernel, block);
            for i in 0..LANES {
                let u = r2[i] * inverse_threshold2;
                losses[i] += scorer.loss(u);
                inliers[i] += u32::from(u < 1.0);
            }
        }
        if sum(&losses) > limit {
            return Score::WORST;
        }
    }
    Score { loss: sum(&losses) - padding as f32, inliers: inliers.iter().sum() }
}

/// Data with a residual within one over the root of `scale`, half of that, and so on.
#[inline(always)]
fn count_blocks<E: Estimator, const N: usize>(kernel: &E::Kernel, blocks: &[BlockOf<E>], scale: f32) -> [u32; N] {
    let mut counts = [[0u32; LANES]; N];
    for block in blocks {
        let r2 = E::squared_residuals(kernel, block);
        let mut limit = 1.0;
        for count in &mut counts {
            for i in 0..LANES {
                count[i] += u32::from(r2[i] * scale < limit);
            }
            limit *= 0.25;
        }
    }
    counts.map(|count| count.iter().sum())
}

#[inline(always)]
fn sum(lanes: &[f32; LANES]) -> f32 {
    let mut half = [0f32; LANES / 2];
    for i in 0..LANES / 2 {
        half[i] = lanes[i] + lanes[i + LANES / 2];
    }
    ((half[0] + half[4]) + (half[1] + half[5])) + ((half[2] + half[6]) + (half[3] + half[7]))
}

/// Scores models of one estimator against its data.
pub(super) struct Quality<'a, E: Estimator, C: Scorer> {
    pub(super) estimator: &'a E,
    pub(super) scorer: &'a C,
    /// In estimator units.
    pub(super) threshold: f64,
    level: Level,
    pub(super) inverse_threshold2: f32,
    padding: usize,
}

impl<'a, E: Estimator, C: Scorer> Quality<'a, E, C> {
    pub(super) fn new(estimator: &'a E, scorer: &'a C, threshold: f64) -> Self {
        Self {
            estimator,
            scorer,
            threshold,
            level: Level::new(),
            inverse_threshold2: (1.0 / (threshold * threshold)) as f32,
            padding: estimator.data().blocks().len() * LANES - estimator.data().count(),
        }
    }

    /// The score, or [`Score::WORST`] where the loss is certain to exceed `limit`.
    pub(super) fn score(&self, model: &E::Model, limit: f32) -> Score {
        let kernel = self.estimator.kernel(model);
        let (blocks, padding, scale) = (self.estimator.data().blocks(), self.padding, self.inverse_threshold2);
        dispatch!(self.level, _simd => score_blocks::<E, C>(&kernel, blocks, padding, self.scorer, scale, limit))
    }

    /// Data of `blocks` within `reach` thresholds, half of that, and so on.
    pub(super) fn counts<const N: usize>(&self, model: &E::Model, blocks: &[BlockOf<E>], reach: f64) -> [u32; N] {
        let kernel = self.estimator.kernel(model);
        let scale = self.inverse_threshold2 / (reach * reach) as f32;
        dispatch!(self.level, _simd => count_blocks::<E, N>(&kernel, blocks, scale))
    }

    /// Standard deviation of the residuals of right data in thresholds, by expectation maximization on a mixture of a Gaussian and an even
    /// background (MLESAC, Torr & Zisserman 2000); the background is what is found from 3 to 10 thresholds away. At most one threshold.
    pub(super) fn noise(&self, model: &E::Model) -> Option<f64> {
        let kernel = self.estimator.kernel(model);
        let scale = self.inverse_threshold2;
        let near: Vec<f64> = self
            .estimator
            .data()
            .blocks()
            .iter()
            .flat_map(|block| E::squared_residuals(&kernel, block))
            .map(|r2| f64::from(r2 * scale))
            .filter(|u| *u < 100.0)
            .collect();
        let shell = near.iter().filter(|u| **u >= 9.0).count() as f64;
        let one = E::RESIDUAL_DIMENSION == 1;
        let density = shell / if one { 14.0 } else { 91.0 * std::f64::consts::PI };
        let mut sigma2 = 0.25;
        let mut inliers = 0.5 * near.len() as f64;
        for _ in 0..12 {
            let peak = inliers * (std::f64::consts::TAU * sigma2).powf(-0.5 * f64::from(E::RESIDUAL_DIMENSION));
            let (mut sum, mut weights) = (0.0, 0.0);
            for u in &near {
                let g = peak * (-0.5 * u / sigma2).exp();
                let w = g / (g + density + 1e-12);
                sum += w * u;
                weights += w;
            }
            if weights < E::SAMPLE as f64 {
                return None;
            }
            inliers = weights;
            sigma2 = (sum / (f64::from(E::RESIDUAL_DIMENSION) * weights)).clamp(1e-6, 1.0);
        }
        Some(sigma2.sqrt())
    }
}
