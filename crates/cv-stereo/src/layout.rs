//! Memory layout of the disparities of a pixel.
//!
//! Disparities are stored in groups of 64 or 128. Within a group, neighboring disparities are in neighboring vectors rather than lanes:
//! of `n` vectors, lane `l` of vector `v` has disparity `l·n + v`. The disparities one above and one below those of a vector are then
//! those of the vectors beside it, and lanes are shifted only at the two ends of a group.

use fearless_simd::{Level, dispatch, prelude::*};

/// The number of disparities is padded to a multiple of this: a cache line, one to four vectors.
pub(crate) const BLOCK: usize = 64;

/// Maximum number of vectors in a group, those of 16 bytes.
pub(crate) const MAX_VECTORS: usize = 2 * BLOCK / 16;

/// The layout for a number of disparities and an instruction set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Layout {
    /// Bytes of a vector.
    pub(crate) lanes: usize,
    /// Disparities per group: one block or two.
    pub(crate) group: usize,
    /// Disparities, padding included.
    pub(crate) depth: usize,
}

impl Layout {
    pub(crate) fn new(level: Level, disparities: usize) -> Self {
        let blocks = disparities.div_ceil(BLOCK);
        let lanes = dispatch!(level, simd => lanes(simd));
        Self { lanes, group: if blocks.is_multiple_of(2) { 2 * BLOCK } else { BLOCK }, depth: blocks * BLOCK }
    }

    /// Returns a layout of this depth whose groups are single vectors: disparities are contiguous.
    pub(crate) fn contiguous(self) -> Self {
        Self { lanes: BLOCK, group: BLOCK, ..self }
    }

    /// Returns the vectors per group.
    pub(crate) fn vectors(&self) -> usize {
        self.group / self.lanes
    }

    /// Returns the number of groups.
    pub(crate) fn groups(&self) -> usize {
        self.depth / self.group
    }

    /// Returns the elements of each phase of a row of the right image: element `j` of the mirrored row has phase `j % n`, so that the
    /// candidates of a pixel for one vector are contiguous.
    pub(crate) fn phase(&self, width: usize) -> usize {
        width / self.vectors() + 1 + self.depth / self.vectors()
    }

    /// Returns the bytes per row and plane of the right image.
    pub(crate) fn right_row(&self, width: usize) -> usize {
        self.vectors() * self.phase(width)
    }
}

#[inline(always)]
fn lanes<S: Simd>(_: S) -> usize {
    S::u8s::LEN
}

/// Returns the position of disparity index `k` in memory.
#[inline(always)]
pub(crate) fn place(k: usize, group: usize, lanes: usize) -> usize {
    let n = group / lanes;
    let rest = k % group;
    k - rest + (rest % n) * lanes + rest / n
}
