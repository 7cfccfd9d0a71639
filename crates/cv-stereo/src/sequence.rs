//! Consecutive frames: noise is averaged over time where an image does not change.
//!
//! A recursive filter (temporal noise reduction, as in video cameras; Brailean et al., "Noise reduction filters for dynamic image sequences",
//! Proc. IEEE 1995): a pixel of a static cell becomes the weighted mean of its value and the filtered one of the previous frame. Both views
//! are filtered by themselves, before matching. No disparity is carried from frame to frame: errors do not persist, and what has moved
//! leaves no trail. (On generated sequences with a moving object, the previous disparity as a prior of static pixels left more errors at
//! normal exposure, 0.86 % against 0.83, where this filter leaves 0.81; at one stop less 1.28 and 1.23 against 1.37.)

use crate::census::{Gray, MARGIN};
use cv_parallel::prelude::*;

/// Side of a cell in px, and of the parts of a cell whose means are compared.
const CELL: usize = 8;
const PART: usize = 4;
/// Weight of the new frame, of 256: noise of independent frames falls to 0.42.
const NEW_WEIGHT: i32 = 77;
/// Gray levels (of 65535): range of the noise estimate (mean absolute difference of frames).
const NOISE_RANGE: (u32, u32) = (80, 1300);
/// A cell has changed if its mean absolute difference is above this multiple of the noise, or the mean difference of a part: six standard
/// deviations of noise.
const MAX_DIFFERENCE: f32 = 1.7;
const MAX_PART_DIFFERENCE: f32 = 1.6;
/// A cell is textured if the mean absolute difference of horizontal neighbors is above this multiple of the noise.
const TEXTURED: f32 = 2.5;
/// Fraction of changed textured cells above which the camera moved, or the scene was cut.
const MAX_CHANGED: f32 = 0.5;

/// The previous frame of one view.
#[derive(Debug, Default)]
pub(crate) struct View {
    /// Filtered gray levels, in the layout of [`Gray`].
    previous: Vec<u16>,
    size: (usize, usize),
    cells: Vec<Cell>,
    /// Whether each cell is static.
    is_static: Vec<bool>,
    columns: usize,
}

#[derive(Debug, Default, Clone, Copy)]
struct Cell {
    /// Mean absolute difference from the previous frame, the largest absolute mean difference of a part, and the mean absolute difference of
    /// horizontal neighbors.
    difference: u32,
    part_difference: u32,
    texture: u32,
}

impl View {
    /// Starts a new sequence.
    pub(crate) fn forget(&mut self) {
        self.previous.clear();
    }

    /// Filters the next frame in place. The first one, and one after a cut, is not changed.
    pub(crate) fn filter(&mut self, gray: &mut Gray) {
        let size = (gray.width, gray.height);
        let stride = gray.stride();
        let is_next = self.size == size && self.previous.len() == gray.values.len();
        let is_next = is_next && self.classify(gray);
        if is_next {
            let (columns, is_static) = (self.columns, &self.is_static);
            let rows = gray.values.par_chunks_mut(stride).zip(self.previous.par_chunks(stride));
            rows.enumerate().for_each(|(y, (row, previous))| {
                let cells = &is_static[y / CELL * columns..][..columns];
                let pixels = row[MARGIN..].chunks_mut(CELL).zip(previous[MARGIN..].chunks(CELL));
                for ((now, before), _) in pixels.zip(cells).filter(|(_, is_static)| **is_static) {
                    for (now, &before) in now.iter_mut().zip(before) {
                        let step = i32::from(*now) - i32::from(before);
                        *now = (i32::from(before) + (step * NEW_WEIGHT + 128).div_euclid(256)) as u16;
                    }
                }
                let (first, last) = (row[MARGIN], row[MARGIN + size.0 - 1]);
                row[..MARGIN].fill(first);
                row[MARGIN + size.0..].fill(last);
            });
        }
        self.size = size;
        self.previous.clear();
        self.previous.extend_from_slice(&gray.values);
    }

