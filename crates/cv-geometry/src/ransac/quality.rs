//! Scoring of models: loss and inlier count over all data, and the noise of the inliers.

use super::{BlockOf, Estimator, Msac, RansacData, Score, Scorer, Scoring, TukeyBiweight};
use crate::match_blocks::LANES;
use fearless_simd::{Level, dispatch};

/// Sums the losses over all blocks; returns [`Score::WORST`] as soon as the sum exceeds `limit`.
///
/// Lanes are accumulated separately in a fixed order and no product is fused, so all instruction sets give identical
/// results.
#[inline(always)]
fn score_blocks<E: Estimator, C: Scorer + ?Sized>(
    kernel: &E::Kernel,
    blocks: &[BlockOf<E>],
    padding: usize,
    scorer: &C,
    inverse_threshold2: f32,
    limit: f32,
) -> Score {
    // The padding lanes contribute a loss of 1 each.
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

/// Counts the data with a residual below 1/√`scale`, half of that, a quarter of that, and so on.
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

/// Sums the lanes pairwise, in a fixed order.
#[inline(always)]
fn sum(lanes: &[f32; LANES]) -> f32 {
    let mut half = [0f32; LANES / 2];
    for i in 0..LANES / 2 {
        half[i] = lanes[i] + lanes[i + LANES / 2];
    }
    ((half[0] + half[4]) + (half[1] + half[5])) + ((half[2] + half[6]) + (half[3] + half[7]))
}

/// Scores models of an estimator on its data.
pub(super) struct Quality<'a, E: Estimator> {
    pub(super) estimator: &'a E,
    pub(super) scoring: Scoring,
    /// In estimator units.
    pub(super) threshold: f64,
    level: Level,
    pub(super) inverse_threshold2: f32,
    padding: usize,
}

impl<'a, E: Estimator> Quality<'a, E> {
    pub(super) fn new(estimator: &'a E, scoring: Scoring, threshold: f64) -> Self {
        Self {
            estimator,
            scoring,
            threshold,
            level: Level::new(),
            inverse_threshold2: (1.0 / (threshold * threshold)) as f32,
            padding: estimator.data().blocks().len() * LANES - estimator.data().count(),
        }
    }

    /// Computes the score of a model, or [`Score::WORST`] if the loss exceeds `limit`.
    pub(super) fn score(&self, model: &E::Model, limit: f32) -> Score {
        let kernel = self.estimator.kernel(model);
        let (blocks, padding, scale) = (self.estimator.data().blocks(), self.padding, self.inverse_threshold2);
        // The built-in losses are inlined into the loop.
        dispatch!(self.level, _simd => match self.scoring {
            Scoring::Msac => score_blocks::<E, _>(&kernel, blocks, padding, &Msac, scale, limit),
            Scoring::TukeyBiweight => score_blocks::<E, _>(&kernel, blocks, padding, &TukeyBiweight, scale, limit),
            Scoring::Other(scorer) => score_blocks::<E, _>(&kernel, blocks, padding, scorer, scale, limit),
        })
    }

    /// Counts the data of `blocks` within `radius` thresholds, half of that, a quarter of that, and so on.
    pub(super) fn counts<const N: usize>(&self, model: &E::Model, blocks: &[BlockOf<E>], radius: f64) -> [u32; N] {
        let kernel = self.estimator.kernel(model);
        let scale = self.inverse_threshold2 / (radius * radius) as f32;
        dispatch!(self.level, _simd => count_blocks::<E, N>(&kernel, blocks, scale))
    }

    /// Estimates the standard deviation of the inliers' residuals in thresholds, by expectation maximization of a
    /// mixture of a Gaussian and a uniform outlier density (MLESAC, Torr & Zisserman 2000). The outlier density is
    /// measured from 3 to 10 thresholds. At most one threshold; `None` if the inliers are fewer than a minimal sample.
    pub(super) fn noise(&self, model: &E::Model) -> Option<f64> {
        let kernel = self.estimator.kernel(model);
        let scale = self.inverse_threshold2;
        let squares: Vec<f64> = self
            .estimator
            .data()
            .blocks()
            .iter()
            .flat_map(|block| E::squared_residuals(&kernel, block))
            .map(|r2| f64::from(r2 * scale))
            .filter(|u| *u < 100.0)
            .collect();
        let outliers = squares.iter().filter(|u| **u >= 9.0).count() as f64;
        // The volume of the shell from 3 to 10: an interval on both sides, or an annulus.
        let is_scalar = E::RESIDUAL_DIMENSION == 1;
        let outlier_density = outliers / if is_scalar { 14.0 } else { 91.0 * std::f64::consts::PI };
        let mut sigma2 = 0.25;
        let mut inliers = 0.5 * squares.len() as f64;
        for _ in 0..12 {
            let peak = inliers * (std::f64::consts::TAU * sigma2).powf(-0.5 * f64::from(E::RESIDUAL_DIMENSION));
            let (mut sum, mut weights) = (0.0, 0.0);
            for u in &squares {
                let g = peak * (-0.5 * u / sigma2).exp();
                let w = g / (g + outlier_density + 1e-12);
                sum += w * u;
                weights += w;
            }
            if weights < E::SAMPLE_SIZE as f64 {
                return None;
            }
            inliers = weights;
            sigma2 = (sum / (f64::from(E::RESIDUAL_DIMENSION) * weights)).clamp(1e-6, 1.0);
        }
        Some(sigma2.sqrt())
    }
}
