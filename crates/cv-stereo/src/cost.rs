//! Matching costs from census bits, and the smoothness penalties of the aggregation paths.

use crate::StereoOptions;
use crate::border_mask::{PairMasks, RowMasks};
use crate::coarse_prior::{PRIOR_CENTER, PRIOR_COSTS, PRIOR_DISTANCES, PRIOR_MARGIN, Prior};
use crate::kernel::TILE;
use crate::layout::{BLOCK, Layout, place};
use crate::winner::outside_cost;
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;
use std::ops::Range;

/// Input of both sweeps.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Frame<'a> {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) min_disparity: i64,
    /// Number of disparities, without padding.
    pub(crate) disparities: usize,
    pub(crate) layout: Layout,
    /// Bytes that describe a pixel: its census bits, then, with a cap, the value of the intensity cost.
    pub(crate) planes: usize,
    /// The bytes of the left image, each row plane by plane.
    pub(crate) left: &'a [u8],
    /// The bytes of the right image, each row mirrored so that disparities ascend: element `j` of a row is column
    /// `width − 1 − min_disparity − j`, and the correspondence of column `x` at index `k` is element `width − 1 − x + k`. A row
    /// has the elements of phase 0 plane by plane, then those of phase 1 and so on.
    pub(crate) right: &'a [u8],
    /// The costs, pixel by pixel in `layout`, if they are given rather than computed.
    pub(crate) given: Option<&'a [u8]>,
    /// Priors, of all pixels or none.
    pub(crate) priors: &'a [Prior],
    /// Pixels without data.
    pub(crate) masks: PairMasks<'a>,
    /// Maximum of the intensity cost.
    pub(crate) intensity_cap: Option<u8>,
    /// Gray levels of the left image, 0 to 255.
    pub(crate) gray: &'a [u8],
    /// Gray levels of the row above, where the frame continues another one; its paths downwards then go on.
    pub(crate) above: Option<&'a [u8]>,
    pub(crate) p1: u8,
    pub(crate) p2: &'a Penalties,
    /// Whether [`crate::winner::Winner::second`] is computed.
    pub(crate) second: bool,
}

impl Frame<'_> {
    /// Returns the indices whose correspondence is inside the right image: its column decreases with the index, so that the first ones may
    /// be right of the image and the last ones left of it.
    #[inline(always)]
    pub(crate) fn inside(&self, x: usize) -> Range<usize> {
        self.inside_columns(x, &(0..self.width))
    }

    /// Returns the indices whose correspondence is in these columns of the right image.
    #[inline(always)]
    pub(crate) fn inside_columns(&self, x: usize, columns: &Range<usize>) -> Range<usize> {
        let column = x as i64 - self.min_disparity;
        let n = self.disparities as i64;
        let start = (column - (columns.end as i64 - 1)).clamp(0, n) as usize;
        start..((column + 1 - columns.start as i64).clamp(0, n) as usize).max(start)
    }

    /// Returns the columns, of these of the left image, whose correspondences at all indices are in those of the right image.
    fn complete(&self, left: &Range<usize>, right: &Range<usize>) -> Range<usize> {
        let last = self.min_disparity + self.disparities as i64 - 1;
        let start = (right.start as i64 + last).max(left.start as i64);
        let end = (right.end as i64 + self.min_disparity).min(left.end as i64);
        if start < end { start as usize..end as usize } else { left.end..left.end }
    }

    /// Returns whether the correspondence at index `k` is inside the right image and has data.
    pub(crate) fn has_match(&self, masks: &RowMasks<'_>, x: usize, k: usize) -> bool {
        let column = x as i64 - self.min_disparity - k as i64;
        self.inside(x).contains(&k) && !masks.hides_right(column as usize)
    }

    /// Returns the cost, at every disparity, of a pixel of the left image without data. The largest that does not overflow path costs, so
    /// that the pixel is the match of no pixel of the right image.
    pub(crate) fn masked_cost(&self) -> u8 {
        u8::MAX - 1 - self.p2.largest - self.p1
    }

    /// Computes the costs of the pixels `xs` of row `y` at every disparity; 255 in the padding, so that those lanes never win and never
    /// extend to their neighbors, since additions saturate. Groups have `BLOCKS` blocks.
    #[inline(always)]
    pub(crate) fn costs<S: Simd, const BLOCKS: usize>(&self, simd: S, y: usize, xs: Range<usize>, out: &mut [u8]) {
        match self.planes - usize::from(self.intensity_cap.is_some()) {
            3 => costs::<S, 3, BLOCKS>(simd, self, y, xs, out),
            6 => costs::<S, 6, BLOCKS>(simd, self, y, xs, out),
            _ => costs::<S, 8, BLOCKS>(simd, self, y, xs, out),
        }
    }
}

