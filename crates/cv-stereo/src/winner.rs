//! The winner of a pixel, and definitions shared by the fast and the reference aggregation.

use crate::StereoOptions;

/// Marks a missing sum: two saturated halves. Such a disparity never wins.
pub(crate) const NO_SUM: u16 = 510;

/// The best disparity of one pixel, as an index from `min_disparity`, with the sums around it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Winner {
    /// Index of the smallest sum, the first of equals.
    pub(crate) index: u16,
    /// The smallest sum.
    pub(crate) cost: u16,
    /// The smallest sum at indices not next to the winner; [`NO_SUM`] without any, and if it was not requested.
    pub(crate) second: u16,
    /// The sum one index below; [`NO_SUM`] at the end of the range. It is larger than [`Winner::cost`], since the first of equal sums
    /// wins, except for a flat minimum: there both neighbors equal it.
    pub(crate) below: u16,
    /// The sum one index above; [`NO_SUM`] at the end of the range.
    pub(crate) above: u16,
}

/// Returns whether the minimum at `index` is flat: the next two sums, as far as they exist, equal it. A single equal one is a minimum
/// half a pixel away.
#[inline(always)]
pub(crate) fn is_flat(index: usize, disparities: usize, cost: u16, at: impl Fn(usize) -> u16) -> bool {
    at(index + 1) == cost && (index + 2 >= disparities || at(index + 2) == cost)
}

/// Returns the cost of correspondences outside the right image, given the sum of the costs inside and their number: three quarters of
/// their mean. In low texture all match equally well, and those outside must not cost more; elsewhere they cost less than a chance match,
/// which the best of the few disparities of a pixel near the border would otherwise beat (of the out-of-view pixels of seven scenes of
/// Middlebury 2014, 46 % were wrong with the mean and 39 % are with this).
pub(crate) fn outside_cost(sum: u32, n: usize) -> u8 {
    let n = n as u32;
    ((sum + n / 2).checked_div(n).unwrap_or(0) * 3 / 4) as u8
}

/// Returns P2 by the absolute difference of neighboring gray levels (0 to 255).
pub(crate) fn p2_table(options: &StereoOptions) -> [u8; 256] {
    let (low, high) = (u32::from(options.p2_min), u32::from(options.p2));
    let half = u32::from(options.p2_gradient);
    std::array::from_fn(|step| {
        let step = step as u32;
        if half == 0 { high as u8 } else { (low + ((high - low) * half + (half + step) / 2) / (half + step)) as u8 }
    })
}
