//! The inner loops of semi-global matching. The disparity is the vector axis; everything is integer, so that every
//! instruction set gives the same bytes.
//!
//! A sweep visits the rows from one end of the image to the other and the pixels of a row from one side to the other.
//! At each pixel it extends the paths that arrive from pixels already visited (from the pixel before, and from the three
//! next to it in the row before) by
//!
//! `L(d) = C(d) + min(L'(d), L'(d−1) + P1, L'(d+1) + P1, min L' + P2) − min L'`
//!
//! and adds them up. Two sweeps from opposite corners cover all directions.

use crate::aligned::Aligned;
use crate::cost::Frame;
use crate::layout::BLOCK;
use crate::select::{Keys, Selection, ids, winner};
use crate::winner::{NO_SUM, Winner};
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

/// Pixels whose costs are computed at a time: 4 KiB at 128 disparities, which stay in the first cache.
const TILE: usize = 32;

/// State of one sweep.
#[derive(Debug, Default)]
pub(crate) struct Sweep {
    /// True for the sweep from the bottom right.
    mirrored: bool,
    /// Path costs of the row before, for the paths from behind, straight and ahead in the sense of the sweep. Pixels of
    /// a diagonal share a slot, so that a slot is read and overwritten at the same visit.
    rows: [Aligned<u8>; 3],
    /// The smallest of each slot.
    least: [Vec<u8>; 3],
    /// Path costs of the pixel before.
    along: Aligned<u8>,
    /// Costs of a tile of pixels.
    costs: Aligned<u8>,
    sums: Aligned<u8>,
    /// P2 of each pixel of the row for each path: from before, straight, behind and ahead.
    p2: [Vec<u8>; 4],
    selection: Selection,
}