#[simd]
fn costs<S: Simd, const BITS: usize, const BLOCKS: usize>(
    simd: S,
    frame: &Frame<'_>,
    y: usize,
    xs: Range<usize>,
    out: &mut [u8],
) {
    let group = BLOCKS * BLOCK;
    let groups = frame.layout.groups();
    let (width, count) = (frame.width, xs.len());
    let out = &mut out[..count * groups * group];
    for (tile, out) in out.chunks_mut(TILE * groups * group).enumerate() {
        let start = xs.start + tile * TILE;
        match_tile::<S, BITS, BLOCKS>(simd, frame, y, start..(start + TILE).min(xs.end), out);
    }
    if let Some(priors) = frame.priors.get(y * width..(y + 1) * width) {
        for (prior, out) in priors[xs.clone()].iter().zip(out.chunks_exact_mut(groups * group)) {
            if prior.cap() > 0 {
                add_prior::<S, BLOCKS>(simd, *prior, out);
            }
        }
    }
    // Columns of both rows that have data.
    let mut columns = [0..width, 0..width];
    if let Some(masks) = frame.masks.row(y) {
        match masks.interior(width) {
            Some(interior) => columns = interior,
            None => {
                for (x, out) in xs.clone().zip(out.chunks_exact_mut(groups * group)) {
                    // The padding, and correspondences outside the right image.
                    set_border_costs::<S, BLOCKS>(simd, frame, frame.inside(x), masks.hides_left(x), out);
                    set_masked_costs(frame, &masks, x, out);
                }
                return;
            }
        }
    }
    let [left_columns, right_columns] = columns;
    // Only pixels near the ends of a row have correspondences outside the right image.
    let complete = frame.complete(&left_columns, &right_columns);
    let start = complete.start.clamp(xs.start, xs.end);
    let end = complete.end.clamp(start, xs.end);
    let out = &mut out[..count * groups * group];
    let (out_left, rest) = out.split_at_mut((start - xs.start) * groups * group);
    let (middle, out_right) = rest.split_at_mut((end - start) * groups * group);
    for (xs, out) in [(xs.start..start, out_left), (end..xs.end, out_right)] {
        for (x, out) in xs.zip(out.chunks_exact_mut(groups * group)) {
            let has_data = left_columns.contains(&x);
            let inside = if has_data { frame.inside_columns(x, &right_columns) } else { 0..0 };
            set_border_costs::<S, BLOCKS>(simd, frame, inside, !has_data, out);
        }
    }
    if frame.disparities < groups * group {
        // Not `for_each`, which is not compiled for the instruction set: its SIMD operations would be function calls.
        for out in middle.chunks_exact_mut(groups * group) {
            pad::<S, BLOCKS>(simd, frame.disparities, out);
        }
    }
}

