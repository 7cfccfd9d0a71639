//! Checks of the winners (uniqueness, field of view, left-right consistency) and their sub-pixel refinement.

use crate::winner::{NO_SUM, Winner};
use crate::{PixelState, StereoOptions, Subpixel};
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

/// Pixels that are checked and refined at a time: so many that their members are stored long before vectors of them are loaded.
const CHUNK: usize = 256;

/// Writes the states and disparities of a row. `right` has the winning indices of the row of the right view.
#[simd]
pub(crate) fn check_row<S: Simd>(
    _: S,
    options: &StereoOptions,
    winners: &[Winner],
    right: &[u16],
    states: &mut [PixelState],
    disparities: &mut [f32],
) {
    let chunks = states.chunks_mut(CHUNK).zip(disparities.chunks_mut(CHUNK));
    for (chunk, (winners, (states, disparities))) in winners.chunks(CHUNK).zip(chunks).enumerate() {
        let winners = Winners::new(options, winners, chunk * CHUNK, right);
        let chunk_states = winners.classify(options);
        states.copy_from_slice(&chunk_states[..states.len()]);
        let first = options.min_disparity as f32;
        for (i, d) in disparities.iter_mut().enumerate() {
            // Computed in any case: a branch would be mispredicted where matched and rejected pixels mix.
            let sums = [winners.below[i], winners.above[i], winners.cost[i]].map(f32::from);
            let value = first + f32::from(winners.index[i]) + subpixel_offset(options.subpixel, sums);
            *d = if chunk_states[i] == PixelState::Matched { value } else { f32::NAN };
        }
    }
}

/// The winners of neighboring pixels by member, for vectors.
struct Winners {
    index: [u16; CHUNK],
    cost: [u16; CHUNK],
    second: [u16; CHUNK],
    below: [u16; CHUNK],
    above: [u16; CHUNK],
    /// Winning index of the correspondence; [`Winners::OUTSIDE`] outside the right image.
    there: [u16; CHUNK],
}

impl Winners {
    /// Larger than every index.
    const OUTSIDE: u16 = u16::MAX;

    /// Collects the winners of the pixels from column `x` on.
    #[inline(always)]
    fn new(options: &StereoOptions, winners: &[Winner], x: usize, right: &[u16]) -> Self {
        let [index, cost, second, below, above, there] = [[0; CHUNK]; 6];
        let mut all = Self { index, cost, second, below, above, there };
        let first = x as i64 - i64::from(options.min_disparity);
        for (i, winner) in winners.iter().enumerate() {
            let Winner { index, cost, second, below, above } = *winner;
            // Negative columns are large ones.
            let column = (first + i as i64 - i64::from(index)) as usize;
            all.there[i] = right.get(column).copied().unwrap_or(Self::OUTSIDE);
            (all.index[i], all.cost[i], all.second[i], all.below[i], all.above[i]) =
                (index, cost, second, below, above);
        }
        all
    }

    /// Classifies the pixels. Branch-free on pixel data, for vectors.
    #[inline(always)]
    fn classify(&self, options: &StereoOptions) -> [PixelState; CHUNK] {
        let tolerance = options.left_right.unwrap_or(u16::MAX);
        // Sums are at most 510 and uniqueness 99 %: their products fit.
        let uniqueness = u16::from(options.uniqueness);
        std::array::from_fn(|i| {
            let (index, there, cost) = (self.index[i], self.there[i], self.cost[i]);
            // A flat minimum determines neither the disparity nor the cause of a rejection.
            let flat = self.below[i] == cost;
            let ambiguous = (uniqueness > 0) & (self.second[i] * (100 - uniqueness) < cost * 100);
            let mut state = if ambiguous { PixelState::Mismatched } else { PixelState::Matched };
            // The surface in the right image is nearer: it occludes this pixel.
            let inconsistent = if there > index { PixelState::Occluded } else { PixelState::Mismatched };
            state = if there.abs_diff(index) > tolerance { inconsistent } else { state };
            state = if there == Self::OUTSIDE { PixelState::OutOfView } else { state };
            if flat { PixelState::Mismatched } else { state }
        })
    }
}

/// Returns the offset of the minimum from the winning index, −0.5 to 0.5. Branch-free on the sums, as [`Winners::classify`].
#[inline(always)]
fn subpixel_offset(method: Subpixel, [below, above, cost]: [f32; 3]) -> f32 {
    let no_sum = f32::from(NO_SUM);
    let slope = below.max(above) - cost;
    // Rise on the lower side relative to that on the higher one: 1 at a whole pixel, 0 half a pixel away.
    let ratio = (below.min(above) - cost) / slope;
    let rest = match method {
        Subpixel::CorrectedVFit => 0.5 * ratio * (1.0 + ratio),
        Subpixel::None | Subpixel::VFit => ratio,
    };
    let offset = (0.5 * (1.0 - rest)).copysign(below - above);
    let none = (method == Subpixel::None) | (below == no_sum) | (above == no_sum) | (slope <= 0.0);
    if none { 0.0 } else { offset }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fearless_simd::{Level, dispatch};
    use proptest::prelude::*;

    /// The checks of one pixel, one after the other.
    fn expected(options: &StereoOptions, x: usize, winner: &Winner, right: &[u16]) -> PixelState {
        let column = x as i64 - i64::from(options.min_disparity) - i64::from(winner.index);
        let there = usize::try_from(column).ok().and_then(|column| right.get(column));
        let ratio = f64::from(winner.second) * f64::from(100 - options.uniqueness);
        match there {
            _ if winner.below == winner.cost => PixelState::Mismatched,
            None => PixelState::OutOfView,
            Some(&there) if options.left_right.is_some_and(|tolerance| there.abs_diff(winner.index) > tolerance) => {
                if there > winner.index {
                    PixelState::Occluded
                } else {
                    PixelState::Mismatched
                }
            }
            _ if options.uniqueness > 0 && ratio < 100.0 * f64::from(winner.cost) => PixelState::Mismatched,
            _ => PixelState::Matched,
        }
    }

    proptest! {
        #[test]
        fn rows_are_checked_as_pixels_are(
            pixels in proptest::collection::vec((0u16..40, 0u16..=NO_SUM, 0u16..=NO_SUM, 0u16..=NO_SUM, 0u16..40), 1..700),
            min_disparity in -20i32..20,
            uniqueness in prop_oneof![Just(0u8), 1u8..100],
            left_right in proptest::option::of(0u16..4),
        ) {
            let options = StereoOptions { min_disparity, uniqueness, left_right, ..Default::default() };
            let winner = |&(index, cost, second, below, _): &(u16, u16, u16, u16, u16)| {
                Winner { index, cost, second, below: below.max(cost), above: NO_SUM }
            };
            let winners: Vec<Winner> = pixels.iter().map(winner).collect();
            let right: Vec<u16> = pixels.iter().map(|pixel| pixel.4).collect();
            let mut states = vec![PixelState::NoData; pixels.len()];
            let mut disparities = vec![0.0; pixels.len()];
            dispatch!(Level::new(), simd => check_row(simd, &options, &winners, &right, &mut states, &mut disparities));
            for (x, (winner, (state, d))) in winners.iter().zip(states.iter().zip(&disparities)).enumerate() {
                prop_assert_eq!(*state, expected(&options, x, winner, &right), "{} {:?}", x, winner);
                // Without a sum above, there is no sub-pixel refinement.
                let whole = (min_disparity + i32::from(winner.index)) as f32;
                prop_assert!(if *state == PixelState::Matched { *d == whole } else { d.is_nan() }, "{x} {winner:?} {d}");
            }
        }
    }
}
