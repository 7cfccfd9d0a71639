//! The normal equations of a problem at its present values, and their reduced system (Schur complement).

use super::product::{multiply_inverse, subtract_product};
use super::residual::{ColumnSums, LossModel, PointSums, ResidualKind, Values, WeightedRows};
use super::structure::{MAX_BLOCK_COLUMNS, Points, Structure};
use crate::linear::cholesky_lower;
use cv_parallel::prelude::*;
use nalgebra::{Cholesky, DMatrix, SMatrix};
use std::ops::Range;

/// Ridge on the diagonal of an eliminated block, relative to its trace: points near infinity have almost no depth information.
pub(super) const DIAGONAL_FLOOR: f64 = 1e-12;
/// Pivot of an eliminated block, relative to its trace, below which the block is rank deficient.
const PIVOT_TOLERANCE: f64 = 1e-15;
/// Number of eliminated blocks per parallel task.
pub(super) const POINTS_PER_TASK: usize = 128;

/// The normal equations `H δ = −g`, `H = Σ w JᵀJ`, `g = Σ w Jᵀr`, as `[U Wᵀ; W V]` with `V` of the eliminated blocks.
#[derive(Debug, Clone, Default)]
pub(super) struct Normal {
    rows: Vec<WeightedRows>,
    /// Values of [`super::structure::Pattern`].
    u: Vec<f64>,
    /// Gradient by the reduced system's columns.
    pub(super) gradient: Vec<f64>,
    /// Diagonal of `u`.
    pub(super) diagonal: Vec<f64>,
    /// Diagonal blocks `V` of the eliminated blocks, by rank; so are the following fields.
    pub(super) v: Vec<f64>,
    pub(super) point_gradient: Vec<f64>,
    /// Cross terms `W`: per [`super::structure::CrossBlock`] a row for each degree of freedom of the eliminated block.
    w: Vec<f64>,
}

/// The reduced system `S δ = −g` for a given damping.
#[derive(Debug, Clone, Default)]
pub(super) struct Reduced {
    /// `S`, values of [`super::structure::Pattern`].
    pub(super) s: Vec<f64>,
    pub(super) gradient: Vec<f64>,
    /// Inverses of the damped `V`, by rank.
    inverses: Vec<f64>,
}

