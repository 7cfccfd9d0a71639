//! How each scale of an octave is made from one that is there: the kernels, and what they need of it.
//!
//! An image that is smooth enough loses nothing when only every second pixel of every second row is kept, and a Gaussian sampled at the phases 0 and ½ of what is
//! kept gives the blurred image at all pixels again (a polyphase filter). Its windows are half as long as those at full resolution, and half of
//! its passes go along half of the columns, so a scale costs a third.

use crate::dog::REACH;

/// The least harmonic sum of the variances of source and kernel, in pixels of the source. The composite of two sampled Gaussians then ripples from phase to phase by
/// `2·exp(−2π²·0.35)`, 0.2 % of its height, at the frequency of the samples, most of which the blurs themselves take away.
const LEAST_VARIANCE: f64 = 0.35;

/// A Gaussian of this variance sampled at distances `offset, 1 + offset, …` from its middle, to three standard deviations: the half from the middle outwards,
/// the whole summing to one.
///
/// What is cut off and the coarse samples would change the variance by some percent: the Gaussian that is sampled is wider by as much.
fn taps(sigma: f64, offset: f64, len: usize) -> Vec<f32> {
    let weights = |s: f64| -> Vec<f64> {
        let weight = |i: usize| (-0.5 * ((i as f64 + offset) / s).powi(2)).exp();
        let all: Vec<f64> = (0..len).map(weight).collect();
        let twice = 2.0 * all.iter().sum::<f64>() - if offset == 0.0 { all[0] } else { 0.0 };
        all.into_iter().map(|w| w / twice).collect()
    };
    let mut s = sigma;
    // The correction is small, so a few steps of the fixed point give it to a thousandth.
    for _ in 0..6 {
        let variance: f64 = weights(s).iter().enumerate().map(|(i, w)| 2.0 * w * (i as f64 + offset).powi(2)).sum();
        s *= (sigma * sigma / variance.max(1e-12)).sqrt().clamp(0.8, 1.25);
    }
    weights(s).into_iter().map(|w| w as f32).collect()
}

/// Taps on each side of the middle one.
fn radius(sigma: f64) -> usize {
    (3.0 * sigma).ceil().max(1.0) as usize
}

/// How a scale comes about.
#[derive(Debug)]
pub(crate) enum Recipe {
    /// It is the image the octave begins with.
    Given,
    /// The scale before, blurred at full resolution with this half-kernel.
    Blur(Vec<f32>),
    /// Every second pixel of every second row of scale `from` (or the image that is doubled), blurred at its pixels and half-way between them.
    Polyphase { from: Option<usize>, even: Vec<f32>, odd: Vec<f32> },
}

impl Recipe {
    /// Rows of half the resolution that are needed below a row pair: of the source's pairs.
    fn reach(&self) -> usize {
        match self {
            Self::Given => 0,
            Self::Blur(kernel) => (kernel.len() - 1).div_ceil(2),
            Self::Polyphase { odd, .. } => odd.len(),
        }
    }

    /// The scale it is made from.
    fn source(&self, index: usize) -> Option<usize> {
        match self {
            Self::Given => None,
            Self::Blur(_) => Some(index - 1),
            Self::Polyphase { from, .. } => *from,
        }
    }
}

/// The scales 0 to `layers + 2` of an octave: σ is `sigma · 2^(i / layers)` of its pixels.
///
/// `doubled`: it begins with an image of half its size and no blur of its own that counts; else with scale 0.
pub(crate) fn recipes(layers: usize, sigma: f32, doubled: bool) -> Vec<Recipe> {
    let scale = |i: usize| f64::from(sigma) * 2f64.powf(i as f64 / layers as f64);
    let polyphase = |from: Option<usize>, i: usize| {
        let have = from.map_or(0.0, |j| 0.5 * scale(j));
        let add = (0.25 * scale(i) * scale(i) - have * have).sqrt();
        let smooth = from.is_none() || (have * add).powi(2) / (have * have + add * add) >= LEAST_VARIANCE;
        smooth.then(|| (radius(add), from, add))
    };
    let one = |i: usize| {
        if i == 0 && !doubled {
            return Recipe::Given;
        }
        let sources = (doubled.then_some(None)).into_iter().chain((0..i).map(Some));
        // The shortest, and of those the one from the last scale.
        let best = sources.filter_map(|from| polyphase(from, i)).rev().min_by_key(|p| p.0);
        match best {
            Some((radius, from, sigma)) => {
                Recipe::Polyphase { from, even: taps(sigma, 0.0, radius + 1), odd: taps(sigma, 0.5, radius + 1) }
            }
            None => {
                let add = (scale(i) * scale(i) - scale(i - 1) * scale(i - 1)).sqrt();
                Recipe::Blur(taps(add, 0.0, radius(add) + 1))
            }
        }
    };
    (0..layers + 3).map(one).collect()
}

