//! Smoothness costs of all pairs of photographs at each pixel of the preview. The resolutions of the preview and the labels in turn need them several times.

use super::contradiction::contradiction;
use super::cost::BORDER_COST;
use super::misalignment::{Misalignments, SPACING};
use crate::surface::{Bounds, Piece, Preview};
use fearless_simd::{Level, dispatch};
use std::sync::OnceLock;

/// Smoothness term per canvas pixel of misalignment beyond the first, in addition to the color difference: 15 gray levels in one channel.
const MISALIGNMENT_COST: f32 = 4.0 * 15.0;
/// Misalignment beyond the first canvas pixel at which the cost is truncated: then it equals that of the border of a photograph.
const MAX_MISALIGNMENT_PX: f32 = 3.0;

/// The costs of all pairs of pieces, each computed when it is first needed.
pub(super) struct PairCosts<'a> {
    preview: &'a Preview,
    misalignments: &'a Misalignments,
    pairs: Vec<OnceLock<PairCost>>,
}

/// Cost of a seam between two photographs at each pixel that both may cover: that of their difference, misalignment and contradiction.
pub(super) struct PairCost {
    common: Bounds,
    pixels: Vec<u16>,
}

impl PairCost {
    /// Returns the cost at a preview pixel.
    #[inline]
    pub(super) fn at(&self, x: usize, y: usize) -> i32 {
        if self.common.contains(x, y) { self.pixels[self.common.index(x, y)].into() } else { BORDER_COST }
    }
}

impl<'a> PairCosts<'a> {
    pub(super) fn new(preview: &'a Preview, misalignments: &'a Misalignments) -> Self {
        let pairs = (0..preview.pieces.len().pow(2)).map(|_| OnceLock::new()).collect();
        Self { preview, misalignments, pairs }
    }

    /// Returns the costs of two pieces. O(overlap) the first time.
    #[inline]
    pub(super) fn of(&self, a: usize, b: usize) -> &PairCost {
        let (a, b) = (a.min(b), a.max(b));
        self.pairs[a * self.preview.pieces.len() + b].get_or_init(|| self.computed(a, b))
    }

    fn computed(&self, a: usize, b: usize) -> PairCost {
        let pieces = [&self.preview.pieces[a], &self.preview.pieces[b]];
        let empty = Bounds { left: 0, top: 0, right: 0, bottom: 0 };
        let common = pieces[0].warped.bounds.intersection(&pieces[1].warped.bounds).unwrap_or(empty);
        let width = common.width();
        let mut pixels = vec![0; width * common.height()];
        let (mut above, mut row) = (DifferenceRow::new(width), DifferenceRow::new(width));
        for (y, out) in (common.top..).zip(pixels.chunks_exact_mut(width.max(1))) {
            let of = |piece: &'a Piece| {
                let left = piece.warped.bounds.left;
                &piece.warped.row(y)[common.left - left..common.right - left]
            };
            let (first, second) = (of(pieces[0]), of(pieces[1]));
            dispatch!(Level::new(), _simd => {
                row.set(first, second);
                row.costs(&above, out);
            });
            for (x, cost) in (common.left..).zip(out.iter_mut()) {
                // At most 2¹⁵ with all terms.
                *cost += contradiction(pieces[0], pieces[1], (x, y), i32::from(*cost)) as u16;
            }
            for (x, costs) in (common.left..).step_by(SPACING).zip(out.chunks_mut(SPACING)) {
                let off = self.preview.step as f32 * self.misalignments.at(a, b, x, y) - 1.0;
                let misaligned = (MISALIGNMENT_COST * off.clamp(0.0, MAX_MISALIGNMENT_PX)) as u16;
                costs.iter_mut().for_each(|cost| *cost += misaligned);
            }
            std::mem::swap(&mut above, &mut row);
        }
        PairCost { common, pixels }
    }
}

/// The difference of two photographs in a row of pixels.
struct DifferenceRow {
    /// Sum over channels of the absolute differences.
    absolute: Vec<i16>,
    /// Sum over channels of the differences.
    signed: Vec<i16>,
    /// 1 where both photographs cover the pixel, else 0.
    covered: Vec<i16>,
}

impl DifferenceRow {
    /// Returns a row that neither photograph covers.
    fn new(width: usize) -> Self {
        Self { absolute: vec![0; width], signed: vec![0; width], covered: vec![0; width] }
    }

    #[inline(always)]
    fn set(&mut self, first: &[[u8; 4]], second: &[[u8; 4]]) {
        let out = self.absolute.iter_mut().zip(&mut self.signed).zip(&mut self.covered);
        for (((absolute, signed), covered), (p, q)) in out.zip(first.iter().zip(second)) {
            let d: [i16; 3] = std::array::from_fn(|c| i16::from(p[c]) - i16::from(q[c]));
            *absolute = d[0].abs() + d[1].abs() + d[2].abs();
            *signed = d[0] + d[1] + d[2];
            *covered = i16::from(p[3] > 0) & i16::from(q[3] > 0);
        }
    }

