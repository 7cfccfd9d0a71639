//! The inner loops of semi-global matching. Vectors run along the disparities; all arithmetic is in integers, so that every instruction
//! set gives the same bytes.
//!
//! A sweep visits the rows in one direction and the pixels of a row in one direction. At each pixel it extends the paths from pixels
//! already visited (the previous pixel, and three of the previous row) by
//!
//! `L(d) = C(d) + min(L'(d), L'(d−1) + P1, L'(d+1) + P1, min L' + P2) − min L'`
//!
//! and sums them. Two sweeps from opposite corners cover all directions.

use crate::aligned_buffer::AlignedBuffer;
use crate::cost::Frame;
use crate::layout::BLOCK;
use crate::select::{Ends, Keys, Selection, ids, select};
use crate::winner::{NO_SUM, Winner};
use cv_core::{Cancelled, Stage};
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;
use std::ops::Range;

/// Pixels whose costs are computed at a time: 4 KiB at 128 disparities, which stay in the first-level cache.
pub(crate) const TILE: usize = 32;

/// State of one sweep.
#[derive(Debug, Default)]
pub(crate) struct Sweep {
    /// True for the sweep from the bottom right.
    mirrored: bool,
    /// Path costs of the previous row, pixel by pixel: from ahead, straight, from behind, in the direction of the sweep, or straight only.
    /// Zeros after the last pixel, for its path from ahead.
    row: AlignedBuffer<u8>,
    /// Their minima: straight, from behind and from ahead, in image order.
    least: [Vec<u8>; 3],
    /// The minima of the path costs that the pixels of this row extend.
    before: [Vec<u8>; 3],
    ongoing: Ongoing,
    /// Costs of a tile of pixels.
    costs: AlignedBuffer<u8>,
    /// Costs of this row and of the next one, where a thread of its own computes those of the next.
    row_costs: [AlignedBuffer<u8>; 2],
    /// Sums of these pixels.
    sums: AlignedBuffer<u8>,
    /// P2 − P1 of each pixel of the row for the path along it; with the minima added, straight, from behind and from ahead.
    p2: [Vec<u8>; 4],
    selection: Selection,
}

/// Paths that continue within a row.
#[derive(Debug, Default)]
struct Ongoing {
    /// Path costs of the previous pixel.
    along: AlignedBuffer<u8>,
    along_least: u8,
    /// Path costs of the previous row at the previous pixel, which have been overwritten.
    behind: AlignedBuffer<u8>,
}