/// What a tile keeps of each scale, in pairs of rows (and of columns) of the octave: an octave is worked two rows at a time.
#[derive(Debug)]
pub(crate) struct Needs {
    /// So many pairs a scale runs behind the first.
    pub(crate) delay: Vec<usize>,
    /// So many pairs beyond the tile it is needed at full resolution.
    pub(crate) fine: Vec<usize>,
    /// So many pairs beyond the tile every second of its pixels is needed.
    pub(crate) coarse: Vec<usize>,
    /// Rows of it that are looked back at.
    pub(crate) fine_rows: Vec<usize>,
    /// Rows of every second pixel that are looked back at.
    pub(crate) coarse_rows: Vec<usize>,
    /// Rows of each difference (of scale `i + 1` and `i`) that are looked back at.
    pub(crate) difference_rows: Vec<usize>,
    /// So many pairs the search for extrema runs behind the first scale.
    pub(crate) search: usize,
}

/// Pairs of rows that the search for extrema looks at beyond its own.
pub(crate) const REACH_PAIRS: usize = REACH.div_ceil(2);

impl Needs {
    pub(crate) fn new(recipes: &[Recipe]) -> Self {
        let n = recipes.len();
        let mut delay = vec![0; n];
        for (i, recipe) in recipes.iter().enumerate().skip(1) {
            let ready = recipe.source(i).map_or(0, |j| delay[j] + recipe.reach());
            delay[i] = ready.max(delay[i - 1]);
        }
        let (mut fine, mut coarse) = (vec![REACH_PAIRS; n], vec![0; n]);
        let (mut fine_rows, mut coarse_rows) = (vec![2; n], vec![1; n]);
        for i in (0..n).rev() {
            if !matches!(recipes[i], Recipe::Polyphase { .. }) {
                fine[i] = fine[i].max(coarse[i]);
            }
            if i > 0 {
                // The difference with the scale before.
                fine_rows[i - 1] = fine_rows[i - 1].max(2 * (delay[i] - delay[i - 1]) + 2);
            }
            let Some(j) = recipes[i].source(i) else { continue };
            let (reach, behind) = (recipes[i].reach(), delay[i] - delay[j]);
            let beyond = fine[i].max(coarse[i]) + reach;
            if let Recipe::Blur(kernel) = &recipes[i] {
                fine[j] = fine[j].max(beyond);
                fine_rows[j] = fine_rows[j].max(2 * behind + 1 + kernel.len());
            } else {
                coarse[j] = coarse[j].max(beyond);
                coarse_rows[j] = coarse_rows[j].max(behind + 1 + reach);
            }
        }
        let search = delay[n - 1] + REACH_PAIRS;
        let difference_rows = (1..n).map(|i| 2 * (search - delay[i]) + 2 + REACH).collect();
        Self { delay, fine, coarse, fine_rows, coarse_rows, difference_rows, search }
    }

    /// So many pairs beyond the tile scale `i` is needed at all.
    pub(crate) fn beyond(&self, i: usize) -> usize {
        self.fine[i].max(self.coarse[i])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn taps_have_the_variance_asked_for_and_sum_to_one() {
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
                // f32 rounding of some ten taps, and the thousandth that the fixed point leaves.
                assert!((moment(0) - 1.0).abs() < 1e-6, "{sigma} {offset}");
                assert!((moment(2) / (sigma * sigma) - 1.0).abs() < 2e-3, "{sigma} {offset}: {}", moment(2));
            }
        }
    }

    #[test]
    fn only_smooth_images_are_thinned() {
        // Lowe's settings: only scale 1 of an octave that begins with scale 0 is blurred at full resolution.
        for (doubled, blurred) in [(false, 1), (true, 0)] {
            let made = recipes(3, 1.6, doubled);
            assert_eq!(made.iter().filter(|r| matches!(r, Recipe::Blur(_))).count(), blurred, "{made:?}");
            assert_eq!(matches!(made[0], Recipe::Given), !doubled);
        }
        // A first scale of σ 0.8 must not be thinned, nor the ones after it while they are as sharp.
        let sharp = recipes(3, 0.8, false);
        assert!(sharp[1..4].iter().all(|r| matches!(r, Recipe::Blur(_))), "{sharp:?}");
        for layers in 1..=8 {
            for sigma in [0.8, 1.2, 1.6, 2.5, 4.0] {
                for doubled in [false, true] {
                    let made = recipes(layers, sigma, doubled);
                    let needs = Needs::new(&made);
                    assert_eq!(made.len(), layers + 3);
                    assert!(needs.delay.is_sorted() && needs.search < 200, "{layers} {sigma} {needs:?}");
                }
            }
        }
    }
}