impl Normal {
    /// Linearizes all residuals and accumulates the normal equations. The error is the kind and index of an undefined residual.
    pub(super) fn linearize(
        &mut self,
        kinds: &[Box<dyn ResidualKind + '_>],
        structure: &Structure,
        values: &Values,
        model: LossModel,
    ) -> Result<(), (usize, usize)> {
        self.rows.resize_with(kinds.len(), WeightedRows::default);
        for (k, (kind, rows)) in kinds.iter().zip(&mut self.rows).enumerate() {
            kind.linearize(values, &structure.incidence[k], model, rows).map_err(|item| (k, item))?;
        }
        if let Some(points) = &structure.points {
            self.accumulate_points(kinds, structure, points);
        }
        self.accumulate_blocks(kinds, structure);
        Ok(())
    }

    fn accumulate_points(&mut self, kinds: &[Box<dyn ResidualKind + '_>], structure: &Structure, points: &Points) {
        let e = points.size;
        resize_zeroed(&mut self.v, points.count * e * e);
        resize_zeroed(&mut self.point_gradient, points.count * e);
        self.w.resize(points.start[points.count], 0.0);
        let firsts: Vec<usize> = (0..points.count).step_by(POINTS_PER_TASK).chain([points.count]).collect();
        let starts: Vec<usize> = firsts.iter().map(|r| points.start[*r]).collect();
        let rows = &self.rows;
        let parts =
            self.v.par_chunks_mut(POINTS_PER_TASK * e * e).zip(self.point_gradient.par_chunks_mut(POINTS_PER_TASK * e));
        parts.zip(split_at_starts(&mut self.w, &starts)).enumerate().for_each(|(part, ((v, g), mut rest))| {
            let (v, g) = (v.chunks_exact_mut(e * e), g.chunks_exact_mut(e));
            for (r, (v, g)) in (part * POINTS_PER_TASK..).zip(v.zip(g)) {
                let w = rest.split_off_mut(..points.start[r + 1] - points.start[r]).unwrap_or_default();
                w.fill(0.0);
                for ((kind, rows), incidence) in kinds.iter().zip(rows).zip(&structure.incidence) {
                    if incidence.eliminated.is_some() {
                        kind.add_to_point(
                            rows,
                            incidence,
                            incidence.residuals_of_point(r),
                            PointSums { v: &mut *v, g: &mut *g, w: &mut *w },
                        );
                    }
                }
                for k in (0..e).filter(|k| points.fixed[r] >> k & 1 == 1) {
                    v[k * e + k] = 1.0;
                }
            }
        });
    }

    fn accumulate_blocks(&mut self, kinds: &[Box<dyn ResidualKind + '_>], structure: &Structure) {
        let pattern = &structure.pattern;
        resize_zeroed(&mut self.u, pattern.start[structure.blocks.len()]);
        resize_zeroed(&mut self.gradient, structure.columns);
        let rows = &self.rows;
        for_each_task(structure, &mut self.u, &mut self.gradient, |task, blocks, values, gradient| {
            for ((kind, rows), incidence) in kinds.iter().zip(rows).zip(&structure.incidence) {
                let (values, gradient) = (&mut *values, &mut *gradient);
                let columns = ColumnSums { structure, blocks: blocks.clone(), values, gradient };
                kind.add_to_columns(rows, incidence, incidence.residuals_of_task.of(task), columns);
            }
        });
        self.diagonal.clear();
        for (b, block) in structure.blocks.iter().enumerate() {
            let step = pattern.height[b] + 1;
            self.diagonal.extend((0..block.size).map(|c| self.u[pattern.start[b] + c * step]));
        }
    }

    /// Computes the damping term of each column of the reduced system. A floor also damps parameters that no residual depends on, whose
    /// diagonal is zero.
    pub(super) fn damping_terms(&self, damping: f64) -> Vec<f64> {
        let floor = DIAGONAL_FLOOR * self.diagonal.iter().fold(0.0, |m: f64, v| m.max(*v));
        self.diagonal.iter().map(|d| damping * d.max(floor)).collect()
    }

    /// Computes the Schur complement `S = U + D − Σ W V⁻¹ Wᵀ`, `g = g − Σ W V⁻¹ g_p`. The error is the first eliminated block whose `V`
    /// is singular.
    pub(super) fn reduce(&self, structure: &Structure, damping: f64, reduced: &mut Reduced) -> Result<(), usize> {
        reduced.s.clone_from(&self.u);
        reduced.gradient.clone_from(&self.gradient);
        let added = self.damping_terms(damping);
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
        resize_zeroed(&mut reduced.inverses, points.count * E * E);
        let size = POINTS_PER_TASK * E * E;
        let parts = reduced.inverses.par_chunks_mut(size).zip(self.v.par_chunks(size));
        let first_failed = parts.zip(points.order.par_chunks(POINTS_PER_TASK)).map(|((out, v), order)| {
            let blocks = out.chunks_exact_mut(E * E).zip(v.chunks_exact(E * E)).zip(order);
            blocks.filter_map(|((out, v), p)| invert_damped::<E>(v, damping, out).err().map(|()| *p)).min()
        });
        if let Some(p) = first_failed.collect().into_iter().flatten().min() {
            return Err(p as usize);
        }
        let inverses = &reduced.inverses;
        for_each_task(structure, &mut reduced.s, &mut reduced.gradient, |task, blocks, values, gradient| {
            let first_value = structure.pattern.start[blocks.start];
            let first_column = structure.blocks.get(blocks.start).map_or(0, |b| b.column);
            // V⁻¹ Wᵀ of one eliminated block and one block of the reduced system, by columns.
            let mut y = [[0.0; E]; MAX_BLOCK_COLUMNS];
            for &r in structure.points_of_task.of(task) {
                let r = r as usize;
                let w = &self.w[points.start[r]..points.start[r + 1]];
                let mut inverse = [[0.0; E]; E];
                inverse.as_flattened_mut().copy_from_slice(&inverses[r * E * E..][..E * E]);
                let g = &self.point_gradient[r * E..][..E];
                let cross_blocks = points.cross_blocks.of(r);
                for (i, cross_block) in cross_blocks.iter().enumerate() {
                    let b = cross_block.block as usize;
                    if !blocks.contains(&b) {
                        continue;
                    }
                    let y = &mut y[..cross_block.size as usize];
                    let cross_terms = &w[E * cross_block.offset as usize..];
                    multiply_inverse(&inverse, cross_terms, y);
                    let gradient = &mut gradient[structure.blocks[b].column - first_column..][..y.len()];
                    for (gradient, y) in gradient.iter_mut().zip(&*y) {
                        *gradient -= y.iter().zip(g).map(|(y, g)| y * g).sum::<f64>();
                    }
                    let height = structure.pattern.height[b];
                    let values = &mut values[structure.pattern.start[b] - first_value..];
                    for other in &cross_blocks[i..] {
                        let out = &mut values[structure.pattern.row(b, other.block)..];
                        let wide = &w[E * other.offset as usize..][..E * other.size as usize];
                        subtract_product(wide, y, out, height);
                    }
                }
            }
        });
        Ok(())
    }

    /// Returns `V⁻¹` of the eliminated block of a rank, and its cross terms `W`: per cross block a row for each of its degrees of freedom.
    pub(super) fn inverse_and_cross_terms<'a>(
        &'a self,
        points: &Points,
        reduced: &'a Reduced,
        r: usize,
    ) -> (&'a [f64], &'a [f64]) {
        let e = points.size;
        (&reduced.inverses[r * e * e..][..e * e], &self.w[points.start[r]..points.start[r + 1]])
    }

    /// Computes the step of the eliminated blocks `δ_p = −V⁻¹ (g_p + Wᵀ δ)` from that of the others, by rank.
    pub(super) fn back_substitute(&self, structure: &Structure, reduced: &Reduced, step: &[f64]) -> Vec<f64> {
        let Some(points) = &structure.points else { return Vec::new() };
        let e = points.size;
        let mut by_rank = vec![0.0; points.count * e];
        let step_of = |r: usize, out: &mut [f64]| {
            let (inverse, w) = self.inverse_and_cross_terms(points, reduced, r);
            let mut sum = [0.0; 6];
            sum[..e].copy_from_slice(&self.point_gradient[r * e..][..e]);
            for cross_block in points.cross_blocks.of(r) {
                let size = cross_block.size as usize;
                let step = &step[structure.blocks[cross_block.block as usize].column..][..size];
                let w = w[e * cross_block.offset as usize..].chunks_exact(size);
                for (sum, w) in sum[..e].iter_mut().zip(w) {
                    *sum += w.iter().zip(step).map(|(a, b)| a * b).sum::<f64>();
                }
            }
            for (out, inverse) in out.iter_mut().zip(inverse.chunks_exact(e)) {
                *out = -inverse.iter().zip(&sum).map(|(v, s)| v * s).sum::<f64>();
            }
        };
        by_rank.par_chunks_mut(POINTS_PER_TASK * e).enumerate().for_each(|(part, out)| {
            (part * POINTS_PER_TASK..).zip(out.chunks_exact_mut(e)).for_each(|(r, out)| step_of(r, out));
        });
        by_rank
    }
}

/// Inverts `V + damping · diag V + floor` by Cholesky; leaves zero for a block that no residual depends on.
fn invert_damped<const E: usize>(v: &[f64], damping: f64, out: &mut [f64]) -> Result<(), ()> {
    let trace: f64 = (0..E).map(|k| v[k * E + k]).sum();
    if trace == 0.0 {
        return Ok(());
    }
    let mut m = SMatrix::<f64, E, E>::from_column_slice(v);
    for k in 0..E {
        m[(k, k)] += damping * m[(k, k)] + DIAGONAL_FLOOR * trace;
    }
    // The lower factor, its diagonal inverted.
    let mut l = cholesky_lower(&m, 0.0).ok_or(())?;
    // Invert the factor in place, then L⁻ᵀ L⁻¹.
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

/// Whether an eliminated block has full rank without the ridge.
pub(super) fn is_determined(v: &[f64], size: usize) -> bool {
    let v = DMatrix::from_column_slice(size, size, v);
    let least = PIVOT_TOLERANCE * v.trace();
    Cholesky::new(v).is_some_and(|factor| factor.l_dirty().diagonal().iter().all(|d| d * d > least))
}

fn resize_zeroed(values: &mut Vec<f64>, n: usize) {
    values.clear();
    values.resize(n, 0.0);
}

/// Splits a slice at ascending positions.
fn split_at_starts<'a>(mut values: &'a mut [f64], start: &[usize]) -> Vec<&'a mut [f64]> {
    let mut parts = Vec::with_capacity(start.len().saturating_sub(1));
    for pair in start.windows(2) {
        let (part, rest) = values.split_at_mut(pair[1] - pair[0]);
        parts.push(part);
        values = rest;
    }
    parts
}

/// Calls `of` in parallel for each of [`Structure::tasks`] with its index, its blocks, and their parts of the values of
/// [`super::structure::Pattern`] and of a vector by columns.
fn for_each_task(
    structure: &Structure,
    values: &mut [f64],
    vector: &mut [f64],
    of: impl Fn(usize, Range<usize>, &mut [f64], &mut [f64]) + Sync,
) {
    let tasks = &structure.tasks;
    let column = |b: &usize| structure.blocks.get(*b).map_or(structure.columns, |b| b.column);
    let starts: Vec<usize> = tasks.iter().map(|b| structure.pattern.start[*b]).collect();
    let columns: Vec<usize> = tasks.iter().map(column).collect();
    let parts = split_at_starts(values, &starts).into_par_iter().zip(split_at_starts(vector, &columns));
    parts.enumerate().for_each(|(t, (values, vector))| of(t, tasks[t]..tasks[t + 1], values, vector));
}