/// Use of the sums of a sweep.
pub(crate) enum Output<'a> {
    /// Stored for the other sweep.
    Store(&'a mut [u8]),
    /// Added to those of the other sweep, and winners selected.
    Finish { other: &'a [u8], winners: &'a mut [Winner], right: &'a mut [u16] },
}

impl Sweep {
    /// Returns the bytes that [`Sweep::start`] allocates.
    pub(crate) fn bytes(width: usize, depth: usize) -> usize {
        let row_costs = if has_cost_threads() { 2 * width * depth } else { 0 };
        3 * width * depth + row_costs + (2 * TILE + 3) * depth + 10 * width + Selection::bytes(width, depth)
    }

    /// Resets the state for a frame.
    pub(crate) fn start(&mut self, frame: &Frame<'_>, mirrored: bool) {
        let depth = frame.layout.depth;
        self.mirrored = mirrored;
        self.row.resize((3 * frame.width + 1) * depth, 0);
        self.row.as_mut_slice().fill(0);
        for least in self.least.iter_mut().chain(&mut self.before) {
            least.clear();
            least.resize(frame.width, 0);
        }
        self.ongoing.along.resize(depth, 0);
        self.ongoing.behind.resize(depth, 0);
        self.costs.resize(TILE * depth, 0);
        self.sums.resize(TILE * depth, 0);
        if has_cost_threads() {
            self.row_costs.iter_mut().for_each(|costs| costs.resize(frame.width * depth, 0));
        }
        for p2 in &mut self.p2 {
            p2.resize(frame.width, 0);
        }
        self.selection.resize(frame);
    }
}

/// Returns whether there are more threads than sweeps: then others compute the costs of the next rows.
fn has_cost_threads() -> bool {
    rayon::current_num_threads() > 2
}

/// Runs `sweep` over `steps` rows from row `first` (both in its own order). `output` has the same rows, in image order.
#[simd]
#[allow(clippy::too_many_arguments)]
pub(crate) fn sweep_rows<S: Simd>(
    simd: S,
    frame: &Frame<'_>,
    sweep: &mut Sweep,
    first: usize,
    steps: usize,
    output: &mut Output<'_>,
    eight: bool,
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    // Constant numbers of disparities: loops unroll, and indices need no bounds checks.
    let single = frame.layout.groups() == 1;
    match (eight, frame.layout.group == BLOCK, single) {
        (false, true, true) => rows::<S, 2, 1, true>(simd, frame, sweep, first, steps, output, stage),
        (false, false, true) => rows::<S, 2, 2, true>(simd, frame, sweep, first, steps, output, stage),
        (false, true, false) => rows::<S, 2, 1, false>(simd, frame, sweep, first, steps, output, stage),
        (false, false, false) => rows::<S, 2, 2, false>(simd, frame, sweep, first, steps, output, stage),
        (true, true, true) => rows::<S, 4, 1, true>(simd, frame, sweep, first, steps, output, stage),
        (true, false, true) => rows::<S, 4, 2, true>(simd, frame, sweep, first, steps, output, stage),
        (true, true, false) => rows::<S, 4, 1, false>(simd, frame, sweep, first, steps, output, stage),
        (true, false, false) => rows::<S, 4, 2, false>(simd, frame, sweep, first, steps, output, stage),
    }
}

#[inline(always)]
fn rows<S: Simd, const PATHS: usize, const BLOCKS: usize, const SINGLE: bool>(
    simd: S,
    frame: &Frame<'_>,
    sweep: &mut Sweep,
    first: usize,
    steps: usize,
    output: &mut Output<'_>,
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    let (width, height) = (frame.width, frame.height);
    let depth = if SINGLE { BLOCKS * BLOCK } else { frame.layout.depth };
    let Sweep { mirrored, row, least, before, ongoing, costs, row_costs, sums, p2, selection } = sweep;
    let mirrored = *mirrored;
    let row = row.as_mut_slice();
    let costs = &mut costs.as_mut_slice()[..TILE * depth];
    let sums = &mut sums.as_mut_slice()[..TILE * depth];
    let row_of = |t: usize| if mirrored { height - 1 - t } else { t };
    let is_ahead = frame.given.is_none() && has_cost_threads();
    let [row_costs, next_costs] = row_costs;
    let (mut row_costs, mut next_costs) = (row_costs.as_mut_slice(), next_costs.as_mut_slice());
    if is_ahead && steps > 0 {
        frame.costs::<S, BLOCKS>(simd, row_of(first), 0..width, row_costs);
    }
    for step in 0..steps {
        stage.add(1)?;
        let y = row_of(first + step);
        // Row of `output`.
        let line = if mirrored { steps - 1 - step } else { step };
        let mut extend_row = |given: Option<&[u8]>| {
            penalties::<S, PATHS>(simd, frame, y, mirrored, p2);
            jumps::<S, PATHS>(simd, mirrored, least, before, p2);
            // Paths that start at the border have no previous costs.
            ongoing.along.as_mut_slice().fill(0);
            ongoing.behind.as_mut_slice().fill(0);
            ongoing.along_least = 0;
            selection.start();
            for begin in (0..width).step_by(TILE) {
                let end = (begin + TILE).min(width);
                let columns = if mirrored { width - end..width - begin } else { begin..end };
                let pixels = line * width + columns.start..line * width + columns.end;
                let span = pixels.start * depth..pixels.end * depth;
                let jumps = columns_of(p2, &columns);
                let before = columns_of(before, &columns);
                let costs = match given {
                    Some(given) => &given[columns.start * depth..columns.end * depth],
                    None => {
                        frame.costs::<S, BLOCKS>(simd, y, columns.clone(), costs);
                        &costs[..span.len()]
                    }
                };
                let tile = Tile { costs, p1: frame.p1, jumps, before, mirrored };
                let row = &mut row[begin * (PATHS - 1) * depth..];
                let [straight, behind, ahead] = &mut *least;
                let least = [&mut straight[columns.clone()], &mut behind[columns.clone()], &mut ahead[columns.clone()]];
                match output {
                    Output::Store(out) => {
                        let ends = Ends { other: &[], running: &mut [], decided: &mut [], best: &mut [], stride: 0 };
                        extend::<S, PATHS, BLOCKS, SINGLE, false>(
                            simd,
                            &tile,
                            ongoing,
                            row,
                            least,
                            &mut out[span],
                            ends,
                        );
                    }
                    Output::Finish { other, winners, .. } => {
                        let own = &mut sums[..span.len()];
                        let mut best = [(NO_SUM, 0); TILE];
                        let other = &other[span];
                        let ends = selection.ends(frame, mirrored, &columns, other, &mut best);
                        extend::<S, PATHS, BLOCKS, SINGLE, true>(simd, &tile, ongoing, row, least, own, ends);
                        select::<S, BLOCKS, SINGLE>(simd, frame, &best, [own, other], &mut winners[pixels]);
                    }
                }
            }
            if let Output::Finish { right, .. } = output {
                let last = if mirrored { 0 } else { width - 1 };
                selection.finish(frame, last, &mut right[line * width..][..width]);
            }
        };
        if is_ahead {
            let next = (step + 1 < steps).then(|| row_of(first + step + 1));
            // Trait objects, so that rayon's part is compiled once.
            let this_row: &mut (dyn FnMut() + Send) = &mut || extend_row(Some(&*row_costs));
            let costs_of_next: &mut (dyn FnMut() + Send) = &mut || {
                if let Some(next) = next {
                    frame.costs::<S, BLOCKS>(simd, next, 0..width, next_costs);
                }
            };
            rayon::join(this_row, costs_of_next);
            (row_costs, next_costs) = (next_costs, row_costs);
        } else {
            extend_row(frame.given.map(|given| &given[y * width * depth..][..width * depth]));
        }
    }
    Ok(())
}

/// Returns some columns of each row. (`map` with a closure would be compiled again for each kind of sweep.)
fn columns_of<'a, const N: usize>(rows: &'a [Vec<u8>; N], columns: &Range<usize>) -> [&'a [u8]; N] {
    std::array::from_fn(|i| &rows[i][columns.clone()])
}

