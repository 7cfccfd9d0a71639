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
use crate::winner::{NO_SUM, Winner, is_flat, outside_cost};
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;

/// Disparities per block: a cache line, one to four vectors.
pub(crate) const BLOCK: usize = 64;

/// Disparities whose index shares a 16-bit key with a sum of at most 510.
const GROUP: usize = 1 << KEY_BITS;
const KEY_BITS: u32 = 7;

/// What both sweeps read.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Frame<'a> {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) min_disparity: i64,
    /// Number of disparities asked for.
    pub(crate) disparities: usize,
    /// Number of blocks that hold them.
    pub(crate) blocks: usize,
    /// Census bytes of the left image, one plane after the other.
    pub(crate) left: &'a [&'a [u8]],
    /// Census bytes of the right image, each row mirrored so that disparities ascend: element `j` of a row is column
    /// `width − 1 − min_disparity − j`, and the match of column `x` at index `k` is element `width − 1 − x + k`.
    pub(crate) right: &'a [&'a [u8]],
    /// The values whose absolute difference, at most so much, is added to the bits: of the left image, and of the
    /// right one laid out as its bits.
    pub(crate) blend: Option<(&'a [u8], &'a [u8], u8)>,
    /// Grey values of the left image, 0 to 255.
    pub(crate) grey: &'a [u8],
    pub(crate) p1: u8,
    /// P2 by absolute grey difference.
    pub(crate) p2: &'a [u8; 256],
    /// Whether [`Winner::second`] is wanted.
    pub(crate) second: bool,
}

impl Frame<'_> {
    /// Length of a row of [`Frame::right`].
    pub(crate) fn right_stride(width: usize, blocks: usize) -> usize {
        width + blocks * BLOCK
    }

    /// True where every lane is a disparity asked for whose match lies inside the right image.
    #[inline(always)]
    fn all_inside(&self, x: usize) -> bool {
        let column = x as i64 - self.min_disparity;
        let last = (self.blocks * BLOCK) as i64 - 1;
        self.disparities == self.blocks * BLOCK && column < self.width as i64 && column >= last
    }

    /// Costs of pixel `(x, y)` at every disparity; 255 in the lanes beyond the last one, which keeps them from ever
    /// winning or lending to their neighbours, since additions saturate.
    #[inline(always)]
    fn costs<S: Simd>(&self, simd: S, x: usize, y: usize, out: &mut [u8]) {
        self.bits(simd, x, y, out);
        // The column in the right image falls with the index: at first it may lie right of the image, at last left.
        let column = x as i64 - self.min_disparity;
        let n = self.disparities as i64;
        let inside = (column - (self.width as i64 - 1)).clamp(0, n) as usize..(column + 1).clamp(0, n) as usize;
        if inside.len() < self.disparities {
            let outside = outside_cost(&out[inside.clone()]);
            out[..inside.start].fill(outside);
            out[inside.end..self.disparities].fill(outside);
        }
        out[self.disparities..].fill(u8::MAX);
    }
}

