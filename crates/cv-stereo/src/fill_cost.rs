//! The data term of hole filling: how well a plane explains why a pixel was not matched. A pixel that is out of view, or occluded by a nearer
//! match of the right image, has a constant cost; a visible one has the dissimilarity of its correspondence; and one that would occlude a
//! match of the right image is penalized.

use crate::PixelState;
use crate::border_mask::PairMasks;
use crate::layout::Layout;
use crate::surfaces::{CELL, Plane, Surfaces, center};
use crate::winner::Winner;

// Set with the constants of `surfaces`; half and twice of each differ by 0.1 points of the errors above 2 px.
/// Costs of out-of-view and of occluded pixels. A visible one costs 0 to 1.
const OUT_OF_VIEW_COST: f32 = 0.45;
const OCCLUDED_COST: f32 = 0.4;
/// Cost of a pixel that would occlude a match of the right image, and the difference in px from which it is in front.
const OCCLUDING_COST: f32 = 2.0;
const OCCLUSION_STEP: f32 = 1.5;
/// Texture in gray levels at which the dissimilarity of a pixel has half its weight.
const HALF_TEXTURE: f32 = 3.0;
/// Fraction of differing census bits of a chance match.
const CHANCE_BITS: f32 = 0.5;
/// Weight of the distance of a plane from a matched pixel, per px up to 2, and from a rejected match.
const MATCH_WEIGHT: f32 = 0.5;
const REJECTED_WEIGHT: f32 = 0.1;

/// The image pair and its winners.
#[derive(Clone, Copy)]
pub(crate) struct Pair<'a> {
    pub(crate) width: usize,
    pub(crate) gray: &'a [u8],
    pub(crate) winners: &'a [Winner],
    pub(crate) min_disparity: i32,
    /// The census bits of both views in `planes` bytes per pixel, as in [`crate::cost::Frame`].
    pub(crate) described: [&'a [u8]; 2],
    pub(crate) planes: usize,
    pub(crate) bits: usize,
    pub(crate) layout: Layout,
    /// Pixels without data.
    pub(crate) masks: PairMasks<'a>,
}

/// Addresses of the census bits of the right image.
#[derive(Clone, Copy)]
pub(crate) struct RightColumns {
    /// Bytes of the census bits of a pixel.
    bytes: usize,
    /// Elements of a row and of a phase, and the binary logarithm of the number of phases: see [`Layout`].
    row: usize,
    phase: usize,
    phases: u32,
    /// The element of column 0.
    first: i64,
}

impl RightColumns {
    pub(crate) fn new(pair: &Pair<'_>) -> Self {
        Self {
            bytes: pair.bits.div_ceil(8),
            row: pair.layout.right_row(pair.width),
            phase: pair.layout.phase(pair.width),
            phases: pair.layout.vectors().ilog2(),
            first: pair.width as i64 - 1 - i64::from(pair.min_disparity),
        }
    }

    /// Returns the index of the first byte of a column within a row; `None` outside the search range.
    #[inline(always)]
    fn place(&self, column: usize, planes: usize) -> Option<usize> {
        let element = usize::try_from(self.first - column as i64).ok().filter(|&element| element < self.row)?;
        Some((element & ((1 << self.phases) - 1)) * planes * self.phase + (element >> self.phases))
    }

    /// Returns the census bits of a pixel, whose bytes are `stride` apart.
    #[inline(always)]
    fn bits(&self, bytes: &[u8], stride: usize) -> u64 {
        let at = |bits: u64, p: usize| bits << 8 | u64::from(bytes[p * stride]);
        // Unrolled for the default window.
        if self.bytes == 3 { (0..3).fold(0, at) } else { (0..self.bytes).fold(0, at) }
    }
}

/// The pair with the matches of its right image.
#[derive(Clone, Copy)]
pub(crate) struct View<'a> {
    pub(crate) pair: Pair<'a>,
    pub(crate) columns: RightColumns,
    /// Disparity of the nearest match of each pixel, −∞ without any, +∞ without data.
    pub(crate) right: &'a [f32],
}

/// The matches of the left image: disparities, NaN in holes, and states.
#[derive(Clone, Copy)]
pub(crate) struct Matches<'a> {
    pub(crate) disparity: &'a [f32],
    pub(crate) states: &'a [PixelState],
}

