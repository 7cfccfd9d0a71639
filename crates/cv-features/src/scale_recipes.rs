//! Recipes for the scales of an octave: kernels and data dependencies.
//!
//! A sufficiently smooth image can be subsampled by two without aliasing, and a Gaussian sampled at the phases 0 and ½
//! of the subsampled image reconstructs the blurred image at all pixels (a polyphase filter). Its kernels are half as
//! long as those at full resolution, and the vertical pass has half the columns, so a scale takes about a third of the
//! time.

use crate::dog::WINDOW_RADIUS;

/// Minimum harmonic sum of the variances of source and kernel, in squared source pixels. The ripple between phases of
/// the composite of two sampled Gaussians is then `2·exp(−2π²·0.35)`, 0.2 % of its height, at the sampling frequency,
/// where the blurs attenuate it further.
const MIN_VARIANCE: f64 = 0.35;

/// Computes the half-kernel of a Gaussian of standard deviation `sigma`, sampled at distances `offset, 1 + offset, …`
/// from its center; the full kernel sums to one.
///
/// Truncation and sampling would change the variance by some percent; the sigma of the sampled Gaussian is corrected
/// for that.
fn taps(sigma: f64, offset: f64, len: usize) -> Vec<f32> {
    let weights = |s: f64| -> Vec<f64> {
        let weight = |i: usize| (-0.5 * ((i as f64 + offset) / s).powi(2)).exp();
        let all: Vec<f64> = (0..len).map(weight).collect();
        let twice = 2.0 * all.iter().sum::<f64>() - if offset == 0.0 { all[0] } else { 0.0 };
        all.into_iter().map(|w| w / twice).collect()
    };
    let mut s = sigma;
    // Fixed-point iteration; a few steps are accurate to 1e-3.
    for _ in 0..6 {
        let variance: f64 = weights(s).iter().enumerate().map(|(i, w)| 2.0 * w * (i as f64 + offset).powi(2)).sum();
        s *= (sigma * sigma / variance.max(1e-12)).sqrt().clamp(0.8, 1.25);
    }
    weights(s).into_iter().map(|w| w as f32).collect()
}

/// Returns the kernel radius.
fn radius(sigma: f64) -> usize {
    (3.0 * sigma).ceil().max(1.0) as usize
}

/// How a scale is computed.
#[derive(Debug)]
pub(crate) enum Recipe {
    /// It is the source image of the octave.
    Source,
    /// The previous scale, blurred at full resolution with this half-kernel.
    Blur(Vec<f32>),
    /// Scale `from` at half resolution (or the image to be upsampled), filtered at its pixels (`even`) and half-way
    /// between them (`odd`).
    Polyphase { from: Option<usize>, even: Vec<f32>, odd: Vec<f32> },
}

impl Recipe {
    /// Returns the number of row pairs of the source that are needed below a row pair.
    fn lookahead(&self) -> usize {
        match self {
            Self::Source => 0,
            Self::Blur(kernel) => (kernel.len() - 1).div_ceil(2),
            Self::Polyphase { odd, .. } => odd.len(),
        }
    }

    /// Returns the index of the source scale.
    fn source(&self, index: usize) -> Option<usize> {
        match self {
            Self::Source => None,
            Self::Blur(_) => Some(index - 1),
            Self::Polyphase { from, .. } => *from,
        }
    }
}

/// Computes the recipes for the scales 0 to `layers + 2` of an octave, with σ = `sigma · 2^(i / layers)` in octave
/// pixels.
///
/// The source of the octave is an image of half its resolution with negligible blur if `is_upsampled`, else scale 0.
pub(crate) fn recipes(layers: usize, sigma: f32, is_upsampled: bool) -> Vec<Recipe> {
    let scale = |i: usize| f64::from(sigma) * 2f64.powf(i as f64 / layers as f64);
    let polyphase = |from: Option<usize>, i: usize| {
        let source_sigma = from.map_or(0.0, |j| 0.5 * scale(j));
        let kernel_sigma = (0.25 * scale(i) * scale(i) - source_sigma * source_sigma).sqrt();
        let is_smooth = from.is_none()
            || (source_sigma * kernel_sigma).powi(2) / (source_sigma * source_sigma + kernel_sigma * kernel_sigma)
                >= MIN_VARIANCE;
        is_smooth.then(|| (radius(kernel_sigma), from, kernel_sigma))
    };
    let recipe = |i: usize| {
        if i == 0 && !is_upsampled {
            return Recipe::Source;
        }
        let sources = (is_upsampled.then_some(None)).into_iter().chain((0..i).map(Some));
        // The shortest kernel; ties by the latest scale.
        let best = sources.filter_map(|from| polyphase(from, i)).rev().min_by_key(|p| p.0);
        match best {
            Some((radius, from, sigma)) => {
                Recipe::Polyphase { from, even: taps(sigma, 0.0, radius + 1), odd: taps(sigma, 0.5, radius + 1) }
            }
            None => {
                let kernel_sigma = (scale(i) * scale(i) - scale(i - 1) * scale(i - 1)).sqrt();
                Recipe::Blur(taps(kernel_sigma, 0.0, radius(kernel_sigma) + 1))
            }
        }
    };
    (0..layers + 3).map(recipe).collect()
}