impl Frame<'_> {
    /// Costs without regard to the borders.
    #[inline(always)]
    fn bits<S: Simd>(&self, simd: S, x: usize, y: usize, out: &mut [u8]) {
        match self.left.len() {
            3 => self.hamming::<S, 3>(simd, x, y, out),
            6 => self.hamming::<S, 6>(simd, x, y, out),
            _ => self.hamming::<S, 8>(simd, x, y, out),
        }
        if let Some((left, right, cap)) = self.blend {
            let value = S::u8s::splat(simd, left[y * self.width + x]);
            let cap = S::u8s::splat(simd, cap);
            let row = &right[y * Self::right_stride(self.width, self.blocks) + self.width - 1 - x..][..out.len()];
            for (out, row) in out.chunks_exact_mut(S::u8s::LEN).zip(row.chunks_exact(S::u8s::LEN)) {
                let other = S::u8s::from_slice(simd, row);
                let more = (value.max(other) - value.min(other)).min(cap);
                (S::u8s::from_slice(simd, out) + more).store_slice(out);
            }
        }
    }

    /// Number of census bits in which pixel `(x, y)` and each of its candidates differ, over `PLANES` bytes.
    #[inline(always)]
    fn hamming<S: Simd, const PLANES: usize>(&self, simd: S, x: usize, y: usize, out: &mut [u8]) {
        let start = y * Self::right_stride(self.width, self.blocks) + self.width - 1 - x;
        let pixel = y * self.width + x;
        let depth = out.len();
        // Plain loops: closures of `from_fn` are not always inlined, and then lose the instruction set.
        let mut bits = [S::u8s::splat(simd, 0); PLANES];
        let mut rows: [&[u8]; PLANES] = [&[]; PLANES];
        for p in 0..PLANES {
            bits[p] = S::u8s::splat(simd, self.left[p][pixel]);
            rows[p] = &self.right[p][start..start + depth];
        }
        let mut at = 0;
        while at < depth {
            let part = at..at + S::u8s::LEN;
            let mut count = (S::u8s::from_slice(simd, &rows[0][part.clone()]) ^ bits[0]).count_ones();
            for p in 1..PLANES {
                count += (S::u8s::from_slice(simd, &rows[p][part.clone()]) ^ bits[p]).count_ones();
            }
            count.store_slice(&mut out[part]);
            at += S::u8s::LEN;
        }
    }
}

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
    along_least: u8,
    cost: Aligned<u8>,
    sums: Aligned<u16>,
    /// Best key per column of the right image (mirrored), one array per group.
    keys: Vec<u16>,
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
    pub(crate) fn bytes(width: usize, blocks: usize) -> usize {
        3 * width * (blocks * BLOCK + 1) + 4 * blocks * BLOCK + 2 * blocks.div_ceil(2) * (width + GROUP)
    }

    /// Prepares for a frame.
    pub(crate) fn start(&mut self, frame: &Frame<'_>, mirrored: bool) {
        let depth = frame.blocks * BLOCK;
        self.mirrored = mirrored;
        for (row, least) in self.rows.iter_mut().zip(&mut self.least) {
            row.resize(frame.width * depth, 0);
            row.as_mut_slice().fill(0);
            least.clear();
            least.resize(frame.width, 0);
        }
        self.along.resize(depth, 0);
        self.cost.resize(depth, 0);
        self.sums.resize(depth, 0);
        self.keys.resize(frame.blocks.div_ceil(2) * (frame.width + GROUP), 0);
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
    match (eight, frame.blocks) {
        (false, 1) => rows::<S, 2, 1>(simd, frame, sweep, first, steps, output),
        (false, 2) => rows::<S, 2, 2>(simd, frame, sweep, first, steps, output),
        (false, _) => rows::<S, 2, 0>(simd, frame, sweep, first, steps, output),
        (true, 1) => rows::<S, 4, 1>(simd, frame, sweep, first, steps, output),
        (true, 2) => rows::<S, 4, 2>(simd, frame, sweep, first, steps, output),
        (true, _) => rows::<S, 4, 0>(simd, frame, sweep, first, steps, output),
    }
}