/// Computes P2 − P1 of the pixels of row `y` for each path. At a border, where paths start, any value will do.
#[inline(always)]
pub(crate) fn penalties<S: Simd, const PATHS: usize>(
    simd: S,
    frame: &Frame<'_>,
    y: usize,
    mirrored: bool,
    [along, straight, behind, ahead]: &mut [Vec<u8>; 4],
) {
    let (width, height) = (frame.width, frame.height);
    let last = width - 1;
    let row = |y: usize| &frame.gray[y * width..][..width];
    let here = row(y);
    let before = match frame.above {
        Some(above) if y == 0 && !mirrored => above,
        _ => row(if mirrored { (y + 1).min(height - 1) } else { y.saturating_sub(1) }),
    };
    let between = |a: &[u8], b: &[u8], out: &mut [u8]| frame.p2.between(simd, a, b, out);
    // From the left and from the right, in image order.
    let left = |b: &[u8], out: &mut [u8]| between(&here[1..], &b[..last], &mut out[1..]);
    let right = |b: &[u8], out: &mut [u8]| between(&here[..last], &b[1..], &mut out[..last]);
    if mirrored {
        right(here, along);
        if PATHS == 4 {
            right(before, behind);
            left(before, ahead);
        }
    } else {
        left(here, along);
        if PATHS == 4 {
            left(before, behind);
            right(before, ahead);
        }
    }
    between(here, before, straight);
}

/// Computes the minima that the paths of each pixel extend, and adds them to P2 − P1, a row at a time: `extend` then only loads them.
#[simd]
fn jumps<S: Simd, const PATHS: usize>(
    _: S,
    mirrored: bool,
    [straight_least, behind_least, ahead_least]: &[Vec<u8>; 3],
    [straight, behind, ahead]: &mut [Vec<u8>; 3],
    [_, straight_jump, behind_jump, ahead_jump]: &mut [Vec<u8>; 4],
) {
    let last = straight.len() - 1;
    let add = |jumps: &mut [u8], before: &[u8]| {
        for (jump, before) in jumps.iter_mut().zip(before) {
            *jump = jump.wrapping_add(*before);
        }
    };
    straight.copy_from_slice(straight_least);
    add(straight_jump, straight);
    if PATHS == 4 {
        // Paths that start at the border have no previous costs: their elements of `before` stay 0.
        let (from_left, left, from_right, right) = if mirrored {
            (ahead_least, &mut *ahead, behind_least, &mut *behind)
        } else {
            (behind_least, &mut *behind, ahead_least, &mut *ahead)
        };
        left[1..].copy_from_slice(&from_left[..last]);
        right[..last].copy_from_slice(&from_right[1..]);
        add(behind_jump, behind);
        add(ahead_jump, ahead);
    }
}

