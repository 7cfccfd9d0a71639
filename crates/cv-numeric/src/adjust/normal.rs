//! The normal equations of a problem where it stands, and the reduced system that is left of them without the eliminated blocks.

use super::residual::{ColumnSums, Kind, LossModel, PointSums, ResidualSums, Rows, Values};
use super::structure::{Points, Structure};
use crate::linear::cholesky_lower;
use nalgebra::{Cholesky, DMatrix, SMatrix};
use rayon::prelude::*;

/// A point near infinity has next to no depth information: this share of the trace keeps it where it is.
pub(super) const FLOOR: f64 = 1e-12;
/// Below this share of the trace, a pivot of an eliminated block is rounding.
const RANK: f64 = 1e-15;

/// The normal equations `H δ = −g`, `H = Σ w JᵀJ`, `g = Σ w Jᵀr`, as `[U Wᵀ; W V]` with `V` of the eliminated blocks.
#[derive(Debug, Clone, Default)]
pub(super) struct Normal {
    rows: Vec<Rows>,
    /// Sums over each kind of residuals.
    pub(super) sums: Vec<ResidualSums>,
    /// Values of [`super::structure::Pattern`].
    u: Vec<f64>,
    /// Gradient by the reduced system's columns.
    pub(super) gradient: Vec<f64>,
    /// Diagonal of `u`.
    pub(super) diagonal: Vec<f64>,
    pub(super) v: Vec<f64>,
    pub(super) point_gradient: Vec<f64>,
    w: Vec<f64>,
}

/// The reduced system `S δ = −g` for some damping.
#[derive(Debug, Clone, Default)]
pub(super) struct Reduced {
    /// `S`, values of [`super::structure::Pattern`].
    pub(super) s: Vec<f64>,
    pub(super) gradient: Vec<f64>,
    /// Inverses of the damped `V`.
    inverses: Vec<f64>,
}

