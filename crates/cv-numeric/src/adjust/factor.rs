//! Cholesky factors of the reduced system.

use super::structure::{Pattern, Structure};
use faer::linalg::solvers::{Llt, Solve};
use faer::{Mat, MatMut, Side};

/// A factor `L Lᵀ` of the free columns.
pub(super) struct Factor(Llt<f64>);

impl Factor {
    /// Of the free columns of `s`; `None` where they are not positive definite.
    pub(super) fn new(structure: &Structure, s: &[f64]) -> Option<Self> {
        let free = structure.free;
        let mut full = Mat::<f64>::zeros(free, free);
        for_columns(structure, s, |column, values| {
            full.col_as_slice_mut(column)[column..].copy_from_slice(&values[..free - column]);
        });
        Llt::new(full.as_ref(), Side::Lower).ok().map(Self)
    }

    /// Solves `S x = b` for as many right sides as there are, in place.
    pub(super) fn solve(&self, columns: usize, b: &mut [f64]) {
        if columns > 0 && !b.is_empty() {
            let right = b.len() / columns;
            self.0.solve_in_place(MatMut::from_column_major_slice_mut(b, columns, right));
        }
    }
}

/// Calls `visit` with each free column of the lower triangle: its number and its values, from the diagonal down.
fn for_columns(structure: &Structure, s: &[f64], mut visit: impl FnMut(usize, &[f64])) {
    let Pattern { start, height, .. } = &structure.pattern;
    for (b, block) in structure.blocks.iter().enumerate().take_while(|(_, b)| b.column < structure.free) {
        for c in 0..block.size {
            visit(block.column + c, &s[start[b] + c * height[b]..][c..height[b]]);
        }
    }
}
