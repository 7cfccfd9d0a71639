//! Semi-global matching in a window of [`WINDOW`] disparities per pixel: time and memory are independent of the search range.
//!
//! The image is matched in strips of rows, in parallel. In each, a sweep down stores its sums, and one up adds its own and selects the
//! winners, as in [`crate::sgm`]. Both start some rows outside the strip. Path costs of a neighbor are shifted by the difference of the
//! two windows; disparities outside the neighbor's window cost P2. The winners of the right view are the cheapest winners of the left
//! view that project to it, as in OpenCV's matcher. The paths are the four along rows and columns: with all eight, more of the generated
//! room of 6 megapixels is off by 2 px (0.72 %, with four 0.67 %), since the windows already have the support of the coarser levels.

use crate::aligned_buffer::AlignedBuffer;
use crate::border_mask::RowMasks;
use crate::buffer_pool;
use crate::coarse_prior::{PRIOR_CENTER, PRIOR_COSTS};
use crate::cost::Frame;
use crate::kernel::penalties;
use crate::search_window::{SearchWindows, WINDOW};
use crate::winner::{NO_SUM, Winner, outside_cost};
use cv_core::{Cancelled, Stage};
use fearless_simd::{Level, dispatch, prelude::*, u8x32, u16x16};
use fearless_simd_macros::simd;
use std::ops::Range;

/// Rows of a strip, and rows outside of it at which its sweeps start.
const STRIP: usize = 160;
const OVERLAP: usize = 16;
/// Pixels whose costs are computed at a time.
const TILE: usize = 64;

/// Returns the bytes of the buffers of `threads` strips.
pub(crate) fn bytes(width: usize, height: usize, threads: usize) -> usize {
    let strips = threads.min(height.div_ceil(STRIP));
    volume(width, height, threads).saturating_add(strips.saturating_mul(width.saturating_mul(WINDOW + 16)))
}

/// Returns the bytes of the sums of `threads` strips.
pub(crate) fn volume(width: usize, height: usize, threads: usize) -> usize {
    threads.min(height.div_ceil(STRIP)).saturating_mul(width.saturating_mul(WINDOW * STRIP))
}

/// Selects the winners of both views. `sums` is resized to the [`volume`], `buffers` to the number of threads.
pub(crate) fn aggregate(
    level: Level,
    frame: &Frame<'_>,
    windows: &SearchWindows,
    (sums, buffers): (&mut AlignedBuffer<u8>, &mut Vec<Buffers>),
    (winners, right): (&mut [Winner], &mut [u16]),
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    let rows = STRIP * frame.width;
    let threads = rayon::current_num_threads().min(frame.height.div_ceil(STRIP));
    sums.resize(volume(frame.width, frame.height, threads), 0);
    buffers.resize_with(threads, Buffers::default);
    let mut buffers: Vec<_> = sums.as_mut_slice().chunks_mut(rows * WINDOW).zip(buffers).collect();
    let strips = winners.chunks_mut(rows).zip(right.chunks_mut(rows)).enumerate();
    buffer_pool::distribute(&mut buffers, strips, |(sums, buffers), (strip, output)| {
        let strip = Strip { frame, windows, first: strip * STRIP };
        dispatch!(level, simd => match_strip(simd, &strip, sums, buffers, output, stage))
    })
}

/// Buffers of a strip, reused for the next one.
#[derive(Debug, Default)]
pub(crate) struct Buffers {
    state: State,
    right_costs: Vec<u16>,
}

/// State of a sweep.
#[derive(Debug, Default)]
struct State {
    /// Path costs of the previous row, in image order.
    straight: Vec<u8>,
    /// Their minima.
    least: Vec<u8>,
    /// P2 − P1 of each pixel of the row: for the path along it, for the one straight, and two that are not used.
    p2: [Vec<u8>; 4],
    /// Costs of some pixels.
    costs: Vec<u8>,
}

/// Some rows of the image.
struct Strip<'a> {
    frame: &'a Frame<'a>,
    windows: &'a SearchWindows,
    /// The first row.
    first: usize,
}

const LANES: [u16; 16] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];