impl Normal {
    /// Where a residual is not defined, its kind and number.
    pub(super) fn linearize(
        &mut self,
        kinds: &[Box<dyn Kind + '_>],
        structure: &Structure,
        values: &Values,
        model: LossModel,
    ) -> Result<(), (usize, usize)> {
        self.rows.resize_with(kinds.len(), Rows::default);
        self.sums.clear();
        for (k, (kind, rows)) in kinds.iter().zip(&mut self.rows).enumerate() {
            let sums = kind.linearize(values, &structure.links[k], model, rows).map_err(|item| (k, item))?;
            self.sums.push(sums);
        }
        if let Some(points) = &structure.points {
            self.sum_points(kinds, structure, points);
        }
        self.sum_blocks(kinds, structure);
        Ok(())
    }

    pub(super) fn cost(&self) -> f64 {
        self.sums.iter().map(|s| s.cost).sum()
    }

    fn sum_points(&mut self, kinds: &[Box<dyn Kind + '_>], structure: &Structure, points: &Points) {
        let e = points.size;
        zero(&mut self.v, points.count * e * e);
        zero(&mut self.point_gradient, points.count * e);
        zero(&mut self.w, points.start[points.count]);
        let w = slices(&mut self.w, &points.start);
        let rows = &self.rows;
        let parts = self.v.par_chunks_mut(e * e).zip(self.point_gradient.par_chunks_mut(e)).zip(w);
        parts.enumerate().with_min_len(64).for_each(|(p, ((v, g), w))| {
            for ((kind, rows), links) in kinds.iter().zip(rows).zip(&structure.links) {
                if links.eliminated.is_some() {
                    let items = links.of_point.of(p);
                    kind.add_to_point(rows, links, items, PointSums { v: &mut *v, g: &mut *g, w: &mut *w });
                }
            }
            for k in (0..e).filter(|k| points.held[p] >> k & 1 == 1) {
                v[k * e + k] = 1.0;
            }
        });
    }

    fn sum_blocks(&mut self, kinds: &[Box<dyn Kind + '_>], structure: &Structure) {
        let pattern = &structure.pattern;
        zero(&mut self.u, pattern.start[structure.blocks.len()]);
        zero(&mut self.gradient, structure.columns);
        let columns: Vec<usize> =
            structure.blocks.iter().map(|b| b.column).chain(std::iter::once(structure.columns)).collect();
        let gradients = slices(&mut self.gradient, &columns);
        let rows = &self.rows;
        slices(&mut self.u, &pattern.start).zip(gradients).enumerate().for_each(|(b, (values, gradient))| {
            let row = first_rows(structure, b);
            for ((kind, rows), links) in kinds.iter().zip(rows).zip(&structure.links) {
                let items = links.of_block.of(b);
                let column = ColumnSums {
                    block: b as u32,
                    values: &mut *values,
                    height: pattern.height[b],
                    row: &row,
                    gradient: &mut *gradient,
                };
                kind.add_to_column(rows, links, items, column);
            }
        });
        self.diagonal.clear();
        for (b, block) in structure.blocks.iter().enumerate() {
            let step = pattern.height[b] + 1;
            self.diagonal.extend((0..block.size).map(|c| self.u[pattern.start[b] + c * step]));
        }
    }

    /// Damping of a column of the reduced system: a diagonal of zero (a parameter nothing depends on) still has to be damped.
    pub(super) fn damped(&self, damping: f64) -> Vec<f64> {
        let floor = FLOOR * self.diagonal.iter().fold(0.0, |m: f64, v| m.max(*v));
        self.diagonal.iter().map(|d| damping * d.max(floor)).collect()
    }

    /// Eliminates: `S = U + D − Σ W V⁻¹ Wᵀ`, `g = g − Σ W V⁻¹ g_p`. The first eliminated block whose `V` has no inverse as the error.
    pub(super) fn reduce(&self, structure: &Structure, damping: f64, reduced: &mut Reduced) -> Result<(), usize> {
        reduced.s.clone_from(&self.u);
        reduced.gradient.clone_from(&self.gradient);
        let added = self.damped(damping);
        for (b, block) in structure.blocks.iter().enumerate() {
            let step = structure.pattern.height[b] + 1;
            for c in 0..block.size {
                reduced.s[structure.pattern.start[b] + c * step] += added[block.column + c];
            }
        }
        let Some(points) = &structure.points else { return Ok(()) };
        match points.size {
            1 => self.eliminate::<1>(structure, points, damping, reduced),
            2 => self.eliminate::<2>(structure, points, damping, reduced),
            3 => self.eliminate::<3>(structure, points, damping, reduced),
            4 => self.eliminate::<4>(structure, points, damping, reduced),
            5 => self.eliminate::<5>(structure, points, damping, reduced),
            _ => self.eliminate::<6>(structure, points, damping, reduced),
        }
    }

    fn eliminate<const E: usize>(
        &self,
        structure: &Structure,
        points: &Points,
        damping: f64,
        reduced: &mut Reduced,
    ) -> Result<(), usize> {
        zero(&mut reduced.inverses, points.count * E * E);
        let parts = reduced.inverses.par_chunks_mut(E * E).zip(self.v.par_chunks(E * E)).enumerate().with_min_len(256);
        let failed = parts.filter_map(|(p, (out, v))| invert::<E>(v, damping, out).err().map(|()| p)).min();
        if let Some(p) = failed {
            return Err(p);
        }
        let columns: Vec<usize> =
            structure.blocks.iter().map(|b| b.column).chain(std::iter::once(structure.columns)).collect();
        let inverses = &reduced.inverses;
        let gradients = slices(&mut reduced.gradient, &columns);
        slices(&mut reduced.s, &structure.pattern.start).zip(gradients).enumerate().for_each(
            |(b, (values, gradient))| {
                let row = first_rows(structure, b);
                let size = structure.blocks[b].size;
                let height = structure.pattern.height[b];
                // V⁻¹ Wᵀ of one eliminated block and this one, by columns.
                let mut y = vec![[0.0; E]; size];
                for &(p, cell) in structure.seen.of(b) {
                    let p = p as usize;
                    let w = &self.w[points.start[p]..points.start[p + 1]];
                    let n = w.len() / E;
                    let inverse = &inverses[p * E * E..][..E * E];
                    let g = &self.point_gradient[p * E..][..E];
                    let cells = &points.cells.of(p)[cell as usize..];
                    let first = cells[0].place as usize;
                    for (c, y) in y.iter_mut().enumerate() {
                        let x: [f64; E] = std::array::from_fn(|k| w[k * n + first + c]);
                        *y = std::array::from_fn(|k| (0..E).map(|l| inverse[k * E + l] * x[l]).sum());
                        gradient[c] -= (0..E).map(|k| y[k] * g[k]).sum::<f64>();
                    }
                    for cell in cells {
                        let out = &mut values[row[cell.block as usize] as usize..];
                        let wide: [&[f64]; E] =
                            std::array::from_fn(|k| &w[k * n + cell.place as usize..][..cell.size as usize]);
                        match cell.size {
                            6 => subtract::<E, 6>(wide, &y, out, height),
                            8 => subtract::<E, 8>(wide, &y, out, height),
                            _ => subtract_any(wide, &y, out, height),
                        }
                    }
                }
            },
        );
        Ok(())
    }

    /// An eliminated block's `V⁻¹` and its cross terms `W`, a row for each of its degrees of freedom.
    pub(super) fn point<'a>(&'a self, points: &Points, reduced: &'a Reduced, p: usize) -> (&'a [f64], &'a [f64]) {
        let e = points.size;
        (&reduced.inverses[p * e * e..][..e * e], &self.w[points.start[p]..points.start[p + 1]])
    }

    /// The eliminated blocks' step `δ_p = −V⁻¹ (g_p + Wᵀ δ)` for a step of the others.
    pub(super) fn back_substitute(&self, structure: &Structure, reduced: &Reduced, step: &[f64], out: &mut Vec<f64>) {
        let Some(points) = &structure.points else { return };
        let e = points.size;
        zero(out, points.count * e);
        out.par_chunks_mut(e).enumerate().with_min_len(256).for_each(|(p, out)| {
            let (inverse, w) = self.point(points, reduced, p);
            let n = w.len() / e;
            let mut sum = [0.0; 6];
            sum[..e].copy_from_slice(&self.point_gradient[p * e..][..e]);
            for cell in points.cells.of(p) {
                let step = &step[structure.blocks[cell.block as usize].column..][..cell.size as usize];
                for (k, sum) in sum[..e].iter_mut().enumerate() {
                    let w = &w[k * n + cell.place as usize..][..cell.size as usize];
                    *sum += w.iter().zip(step).map(|(a, b)| a * b).sum::<f64>();
                }
            }
            for (k, out) in out.iter_mut().enumerate() {
                *out = -(0..e).map(|l| inverse[k * e + l] * sum[l]).sum::<f64>();
            }
        });
    }
}

/// `out[c][a] −= Σ_k wide[k][a] · y[c][k]` for columns `height` apart.
#[inline(always)]
fn subtract<const E: usize, const A: usize>(wide: [&[f64]; E], y: &[[f64; E]], out: &mut [f64], height: usize) {
    // Of a size that is known, so that the sums stay in vector registers.
    let wide: [[f64; A]; E] = wide.map(|row| std::array::from_fn(|a| row[a]));
    for (c, y) in y.iter().enumerate() {
        let out = &mut out[c * height..][..A];
        let mut sum: [f64; A] = std::array::from_fn(|a| out[a]);
        for (row, y) in wide.iter().zip(y) {
            for (sum, w) in sum.iter_mut().zip(row) {
                *sum -= w * y;
            }
        }
        out.copy_from_slice(&sum);
    }
}

#[inline(always)]
fn subtract_any<const E: usize>(wide: [&[f64]; E], y: &[[f64; E]], out: &mut [f64], height: usize) {
    for (c, y) in y.iter().enumerate() {
        let out = &mut out[c * height..][..wide[0].len()];
        for (row, y) in wide.iter().zip(y) {
            for (o, w) in out.iter_mut().zip(*row) {
                *o -= w * y;
            }
        }
    }
}

/// The inverse of `V + damping · diag V + floor`, by Cholesky; zero for a block that nothing depends on.
fn invert<const E: usize>(v: &[f64], damping: f64, out: &mut [f64]) -> Result<(), ()> {
    let trace: f64 = (0..E).map(|k| v[k * E + k]).sum();
    if trace == 0.0 {
        return Ok(());
    }
    let mut m = SMatrix::<f64, E, E>::from_column_slice(v);
    for k in 0..E {
        m[(k, k)] += damping * m[(k, k)] + FLOOR * trace;
    }
    // The lower factor, its diagonal inverted.
    let mut l = cholesky_lower(&m, 0.0).ok_or(())?;
    // The inverse of the factor in its place, then L⁻ᵀ L⁻¹.
    for j in 0..E {
        for i in j + 1..E {
            let sum: f64 = (j..i).map(|k| l[(i, k)] * l[(k, j)]).sum();
            l[(i, j)] = -sum * l[(i, i)];
        }
    }
    for i in 0..E {
        for j in 0..=i {
            let sum: f64 = (i..E).map(|k| l[(k, i)] * l[(k, j)]).sum();
            (out[i * E + j], out[j * E + i]) = (sum, sum);
        }
    }
    Ok(())
}

/// Whether the residuals determine an eliminated block, without floor.
pub(super) fn determined(v: &[f64], size: usize) -> bool {
    let v = DMatrix::from_column_slice(size, size, v);
    let least = RANK * v.trace();
    Cholesky::new(v).is_some_and(|factor| factor.l_dirty().diagonal().iter().all(|d| d * d > least))
}

fn zero(values: &mut Vec<f64>, n: usize) {
    values.clear();
    values.resize(n, 0.0);
}

/// The parts of a slice between ascending positions, to be worked on in parallel.
fn slices<'a>(mut values: &'a mut [f64], start: &[usize]) -> rayon::vec::IntoIter<&'a mut [f64]> {
    let mut parts = Vec::with_capacity(start.len().saturating_sub(1));
    for pair in start.windows(2) {
        let (part, rest) = values.split_at_mut(pair[1] - pair[0]);
        parts.push(part);
        values = rest;
    }
    parts.into_par_iter()
}

/// First row of each block in a block column.
fn first_rows(structure: &Structure, b: usize) -> Vec<u32> {
    let mut row = vec![0; structure.blocks.len()];
    for &(block, first) in &structure.pattern.rows[b] {
        row[block as usize] = first;
    }
    row
}
