//! In which order the disparities of a pixel lie in memory.
//!
//! They come in groups of 64 or 128, and within a group neighboring disparities lie in neighboring vectors rather than
//! lanes: of `n` vectors, lane `l` of vector `v` holds disparity `l·n + v`. A path that looks one disparity up and one
//! down then finds both in vectors it has at hand, and moves lanes only at the two ends of a group.

use fearless_simd::{Level, dispatch, prelude::*};

/// Disparities come in multiples of so many: a cache line, one to four vectors.
pub(crate) const BLOCK: usize = 64;

/// Most vectors in a group, those of 16 bytes.
pub(crate) const MAX_VECTORS: usize = 2 * BLOCK / 16;

/// The order for a number of disparities and an instruction set.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Layout {
    /// Bytes of a vector.
    pub(crate) lanes: usize,
    /// Disparities per group: one block or two.
    pub(crate) group: usize,
    /// Disparities with those that only pad.
    pub(crate) depth: usize,
}

impl Layout {
    pub(crate) fn new(level: Level, disparities: usize) -> Self {
        let blocks = disparities.div_ceil(BLOCK);
        let lanes = dispatch!(level, simd => lanes(simd));
        Self { lanes, group: if blocks.is_multiple_of(2) { 2 * BLOCK } else { BLOCK }, depth: blocks * BLOCK }
    }

    /// Vectors per group.
    pub(crate) fn vectors(&self) -> usize {
        self.group / self.lanes
    }

    /// Number of groups.
    pub(crate) fn groups(&self) -> usize {
        self.depth / self.group
    }

    /// Elements of each phase of a row of the right image: element `j` of the mirrored row has phase `j % n`, so that the
    /// candidates of a pixel for one vector lie side by side.
    pub(crate) fn phase(&self, width: usize) -> usize {
        width / self.vectors() + 1 + self.depth / self.vectors()
    }

    /// Bytes per row and plane of the right image.
    pub(crate) fn right_row(&self, width: usize) -> usize {
        self.vectors() * self.phase(width)
    }
}

#[inline(always)]
fn lanes<S: Simd>(_: S) -> usize {
    S::u8s::LEN
}

/// Where index `k` lies among the disparities of a pixel.
#[inline(always)]
pub(crate) fn place(k: usize, group: usize, lanes: usize) -> usize {
    let n = group / lanes;
    let rest = k % group;
    k - rest + (rest % n) * lanes + rest / n
}
