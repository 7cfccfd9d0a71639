//! Black rectangles on white paper: a printed calibration board.

/// Rectangles that do not overlap, on a sheet; meters.
#[derive(Debug, Clone, Default)]
pub struct Print {
    rectangles: Vec<[f32; 4]>,
    /// Indices of the rectangles that touch a cell of the sheet, by row and column of cells.
    cells: Vec<Vec<u32>>,
    /// Width and height of the sheet.
    size: (f32, f32),
}

/// Cells along each side.
const CELLS: usize = 48;

impl Print {
    /// From left, top, width and height of each rectangle on a sheet of `size`, from its corner; rectangles that overlap would be darker than black.
    pub fn new(rectangles: Vec<[f32; 4]>, size: (f32, f32)) -> Self {
        let mut cells = vec![Vec::new(); CELLS * CELLS];
        let cell = |v: f32, size: f32| ((v / size * CELLS as f32).max(0.0) as usize).min(CELLS - 1);
        for (i, [x, y, w, h]) in rectangles.iter().enumerate() {
            // One cell more to each side, for samples that are wide.
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

    /// The share of a square of side `width` about a place that is black.
    pub(crate) fn black(&self, u: f32, v: f32, width: f32) -> f32 {
        let cell = |v: f32, size: f32| ((v / size * CELLS as f32).max(0.0) as usize).min(CELLS - 1);
        let half = 0.5 * width.max(1e-7);
        let overlap = |at: f32, from: f32, length: f32| {
            ((at + half).min(from + length) - (at - half).max(from)).max(0.0) / (2.0 * half)
        };
        let near = self.cells.get(cell(v, self.size.1) * CELLS + cell(u, self.size.0));
        let sum = near.into_iter().flatten().filter_map(|i| self.rectangles.get(*i as usize));
        sum.map(|[x, y, w, h]| overlap(u, *x, *w) * overlap(v, *y, *h)).sum::<f32>().min(1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn black_is_the_share_of_the_sample_that_rectangles_cover() {
        let print = Print::new(vec![[0.1, 0.1, 0.05, 0.05], [0.15, 0.1, 0.02, 0.05]], (0.3, 0.2));
        // Inside, over an edge at half, over a seam, over a corner at a quarter, outside.
        for (u, v, black) in
            [(0.12, 0.12, 1.0), (0.1, 0.12, 0.5), (0.15, 0.12, 1.0), (0.1, 0.1, 0.25), (0.2, 0.12, 0.0)]
        {
            let found = print.black(u, v, 0.004);
            assert!((found - black).abs() < 1e-4, "{u} {v}: {found}");
        }
    }
}