#[simd]
fn match_strip<S: Simd>(
    simd: S,
    strip: &Strip<'_>,
    sums: &mut [u8],
    buffers: &mut Buffers,
    (winners, right): (&mut [Winner], &mut [u16]),
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    let Frame { width, height, .. } = *strip.frame;
    let Buffers { state, right_costs } = buffers;
    let end = strip.first + winners.len() / width;
    let from = strip.first.saturating_sub(OVERLAP);
    state.start(width);
    for y in from..end {
        let row = Row::new(strip, y, false, y == from);
        if y < strip.first {
            sweep_row(simd, &row, state, Output::Nothing);
        } else {
            let start = (y - strip.first) * width;
            let sums = &mut sums[start * WINDOW..(start + width) * WINDOW];
            sweep_row(simd, &row, state, Output::Store(sums));
            stage.add(1)?;
        }
    }
    let from = (end + OVERLAP).min(height);
    state.start(width);
    for y in (strip.first..from).rev() {
        let row = Row::new(strip, y, true, y + 1 == from);
        if y >= end {
            sweep_row(simd, &row, state, Output::Nothing);
        } else {
            let start = (y - strip.first) * width;
            let sums = &sums[start * WINDOW..(start + width) * WINDOW];
            let winners = &mut winners[start..start + width];
            sweep_row(simd, &row, state, Output::Finish(sums, winners));
            project(strip.frame, winners, right_costs, &mut right[start..start + width]);
            stage.add(1)?;
        }
    }
    Ok(())
}

impl State {
    fn start(&mut self, width: usize) {
        for (values, len) in [(&mut self.straight, width * WINDOW), (&mut self.least, width)] {
            values.clear();
            values.resize(len, 0);
        }
        self.p2.iter_mut().for_each(|p2| p2.resize(width, 0));
    }
}

/// A row of a sweep.
struct Row<'a> {
    frame: &'a Frame<'a>,
    y: usize,
    mirrored: bool,
    /// The windows of the row and of the previous one, each for two pixels.
    windows: [&'a [u16]; 2],
}

impl<'a> Row<'a> {
    fn new(strip: &Strip<'a>, y: usize, mirrored: bool, is_first: bool) -> Self {
        let previous = if is_first {
            y
        } else if mirrored {
            y + 1
        } else {
            y - 1
        };
        Self { frame: strip.frame, y, mirrored, windows: [strip.windows.row(y), strip.windows.row(previous)] }
    }

    /// Returns the first index of the window of a pixel of this row, or of the previous one.
    #[inline(always)]
    fn first(&self, previous: bool, x: usize) -> i32 {
        let windows = self.windows[usize::from(previous)];
        i32::from(windows[(x / 2).min(windows.len() - 1)])
    }
}

/// Use of the sums of a row.
enum Output<'a> {
    Nothing,
    Store(&'a mut [u8]),
    /// Added to those of the other sweep, and winners selected.
    Finish(&'a [u8], &'a mut [Winner]),
}

/// Extends the paths by a row.
#[simd]
fn sweep_row<S: Simd>(simd: S, row: &Row<'_>, state: &mut State, mut output: Output<'_>) {
    let Frame { width, p1, .. } = *row.frame;
    penalties::<S, 2>(simd, row.frame, row.y, row.mirrored, &mut state.p2);
    let State { straight, least, p2, costs } = state;
    let p1 = u8x32::splat(simd, p1);
    let zero = u8x32::splat(simd, 0);
    let mut along = Path { first: 0, values: zero, least: 0 };
    let mut scratch = [u8::MAX; 3 * WINDOW];
    costs.resize(TILE * WINDOW, 0);
    for begin in (0..width).step_by(TILE) {
        let end = (begin + TILE).min(width);
        let columns = if row.mirrored { width - end..width - begin } else { begin..end };
        match row.frame.planes - usize::from(row.frame.intensity_cap.is_some()) {
            3 => compute_costs::<S, 3>(simd, row, columns.clone(), costs),
            6 => compute_costs::<S, 6>(simd, row, columns.clone(), costs),
            _ => compute_costs::<S, 8>(simd, row, columns.clone(), costs),
        }
        for k in 0..end - begin {
            let x = if row.mirrored { columns.end - 1 - k } else { columns.start + k };
            let is_first = begin + k == 0;
            let first = row.first(false, x);
            let cost = load(simd, costs, x - columns.start);
            if is_first {
                along.first = first;
            }
            along = along.extend(simd, first, cost, p1, p2[0][x], &mut scratch);
            let mut sum = along.values;
            let previous = row.first(true, x);
            let before = Path { first: previous, values: load(simd, straight, x), least: least[x] };
            let extended = before.extend(simd, first, cost, p1, p2[1][x], &mut scratch);
            extended.store(x, straight, least);
            sum = sum.saturating_add(extended.values);
            match &mut output {
                Output::Nothing => {}
                Output::Store(sums) => sum.store_slice(&mut sums[x * WINDOW..][..WINDOW]),
                Output::Finish(sums, winners) => {
                    winners[x] = select(simd, row.frame, first as usize, sum, load(simd, sums, x))
                }
            }
        }
    }
}

