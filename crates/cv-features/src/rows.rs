//! Rows, their borders, and rings of the last few of them.

use std::ops::Range;

/// Index `i` of a row of `n` mirrored about its end samples (`dcb|abcd|cba`, OpenCV's BORDER_REFLECT_101).
#[inline]
pub(crate) fn mirror(i: isize, n: usize) -> usize {
    if (0..n as isize).contains(&i) {
        return i as usize;
    }
    if n == 1 {
        return 0;
    }
    let n = n as isize;
    let period = 2 * (n - 1);
    let i = i.rem_euclid(period);
    (if i < n { i } else { period - i }) as usize
}

/// Fills the first `left` and the last `right` samples with the mirror image of what lies between.
pub(crate) fn mirror_ends(padded: &mut [f32], left: usize, right: usize) {
    let w = padded.len() - left - right;
    for k in 1..=left {
        padded[left - k] = padded[left + mirror(-(k as isize), w)];
    }
    for k in 1..=right {
        padded[left + w - 1 + k] = padded[left + mirror((w - 1 + k) as isize, w)];
    }
}

/// The last rows of a part of an image.
pub(crate) struct Ring {
    data: Vec<f32>,
    /// First column.
    pub(crate) from: usize,
    pub(crate) width: usize,
    rows: usize,
}

impl Ring {
    pub(crate) fn new(columns: Range<usize>, rows: usize) -> Self {
        Self { data: vec![0.0; columns.len() * rows], from: columns.start, width: columns.len(), rows }
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

    /// Columns `a..b` of the rows `y − r` to `y + r` of an image of `h` rows, mirrored at its ends.
    pub(crate) fn window<'a>(
        &'a self,
        y: usize,
        r: usize,
        h: usize,
        columns: &Range<usize>,
        rows: &mut Vec<&'a [f32]>,
    ) {
        let (a, b) = (columns.start - self.from, columns.end - self.from);
        rows.clear();
        if y >= r && y + r < h {
            let mut slot = (y - r) % self.rows;
            for _ in 0..=2 * r {
                rows.push(&self.data[slot * self.width..][a..b]);
                slot = if slot + 1 == self.rows { 0 } else { slot + 1 };
            }
        } else {
            rows.extend((0..=2 * r).map(|d| &self.row(mirror((y + d) as isize - r as isize, h))[a..b]));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mirrors_as_often_as_it_takes() {
        let seen: Vec<usize> = (-5..7).map(|i| mirror(i, 3)).collect();
        assert_eq!(seen, [1, 0, 1, 2, 1, 0, 1, 2, 1, 0, 1, 2]);
        assert_eq!((mirror(-3, 1), mirror(4, 1)), (0, 0));
        let mut row = [0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 0.0, 0.0];
        mirror_ends(&mut row, 3, 2);
        assert_eq!(row, [2.0, 3.0, 2.0, 1.0, 2.0, 3.0, 2.0, 1.0]);
    }
}