    /// Computes the cost of [`difference`](super::cost::difference).
    #[inline(always)]
    fn costs(&self, above: &Self, out: &mut [u16]) {
        let n = out.len();
        let (absolute, signed, covered) = (&self.absolute[..n], &self.signed[..n], &self.covered[..n]);
        let (signed_above, covered_above) = (&above.signed[..n], &above.covered[..n]);
        let cost = |i: usize, left: i16| {
            let up = covered_above[i] * (signed[i] - signed_above[i]).abs();
            let cost = 4 * (absolute[i] + left + up);
            if covered[i] != 0 { cost as u16 } else { BORDER_COST as u16 }
        };
        if n > 0 {
            out[0] = cost(0, 0);
        }
        for i in 1..n {
            out[i] = cost(i, covered[i - 1] * (signed[i] - signed[i - 1]).abs());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::cost::difference;
    use super::*;
    use crate::testing::{drawn, stage};
    use cv_core::Image;
    use proptest::prelude::*;

    fn piece(bounds: Bounds, seed: u32) -> Piece {
        let level = |x: usize, y: usize, c: u32| {
            let h = (x as u32 * 7919 + y as u32 * 104_729 + c * 31 + seed).wrapping_mul(0x9E37_79B1);
            if h >> 30 == 0 { 255 } else { (h >> 20) as u8 }
        };
        let mut warped = drawn(bounds, |x, y| [level(x, y, 0), level(x, y, 1), level(x, y, 2)]);
        // Pixels that the photograph does not cover.
        for pixel in warped.pixels.as_mut_slice().as_chunks_mut::<4>().0.iter_mut().step_by(5 + seed as usize) {
            pixel[3] = 0;
        }
        let zero = vec![0.0; bounds.width() * bounds.height()];
        Piece::new(warped, zero.clone(), zero, 0.0)
    }

    proptest! {
        #[test]
        fn costs_are_those_of_difference_contradiction_and_misalignment(
            (x, y) in (0..30_usize, 0..20_usize),
            (w, h) in (1..50_usize, 1..40_usize),
            step in 1..5_usize,
        ) {
            let first = Bounds { left: 3, top: 2, right: 43, bottom: 32 };
            let second = Bounds { left: x, top: y, right: x + w, bottom: y + h };
            let pieces = vec![piece(first, 0), piece(second, 1)];
            let preview = Preview { step, width: 90, height: 70, full_circle: false, pieces };
            let found = Misalignments::find(&preview, &[0, 1], &stage()).unwrap();
            let costs = PairCosts::new(&preview, &found);
            let [a, b] = &preview.pieces[..] else { unreachable!() };
            for (x, y) in (0..70).flat_map(|y| (0..90).map(move |x| (x, y))) {
                let own = difference(Some(&a.warped), Some(&b.warped), x, y);
                let off = step as f32 * found.at(0, 1, x, y) - 1.0;
                let misaligned = (MISALIGNMENT_COST * off.clamp(0.0, MAX_MISALIGNMENT_PX)) as i32;
                let expected = own + misaligned + contradiction(a, b, (x, y), own);
                prop_assert_eq!(costs.of(0, 1).at(x, y), expected, "{} {}", x, y);
                prop_assert_eq!(costs.of(1, 0).at(x, y), expected);
            }
        }
    }

    #[test]
    fn the_largest_cost_is_represented() {
        // White beside black, one in each photograph, and every patch different.
        let bounds = Bounds { left: 0, top: 0, right: 40, bottom: 40 };
        let piece = |odd: usize| {
            let colors = Image::<u8, 1>::from_fn(40, 40, |x, y| [if (x + y) % 2 == odd { 255 } else { 0 }]);
            let zero = vec![0.0; 1600];
            Piece::new(drawn(bounds, |x, y| [colors.at(x, y)[0]; 3]), zero.clone(), zero, 0.0)
        };
        let preview = Preview { step: 4, width: 40, height: 40, full_circle: false, pieces: vec![piece(0), piece(1)] };
        let found = Misalignments::find(&preview, &[0, 1], &stage()).unwrap();
        let costs = PairCosts::new(&preview, &found);
        let [a, b] = &preview.pieces[..] else { unreachable!() };
        let own = difference(Some(&a.warped), Some(&b.warped), 20, 20);
        assert_eq!(own, 4 * (3 * 255 + 2 * 6 * 255));
        let off = (4.0 * found.at(0, 1, 20, 20) - 1.0).clamp(0.0, MAX_MISALIGNMENT_PX);
        let expected = own + contradiction(a, b, (20, 20), own) + (MISALIGNMENT_COST * off) as i32;
        assert_eq!(costs.of(0, 1).at(20, 20), expected);
    }
}