/// Loads the window of pixel `x`.
#[inline(always)]
fn load<S: Simd>(simd: S, values: &[u8], x: usize) -> u8x32<S> {
    u8x32::from_slice(simd, &values[x * WINDOW..][..WINDOW])
}

/// Path costs of a pixel in its window.
#[derive(Clone, Copy)]
struct Path<S: Simd> {
    /// First index of the window.
    first: i32,
    values: u8x32<S>,
    /// Their minimum.
    least: u8,
}

impl<S: Simd> Path<S> {
    #[inline(always)]
    fn store(self, x: usize, values: &mut [u8], least: &mut [u8]) {
        self.values.store_slice(&mut values[x * WINDOW..][..WINDOW]);
        least[x] = self.least;
    }

    /// Extends the path to a pixel with these costs, whose window starts at `first`; `p2` is P2 − P1. `scratch` is 255 but for its middle.
    #[inline(always)]
    fn extend(self, simd: S, first: i32, cost: u8x32<S>, p1: u8x32<S>, p2: u8, scratch: &mut [u8; 3 * WINDOW]) -> Self {
        let worst = u8x32::splat(simd, u8::MAX);
        let here = if first == self.first {
            self.values
        } else {
            self.values.store_slice(&mut scratch[WINDOW..2 * WINDOW]);
            let at = (WINDOW as i32 + first - self.first).clamp(0, 2 * WINDOW as i32) as usize;
            u8x32::from_slice(simd, &scratch[at..][..WINDOW])
        };
        let below = worst.slide::<{ WINDOW - 1 }>(here);
        let above = here.slide::<1>(worst);
        let jump = u8x32::splat(simd, self.least.wrapping_add(p2));
        let step = below.min(above).min(jump) + p1;
        let values = (step.min(here) - u8x32::splat(simd, self.least)).saturating_add(cost);
        Self { first, values, least: values.reduce_min() }
    }
}

/// Computes the costs of the pixels `xs` of a row in their windows.
#[simd]
fn compute_costs<S: Simd, const BITS: usize>(simd: S, row: &Row<'_>, xs: Range<usize>, out: &mut [u8]) {
    let frame = row.frame;
    let (width, planes, phase) = (frame.width, frame.planes, frame.layout.phase(frame.width));
    let left = &frame.left[row.y * width * planes..][..width * planes];
    let right = &frame.right[row.y * planes * phase..][..planes * phase];
    let left: [&[u8]; 9] = std::array::from_fn(|p| left.get(p * width..(p + 1) * width).unwrap_or(&[]));
    let right: [&[u8]; 9] = std::array::from_fn(|p| right.get(p * phase..(p + 1) * phase).unwrap_or(&[]));
    // Pixels whose whole range is inside the right image.
    let start = (frame.disparities as i64 - 1 + frame.min_disparity).max(0) as usize;
    let interior = start..(width as i64 + frame.min_disparity).clamp(0, width as i64) as usize;
    let priors = frame.priors.get(row.y * width..(row.y + 1) * width);
    let masks = frame.masks.row(row.y);
    for (x, out) in xs.zip(out.chunks_exact_mut(WINDOW)) {
        let first = row.first(false, x);
        let at = width - 1 - x + first as usize;
        let mut cost = u8x32::splat(simd, 0);
        for p in 0..BITS {
            let candidates = u8x32::from_slice(simd, &right[p][at..][..WINDOW]);
            cost += (candidates ^ u8x32::splat(simd, left[p][x])).count_ones();
        }
        if let Some(cap) = frame.intensity_cap {
            let value = u8x32::splat(simd, left[BITS][x]);
            let other = u8x32::from_slice(simd, &right[BITS][at..][..WINDOW]);
            cost += (value.max(other) - value.min(other)).min(u8x32::splat(simd, cap));
        }
        if let Some(prior) = priors.map(|priors| priors[x]) {
            let local = (i32::from(prior.index()) - first).clamp(-40, 72);
            let from = (PRIOR_CENTER - local) as usize;
            // Contiguous disparities: groups of one vector.
            cost += u8x32::from_slice(simd, &PRIOR_COSTS[0][usize::from(prior.cap())][from..][..WINDOW]);
        }
        cost.store_slice(out);
        if let Some(masks) = &masks {
            set_masked_costs(frame, masks, x, first as usize, out);
            continue;
        }
        if interior.contains(&x) {
            continue;
        }
        let inside = frame.inside(x);
        let first = first as usize;
        if inside.start > first || inside.end < first + WINDOW {
            let inside =
                inside.start.clamp(first, first + WINDOW) - first..inside.end.clamp(first, first + WINDOW) - first;
            let sum = out[inside.clone()].iter().map(|&cost| u32::from(cost)).sum();
            let outside = outside_cost(sum, inside.len());
            out[..inside.start].fill(outside);
            out[inside.end..].fill(outside);
        }
    }
}