    /// Sets which cells are static. Returns false if most of the texture changed.
    fn classify(&mut self, gray: &Gray) -> bool {
        let (width, height, stride) = (gray.width, gray.height, gray.stride());
        self.columns = width.div_ceil(CELL);
        let (columns, rows) = (self.columns, height.div_ceil(CELL));
        self.cells.resize(columns * rows, Cell::default());
        let previous = &self.previous;
        self.cells.par_chunks_mut(columns).enumerate().for_each(|(cy, cells)| {
            for (cx, cell) in cells.iter_mut().enumerate() {
                let (mut difference, mut texture, mut count) = (0, 0, 0);
                let mut parts = [(0i32, 0u32); 4];
                for y in cy * CELL..((cy + 1) * CELL).min(height) {
                    let from = y * stride + MARGIN + cx * CELL;
                    let n = CELL.min(width - cx * CELL);
                    let (now, next, before) = (&gray.values[from..], &gray.values[from + 1..], &previous[from..]);
                    let upper = (y - cy * CELL) / PART * 2;
                    for half in 0..2 {
                        let part = half * PART..n.clamp(half * PART, (half + 1) * PART);
                        let (now, next, before) = (&now[part.clone()], &next[part.clone()], &before[part]);
                        let mut sum = 0;
                        for ((now, next), before) in now.iter().zip(next).zip(before) {
                            let step = i32::from(*now) - i32::from(*before);
                            sum += step;
                            difference += step.unsigned_abs();
                            texture += u32::from(now.abs_diff(*next));
                        }
                        parts[upper + half].0 += sum;
                        parts[upper + half].1 += now.len() as u32;
                        count += now.len() as u32;
                    }
                }
                let part_difference = parts.iter().map(|(sum, n)| sum.unsigned_abs() / (*n).max(1)).max();
                *cell = Cell {
                    difference: difference / count,
                    part_difference: part_difference.unwrap_or(0),
                    texture: texture / count,
                };
            }
        });
        let quantile = |of: fn(&Cell) -> u32, part: usize| {
            let mut values: Vec<u32> = self.cells.iter().map(of).collect();
            let at = values.len() / part;
            *values.select_nth_unstable(at).1
        };
        let noise = quantile(|cell| cell.difference, 4).min(quantile(|cell| cell.texture, 10));
        let noise = noise.clamp(NOISE_RANGE.0, NOISE_RANGE.1) as f32;
        let changed = |cell: &Cell| {
            cell.difference as f32 > MAX_DIFFERENCE * noise + 64.0
                || cell.part_difference as f32 > MAX_PART_DIFFERENCE * noise + 64.0
        };
        let (mut textured, mut moved) = (0, 0);
        for cell in self.cells.iter().filter(|cell| cell.texture as f32 > TEXTURED * noise) {
            textured += 1;
            moved += usize::from(changed(cell));
        }
        if moved as f32 > MAX_CHANGED * textured as f32 {
            return false;
        }
        self.is_static.clear();
        self.is_static.resize(columns * rows, true);
        for (i, _) in self.cells.iter().enumerate().filter(|(_, cell)| changed(cell)) {
            // With its neighbors: what moved reaches into them.
            let (x, y) = (i % columns, i / columns);
            for y in y.saturating_sub(1)..(y + 2).min(rows) {
                self.is_static[y * columns + x.saturating_sub(1)..y * columns + (x + 2).min(columns)].fill(false);
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A scene with texture and a flat part, shifted, with noise of two levels of 255.
    fn frame(shift: usize, seed: usize) -> Gray {
        let hash = |x: usize, y: usize| ((x * 7919 + y * 104_729) as u32).wrapping_mul(2_654_435_761) >> 8;
        let (width, height) = (96, 64);
        let mut gray = Gray { values: Vec::new(), width, height };
        for y in 0..height {
            let row = (0..width).map(|x| {
                let scene = if x < 40 { 90 } else { 60 + hash((x + shift) / 3, y / 3) % 90 };
                let noise = (0..4).map(|i| hash(x + 1000 * i + 5000 * seed, y) % 512).sum::<u32>();
                (scene * 257 + noise) as u16
            });
            let row: Vec<u16> = row.collect();
            gray.values.extend([row[0]; MARGIN]);
            gray.values.extend_from_slice(&row);
            gray.values.extend([row[width - 1]; MARGIN]);
        }
        gray
    }

    fn deviation(a: &Gray, b: &Gray) -> f64 {
        let squares = a.values.iter().zip(&b.values).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2));
        (squares.sum::<f64>() / a.values.len() as f64).sqrt()
    }

    #[test]
    fn noise_of_static_frames_is_averaged() {
        let mut view = View::default();
        let filtered: Vec<Gray> = (0..12)
            .map(|seed| {
                let mut gray = frame(0, seed);
                view.filter(&mut gray);
                gray
            })
            .collect();
        assert_eq!(filtered[0].values, frame(0, 0).values);
        let (before, after) = (deviation(&frame(0, 10), &frame(0, 11)), deviation(&filtered[7], &filtered[11]));
        // Four frames apart 0.4 of the noise is left, of which a quarter is common.
        assert!(after < 0.5 * before, "{after} {before}");
    }

    #[test]
    fn changed_parts_and_frames_after_a_cut_stay_as_they_are() {
        let mut view = View::default();
        view.filter(&mut frame(0, 0));
        // The camera moved: the flat part has not changed, but nothing proves it.
        let mut moved = frame(5, 1);
        view.filter(&mut moved);
        assert_eq!(moved.values, frame(5, 1).values);
        // A small object appears.
        let mut next = frame(5, 2);
        let is_object = |x: usize, y: usize| (50..62).contains(&x) && (20..30).contains(&y);
        let stride = next.stride();
        for (x, y) in (0..64).flat_map(|y| (0..96).map(move |x| (x, y))).filter(|&(x, y)| is_object(x, y)) {
            next.values[y * stride + MARGIN + x] = 60_000;
        }
        let plain = next.values.clone();
        view.filter(&mut next);
        for (x, y) in (0..64).flat_map(|y| (0..96).map(move |x| (x, y))) {
            let i = y * stride + MARGIN + x;
            if is_object(x, y) {
                assert_eq!(next.values[i], 60_000);
            }
            // A cell away everything is averaged.
            if !(32..80).contains(&x) {
                let mean = (f64::from(plain[i]) * 77.0 + f64::from(moved.values[i]) * 179.0) / 256.0;
                assert!((f64::from(next.values[i]) - mean).abs() <= 1.0);
            }
        }
        view.forget();
        let mut first = frame(5, 3);
        view.filter(&mut first);
        assert_eq!(first.values, frame(5, 3).values);
    }
}