/// Data dependencies of the scales of a tile, in pairs of rows (and of columns) of the octave, which is processed two
/// rows at a time.
#[derive(Debug)]
pub(crate) struct Dependencies {
    /// Delay of each scale relative to the first, in pairs.
    pub(crate) delay: Vec<usize>,
    /// Margin beyond the tile in which each scale is needed at full resolution, in pairs.
    pub(crate) fine: Vec<usize>,
    /// Margin beyond the tile in which each scale is needed at half resolution, in pairs.
    pub(crate) coarse: Vec<usize>,
    /// Number of buffered rows of each scale at full resolution.
    pub(crate) fine_rows: Vec<usize>,
    /// Number of buffered rows of each scale at half resolution.
    pub(crate) coarse_rows: Vec<usize>,
    /// Number of buffered rows of each difference (of scales `i + 1` and `i`).
    pub(crate) difference_rows: Vec<usize>,
    /// Delay of the detection of extrema relative to the first scale, in pairs.
    pub(crate) detection_delay: usize,
}

/// Margin in row pairs of the differences for the detection of extrema.
pub(crate) const DEPENDENCY_MARGIN_PAIRS: usize = WINDOW_RADIUS.div_ceil(2);

impl Dependencies {
    pub(crate) fn new(recipes: &[Recipe]) -> Self {
        let n = recipes.len();
        let mut delay = vec![0; n];
        for (i, recipe) in recipes.iter().enumerate().skip(1) {
            let ready = recipe.source(i).map_or(0, |j| delay[j] + recipe.lookahead());
            delay[i] = ready.max(delay[i - 1]);
        }
        let (mut fine, mut coarse) = (vec![DEPENDENCY_MARGIN_PAIRS; n], vec![0; n]);
        let (mut fine_rows, mut coarse_rows) = (vec![2; n], vec![1; n]);
        for i in (0..n).rev() {
            if !matches!(recipes[i], Recipe::Polyphase { .. }) {
                fine[i] = fine[i].max(coarse[i]);
            }
            if i > 0 {
                // For the difference with the previous scale.
                fine_rows[i - 1] = fine_rows[i - 1].max(2 * (delay[i] - delay[i - 1]) + 2);
            }
            let Some(j) = recipes[i].source(i) else { continue };
            let (lookahead, lag) = (recipes[i].lookahead(), delay[i] - delay[j]);
            let margin = fine[i].max(coarse[i]) + lookahead;
            if let Recipe::Blur(kernel) = &recipes[i] {
                fine[j] = fine[j].max(margin);
                fine_rows[j] = fine_rows[j].max(2 * lag + 1 + kernel.len());
            } else {
                coarse[j] = coarse[j].max(margin);
                coarse_rows[j] = coarse_rows[j].max(lag + 1 + lookahead);
            }
        }
        let detection_delay = delay[n - 1] + DEPENDENCY_MARGIN_PAIRS;
        let difference_rows = (1..n).map(|i| 2 * (detection_delay - delay[i]) + 2 + WINDOW_RADIUS).collect();
        Self { delay, fine, coarse, fine_rows, coarse_rows, difference_rows, detection_delay }
    }

    /// Returns the margin beyond the tile in which scale `i` is needed at any resolution, in pairs.
    pub(crate) fn margin(&self, i: usize) -> usize {
        self.fine[i].max(self.coarse[i])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn taps_have_the_requested_variance_and_sum_to_one() {
        for k in 8..60 {
            let sigma = k as f64 * 0.1;
            for (offset, len) in [(0.0, radius(sigma) + 1), (0.5, radius(sigma) + 1)] {
                let taps = taps(sigma, offset, len);
                let moment = |power: i32| -> f64 {
                    let one = |(i, w): (usize, &f32)| {
                        let twice = if i == 0 && offset == 0.0 { 1.0 } else { 2.0 };
                        twice * f64::from(*w) * (i as f64 + offset).powi(power)
                    };
                    taps.iter().enumerate().map(one).sum()
                };
                // f32 rounding of about ten taps, and the tolerance of the fixed-point iteration.
                assert!((moment(0) - 1.0).abs() < 1e-6, "{sigma} {offset}");
                assert!((moment(2) / (sigma * sigma) - 1.0).abs() < 2e-3, "{sigma} {offset}: {}", moment(2));
            }
        }
    }

    #[test]
    fn only_smooth_images_are_subsampled() {
        // Lowe's parameters: only scale 1 of an octave that starts with scale 0 is blurred at full resolution.
        for (is_upsampled, blurred) in [(false, 1), (true, 0)] {
            let made = recipes(3, 1.6, is_upsampled);
            assert_eq!(made.iter().filter(|r| matches!(r, Recipe::Blur(_))).count(), blurred, "{made:?}");
            assert_eq!(matches!(made[0], Recipe::Source), !is_upsampled);
        }
        // A first scale with σ = 0.8 must not be subsampled, nor the next ones while they are not smooth enough.
        let sharp = recipes(3, 0.8, false);
        assert!(sharp[1..4].iter().all(|r| matches!(r, Recipe::Blur(_))), "{sharp:?}");
        for layers in 1..=8 {
            for sigma in [0.8, 1.2, 1.6, 2.5, 4.0] {
                for is_upsampled in [false, true] {
                    let made = recipes(layers, sigma, is_upsampled);
                    let dependencies = Dependencies::new(&made);
                    assert_eq!(made.len(), layers + 3);
                    assert!(
                        dependencies.delay.is_sorted() && dependencies.detection_delay < 200,
                        "{layers} {sigma} {dependencies:?}"
                    );
                }
            }
        }
    }
}
