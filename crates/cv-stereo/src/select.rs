//! Winner-takes-all selection in both views, from the sums of a pixel while they are in registers.
//!
//! A sum and its index share a 16-bit key, so that the smallest key is the first of the smallest sums. The candidates of a pixel of the
//! right image are those of successive pixels of the left one at successive indices: the best keys so far are kept in vectors that shift
//! by one index per pixel, and the key that is shifted out is final.

use crate::aligned_buffer::AlignedBuffer;
use crate::cost::Frame;
use crate::layout::{BLOCK, MAX_VECTORS, place};
use crate::winner::{NO_SUM, Winner, is_flat};
use fearless_simd::prelude::*;
use fearless_simd_macros::simd;
use std::ops::Range;

/// Bits of a key for the index within a group.
const KEY_BITS: u32 = 7;
const INDEX: u16 = (1 << KEY_BITS) - 1;

/// State of the selection, kept between frames.
#[derive(Debug, Default)]
pub(crate) struct Selection {
    /// Best keys of the right pixels that are candidates of the current pixel. Vector `r` of the `2n` of a group has indices `2n·l + r`.
    running: AlignedBuffer<u16>,
    /// Final keys of the right pixels, group by group: at `x + group − 1 − k` that of the candidate of `x` at index `k`.
    decided: Vec<u16>,
}

impl Selection {
    pub(crate) fn bytes(width: usize, depth: usize) -> usize {
        2 * depth + 2 * depth.div_ceil(64) * (width + 128)
    }

    pub(crate) fn resize(&mut self, frame: &Frame<'_>) {
        let layout = frame.layout;
        self.running.resize(layout.depth, 0);
        self.decided.resize(layout.groups() * (frame.width + layout.group), 0);
    }

    /// Resets the state for a row.
    pub(crate) fn start(&mut self) {
        self.running.as_mut_slice().fill(u16::MAX);
    }

    /// Returns the buffers of the columns `xs`.
    pub(crate) fn ends<'a>(
        &'a mut self,
        frame: &Frame<'_>,
        mirrored: bool,
        xs: &Range<usize>,
        other: &'a [u8],
        best: &'a mut [(u16, u16)],
    ) -> Ends<'a> {
        let start = if mirrored { xs.start + frame.layout.group - 1 } else { xs.start };
        Ends {
            other,
            running: self.running.as_mut_slice(),
            decided: &mut self.decided[start..],
            best,
            stride: frame.width + frame.layout.group,
        }
    }

    /// Ends a row whose last pixel was `x`: index of the best match of every pixel of the right row.
    pub(crate) fn finish(&mut self, frame: &Frame<'_>, x: usize, out: &mut [u16]) {
        let (group, stride) = (frame.layout.group, frame.width + frame.layout.group);
        // Half vectors: as many lanes as a vector of keys has.
        let lanes = frame.layout.lanes / 2;
        let running = self.running.as_mut_slice();
        for (running, decided) in running.chunks_exact(group).zip(self.decided.chunks_exact_mut(stride)) {
            for k in 0..group {
                decided[x + group - 1 - k] = running[place(k, group, lanes)];
            }
        }
        // Index of the key of column 0 in the first group.
        let first = frame.min_disparity + group as i64 - 1;
        if frame.layout.groups() == 1 {
            // Columns that are a candidate of some pixel.
            let start = (-first).clamp(0, frame.width as i64) as usize;
            let end = ((stride - 1) as i64 - first).clamp(start as i64, frame.width as i64) as usize;
            out[..start].fill(0);
            out[end..].fill(0);
            let keys = self.decided.iter().skip((start as i64 + first) as usize);
            for (out, &key) in out[start..end].iter_mut().zip(keys) {
                *out = if key >> KEY_BITS < NO_SUM { key & INDEX } else { 0 };
            }
            return;
        }
        for (column, out) in out.iter_mut().enumerate() {
            let mut best = (NO_SUM, 0);
            for (g, decided) in self.decided.chunks_exact(stride).enumerate() {
                let at = column as i64 + first + (g * group) as i64;
                if at >= (stride - 1) as i64 {
                    break;
                }
                let Some(&key) = usize::try_from(at).ok().and_then(|at| decided.get(at)) else { continue };
                if key >> KEY_BITS < best.0 {
                    best = (key >> KEY_BITS, (key & INDEX) + (g * group) as u16);
                }
            }
            *out = best.1;
        }
    }
}

/// Buffers of the selection of some pixels.
pub(crate) struct Ends<'a> {
    /// Sums of the other sweep.
    pub(crate) other: &'a [u8],
    pub(crate) running: &'a mut [u16],
    pub(crate) decided: &'a mut [u16],
    /// Stride of the groups of `decided`.
    pub(crate) stride: usize,
    /// The smallest sum and its index.
    pub(crate) best: &'a mut [(u16, u16)],
}

/// Writes the winners of some pixels.
#[simd]
pub(crate) fn select<S: Simd, const BLOCKS: usize, const SINGLE: bool>(
    simd: S,
    frame: &Frame<'_>,
    best: &[(u16, u16)],
    [own, other]: [&[u8]; 2],
    winners: &mut [Winner],
) {
    let depth = if SINGLE { BLOCKS * BLOCK } else { frame.layout.depth };
    let (own, other) = (own.chunks_exact(depth), other.chunks_exact(depth));
    for ((winner, &best), (own, other)) in winners.iter_mut().zip(best).zip(own.zip(other)) {
        *winner = surroundings(simd, frame, BLOCKS * BLOCK, best, own, other);
    }
}