/// Some pixels of a row, in image order.
struct Tile<'a> {
    costs: &'a [u8],
    p1: u8,
    /// P2 − P1 for the path along the row; with the minima added, straight, from behind and from ahead.
    jumps: [&'a [u8]; 4],
    /// The previous minima straight, from behind and from ahead.
    before: [&'a [u8]; 3],
    mirrored: bool,
}

/// Extends every path pixel by pixel and stores the sums of the extended ones, in image order. With `KEYS` also adds the sums of the other
/// sweep and selects winners.
#[simd]
fn extend<S: Simd, const PATHS: usize, const BLOCKS: usize, const SINGLE: bool, const KEYS: bool>(
    simd: S,
    tile: &Tile<'_>,
    ongoing: &mut Ongoing,
    row: &mut [u8],
    [straight_least, behind_least, ahead_least]: [&mut [u8]; 3],
    sums: &mut [u8],
    ends: Ends<'_>,
) {
    let lanes = S::u8s::LEN;
    let group = BLOCKS * BLOCK;
    let n = group / lanes;
    let along = ongoing.along.as_mut_slice();
    let behind = ongoing.behind.as_mut_slice();
    let depth = if SINGLE { group } else { along.len() };
    // A pixel of the previous row.
    let stride = (PATHS - 1) * depth;
    let count = tile.jumps[0].len();
    let [along_jumps, straight_jumps, behind_jumps, ahead_jumps] = tile.jumps;
    let jumps = [&along_jumps[..count], &straight_jumps[..count], &behind_jumps[..count], &ahead_jumps[..count]];
    let [straight_before, behind_before, ahead_before] = tile.before;
    let before = [&straight_before[..count], &behind_before[..count], &ahead_before[..count]];
    let splat = |value: u8| S::u8s::splat(simd, value);
    let p1 = splat(tile.p1);
    let Ends { other, running, decided, best, stride: decided_stride } = ends;
    let ids = ids(simd, n);
    let mut along_least = S::u8s::splat(simd, ongoing.along_least);
    // In registers where they fit.
    let (mut held_along, mut held_behind, mut held_keys) = ([0; 2 * BLOCK], [0; 2 * BLOCK], [0; 2 * BLOCK]);
    if SINGLE {
        held_along[..group].copy_from_slice(along);
        held_behind[..group].copy_from_slice(behind);
        if KEYS {
            held_keys[..group].copy_from_slice(running);
        }
    }
    for k in 0..count {
        let at = if tile.mirrored { count - 1 - k } else { k };
        let cost = &tile.costs[at * depth..][..depth];
        let sums = &mut sums[at * depth..][..depth];
        let (here, next) = row[k * stride..][..stride + depth].split_at_mut(stride);
        let along = if SINGLE { &mut held_along[..group] } else { &mut *along };
        let behind = if SINGLE { &mut held_behind[..group] } else { &mut *behind };
        // The path from the previous pixel comes first: the next pixel depends on it.
        let mut step = Step::new(simd, along_least, along_least + splat(jumps[0][at]));
        for start in (0..depth).step_by(group) {
            for v in 0..n {
                let extended = step.extend(simd, p1, cost, along, (start, v, group));
                extended.store_slice(&mut along[start + v * lanes..][..lanes]);
            }
        }
        along_least = S::u8s::splat(simd, step.smallest.reduce_min());
        let mut straight_step = Step::new(simd, splat(before[0][at]), splat(jumps[1][at]));
        let mut behind_step = Step::new(simd, splat(before[1][at]), splat(jumps[2][at]));
        let mut ahead_step = Step::new(simd, splat(before[2][at]), splat(jumps[3][at]));
        for start in (0..depth).step_by(group) {
            let running = if SINGLE || !KEYS { &mut held_keys[..group] } else { &mut running[start..][..group] };
            let mut keys = Keys::begin(simd, running, n);
            for v in 0..n {
                let place = (start, v, group);
                let to = start + v * lanes;
                let mut sum = S::u8s::from_slice(simd, &along[to..][..lanes]);
                if PATHS == 4 {
                    let (ahead_here, rest) = here.split_at_mut(depth);
                    let (straight, behind_here) = rest.split_at_mut(depth);
                    let extended = straight_step.extend(simd, p1, cost, straight, place);
                    extended.store_slice(&mut straight[to..][..lanes]);
                    sum = sum.saturating_add(extended);
                    let extended = behind_step.extend(simd, p1, cost, behind, place);
                    behind[to..][..lanes].copy_from_slice(&behind_here[to..][..lanes]);
                    extended.store_slice(&mut behind_here[to..][..lanes]);
                    sum = sum.saturating_add(extended);
                    let extended = ahead_step.extend(simd, p1, cost, next, place);
                    extended.store_slice(&mut ahead_here[to..][..lanes]);
                    sum = sum.saturating_add(extended);
                } else {
                    let extended = straight_step.extend(simd, p1, cost, here, place);
                    extended.store_slice(&mut here[to..][..lanes]);
                    sum = sum.saturating_add(extended);
                }
                sum.store_slice(&mut sums[to..][..lanes]);
                if KEYS {
                    let other = S::u8s::from_slice(simd, &other[at * depth + to..][..lanes]);
                    keys.add(simd, [sum, other], &ids, running, (v, n), tile.mirrored);
                }
            }
            if KEYS {
                decided[start / group * decided_stride + at] = running[if tile.mirrored { 0 } else { group - 1 }];
                best[at] = keys.end(best[at], start);
            }
        }
        straight_least[at] = straight_step.smallest.reduce_min();
        if PATHS == 4 {
            behind_least[at] = behind_step.smallest.reduce_min();
            ahead_least[at] = ahead_step.smallest.reduce_min();
        }
    }
    ongoing.along_least = along_least.as_slice()[0];
    if SINGLE {
        along.copy_from_slice(&held_along[..group]);
        behind.copy_from_slice(&held_behind[..group]);
        if KEYS {
            running.copy_from_slice(&held_keys[..group]);
        }
    }
}

/// The extension of a path by a pixel.
struct Step<S: Simd> {
    /// The minimum at the previous pixel, and with P2 − P1 added.
    least: S::u8s,
    jump: S::u8s,
    /// Old values of the previous vector, of the first one of the group, and of the last one of the previous group.
    before: S::u8s,
    first: S::u8s,
    last: S::u8s,
    smallest: S::u8s,
}

impl<S: Simd> Step<S> {
    #[inline(always)]
    fn new(simd: S, least: S::u8s, jump: S::u8s) -> Self {
        let worst = S::u8s::splat(simd, u8::MAX);
        Self { least, jump, before: worst, first: worst, last: worst, smallest: worst }
    }

    /// Extends vector `v` of the group at `start`. The previous vectors may have been overwritten.
    #[inline(always)]
    fn extend(
        &mut self,
        simd: S,
        p1: S::u8s,
        cost: &[u8],
        slot: &[u8],
        (start, v, group): (usize, usize, usize),
    ) -> S::u8s {
        let lanes = S::u8s::LEN;
        let at = start + v * lanes;
        let load = |slot: &[u8], at: usize| S::u8s::from_slice(simd, &slot[at..][..lanes]);
        let here = load(slot, at);
        let below = if v > 0 {
            self.before
        } else {
            let end = load(slot, start + group - lanes);
            let below = up_one::<S>(self.last, end);
            (self.first, self.last) = (here, end);
            below
        };
        let above = if at + lanes < start + group {
            load(slot, at + lanes)
        } else {
            let next =
                if start + group < cost.len() { load(slot, start + group) } else { S::u8s::splat(simd, u8::MAX) };
            self.first.slide::<1>(next)
        };
        // Never above 255, other than those of neighbors in the padding.
        let step = below.min(above).min(self.jump) + p1;
        let cheapest = step.min(here);
        let extended = (cheapest - self.least).saturating_add(load(cost, at));
        self.smallest = self.smallest.min(extended);
        self.before = here;
        extended
    }
}

/// Shifts `here` up by one lane; its first lane is the last of `before`.
#[inline(always)]
fn up_one<S: Simd>(before: S::u8s, here: S::u8s) -> S::u8s {
    match S::u8s::LEN {
        16 => before.slide::<15>(here),
        32 => before.slide::<31>(here),
        _ => before.slide::<63>(here),
    }
}