#[inline(always)]
fn rows<S: Simd, const PATHS: usize, const BLOCKS: usize>(
    simd: S,
    frame: &Frame<'_>,
    sweep: &mut Sweep,
    first: usize,
    steps: usize,
    output: &mut Output<'_>,
) {
    let (width, height) = (frame.width, frame.height);
    // Blocks of any number where `BLOCKS` is zero.
    let blocks = if BLOCKS > 0 { BLOCKS } else { frame.blocks };
    let depth = blocks * BLOCK;
    let groups = blocks.div_ceil(2);
    let Sweep { mirrored, rows, least, along, along_least, cost, sums, keys } = sweep;
    let [behind, straight, ahead] = rows;
    let (behind, straight, ahead) = (behind.as_mut_slice(), straight.as_mut_slice(), ahead.as_mut_slice());
    let [behind_least, straight_least, ahead_least] = least;
    let along = &mut along.as_mut_slice()[..depth];
    let cost = &mut cost.as_mut_slice()[..depth];
    let sums = &mut sums.as_mut_slice()[..depth];
    for step in 0..steps {
        let t = first + step;
        let y = if *mirrored { height - 1 - t } else { t };
        // Row of `output`.
        let line = if *mirrored { steps - 1 - step } else { step };
        if matches!(output, Output::Finish { .. }) {
            keys.fill(u16::MAX);
        }
        let turn = t % width;
        for i in 0..width {
            let x = if *mirrored { width - 1 - i } else { i };
            // Slots: pixel i of row t on the diagonal i − t or i + t.
            let from_behind = if i >= turn { i - turn } else { i + width - turn };
            let from_ahead = if i + turn < width { i + turn } else { i + turn - width };
            if i == 0 {
                along.fill(0);
                *along_least = 0;
                if PATHS == 4 {
                    behind[from_behind * depth..][..depth].fill(0);
                    behind_least[from_behind] = 0;
                }
            }
            if PATHS == 4 && i == width - 1 {
                ahead[from_ahead * depth..][..depth].fill(0);
                ahead_least[from_ahead] = 0;
            }
            // A copy on the stack that is only touched at constant places lives in registers.
            let mut local = [[0u8; BLOCK]; BLOCKS];
            let cost: &[u8] = if BLOCKS == 0 {
                frame.costs(simd, x, y, cost);
                cost
            } else {
                let local = local.as_flattened_mut();
                if frame.all_inside(x) {
                    frame.bits(simd, x, y, local);
                } else {
                    frame.costs(simd, x, y, cost);
                    local.copy_from_slice(cost);
                }
                local
            };

            // Neighbours the paths come from; at a border any value does, since the slots there are all zero.
            let grey = |x: usize, y: usize| frame.grey[y * width + x];
            let here = grey(x, y);
            let (x_before, x_after) = if *mirrored {
                ((x + 1).min(width - 1), x.saturating_sub(1))
            } else {
                (x.saturating_sub(1), (x + 1).min(width - 1))
            };
            let y_before = if *mirrored { (y + 1).min(height - 1) } else { y.saturating_sub(1) };
            let p2 = |x: usize, y: usize| frame.p2[usize::from(here.abs_diff(grey(x, y)))];

            // With two paths the last two are not looked at.
            let mut paths = [
                Path { slot: &mut *along, least: along_least, p2: p2(x_before, y) },
                Path { slot: &mut straight[i * depth..][..depth], least: &mut straight_least[i], p2: p2(x, y_before) },
                Path {
                    slot: &mut behind[from_behind * depth..][..depth],
                    least: &mut behind_least[from_behind],
                    p2: p2(x_before, y_before),
                },
                Path {
                    slot: &mut ahead[from_ahead * depth..][..depth],
                    least: &mut ahead_least[from_ahead],
                    p2: p2(x_after, y_before),
                },
            ];
            let pixel = line * width + x;
            match output {
                Output::Store(out) => {
                    let out = &mut out[pixel * depth..][..depth];
                    extend::<S, PATHS>(simd, frame.p1, cost, &mut paths, |at, sum: S::u8s| {
                        sum.store_slice(&mut out[at..at + S::u8s::LEN]);
                    });
                }
                Output::Finish { other, winners, .. } => {
                    let other = &other[pixel * depth..][..depth];
                    let start = width - 1 - x;
                    let none = S::u16s::splat(simd, u16::MAX);
                    let iota = S::u16s::from_fn(simd, |lane| lane as u16);
                    let half = S::u16s::LEN;
                    let mut group_best = none;
                    let mut best = (NO_SUM, 0u16);
                    extend::<S, PATHS>(simd, frame.p1, cost, &mut paths, |at, sum: S::u8s| {
                        let (low, high) = sum.widening_add(S::u8s::from_slice(simd, &other[at..at + S::u8s::LEN]));
                        let group = at / GROUP;
                        let in_group = at % GROUP;
                        let row = &mut keys[group * (width + GROUP) + start + in_group..][..S::u8s::LEN];
                        let sums = &mut sums[at..at + S::u8s::LEN];
                        for (part, total) in [low, high].into_iter().enumerate() {
                            let offset = part * half;
                            total.store_slice(&mut sums[offset..offset + half]);
                            let key = (total << KEY_BITS) | (iota + (in_group + offset) as u16);
                            group_best = group_best.min(key);
                            let row = &mut row[offset..offset + half];
                            S::u16s::from_slice(simd, row).min(key).store_slice(row);
                        }
                        if in_group + S::u8s::LEN == GROUP || at + S::u8s::LEN == depth {
                            let key = group_best.reduce_min();
                            group_best = none;
                            if key >> KEY_BITS < best.0 {
                                best = (key >> KEY_BITS, (key & (GROUP as u16 - 1)) + (group * GROUP) as u16);
                            }
                        }
                    });
                    winners[pixel] = finish(simd, frame, best, sums);
                }
            }
        }
        if let Output::Finish { right, .. } = output {
            right_indices(frame, groups, keys, &mut right[line * width..][..width]);
        }
    }
}

/// One path at one pixel.
struct Path<'a> {
    slot: &'a mut [u8],
    least: &'a mut u8,
    p2: u8,
}

