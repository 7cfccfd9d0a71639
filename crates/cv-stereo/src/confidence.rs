//! Confidence and standard deviation of matched disparities.

use crate::PixelState;
use crate::winner::{NO_SUM, Winner};

/// Returns the confidence of a matched pixel, 0 to 1: how far the best sum is below the best one elsewhere (`(second − best) /
/// second`, the naive peak ratio of Hu & Mordohai, "A quantitative evaluation of confidence measures for stereo vision",
/// PAMI 2012); 0 for filled pixels.
pub(crate) fn confidence(winner: &Winner, state: PixelState) -> f32 {
    if state != PixelState::Matched {
        return 0.0;
    }
    match (winner.second, winner.cost) {
        (NO_SUM, _) => 1.0,
        (0, _) => 0.0,
        (second, cost) => f32::from(second.saturating_sub(cost)) / f32::from(second),
    }
}

/// Returns the standard deviation of a matched disparity in px; NaN for filled pixels: `√((1 + cost) / rise) / 5`.
///
/// The minimum of sums that rise by `rise` per pixel is uncertain by their own uncertainty over the rise; but the sums are of paths that
/// share their costs, and smoothing averages the least certain disparities most. Form and factor were fitted to nine generated scenes of
/// four kinds (seeds 300 to 304), as they are, at one stop less, and with noise of 3 and 8 gray levels: of each of the 36 pairs 53 to
/// 78 % of the errors are within one standard deviation and 88 % of all within two; the tails are heavier than a normal distribution's.
/// Under stronger noise it is too small: down to half of the errors are within one.
pub(crate) fn sigma(winner: &Winner, state: PixelState) -> f32 {
    if state != PixelState::Matched {
        return f32::NAN;
    }
    let rise = |side: u16| if side == NO_SUM { 0.0 } else { f32::from(side.saturating_sub(winner.cost)) };
    let rise = rise(winner.below).max(rise(winner.above)).max(0.5);
    (0.207 * ((1.0 + f32::from(winner.cost)) / rise).sqrt()).clamp(0.0625, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_deep_minimum_has_higher_confidence_than_a_shallow_one() {
        let deep = Winner { index: 3, cost: 10, second: 200, below: 90, above: 80 };
        let shallow = Winner { index: 3, cost: 100, second: 110, below: 104, above: 103 };
        let (a, b) = (confidence(&deep, PixelState::Matched), confidence(&shallow, PixelState::Matched));
        assert_eq!((a, b), (0.95, 10.0 / 110.0));
        assert!(sigma(&deep, PixelState::Matched) < sigma(&shallow, PixelState::Matched));
        assert_eq!(confidence(&deep, PixelState::Occluded), 0.0);
        assert!(sigma(&deep, PixelState::OutOfView).is_nan());
    }

    #[test]
    fn minima_at_the_ends_and_zero_sums_give_finite_values() {
        let flat = Winner { index: 0, cost: 0, second: 0, below: NO_SUM, above: NO_SUM };
        assert_eq!(confidence(&flat, PixelState::Matched), 0.0);
        assert!(sigma(&flat, PixelState::Matched).is_finite());
        assert_eq!(confidence(&Winner { second: NO_SUM, ..flat }, PixelState::Matched), 1.0);
    }
}