/// Sets the costs of correspondences without data or outside the right image, in a window that starts at `first`, and all of a pixel
/// without data.
fn set_masked_costs(frame: &Frame<'_>, masks: &RowMasks<'_>, x: usize, first: usize, out: &mut [u8]) {
    if masks.hides_left(x) {
        out.fill(frame.masked_cost());
        return;
    }
    let has_data = |k: usize| frame.has_match(masks, x, k);
    let indices = || (first..first + WINDOW).zip(0..).filter(|(k, _)| has_data(*k));
    let (sum, count) =
        indices().fold((0, 0), |(sum, count), (_, at): (_, usize)| (sum + u32::from(out[at]), count + 1));
    if count < WINDOW {
        let outside = outside_cost(sum, count);
        for (k, cost) in (first..).zip(out) {
            if !has_data(k) {
                *cost = outside;
            }
        }
    }
}

/// Returns the winner of a pixel whose window starts at `first`. One at an end of the window that is no end of the range is a flat minimum:
/// its disparity is outside.
#[inline(always)]
fn select<S: Simd>(simd: S, frame: &Frame<'_>, first: usize, own: u8x32<S>, other: u8x32<S>) -> Winner {
    let [own, other] = [own.widen(), other.widen()];
    let (low, high) = (own.0 + other.0, own.1 + other.1);
    let ids = u16x16::from_slice(simd, &LANES);
    let key = ((low << 5) | ids).min((high << 5) | (ids + 16)).reduce_min();
    let (cost, lane) = (key >> 5, usize::from(key & 31));
    // Branch-free: a branch would wait for the minimum, and be mispredicted.
    let mut sums = [NO_SUM; WINDOW + 3];
    low.store_slice(&mut sums[1..17]);
    high.store_slice(&mut sums[17..33]);
    let [below, _, above, next] = std::array::from_fn(|i| sums[(lane + i).min(WINDOW + 2)]);
    let second = if frame.second {
        (0..WINDOW).filter(|other| other.abs_diff(lane) > 1).fold(NO_SUM, |least, lane| least.min(sums[lane + 1]))
    } else {
        NO_SUM
    };
    let is_end = ((lane == 0) & (first > 0)) | ((lane + 1 == WINDOW) & (first + WINDOW < frame.disparities));
    let is_flat = is_end | ((above == cost) & ((next == cost) | (lane + 2 >= WINDOW)));
    let (below, above) = if is_flat { (cost, cost) } else { (below, above) };
    Winner { index: (first + lane) as u16, cost, second, below, above }
}

/// Sets the index of the cheapest winner that projects to each pixel of the right row; the first of equal ones.
fn project(frame: &Frame<'_>, winners: &[Winner], costs: &mut Vec<u16>, right: &mut [u16]) {
    costs.clear();
    costs.resize(right.len(), u16::MAX);
    right.fill(0);
    for (x, winner) in winners.iter().enumerate() {
        let column = x as i64 - frame.min_disparity - i64::from(winner.index);
        let column = usize::try_from(column).ok();
        let target = column.and_then(|at| costs.get_mut(at).zip(right.get_mut(at)));
        if let Some((cost, index)) = target.filter(|(cost, _)| winner.cost < **cost) {
            (*cost, *index) = (winner.cost, winner.index);
        }
    }
}
