//! A printed calibration board: black rectangles on white paper.

/// Disjoint rectangles on a sheet, in meters.
#[derive(Debug, Clone, Default)]
pub struct Print {
    rectangles: Vec<[f32; 4]>,
    /// Indices of the rectangles that intersect a cell of the sheet, row by row.
    cells: Vec<Vec<u32>>,
    /// Width and height of the sheet.
    size: (f32, f32),
}

/// Number of cells along each side.
const CELLS: usize = 48;

impl Print {
    /// Creates a print from left, top, width and height of each rectangle on a sheet of `size`. Overlapping rectangles
    /// would be darker than black.
    pub fn new(rectangles: Vec<[f32; 4]>, size: (f32, f32)) -> Self {
        let mut cells = vec![Vec::new(); CELLS * CELLS];
        let cell = |v: f32, size: f32| ((v / size * CELLS as f32).max(0.0) as usize).min(CELLS - 1);
        for (i, [x, y, w, h]) in rectangles.iter().enumerate() {
            // One cell more on each side, for wide samples.
            let along = |from: f32, to: f32, size: f32| {
                cell(from, size).saturating_sub(1)..=(cell(to, size) + 1).min(CELLS - 1)
            };
            for row in along(*y, y + h, size.1) {
                for column in along(*x, x + w, size.0) {
                    cells[row * CELLS + column].push(i as u32);
                }
            }
        }
        Self { rectangles, cells, size }
    }

    /// Returns the black fraction of a square sample with center `(u, v)` and side `width`.
    pub(crate) fn black_fraction(&self, u: f32, v: f32, width: f32) -> f32 {
        let cell = |v: f32, size: f32| ((v / size * CELLS as f32).max(0.0) as usize).min(CELLS - 1);
        let half = 0.5 * width.max(1e-7);
        let overlap = |center: f32, from: f32, length: f32| {
            ((center + half).min(from + length) - (center - half).max(from)).max(0.0) / (2.0 * half)
        };
        let nearby = self.cells.get(cell(v, self.size.1) * CELLS + cell(u, self.size.0));
        let sum = nearby.into_iter().flatten().filter_map(|i| self.rectangles.get(*i as usize));
        sum.map(|[x, y, w, h]| overlap(u, *x, *w) * overlap(v, *y, *h)).sum::<f32>().min(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_black_fraction_is_the_coverage_of_the_sample() {
        let print = Print::new(vec![[0.1, 0.1, 0.05, 0.05], [0.15, 0.1, 0.02, 0.05]], (0.3, 0.2));
        // Inside, on an edge, on the seam of two rectangles, on a corner, outside.
        for (u, v, black_fraction) in
            [(0.12, 0.12, 1.0), (0.1, 0.12, 0.5), (0.15, 0.12, 1.0), (0.1, 0.1, 0.25), (0.2, 0.12, 0.0)]
        {
            let found = print.black_fraction(u, v, 0.004);
            assert!((found - black_fraction).abs() < 1e-4, "{u} {v}: {found}");
        }
    }
}
