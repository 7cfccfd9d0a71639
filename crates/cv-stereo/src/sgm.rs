//! Semi-global aggregation (Hirschmüller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008)
//! in two sweeps that meet in the middle.
//!
//! One sweep goes down from the top left, the other up from the bottom right, in parallel. Until they meet, each stores its sums; then
//! each adds the other's sums to its own and selects the winners immediately. The volume of sums is so written once and read once, costs
//! are computed from the census bits on the fly, and no two threads write to the same memory. With more than two threads, others
//! compute the costs of the next row of each sweep.

use crate::aligned_buffer::AlignedBuffer;
use crate::cost::Frame;
use crate::kernel::{Output, Sweep, sweep_rows};
use crate::layout::Layout;
use crate::winner::Winner;
use cv_core::{Cancelled, Progress, Stage};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch};
use std::ops::Range;

/// Buffers of the aggregation, reused between frames.
#[derive(Debug, Default)]
pub(crate) struct Aggregator {
    /// Of the hierarchical search, the sums of [`crate::window_sweep`].
    pub(crate) sums: AlignedBuffer<u8>,
    sweeps: [Sweep; 2],
    pub(crate) winners: Vec<Winner>,
    pub(crate) right: Vec<u16>,
}

impl Aggregator {
    /// Returns the bytes for images of this size.
    pub(crate) fn bytes(width: usize, height: usize, layout: Layout) -> usize {
        let pixels = width.saturating_mul(height);
        pixels
            .saturating_mul(layout.depth + size_of::<Winner>() + size_of::<u16>())
            .saturating_add(2 * Sweep::bytes(width, layout.depth))
    }

    fn resize(&mut self, width: usize, height: usize, depth: usize) {
        self.sums.resize(width * height * depth, 0);
        self.winners.resize(width * height, Winner::default());
        self.right.resize(width * height, 0);
    }

    /// Allocates the memory of a frame and touches every page of it.
    pub(crate) fn prepare(
        &mut self,
        width: usize,
        height: usize,
        layout: Layout,
        progress: &dyn Progress,
    ) -> Result<(), Cancelled> {
        const PART: usize = 1 << 20;
        self.resize(width, height, layout.depth);
        let sums = self.sums.as_mut_slice();
        let stage = Stage::new(progress, "prepare", sums.len().div_ceil(PART))?;
        sums.par_chunks_mut(PART).try_for_each(|part| {
            part.fill(0);
            stage.add(1)
        })
    }

    /// Computes [`Aggregator::winners`] and [`Aggregator::right`] of the first `rows` rows of the frame. In the rows below, only the paths upwards are followed. A frame with a row
    /// [`above`](Frame::above) continues the last one, below its `rows`. Reports two units of progress per row, one per row below.
    pub(crate) fn run(
        &mut self,
        level: Level,
        frame: &Frame<'_>,
        rows: usize,
        eight: bool,
        stage: &Stage<'_>,
    ) -> Result<(), Cancelled> {
        let width = frame.width;
        let depth = frame.layout.depth;
        self.resize(width, rows, depth);
        let [down, up] = &mut self.sweeps;
        // Rows of the upper half, swept first by `down` and last by `up`.
        let top = rows / 2;
        let bottom = rows - top;
        let below = frame.height - rows;
        let (sums_top, sums_bottom) = self.sums.as_mut_slice().split_at_mut(top * width * depth);
        let (winners_top, winners_bottom) = self.winners.split_at_mut(top * width);
        let (right_top, right_bottom) = self.right.split_at_mut(top * width);
        let run = |state: &mut Sweep, first: usize, steps: usize, output: Output<'_>| -> Result<(), Cancelled> {
            sweep(level, frame, state, first..first + steps, output, eight, stage)
        };
        let (one, other) = rayon::join(
            || {
                if frame.above.is_none() {
                    down.start(frame, false);
                }
                run(down, 0, top, Output::Store(sums_top))
            },
            || {
                up.start(frame, true);
                // The sums of the rows below are not used: they are overwritten.
                for first in (0..below).step_by(bottom.max(1)) {
                    let steps = bottom.min(below - first);
                    run(up, first, steps, Output::Store(&mut sums_bottom[..steps * width * depth]))?;
                }
                run(up, below, bottom, Output::Store(sums_bottom))
            },
        );
        one.and(other)?;
        let (one, other) = rayon::join(
            || {
                run(
                    down,
                    top,
                    bottom,
                    Output::Finish { other: sums_bottom, winners: winners_bottom, right: right_bottom },
                )
            },
            || run(up, below + bottom, top, Output::Finish { other: sums_top, winners: winners_top, right: right_top }),
        );
        one.and(other)
    }
}

/// Runs a sweep over some rows, in its own order; `output` has the same rows.
pub(crate) fn sweep(
    level: Level,
    frame: &Frame<'_>,
    state: &mut Sweep,
    rows: Range<usize>,
    mut output: Output<'_>,
    eight: bool,
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    dispatch!(level, simd => sweep_rows(simd, frame, state, rows.start, rows.len(), &mut output, eight, stage))
}
