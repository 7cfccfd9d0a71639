//! Edges between the cells of a grid, and their coarsening.

use crate::rows::is_check_due;
use cv_core::{Cancelled, Stage};

/// Weights of the edges of each cell to the right and below, 0 where there is none.
pub(crate) struct GridEdges {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) right: Vec<f32>,
    pub(crate) down: Vec<f32>,
}

impl GridEdges {
    /// Creates a grid without edges.
    pub(crate) fn new(width: usize, height: usize) -> Self {
        let n = width * height;
        Self { width, height, right: vec![0.0; n], down: vec![0.0; n] }
    }

    /// Coarsens to half resolution. The weight of an edge between two cells is half the sum of the fine edges between them (number over doubled distance).
    pub(crate) fn coarser(&self, stage: &Stage<'_>) -> Result<Self, Cancelled> {
        let (w, h) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut coarse = Self::new(w, h);
        for y in 0..self.height {
            if is_check_due(y, self.width) {
                stage.check()?;
            }
            let (fine, out) = (y * self.width..(y + 1) * self.width, y / 2 * w..(y / 2 + 1) * w);
            for (out, pair) in coarse.right[out.clone()].iter_mut().zip(self.right[fine.clone()].as_chunks::<2>().0) {
                *out += 0.5 * pair[1];
            }
            if y % 2 == 1 {
                let (pairs, last) = self.down[fine].as_chunks::<2>();
                let sums = pairs.iter().map(|pair| pair[0] + pair[1]).chain(last.iter().copied());
                coarse.down[out].iter_mut().zip(sums).for_each(|(out, sum)| *out = 0.5 * sum);
            }
        }
        Ok(coarse)
    }

    /// Returns the weights of the edges to the right, left, below and above.
    fn weights(&self, x: usize, y: usize) -> [f32; 4] {
        let i = y * self.width + x;
        let left = if x > 0 { self.right[i - 1] } else { 0.0 };
        [self.right[i], left, self.down[i], if y > 0 { self.down[i - self.width] } else { 0.0 }]
    }

    /// Returns the sum of the edge weights of a cell.
    pub(crate) fn total(&self, x: usize, y: usize) -> f32 {
        self.weights(x, y).iter().sum()
    }

    /// Returns whether all four edges of a cell have weight 1.
    pub(crate) fn is_uniform(&self, x: usize, y: usize) -> bool {
        self.weights(x, y) == [1.0; 4]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::stage;

    #[test]
    fn an_edge_between_cells_counts_the_edges_between_their_children_at_half_weight() {
        let mut fine = GridEdges::new(5, 3);
        for (x, y) in (0..3).flat_map(|y| (0..5).map(move |x| (x, y))) {
            fine.right[5 * y + x] = f32::from(x < 4);
            fine.down[5 * y + x] = f32::from(y < 2);
        }
        fine.right[1] = 0.0;
        let coarse = fine.coarser(&stage()).unwrap();
        assert_eq!((coarse.width, coarse.height), (3, 2));
        // One of two edges is missing; the last row and column have cells of half the size.
        assert_eq!(coarse.right, [0.5, 1.0, 0.0, 0.5, 0.5, 0.0]);
        assert_eq!(coarse.down, [1.0, 1.0, 0.5, 0.0, 0.0, 0.0]);
        assert!(fine.is_uniform(3, 1) && !fine.is_uniform(1, 0) && !fine.is_uniform(4, 1));
        assert_eq!([coarse.total(1, 0), coarse.total(2, 1)], [2.5, 1.0]);
    }
}
