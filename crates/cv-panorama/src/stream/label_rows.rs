//! Label images of large canvases, as runs of equal labels.

use crate::blend::NO_PHOTO;
use crate::surface::Bounds;
use cv_core::Image;

/// Labels of a canvas, run-length encoded by rows: memory by the length of the seams instead of the number of pixels.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LabelRows {
    width: usize,
    /// Of each row the runs in order: the column after the last, and the label.
    rows: Vec<Vec<(u32, u16)>>,
}

impl LabelRows {
    /// Creates labels without rows.
    pub(crate) fn new(width: usize) -> Self {
        Self { width, rows: Vec::new() }
    }

    pub(crate) fn size(&self) -> (usize, usize) {
        (self.width, self.rows.len())
    }

    /// Appends the rows of an image of the same width.
    pub(crate) fn append(&mut self, labels: &Image<u16, 1>) {
        self.rows.extend((0..labels.height()).map(|y| runs(0, labels.row(y)).collect()));
    }

    /// Writes the labels of a row, from column `left`.
    pub(crate) fn read_row(&self, y: usize, left: usize, out: &mut [u16]) {
        let right = left + out.len();
        let mut x = left;
        let row = &self.rows[y];
        let first = row.partition_point(|run| run.0 as usize <= left);
        for &(end, label) in &row[first..] {
            let end = (end as usize).min(right);
            out[x - left..end - left].fill(label);
            x = end;
            if x == right {
                break;
            }
        }
    }

    /// Returns the labels of a part of the canvas.
    pub(crate) fn window(&self, bounds: Bounds) -> Image<u16, 1> {
        let mut labels = Image::new(bounds.width(), bounds.height(), [NO_PHOTO]);
        (0..bounds.height()).for_each(|y| self.read_row(bounds.top + y, bounds.left, labels.row_mut(y)));
        labels
    }

    /// Replaces the labels of a row, from column `left`.
    pub(crate) fn write_row(&mut self, y: usize, left: usize, labels: &[u16]) {
        let (row, right) = (&self.rows[y], left + labels.len());
        let mut merged: Vec<(u32, u16)> = Vec::with_capacity(row.len() + 4);
        let mut push = |end: usize, label: u16| match merged.last_mut() {
            Some(last) if last.1 == label => last.0 = end as u32,
            _ => merged.push((end as u32, label)),
        };
        let mut start = 0;
        for &(end, label) in row {
            if start < left {
                push((end as usize).min(left), label);
            }
            start = end as usize;
        }
        runs(left, labels).for_each(|(end, label)| push(end as usize, label));
        for &(end, label) in row.iter().filter(|run| run.0 as usize > right) {
            push(end as usize, label);
        }
        self.rows[y] = merged;
    }

    /// Returns the memory in bytes.
    #[cfg(test)]
    fn bytes(&self) -> usize {
        self.rows.iter().map(|row| row.len() * size_of::<(u32, u16)>()).sum()
    }
}

/// Returns the runs of labels that begin at column `left`.
fn runs(left: usize, labels: &[u16]) -> impl Iterator<Item = (u32, u16)> {
    let mut end = left;
    labels.chunk_by(|a, b| a == b).map(move |run| {
        end += run.len();
        (end as u32, run[0])
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn windows_and_rows_are_those_of_the_image(labels in proptest::collection::vec(0..3_u16, 60), new in proptest::collection::vec(0..3_u16, 1..12), left in 0..12_usize, y in 0..5_usize) {
            let mut plain = Image::from_fn(12, 5, |x, y| [labels[12 * y + x]]);
            let mut rows = LabelRows::new(12);
            rows.append(&plain);
            let new = &new[..new.len().min(12 - left)];
            rows.write_row(y, left, new);
            plain.row_mut(y)[left..left + new.len()].copy_from_slice(new);
            let whole = Bounds { left: 0, top: 0, right: 12, bottom: 5 };
            prop_assert_eq!(&rows.window(whole), &plain);
            let part = Bounds { left: left.min(10), top: y.min(3), right: 12, bottom: 5 };
            let expected = Image::from_fn(part.width(), part.height(), |x, y| plain.at(part.left + x, part.top + y));
            prop_assert_eq!(rows.window(part), expected);
            // Equal neighbors are one run.
            let mut anew = LabelRows::new(12);
            anew.append(&plain);
            prop_assert_eq!(rows, anew);
        }
    }

    #[test]
    fn memory_grows_with_the_seams_only() {
        let mut rows = LabelRows::new(10_000);
        rows.append(&Image::from_fn(10_000, 10, |x, _| [u16::from(x > 5000)]));
        assert_eq!(rows.bytes(), 10 * 2 * 8);
    }
}