/// Computes the costs of at most [`TILE`] pixels at every disparity, as if all correspondences were inside the right image.
#[inline(always)]
fn match_tile<S: Simd, const BITS: usize, const BLOCKS: usize>(
    simd: S,
    frame: &Frame<'_>,
    y: usize,
    xs: Range<usize>,
    out: &mut [u8],
) {
    let lanes = S::u8s::LEN;
    let group = BLOCKS * BLOCK;
    let n = group / lanes;
    let groups = frame.layout.groups();
    let (width, planes) = (frame.width, frame.planes);
    let (count, phase) = (xs.len(), frame.layout.phase(width));
    let left = &frame.left[y * width * planes..][..width * planes];
    let row = &frame.right[y * planes * n * phase..][..planes * n * phase];
    let here = |p: usize| &left[p * width + xs.start..][..count];
    // Four times in a word: broadcasting words is a load, broadcasting bytes also a permutation.
    let mut described = [[0u32; TILE]; BITS];
    for (p, words) in described.iter_mut().enumerate() {
        for (word, &byte) in words.iter_mut().zip(here(p)) {
            *word = u32::from(byte) * 0x0101_0101;
        }
    }
    // Pixels `n` apart have their candidates in the same phases, one element further: one vector of all of them at a time, so that the loop
    // reads few slices.
    for class in 0..n.min(count) {
        let steps = (count - class).div_ceil(n);
        for v in 0..n {
            let start = width - xs.end + class + v;
            let (of, first) = (start % n, start / n);
            for g in 0..groups {
                let to = (g * n + v) * lanes;
                let candidates = |p: usize| &row[(of * planes + p) * phase + first + g * lanes..][..steps - 1 + lanes];
                let bits: [&[u8]; BITS] = std::array::from_fn(candidates);
                let intensity = frame.intensity_cap.map(|cap| (S::u8s::splat(simd, cap), candidates(BITS), here(BITS)));
                for step in 0..steps {
                    let pixel = count - 1 - class - step * n;
                    let mut cost = S::u8s::splat(simd, 0);
                    for p in 0..BITS {
                        let candidate = S::u8s::from_slice(simd, &bits[p][step..][..lanes]);
                        let here = S::u32s::splat(simd, described[p][pixel]).bitcast::<S::u8s>();
                        cost += (candidate ^ here).count_ones();
                    }
                    if let Some((cap, candidates, here)) = intensity {
                        let candidate = S::u8s::from_slice(simd, &candidates[step..][..lanes]);
                        let value = S::u8s::splat(simd, here[pixel]);
                        cost += (value.max(candidate) - value.min(candidate)).min(cap);
                    }
                    cost.store_slice(&mut out[pixel * groups * group + to..][..lanes]);
                }
            }
        }
    }
}

/// Sets the costs of the padding.
#[inline(always)]
fn pad<S: Simd, const BLOCKS: usize>(simd: S, disparities: usize, out: &mut [u8]) {
    let lanes = S::u8s::LEN;
    let group = BLOCKS * BLOCK;
    let n = group / lanes;
    let first = S::u8s::from_fn(simd, |lane| (lane * n) as u8);
    let worst = S::u8s::splat(simd, u8::MAX);
    let last = disparities / group;
    // Fewer than 128.
    let end = S::u8s::splat(simd, (disparities % group) as u8);
    for (v, out) in out[last * group..][..group].chunks_exact_mut(lanes).enumerate() {
        let cost = S::u8s::from_slice(simd, out);
        (first + v as u8).simd_lt(end).select(cost, worst).store_slice(out);
    }
}

/// Sets the costs of correspondences without data, or outside the right image, of a pixel with data in a row that has pixels without data
/// between others.
fn set_masked_costs(frame: &Frame<'_>, masks: &RowMasks<'_>, x: usize, out: &mut [u8]) {
    if masks.hides_left(x) {
        return;
    }
    let Layout { group, lanes, .. } = frame.layout;
    let has_data = |k: &usize| frame.has_match(masks, x, *k);
    let (mut sum, mut count) = (0, 0);
    for k in (0..frame.disparities).filter(has_data) {
        sum += u32::from(out[place(k, group, lanes)]);
        count += 1;
    }
    let outside = outside_cost(sum, count);
    for k in (0..frame.disparities).filter(|k| !has_data(k)) {
        out[place(k, group, lanes)] = outside;
    }
}

/// Adds the cost of the distance from the prior of a pixel.
#[inline(always)]
fn add_prior<S: Simd, const BLOCKS: usize>(simd: S, prior: Prior, out: &mut [u8]) {
    let lanes = S::u8s::LEN;
    let group = BLOCKS * BLOCK;
    let n = group / lanes;
    let costs = &PRIOR_COSTS[n.ilog2() as usize][usize::from(prior.cap())];
    for (g, out) in out.chunks_exact_mut(group).enumerate() {
        let local = i32::from(prior.index()) - (g * group) as i32;
        let first = (PRIOR_CENTER - local.clamp(-PRIOR_MARGIN, group as i32 + PRIOR_MARGIN)) as usize;
        for (v, out) in out.chunks_exact_mut(lanes).enumerate() {
            let at = first + v;
            let costs = &costs[at % n * (PRIOR_DISTANCES / n) + at / n..][..lanes];
            (S::u8s::from_slice(simd, out) + S::u8s::from_slice(simd, costs)).store_slice(out);
        }
    }
}