/// Extends every path by a pixel and hands on the sum of the extended ones, a vector at a time with its first index.
#[inline(always)]
fn extend<S: Simd, const PATHS: usize>(
    simd: S,
    p1: u8,
    cost: &[u8],
    paths: &mut [Path<'_>; 4],
    mut emit: impl FnMut(usize, S::u8s),
) {
    let depth = cost.len();
    let worst = S::u8s::splat(simd, u8::MAX);
    let p1 = S::u8s::splat(simd, p1);
    let mut before = [worst; PATHS];
    let mut smallest = [worst; PATHS];
    let mut least = [worst; PATHS];
    let mut jump = [worst; PATHS];
    for p in 0..PATHS {
        least[p] = S::u8s::splat(simd, *paths[p].least);
        jump[p] = S::u8s::splat(simd, *paths[p].least + paths[p].p2);
    }
    let mut at = 0;
    while at < depth {
        let c = S::u8s::from_slice(simd, &cost[at..at + S::u8s::LEN]);
        let mut sum = S::u8s::splat(simd, 0);
        for p in 0..PATHS {
            let slot = &mut *paths[p].slot;
            let here = S::u8s::from_slice(simd, &slot[at..at + S::u8s::LEN]);
            let after = if at + S::u8s::LEN < depth {
                S::u8s::from_slice(simd, &slot[at + S::u8s::LEN..at + 2 * S::u8s::LEN])
            } else {
                worst
            };
            let step = up_one::<S>(before[p], here).min(here.slide::<1>(after)).saturating_add(p1);
            let cheapest = step.min(here).min(jump[p]);
            let extended = (cheapest - least[p]).saturating_add(c);
            extended.store_slice(&mut slot[at..at + S::u8s::LEN]);
            smallest[p] = smallest[p].min(extended);
            sum = sum.saturating_add(extended);
            before[p] = here;
        }
        emit(at, sum);
        at += S::u8s::LEN;
    }
    for p in 0..PATHS {
        *paths[p].least = smallest[p].reduce_min();
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

/// The winner with its surroundings.
#[inline(always)]
fn finish<S: Simd>(simd: S, frame: &Frame<'_>, (cost, index): (u16, u16), sums: &[u16]) -> Winner {
    let k = usize::from(index);
    let at = |k: usize| if k < frame.disparities { sums[k] } else { NO_SUM };
    let second = if frame.second { second(simd, index, sums) } else { NO_SUM };
    let (below, above) =
        if is_flat(k, frame.disparities, cost, at) { (cost, cost) } else { (at(k.wrapping_sub(1)), at(k + 1)) };
    Winner { index, cost, second, below, above }
}

/// The smallest sum that is not next to the winner.
#[inline(always)]
fn second<S: Simd>(simd: S, index: u16, sums: &[u16]) -> u16 {
    let iota = S::u16s::from_fn(simd, |lane| lane as u16);
    let none = S::u16s::splat(simd, u16::MAX);
    // Lanes within one of the winner, by unsigned wrap-around.
    let low = S::u16s::splat(simd, index.wrapping_sub(1));
    let mut second = none;
    for (at, part) in sums.chunks_exact(S::u16s::LEN).enumerate() {
        let distance = iota + (at * S::u16s::LEN) as u16 - low;
        let far = distance.simd_gt(S::u16s::splat(simd, 2));
        second = second.min(far.select(S::u16s::from_slice(simd, part), none));
    }
    second.reduce_min().min(NO_SUM)
}

/// Index of the best match of every pixel of a right row.
fn right_indices(frame: &Frame<'_>, groups: usize, keys: &[u16], out: &mut [u16]) {
    // Element j of the mirrored row is column width − 1 − min_disparity − j; group g starts at disparity g·GROUP, which
    // is that many elements further.
    let width = frame.width as i64;
    let stride = frame.width + GROUP;
    let best_of = |key: u16, group: usize, best: (u16, u16)| {
        let sum = key >> KEY_BITS;
        if sum < best.0 { (sum, (key & (GROUP as u16 - 1)) + (group * GROUP) as u16) } else { best }
    };
    let first = width - 1 - frame.min_disparity;
    if groups == 1 && frame.min_disparity >= 0 && first >= 0 {
        // The usual case: columns 0 to `first` have candidates, those right of it none.
        let (seen, unseen) = out.split_at_mut(first as usize + 1);
        unseen.fill(0);
        for (index, &key) in seen.iter_mut().zip(keys[..=first as usize].iter().rev()) {
            *index = best_of(key, 0, (NO_SUM, 0)).1;
        }
        return;
    }
    for (column, index) in out.iter_mut().enumerate() {
        let mut best = (NO_SUM, 0u16);
        for group in 0..groups {
            let Ok(at) = usize::try_from(first - column as i64 - (group * GROUP) as i64) else { break };
            let Some(&key) = keys[group * stride..][..stride].get(at) else { continue };
            best = best_of(key, group, best);
        }
        *index = best.1;
    }
}