/// The keys of a group at one pixel.
pub(crate) struct Keys<S: Simd> {
    /// Old keys of the two vectors before the next two.
    even: S::u16s,
    odd: S::u16s,
    /// Old keys of vectors `0` and `n`.
    first: S::u16s,
    middle: S::u16s,
    /// The smallest keys so far.
    best: S::u16s,
}

/// Loads vector `r`.
#[inline(always)]
fn vector<S: Simd>(simd: S, of: &[u16], r: usize) -> S::u16s {
    S::u16s::from_slice(simd, &of[r * S::u16s::LEN..][..S::u16s::LEN])
}

impl<S: Simd> Keys<S> {
    /// Starts a group of `n` vectors.
    #[inline(always)]
    pub(crate) fn begin(simd: S, running: &[u16], n: usize) -> Self {
        let none = S::u16s::splat(simd, u16::MAX);
        let last = vector(simd, running, 2 * n - 1);
        let even = match S::u16s::LEN {
            8 => none.slide::<7>(last),
            16 => none.slide::<15>(last),
            _ => none.slide::<31>(last),
        };
        let (first, middle) = (vector(simd, running, 0), vector(simd, running, n));
        Self { even, odd: vector(simd, running, n - 1), first, middle, best: none }
    }

    /// Adds the sums of both sweeps at vector `v` of `n`, from left to right or `mirrored`. `ids` are the indices of the vectors of keys.
    #[inline(always)]
    pub(crate) fn add(
        &mut self,
        simd: S,
        [own, other]: [S::u8s; 2],
        ids: &[S::u16s; 2 * MAX_VECTORS],
        running: &mut [u16],
        (v, n): (usize, usize),
        mirrored: bool,
    ) {
        // Bytes at even positions, and at odd ones.
        let [own, other] = [own.bitcast::<S::u16s>(), other.bitcast::<S::u16s>()];
        let low = S::u16s::splat(simd, 0xff);
        let even = (((own & low) + (other & low)) << KEY_BITS) | ids[v];
        let odd = (((own >> 8) + (other >> 8)) << KEY_BITS) | ids[n + v];
        self.best = self.best.min(even).min(odd);
        let here = [vector(simd, running, v), vector(simd, running, n + v)];
        let [before_even, before_odd] = if !mirrored {
            [self.even, self.odd]
        } else if v + 1 < n {
            [vector(simd, running, v + 1), vector(simd, running, n + v + 1)]
        } else {
            [self.middle, self.first.slide::<1>(S::u16s::splat(simd, u16::MAX))]
        };
        [self.even, self.odd] = here;
        before_even.min(even).store_slice(&mut running[v * S::u16s::LEN..][..S::u16s::LEN]);
        before_odd.min(odd).store_slice(&mut running[(n + v) * S::u16s::LEN..][..S::u16s::LEN]);
    }

    /// Returns the smallest sum and its index, of this group, whose first index is `start`, or `best` of the previous ones.
    #[inline(always)]
    pub(crate) fn end(&self, best: (u16, u16), start: usize) -> (u16, u16) {
        let key = self.best.reduce_min();
        if key >> KEY_BITS < best.0 { (key >> KEY_BITS, (key & INDEX) + start as u16) } else { best }
    }
}

/// Returns the indices of the vectors of keys, for `n` vectors of sums per group.
#[inline(always)]
pub(crate) fn ids<S: Simd>(simd: S, n: usize) -> [S::u16s; 2 * MAX_VECTORS] {
    let first = S::u16s::from_fn(simd, |lane| (lane * 2 * n) as u16);
    let mut ids = [first; 2 * MAX_VECTORS];
    for (r, id) in ids.iter_mut().enumerate() {
        *id += S::u16s::splat(simd, r as u16);
    }
    ids
}

/// Returns the winner with the sums around it, given the sums of both sweeps.
#[inline(always)]
fn surroundings<S: Simd>(
    simd: S,
    frame: &Frame<'_>,
    group: usize,
    (cost, index): (u16, u16),
    own: &[u8],
    other: &[u8],
) -> Winner {
    let k = usize::from(index);
    let other = &other[..own.len()];
    let at = |k: usize| {
        if k < frame.disparities {
            let place = place(k, group, S::u8s::LEN);
            u16::from(own[place]) + u16::from(other[place])
        } else {
            NO_SUM
        }
    };
    let second = if frame.second { second(simd, group, index, own, other) } else { NO_SUM };
    let (below, above) =
        if is_flat(k, frame.disparities, cost, at) { (cost, cost) } else { (at(k.wrapping_sub(1)), at(k + 1)) };
    Winner { index, cost, second, below, above }
}

/// Returns the smallest sum that is not next to the winner.
#[inline(always)]
fn second<S: Simd>(simd: S, group: usize, index: u16, own: &[u8], other: &[u8]) -> u16 {
    let n = group / S::u8s::LEN;
    let ids = ids(simd, n);
    let none = S::u16s::splat(simd, u16::MAX);
    // Indices within one of the winner, by unsigned wrap-around.
    let low = S::u16s::splat(simd, index.wrapping_sub(1));
    let two = S::u16s::splat(simd, 2);
    let byte = S::u16s::splat(simd, 0xff);
    let mut second = none;
    for (at, (own, other)) in own.chunks_exact(S::u8s::LEN).zip(other.chunks_exact(S::u8s::LEN)).enumerate() {
        let [own, other] = [own, other].map(|part| S::u8s::from_slice(simd, part).bitcast::<S::u16s>());
        let (g, v) = (at / n, at % n);
        for (sum, id) in [((own & byte) + (other & byte), ids[v]), ((own >> 8) + (other >> 8), ids[n + v])] {
            let far = (id + (g * group) as u16 - low).simd_gt(two);
            second = second.min(far.select(sum, none));
        }
    }
    second.reduce_min().min(NO_SUM)
}
