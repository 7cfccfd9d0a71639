//! Line buffers: ring buffers of the last rows of an image processed from top to bottom.

use cv_imgproc::mirror_index;
use std::ops::Range;

/// A ring buffer of rows of a range of columns.
pub(crate) struct LineBuffer {
    data: Vec<f32>,
    /// First column of the range.
    pub(crate) from: usize,
    pub(crate) width: usize,
    rows: usize,
}

impl LineBuffer {
    pub(crate) fn new(columns: Range<usize>, rows: usize) -> Self {
        Self { data: vec![0.0; columns.len() * rows], from: columns.start, width: columns.len(), rows }
    }

    /// Resizes for another range of columns and number of rows; the contents are unspecified.
    pub(crate) fn resize(&mut self, columns: Range<usize>, rows: usize) {
        (self.from, self.width, self.rows) = (columns.start, columns.len(), rows);
        self.data.resize(self.width * rows, 0.0);
    }

    /// Returns row `y` of the image, from column `from`.
    #[inline]
    pub(crate) fn row(&self, y: usize) -> &[f32] {
        let start = (y % self.rows) * self.width;
        &self.data[start..start + self.width]
    }

    pub(crate) fn row_mut(&mut self, y: usize) -> &mut [f32] {
        let start = (y % self.rows) * self.width;
        &mut self.data[start..start + self.width]
    }

    /// Collects columns `columns` of `count` rows from row `first` of an image with `h` rows, mirrored at the border.
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