/// What becomes of the sums of a sweep.
pub(crate) enum Output<'a> {
    /// Kept for the other sweep.
    Store(&'a mut [u8]),
    /// Joined with those of the other sweep.
    Finish { other: &'a [u8], winners: &'a mut [Winner], right: &'a mut [u16] },
}

impl Sweep {
    /// Bytes that [`Sweep::start`] will hold on to.
    pub(crate) fn bytes(width: usize, depth: usize) -> usize {
        3 * width * (depth + 1) + (TILE + 2) * depth + 4 * width + Selection::bytes(width, depth)
    }

    /// Prepares for a frame.
    pub(crate) fn start(&mut self, frame: &Frame<'_>, mirrored: bool) {
        let depth = frame.layout.depth;
        self.mirrored = mirrored;
        for (row, least) in self.rows.iter_mut().zip(&mut self.least) {
            row.resize(frame.width * depth, 0);
            row.as_mut_slice().fill(0);
            least.clear();
            least.resize(frame.width, 0);
        }
        self.along.resize(depth, 0);
        self.costs.resize(TILE * depth, 0);
        self.sums.resize(depth, 0);
        for p2 in &mut self.p2 {
            p2.resize(frame.width, 0);
        }
        self.selection.resize(frame);
    }
}

/// Runs `sweep` over `steps` rows from row `first` (both counted in its own sense). `output` covers the same rows, in
/// the sense of the image.
#[simd]
pub(crate) fn sweep_rows<S: Simd>(
    simd: S,
    frame: &Frame<'_>,
    sweep: &mut Sweep,
    first: usize,
    steps: usize,
    output: &mut Output<'_>,
    eight: bool,
) {
    // The usual numbers of disparities as constants: loops over them unroll, and indices need no checks.
    let single = frame.layout.groups() == 1;
    match (eight, frame.layout.group == BLOCK, single) {
        (false, true, true) => rows::<S, 2, 1, true>(simd, frame, sweep, first, steps, output),
        (false, false, true) => rows::<S, 2, 2, true>(simd, frame, sweep, first, steps, output),
        (false, true, false) => rows::<S, 2, 1, false>(simd, frame, sweep, first, steps, output),
        (false, false, false) => rows::<S, 2, 2, false>(simd, frame, sweep, first, steps, output),
        (true, true, true) => rows::<S, 4, 1, true>(simd, frame, sweep, first, steps, output),
        (true, false, true) => rows::<S, 4, 2, true>(simd, frame, sweep, first, steps, output),
        (true, true, false) => rows::<S, 4, 1, false>(simd, frame, sweep, first, steps, output),
        (true, false, false) => rows::<S, 4, 2, false>(simd, frame, sweep, first, steps, output),
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
) {
    let (width, height) = (frame.width, frame.height);
    let group = BLOCKS * BLOCK;
    let n = group / S::u8s::LEN;
    let depth = if SINGLE { group } else { frame.layout.depth };
    let Sweep { mirrored, rows, least, along, costs, sums, p2, selection } = sweep;
    let mirrored = *mirrored;
    let [behind, straight, ahead] = rows.each_mut().map(|row| &mut row.as_mut_slice()[..width * depth]);
    let [behind_least, straight_least, ahead_least] = least.each_mut().map(|least| &mut least[..width]);
    let along = &mut along.as_mut_slice()[..depth];
    let costs = &mut costs.as_mut_slice()[..TILE * depth];
    let sums = &mut sums.as_mut_slice()[..depth];
    let ids = ids(simd, n);
    let p1 = S::u8s::splat(simd, frame.p1);
    for step in 0..steps {
        let t = first + step;
        let y = if mirrored { height - 1 - t } else { t };
        // Row of `output`.
        let line = if mirrored { steps - 1 - step } else { step };
        penalties::<S, PATHS>(simd, frame, y, mirrored, p2);
        let [p2_along, p2_straight, p2_behind, p2_ahead] = p2.each_ref().map(|p2| &p2[..width]);
        // Slots: pixel i of row t on the diagonal i − t or i + t. Paths that start at the border start from nothing.
        let turn = t % width;
        along.fill(0);
        let mut along_least = 0;
        if PATHS == 4 {
            let (from_behind, from_ahead) = ((width - turn) % width, (width - 1 + turn) % width);
            behind[from_behind * depth..][..depth].fill(0);
            behind_least[from_behind] = 0;
            ahead[from_ahead * depth..][..depth].fill(0);
            ahead_least[from_ahead] = 0;
        }
        let (decided, running) = selection.start();
        let held = width + group;
        for tile in (0..width).step_by(TILE) {
            let end = (tile + TILE).min(width);
            let columns = if mirrored { width - end..width - tile } else { tile..end };
            let start = columns.start;
            frame.costs::<S, BLOCKS, SINGLE>(simd, y, columns, costs);
            for i in tile..end {
                let x = if mirrored { width - 1 - i } else { i };
                let from_behind = if i >= turn { i - turn } else { i + width - turn };
                let from_ahead = if i + turn < width { i + turn } else { i + turn - width };
                let cost = &costs[(x - start) * depth..][..depth];
                // With two paths the last two are not looked at.
                let mut paths = [
                    Path { slot: &mut *along, least: &mut along_least, p2: p2_along[x] },
                    Path {
                        slot: &mut straight[i * depth..][..depth],
                        least: &mut straight_least[i],
                        p2: p2_straight[x],
                    },
                    Path {
                        slot: &mut behind[from_behind * depth..][..depth],
                        least: &mut behind_least[from_behind],
                        p2: p2_behind[x],
                    },
                    Path {
                        slot: &mut ahead[from_ahead * depth..][..depth],
                        least: &mut ahead_least[from_ahead],
                        p2: p2_ahead[x],
                    },
                ];
                let pixel = line * width + x;
                match output {
                    Output::Store(out) => {
                        let out = &mut out[pixel * depth..][..depth];
                        extend::<S, PATHS>(simd, p1, cost, &mut paths, group, |at, sum: S::u8s| {
                            sum.store_slice(&mut out[at..][..S::u8s::LEN]);
                        });
                    }
                    Output::Finish { other, winners, .. } => {
                        let other = &other[pixel * depth..][..depth];
                        let mut best = (NO_SUM, 0u16);
                        let mut keys = Keys::begin(simd, &running[..group], n);
                        extend::<S, PATHS>(simd, p1, cost, &mut paths, group, |at, own: S::u8s| {
                            own.store_slice(&mut sums[at..][..S::u8s::LEN]);
                            let (g, v) =
                                if SINGLE { (0, at / S::u8s::LEN) } else { (at / group, at % group / S::u8s::LEN) };
                            let running = &mut running[g * group..][..group];
                            if !SINGLE && v == 0 {
                                keys = Keys::begin(simd, running, n);
                            }
                            let other = S::u8s::from_slice(simd, &other[at..][..S::u8s::LEN]);
                            keys.add(simd, [own, other], &ids, running, v, n, mirrored);
                            if v + 1 == n {
                                let decided = &mut decided[g * held..][..held];
                                best = keys.end(decided, running, x, (group, g), mirrored, best);
                            }
                        });
                        winners[pixel] = winner(simd, frame, group, best, sums, other);
                    }
                }
            }
        }
        if let Output::Finish { right, .. } = output {
            let last = if mirrored { 0 } else { width - 1 };
            selection.finish(frame, last, &mut right[line * width..][..width]);
        }
    }
}

/// P2 of the pixels of row `y` for each path. At a border, where paths start from nothing, any value does.
#[inline(always)]
fn penalties<S: Simd, const PATHS: usize>(
    simd: S,
    frame: &Frame<'_>,
    y: usize,
    mirrored: bool,
    [along, straight, behind, ahead]: &mut [Vec<u8>; 4],
) {
    let (width, height) = (frame.width, frame.height);
    let last = width - 1;
    let row = |y: usize| &frame.grey[y * width..][..width];
    let here = row(y);
    let before = row(if mirrored { (y + 1).min(height - 1) } else { y.saturating_sub(1) });
    let between = |a: &[u8], b: &[u8], out: &mut [u8]| frame.p2.between(simd, a, b, out);
    // From the left and from the right, in the sense of the image.
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

/// One path at one pixel.
struct Path<'a> {
    slot: &'a mut [u8],
    least: &'a mut u8,
    p2: u8,
}

/// Extends every path by a pixel and hands on the sum of the extended ones, a vector at a time with its place.
#[inline(always)]
fn extend<S: Simd, const PATHS: usize>(
    simd: S,
    p1: S::u8s,
    cost: &[u8],
    [along, others @ ..]: &mut [Path<'_>; 4],
    group: usize,
    mut emit: impl FnMut(usize, S::u8s),
) {
    let (depth, lanes) = (cost.len(), S::u8s::LEN);
    // First of all the path from the pixel before: the next pixel waits for it.
    let mut step = Step::new(simd, along);
    for start in (0..depth).step_by(group) {
        for v in 0..group / lanes {
            step.extend(simd, p1, cost, along.slot, (start, v, group));
        }
    }
    *along.least = step.smallest.reduce_min();
    let mut steps = others.each_ref().map(|path| Step::new(simd, path));
    for start in (0..depth).step_by(group) {
        for v in 0..group / lanes {
            let at = start + v * lanes;
            let mut sum = S::u8s::from_slice(simd, &along.slot[at..][..lanes]);
            for p in 0..PATHS - 1 {
                sum = sum.saturating_add(steps[p].extend(simd, p1, cost, others[p].slot, (start, v, group)));
            }
            emit(at, sum);
        }
    }
    for p in 0..PATHS - 1 {
        *others[p].least = steps[p].smallest.reduce_min();
    }
}

/// A path in the midst of being extended by a pixel.
struct Step<S: Simd> {
    /// The least at the pixel before, and with P2.
    least: S::u8s,
    jump: S::u8s,
    /// What the vector before held, the first one of the group, and the last one of the group before.
    before: S::u8s,
    first: S::u8s,
    last: S::u8s,
    smallest: S::u8s,
}

impl<S: Simd> Step<S> {
    #[inline(always)]
    fn new(simd: S, path: &Path<'_>) -> Self {
        let worst = S::u8s::splat(simd, u8::MAX);
        Self {
            least: S::u8s::splat(simd, *path.least),
            jump: S::u8s::splat(simd, *path.least + path.p2),
            before: worst,
            first: worst,
            last: worst,
            smallest: worst,
        }
    }

    /// Extends vector `v` of the group at `start`.
    #[inline(always)]
    fn extend(
        &mut self,
        simd: S,
        p1: S::u8s,
        cost: &[u8],
        slot: &mut [u8],
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
        let step = below.min(above).saturating_add(p1);
        let cheapest = step.min(here).min(self.jump);
        let extended = (cheapest - self.least).saturating_add(load(cost, at));
        extended.store_slice(&mut slot[at..][..lanes]);
        self.smallest = self.smallest.min(extended);
        self.before = here;
        extended
    }
}

/// `here` moved up by one lane, its first lane from the last of `before`.
#[inline(always)]
fn up_one<S: Simd>(before: S::u8s, here: S::u8s) -> S::u8s {
    match S::u8s::LEN {
        16 => before.slide::<15>(here),
        32 => before.slide::<31>(here),
        _ => before.slide::<63>(here),
    }
}
