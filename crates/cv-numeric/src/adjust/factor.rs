//! Cholesky factorization of the reduced system by faer: dense, or sparse with one symbolic analysis.

use super::structure::{Pattern, Structure};
use faer::linalg::solvers::{Llt, Solve};
use faer::sparse::linalg::solvers::{Llt as SparseLlt, SymbolicLlt};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMat};
use faer::{Mat, MatMut, Side};

/// Symbolic analysis of a reduced system: elimination order and fill-in.
pub(super) enum Analysis {
    Dense,
    /// Sparsity pattern of the lower triangle (compressed columns), and its symbolic factor.
    Sparse {
        symbolic: SymbolicSparseColMat<usize>,
        factor: SymbolicLlt<usize>,
    },
}

/// A factor `L Lᵀ`.
pub(super) enum Factor {
    Dense(Llt<f64>),
    Sparse(SparseLlt<usize, f64>),
}

impl Analysis {
    /// Analyzes the free columns of the reduced system; `None` where memory is insufficient.
    pub(super) fn new(structure: &Structure) -> Option<Self> {
        if structure.pattern.dense {
            return Some(Self::Dense);
        }
        let free = structure.free;
        let mut start = Vec::with_capacity(free + 1);
        start.push(0);
        let mut rows = Vec::new();
        for (b, block) in structure.blocks.iter().enumerate().take_while(|(_, b)| b.column < free) {
            let first = rows.len();
            for &(other, _) in &structure.pattern.rows[b] {
                let other = &structure.blocks[other as usize];
                if other.column < free {
                    rows.extend(other.column..other.column + other.size);
                }
            }
            let all = rows[first..].to_vec();
            rows.truncate(first);
            for c in 0..block.size {
                rows.extend_from_slice(&all[c..]);
                start.push(rows.len());
            }
        }
        let symbolic = SymbolicSparseColMat::new_checked(free, free, start, None, rows);
        let factor = SymbolicLlt::try_new(symbolic.as_ref(), Side::Lower).ok()?;
        Some(Self::Sparse { symbolic, factor })
    }

    /// Factors the free columns of `s`; `None` where they are not positive definite.
    pub(super) fn factor(&self, structure: &Structure, s: &[f64]) -> Option<Factor> {
        match self {
            Self::Dense => {
                let free = structure.free;
                let mut full = Mat::<f64>::zeros(free, free);
                for_each_column(structure, s, |column, values| {
                    let height = free - column;
                    full.col_as_slice_mut(column)[column..].copy_from_slice(&values[..height]);
                });
                Llt::new(full.as_ref(), Side::Lower).ok().map(Factor::Dense)
            }
            Self::Sparse { symbolic, factor } => {
                let mut values = Vec::with_capacity(symbolic.row_idx().len());
                let starts = symbolic.col_ptr();
                for_each_column(structure, s, |column, of| {
                    // Rows of considered columns are last and left out.
                    values.extend_from_slice(&of[..starts[column + 1] - starts[column]]);
                });
                let matrix = SparseColMatRef::new(symbolic.as_ref(), &values);
                SparseLlt::try_new_with_symbolic(factor.clone(), matrix, Side::Lower).ok().map(Factor::Sparse)
            }
        }
    }
}

impl Factor {
    /// Solves `S x = b` in place for all right-hand sides, `b.len() / columns` of them.
    pub(super) fn solve(&self, columns: usize, b: &mut [f64]) {
        if columns == 0 || b.is_empty() {
            return;
        }
        let right = b.len() / columns;
        match self {
            Self::Dense(factor) => factor.solve_in_place(MatMut::from_column_major_slice_mut(b, columns, right)),
            Self::Sparse(factor) => factor.solve_in_place(MatMut::from_column_major_slice_mut(b, columns, right)),
        }
    }
}

/// Calls `visit` with each free column of the lower triangle: its index and its values from the diagonal down.
fn for_each_column(structure: &Structure, s: &[f64], mut visit: impl FnMut(usize, &[f64])) {
    let Pattern { start, height, .. } = &structure.pattern;
    for (b, block) in structure.blocks.iter().enumerate().take_while(|(_, b)| b.column < structure.free) {
        for c in 0..block.size {
            visit(block.column + c, &s[start[b] + c * height[b]..][c..height[b]]);
        }
    }
}
