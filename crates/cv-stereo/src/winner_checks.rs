//! Checks of the winners (uniqueness, field of view, left-right consistency) and their sub-pixel refinement.

use crate::winner::{NO_SUM, Winner};
use crate::{PixelState, StereoOptions, Subpixel};
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

/// Pixels that are refined at a time, in vectors.
const CHUNK: usize = 64;

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
        let [mut index, mut cost, mut below, mut above] = [[0f32; CHUNK]; 4];
        let mut is_matched = [0f32; CHUNK];
        for (i, (winner, state)) in winners.iter().zip(states).enumerate() {
            *state = classify_winner(options, chunk * CHUNK + i, winner, right);
            is_matched[i] = f32::from(u8::from(*state == PixelState::Matched));
            index[i] = f32::from(winner.index);
            cost[i] = f32::from(winner.cost);
            below[i] = f32::from(winner.below);
            above[i] = f32::from(winner.above);
        }
        let first = options.min_disparity as f32;
        for (i, d) in disparities.iter_mut().enumerate() {
            // Computed in any case: a branch would be mispredicted where matched and rejected pixels mix.
            let value = first + index[i] + subpixel_offset(options.subpixel, [below[i], above[i], cost[i]]);
            *d = if is_matched[i] > 0.0 { value } else { f32::NAN };
        }
    }
}

/// Classifies a pixel by its winner. Branch-free on pixel data, which would be mispredicted where matched and rejected pixels mix.
#[inline(always)]
fn classify_winner(options: &StereoOptions, x: usize, winner: &Winner, right: &[u16]) -> PixelState {
    let xr = x as i64 - i64::from(options.min_disparity) - i64::from(winner.index);
    let inside = xr >= 0 && xr < right.len() as i64;
    let right_index = right[xr.clamp(0, right.len() as i64 - 1) as usize];
    let differs = options.left_right.is_some_and(|tolerance| right_index.abs_diff(winner.index) > tolerance);
    // A flat minimum determines neither the disparity nor the cause of a rejection.
    let flat = winner.below == winner.cost;
    let ambiguous = u32::from(winner.second) * u32::from(100 - options.uniqueness) < u32::from(winner.cost) * 100;
    let ambiguous = flat | (ambiguous & (options.uniqueness > 0));
    let mut state = if ambiguous { PixelState::Mismatched } else { PixelState::Matched };
    // The surface in the right image is nearer: it occludes this pixel.
    let inconsistent = if right_index > winner.index { PixelState::Occluded } else { PixelState::Mismatched };
    state = if differs { inconsistent } else { state };
    state = if inside { state } else { PixelState::OutOfView };
    if flat { PixelState::Mismatched } else { state }
}

/// Returns the offset of the minimum from the winning index, −0.5 to 0.5. Branch-free on the sums, as [`classify_winner`].
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
