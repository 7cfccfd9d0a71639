//! Checks of the winners (uniqueness, field of view, left-right consistency) and their sub-pixel refinement.

use crate::winner::{NO_SUM, Winner};
use crate::{PixelState, StereoOptions, Subpixel};

/// Writes the states and disparities of a row. `right` has the winning indices of the row of the right view.
pub(crate) fn check_row(
    options: &StereoOptions,
    winners: &[Winner],
    right: &[u16],
    states: &mut [PixelState],
    disparities: &mut [f32],
) {
    for (x, ((winner, state), d)) in winners.iter().zip(states).zip(disparities).enumerate() {
        *state = classify_winner(options, x, winner, right);
        let whole = (options.min_disparity + i32::from(winner.index)) as f32;
        // Computed in any case: a branch would be mispredicted where matched and rejected pixels mix.
        let value = whole + subpixel_offset(options.subpixel, winner);
        *d = if *state == PixelState::Matched { value } else { f32::NAN };
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
fn subpixel_offset(method: Subpixel, winner: &Winner) -> f32 {
    let [below, above, cost] = [winner.below, winner.above, winner.cost].map(f32::from);
    let slope = below.max(above) - cost;
    // Rise on the lower side relative to that on the higher one: 1 at a whole pixel, 0 half a pixel away.
    let ratio = (below.min(above) - cost) / slope;
    let rest = match method {
        Subpixel::CorrectedVFit => 0.5 * ratio * (1.0 + ratio),
        Subpixel::None | Subpixel::VFit => ratio,
    };
    let offset = (0.5 * (1.0 - rest)).copysign(below - above);
    let none = (method == Subpixel::None) | (winner.below == NO_SUM) | (winner.above == NO_SUM) | (slope <= 0.0);
    if none { 0.0 } else { offset }
}