/// Sets the costs of correspondences outside the right image, and of the padding; all of a pixel without data.
#[inline(always)]
fn set_border_costs<S: Simd, const BLOCKS: usize>(
    simd: S,
    frame: &Frame<'_>,
    inside: Range<usize>,
    is_masked: bool,
    out: &mut [u8],
) {
    let lanes = S::u8s::LEN;
    let group = BLOCKS * BLOCK;
    let n = group / lanes;
    let first = S::u8s::from_fn(simd, |lane| (lane * n) as u8);
    let zero = S::u8s::splat(simd, 0);
    // At most 128: they and the indices of a group fit a byte.
    let local = |k: usize, g: usize| S::u8s::splat(simd, k.saturating_sub(g * group).min(group) as u8);
    let mut sum = 0;
    for (g, out) in out.chunks_exact(group).enumerate() {
        let (low, high) = (local(inside.start, g), local(inside.end, g));
        // At most eight times 508.
        let mut part = S::u16s::splat(simd, 0);
        for v in 0..n {
            let k = first + v as u8;
            let cost = S::u8s::from_slice(simd, &out[v * lanes..][..lanes]);
            part += (k.simd_ge(low) & k.simd_lt(high)).select(cost, zero).pairwise_widening_add();
        }
        // At most 128 times 254.
        sum += u32::from(part.reduce_sum());
    }
    let inside = if is_masked { 0..0 } else { inside };
    let outside = if is_masked { frame.masked_cost() } else { outside_cost(sum, inside.len()) };
    let outside = S::u8s::splat(simd, outside);
    let worst = S::u8s::splat(simd, u8::MAX);
    for (g, out) in out.chunks_exact_mut(group).enumerate() {
        let (low, high) = (local(inside.start, g), local(inside.end, g));
        let end = local(frame.disparities, g);
        for v in 0..n {
            let k = first + v as u8;
            let out = &mut out[v * lanes..][..lanes];
            let cost = (k.simd_ge(low) & k.simd_lt(high)).select(S::u8s::from_slice(simd, out), outside);
            k.simd_lt(end).select(cost, worst).store_slice(out);
        }
    }
}

/// P2 − P1 by the absolute difference of neighboring gray levels.
#[derive(Debug, Clone)]
pub(crate) struct Penalties {
    table: [u8; 256],
    /// The differences at which it decreases by one; repeated for larger decreases.
    steps: Vec<u8>,
    /// The largest of the table.
    largest: u8,
}

impl Penalties {
    pub(crate) fn new(options: &StereoOptions) -> Self {
        let table = crate::winner::p2_table(options).map(|p2| p2 - options.p1);
        let falls = |step: &u8| usize::from(table[usize::from(*step) - 1] - table[usize::from(*step)]);
        let steps = (1..=255u8).flat_map(|step| std::iter::repeat_n(step, falls(&step))).collect();
        Self { table, steps, largest: table[0] }
    }

    /// Computes P2 − P1 between the pixels of two rows.
    pub(crate) fn between<S: Simd>(&self, simd: S, a: &[u8], b: &[u8], out: &mut [u8]) {
        between(simd, self, a, b, out);
    }
}

#[simd]
fn between<S: Simd>(simd: S, penalties: &Penalties, a: &[u8], b: &[u8], out: &mut [u8]) {
    let lanes = S::u8s::LEN;
    let whole = out.len() - out.len() % lanes;
    let one = S::u8s::splat(simd, 1);
    // Two vectors of the table are looked up; beyond them few steps remain.
    let near: [S::u8s; 2] = std::array::from_fn(|i| S::u8s::from_slice(simd, &penalties.table[i * lanes..][..lanes]));
    let reach = (2 * lanes - 1) as u8;
    let far = &penalties.steps[penalties.steps.partition_point(|&step| step <= reach)..];
    for at in (0..whole).step_by(lanes) {
        let (a, b) = (S::u8s::from_slice(simd, &a[at..][..lanes]), S::u8s::from_slice(simd, &b[at..][..lanes]));
        let difference = a.max(b) - a.min(b);
        let mut p2 = near[0].concat_swizzle_dyn(near[1], difference.min(S::u8s::splat(simd, reach)));
        for &step in far {
            p2 = difference.simd_ge(S::u8s::splat(simd, step)).select(p2 - one, p2);
        }
        p2.store_slice(&mut out[at..][..lanes]);
    }
    for ((out, &a), &b) in out[whole..].iter_mut().zip(&a[whole..]).zip(&b[whole..]) {
        *out = penalties.table[usize::from(a.abs_diff(b))];
    }
}
