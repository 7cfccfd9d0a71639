//! Loss functions by which models are scored.

use crate::match_blocks::LANES;
use fearless_simd::{Level, dispatch, f64x8, prelude::*};

/// A robust loss ρ(u) of `u = (residual / threshold)²`, from 0 at `u = 0` to 1 for outliers (and for NaN).
pub trait Scorer: std::fmt::Debug + Sync {
    /// Evaluates the loss. The implementations of this crate are `#[inline(always)]`: they run inside vectorized loops.
    fn loss(&self, u: f32) -> f32;

    /// Returns the weight of a residual in iteratively reweighted least squares: the derivative of the loss with
    /// respect to `u`, scaled to 1 at `u = 0`.
    fn weight(&self, u: f64) -> f64;

    /// Returns the `u` from which the loss is 1.
    fn cutoff(&self) -> f64;

    /// Evaluates losses and weights of a block of residuals: 1 and 0 from the cutoff on, and for NaN.
    ///
    /// Provided: [`Scorer::loss`] and [`Scorer::weight`], inlined into a vectorized loop.
    fn losses_and_weights(&self, u: &[f64; LANES], losses: &mut [f64; LANES], weights: &mut [f64; LANES]) {
        dispatch!(Level::new(), _simd => {
            let cutoff = self.cutoff();
            for i in 0..LANES {
                let is_below_cutoff = u[i] < cutoff;
                let (loss, weight) = (f64::from(self.loss(u[i] as f32)), self.weight(u[i]));
                losses[i] = if is_below_cutoff { loss } else { 1.0 };
                weights[i] = if is_below_cutoff { weight } else { 0.0 };
            }
        })
    }
}

/// Losses and weights of a block of residuals.
pub(crate) struct BlockLosses {
    losses: [f64; LANES],
    weights: [f64; LANES],
}

impl BlockLosses {
    /// Evaluates the loss of a block, whose first `count` lanes hold residuals; the others have a loss of 1.
    #[inline(always)]
    pub(crate) fn new(scorer: &dyn Scorer, mut u: [f64; LANES], count: usize) -> Self {
        u[count..].fill(f64::NAN);
        let (mut losses, mut weights) = ([0.0; LANES], [0.0; LANES]);
        scorer.losses_and_weights(&u, &mut losses, &mut weights);
        Self { losses, weights }
    }

    /// Returns the weights of a half of the block.
    #[inline(always)]
    pub(crate) fn weights<S: Simd>(&self, simd: S, half: usize) -> f64x8<S> {
        f64x8::from_slice(simd, &self.weights[half * LANES / 2..][..LANES / 2])
    }

    /// Adds the losses of both halves.
    #[inline(always)]
    pub(crate) fn sum<S: Simd>(&self, simd: S) -> f64x8<S> {
        let (first, second) = self.losses.split_at(LANES / 2);
        f64x8::from_slice(simd, first) + f64x8::from_slice(simd, second)
    }
}

/// Least squares, for inliers only.
#[derive(Debug)]
pub(crate) struct LeastSquaresLoss;

impl Scorer for LeastSquaresLoss {
    #[inline(always)]
    fn loss(&self, u: f32) -> f32 {
        u
    }

    #[inline(always)]
    fn weight(&self, _: f64) -> f64 {
        1.0
    }

    #[inline(always)]
    fn cutoff(&self) -> f64 {
        f64::INFINITY
    }
}

/// `min(u, 1)`: MSAC (Torr & Zisserman, "MLESAC", 2000, §3).
#[derive(Debug, Clone, Copy, Default)]
pub struct Msac;

impl Scorer for Msac {
    #[inline(always)]
    fn loss(&self, u: f32) -> f32 {
        if u < 1.0 { u } else { 1.0 }
    }

    #[inline(always)]
    fn weight(&self, u: f64) -> f64 {
        if u < 1.0 { 1.0 } else { 0.0 }
    }

    #[inline(always)]
    fn cutoff(&self) -> f64 {
        1.0
    }
}

/// Tukey's biweight with its cutoff at 2.5 thresholds: a smooth loss close to MAGSAC++'s marginalization over noise
/// levels (Barath et al. 2020), without its lookup table.
#[derive(Debug, Clone, Copy, Default)]
pub struct TukeyBiweight;

/// The square of the cutoff, 2.5 thresholds. Of 1, 1.5, 2, 2.5 and 3.5, it has the smallest errors on synthetic
/// fundamental matrices of general and dominantly planar scenes (noise 0.1 to 2 px, 20 to 80 % outliers); homographies
/// are slightly better at 3.5.
const BIWEIGHT_CUTOFF: f32 = 6.25;

impl Scorer for TukeyBiweight {
    #[inline(always)]
    fn loss(&self, u: f32) -> f32 {
        let v = u * (1.0 / BIWEIGHT_CUTOFF);
        let w = if v < 1.0 { 1.0 - v } else { 0.0 };
        1.0 - w * w * w
    }

    #[inline(always)]
    fn weight(&self, u: f64) -> f64 {
        let v = u * (1.0 / f64::from(BIWEIGHT_CUTOFF));
        let w = if v < 1.0 { 1.0 - v } else { 0.0 };
        w * w
    }

    #[inline(always)]
    fn cutoff(&self) -> f64 {
        f64::from(BIWEIGHT_CUTOFF)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(scorer: &impl Scorer) {
        let c = scorer.cutoff() as f32;
        assert_eq!((scorer.loss(0.0), scorer.loss(c * 1.01), scorer.loss(f32::NAN)), (0.0, 1.0, 1.0));
        assert_eq!((scorer.weight(0.0), scorer.weight(f64::from(c) * 1.01)), (1.0, 0.0));
        let mut previous = 0.0;
        for i in 1..200 {
            let u = c * i as f32 / 200.0;
            let loss = scorer.loss(u);
            assert!(loss > previous);
            previous = loss;
            // The weight is the derivative up to a factor (the slope at 0): f32 differences over 1e-3 have an error of
            // 1e-3.
            let slope = |u: f32| f64::from(scorer.loss(u + 1e-3 * c) - scorer.loss(u)) / f64::from(1e-3 * c);
            if u + 1e-3 * c < c {
                let expected = scorer.weight(f64::from(u) + 5e-4 * f64::from(c)) * slope(0.0);
                assert!((slope(u) - expected).abs() < 5e-3 * slope(0.0), "{u}: {} {expected}", slope(u));
            }
        }
    }

    #[test]
    fn blocks_have_the_losses_and_weights_of_their_residuals() {
        for scorer in [&Msac as &dyn Scorer, &TukeyBiweight] {
            let c = scorer.cutoff();
            let mut u: [f64; LANES] = std::array::from_fn(|i| c * i as f64 / 10.0);
            (u[13], u[14], u[15]) = (f64::NAN, f64::INFINITY, f64::MAX);
            let (mut losses, mut weights) = ([f64::NAN; LANES], [f64::NAN; LANES]);
            scorer.losses_and_weights(&u, &mut losses, &mut weights);
            for i in 0..LANES {
                let plain =
                    if u[i] < c { (f64::from(scorer.loss(u[i] as f32)), scorer.weight(u[i])) } else { (1.0, 0.0) };
                assert_eq!((losses[i], weights[i]), plain, "{}", u[i]);
            }
        }
    }

    #[test]
    fn losses_increase_from_zero_to_one_and_weights_are_their_derivatives() {
        check(&Msac);
        check(&TukeyBiweight);
    }
}