impl View<'_> {
    pub(crate) fn height(&self) -> usize {
        self.right.len() / self.pair.width
    }

    /// Returns a row of pixels.
    #[inline(always)]
    pub(crate) fn row(&self, y: usize) -> Row<'_> {
        let Pair { width, planes, described, .. } = self.pair;
        let stride = planes * self.columns.row;
        Row {
            columns: self.columns,
            planes,
            chance: CHANCE_BITS * self.pair.bits as f32,
            left: &described[0][y * planes * width..][..planes * width],
            right: &described[1][y * stride..][..stride],
            visible: &self.right[y * width..][..width],
        }
    }

    /// Returns the plane of a surface in a cell: the local one where it is out of view or occluded.
    #[inline(always)]
    pub(crate) fn plane<'a>(&self, surfaces: &'a Surfaces, label: u32, c: usize) -> &'a Plane {
        let width = self.pair.width;
        let local = &surfaces.local_planes[label as usize];
        let (x, y) = center(c, surfaces.columns);
        let d = local.at(x, y);
        let (x, y) = ((x as usize).min(width - 1), (y as usize).min(self.height() - 1));
        match unmatched_state(x, d, &self.right[y * width..][..width]) {
            PixelState::OutOfView | PixelState::Occluded => local,
            _ => &surfaces.planes[label as usize],
        }
    }

    /// Returns the data terms of planes in a cell, from `N` pixels, `STEP` apart, of every `STEP`-th row.
    #[inline(always)]
    pub(crate) fn cell_costs<const PLANES: usize, const N: usize, const STEP: usize>(
        &self,
        matches: Matches<'_>,
        surfaces: &Surfaces,
        c: usize,
        planes: &[Option<&Plane>; PLANES],
    ) -> [f32; PLANES] {
        let width = self.pair.width;
        let texture = texture_weight(surfaces, c);
        // Of a sample: the number of pixels it represents.
        let weight = (STEP * STEP) as f32;
        let mut costs = [0.0; PLANES];
        let (left, top) = (c % surfaces.columns * CELL + STEP / 2, c / surfaces.columns * CELL);
        for y in (top + STEP / 2..(top + CELL).min(self.height())).step_by(STEP) {
            let row = self.row(y);
            let (mut values, mut count) = ([[0f32; N]; PLANES], 0);
            for plane in planes.iter().map_while(|plane| *plane) {
                values[count] = plane.row::<N, STEP>(left, y);
                count += 1;
            }
            let (costs, values) = (&mut costs[..count], &values[..count]);
            for (i, x) in (left..width).step_by(STEP).take(N).enumerate() {
                let at = y * width + x;
                let d = matches.disparity[at];
                if !d.is_nan() {
                    for (cost, values) in costs.iter_mut().zip(values) {
                        *cost += weight * MATCH_WEIGHT * (d - values[i]).abs().min(2.0);
                    }
                    continue;
                }
                let bits = row.bits(x);
                let has_match = !matches!(matches.states[at], PixelState::OutOfView | PixelState::NoData);
                let rejected = (self.pair.min_disparity + i32::from(self.pair.winners[at].index)) as f32;
                for (cost, values) in costs.iter_mut().zip(values) {
                    *cost += 0.25 * weight * OCCLUDING_COST * row.cost(x, values[i], texture, bits);
                    if has_match {
                        *cost += weight * REJECTED_WEIGHT * (rejected - values[i]).abs().min(2.0);
                    }
                }
            }
        }
        costs
    }
}

/// A row of the pair, for the data terms of its pixels.
#[derive(Clone, Copy)]
pub(crate) struct Row<'a> {
    columns: RightColumns,
    planes: usize,
    /// Number of differing census bits of a chance match.
    chance: f32,
    /// Census bits of both views.
    left: &'a [u8],
    right: &'a [u8],
    /// The nearest match of each pixel of the right image: see [`View::right`].
    visible: &'a [f32],
}

impl Row<'_> {
    /// Returns the census bits of a pixel of the left image.
    #[inline(always)]
    pub(crate) fn bits(&self, x: usize) -> u64 {
        self.columns.bits(&self.left[x..], self.visible.len())
    }

    /// Returns the data term of a pixel with these census bits at a disparity; `texture` is the weight of the dissimilarity, 0 to 1.
    ///
    /// Branch-free in view: whether a pixel is visible, occluded or occluding could not be predicted.
    #[inline(always)]
    pub(crate) fn cost(&self, x: usize, d: f32, texture: f32, bits: u64) -> f32 {
        let column = x as f32 - d + 0.5;
        if !(column >= 0.0 && column < self.visible.len() as f32) {
            return OUT_OF_VIEW_COST;
        }
        let column = column as usize;
        let visible = self.visible[column];
        let place = self.columns.place(column, self.planes);
        let there = self.columns.bits(&self.right[place.unwrap_or(0)..], self.columns.phase);
        let chance = (bits ^ there).count_ones() as f32 / self.chance;
        let cost = 0.5 + texture * (if chance < 1.0 { chance } else { 1.0 } - 0.5);
        let cost = if place.is_some() { cost } else { OUT_OF_VIEW_COST };
        let behind = if visible == f32::INFINITY { OUT_OF_VIEW_COST } else { OCCLUDED_COST };
        let cost = if d < visible - 1.0 { behind } else { cost };
        // −∞: no match there.
        let is_occluding = visible.is_finite() & (d > visible + OCCLUSION_STEP);
        if is_occluding { OCCLUDING_COST } else { cost }
    }
}

/// Returns the weight of the dissimilarity in a cell, 0 to 1.
pub(crate) fn texture_weight(surfaces: &Surfaces, c: usize) -> f32 {
    let steps = surfaces.cells[c].texture;
    steps / (steps + HALF_TEXTURE)
}

/// Returns the state of an unmatched pixel by its disparity and the matches of the right image in its row.
pub(crate) fn unmatched_state(x: usize, d: f32, right: &[f32]) -> PixelState {
    let column = x as f32 - d + 0.5;
    if !(column >= 0.0 && column < right.len() as f32) || right[column as usize] == f32::INFINITY {
        PixelState::OutOfView
    } else if right[column as usize] > d + 1.0 {
        PixelState::Occluded
    } else {
        PixelState::Mismatched
    }
}
