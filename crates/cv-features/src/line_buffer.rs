//! Line buffers: the last few rows of an image that is worked from top to bottom.

use cv_imgproc::mirror_index;
use std::ops::Range;

/// The last rows of a part of an image.
pub(crate) struct LineBuffer {
    data: Vec<f32>,
    /// First column.
    pub(crate) from: usize,
    pub(crate) width: usize,
    rows: usize,
}

impl LineBuffer {
    pub(crate) fn new(columns: Range<usize>, rows: usize) -> Self {
        Self { data: vec![0.0; columns.len() * rows], from: columns.start, width: columns.len(), rows }
    }

    /// Makes room for the rows of another part; what they held is left in them.
    pub(crate) fn fit(&mut self, columns: Range<usize>, rows: usize) {
        (self.from, self.width, self.rows) = (columns.start, columns.len(), rows);
        self.data.resize(self.width * rows, 0.0);
    }

    /// Row `y` of the image, from column `from` on.
    #[inline]
    pub(crate) fn row(&self, y: usize) -> &[f32] {
        let start = (y % self.rows) * self.width;
        &self.data[start..start + self.width]
    }

    pub(crate) fn row_mut(&mut self, y: usize) -> &mut [f32] {
        let start = (y % self.rows) * self.width;
        &mut self.data[start..start + self.width]
    }

    /// Columns `a..b` of `count` rows from row `first` on, of an image of `h` rows, mirrored at its ends.
    pub(crate) fn window<'a>(
        &'a self,
        first: isize,
        count: usize,
        h: usize,
        columns: &Range<usize>,
        rows: &mut Vec<&'a [f32]>,
    ) {
        let (a, b) = (columns.start - self.from, columns.end - self.from);
        rows.clear();
        if first >= 0 && first as usize + count <= h {
            let mut slot = first as usize % self.rows;
            for _ in 0..count {
                rows.push(&self.data[slot * self.width..][a..b]);
                slot = if slot + 1 == self.rows { 0 } else { slot + 1 };
            }
        } else {
            rows.extend((0..count).map(|d| &self.row(mirror_index(first + d as isize, h))[a..b]));
        }
    }
}
