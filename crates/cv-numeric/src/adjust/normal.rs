//! The normal equations of a problem where it stands, and the reduced system that is left of them without the eliminated blocks.

use super::product::{subtract_product, times_inverse};
use super::residual::{ColumnSums, Kind, LossModel, PointSums, Rows, Values};
use super::structure::{MOST_COLUMNS, Points, Structure};
use crate::linear::cholesky_lower;
use nalgebra::{Cholesky, DMatrix, SMatrix};
use rayon::prelude::*;
use std::ops::Range;

/// A point near infinity has next to no depth information: this share of the trace keeps it where it is.
pub(super) const FLOOR: f64 = 1e-12;
/// Below this share of the trace, a pivot of an eliminated block is rounding.
const RANK: f64 = 1e-15;
/// Eliminated blocks that one task sums.
const POINTS: usize = 128;

/// The normal equations `H δ = −g`, `H = Σ w JᵀJ`, `g = Σ w Jᵀr`, as `[U Wᵀ; W V]` with `V` of the eliminated blocks.
#[derive(Debug, Clone, Default)]
pub(super) struct Normal {
    rows: Vec<Rows>,
    /// Values of [`super::structure::Pattern`].
    u: Vec<f64>,
    /// Gradient by the reduced system's columns.
    pub(super) gradient: Vec<f64>,
    /// Diagonal of `u`.
    pub(super) diagonal: Vec<f64>,
    /// By rank of the eliminated block, as what follows.
    pub(super) v: Vec<f64>,
    pub(super) point_gradient: Vec<f64>,
    /// A row for each degree of freedom of the eliminated block, for each [`super::structure::Cell`] by itself.
    w: Vec<f64>,
}

/// The reduced system `S δ = −g` for some damping.
#[derive(Debug, Clone, Default)]
pub(super) struct Reduced {
    /// `S`, values of [`super::structure::Pattern`].
    pub(super) s: Vec<f64>,
    pub(super) gradient: Vec<f64>,
    /// Inverses of the damped `V`, by rank.
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
        for (k, (kind, rows)) in kinds.iter().zip(&mut self.rows).enumerate() {
            kind.linearize(values, &structure.links[k], model, rows).map_err(|item| (k, item))?;
        }
        if let Some(points) = &structure.points {
            self.sum_points(kinds, structure, points);
        }
        self.sum_blocks(kinds, structure);
        Ok(())
    }

    fn sum_points(&mut self, kinds: &[Box<dyn Kind + '_>], structure: &Structure, points: &Points) {
        let e = points.size;
        zero(&mut self.v, points.count * e * e);
        zero(&mut self.point_gradient, points.count * e);
        self.w.resize(points.start[points.count], 0.0);
        let firsts: Vec<usize> = (0..points.count).step_by(POINTS).chain([points.count]).collect();
        let starts: Vec<usize> = firsts.iter().map(|r| points.start[*r]).collect();
        let rows = &self.rows;
        let parts = self.v.par_chunks_mut(POINTS * e * e).zip(self.point_gradient.par_chunks_mut(POINTS * e));
        parts.zip(slices(&mut self.w, &starts)).enumerate().for_each(|(part, ((v, g), mut rest))| {
            let (v, g) = (v.chunks_exact_mut(e * e), g.chunks_exact_mut(e));
            for (r, (v, g)) in (part * POINTS..).zip(v.zip(g)) {
                let w = rest.split_off_mut(..points.start[r + 1] - points.start[r]).unwrap_or_default();
                w.fill(0.0);
                for ((kind, rows), links) in kinds.iter().zip(rows).zip(&structure.links) {
                    if links.eliminated.is_some() {
                        kind.add_to_point(
                            rows,
                            links,
                            links.of_point(r),
                            PointSums { v: &mut *v, g: &mut *g, w: &mut *w },
                        );
                    }
                }
                for k in (0..e).filter(|k| points.held[r] >> k & 1 == 1) {
                    v[k * e + k] = 1.0;
                }
            }
        });
    }

    fn sum_blocks(&mut self, kinds: &[Box<dyn Kind + '_>], structure: &Structure) {
        let pattern = &structure.pattern;
        zero(&mut self.u, pattern.start[structure.blocks.len()]);
        zero(&mut self.gradient, structure.columns);
        let rows = &self.rows;
        for_tasks(structure, &mut self.u, &mut self.gradient, |task, blocks, values, gradient| {
            for ((kind, rows), links) in kinds.iter().zip(rows).zip(&structure.links) {
                let (values, gradient) = (&mut *values, &mut *gradient);
                let columns = ColumnSums { structure, blocks: blocks.clone(), values, gradient };
                kind.add_to_columns(rows, links, links.of_task.of(task), columns);
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
        let failed = parts.filter_map(|(r, (out, v))| invert::<E>(v, damping, out).err().map(|()| points.order[r]));
        if let Some(p) = failed.min() {
            return Err(p as usize);
        }
        let inverses = &reduced.inverses;
        for_tasks(structure, &mut reduced.s, &mut reduced.gradient, |task, blocks, values, gradient| {
            let first_value = structure.pattern.start[blocks.start];
            let first_column = structure.blocks.get(blocks.start).map_or(0, |b| b.column);
            // V⁻¹ Wᵀ of one eliminated block and one of the reduced system, by columns.
            let mut y = [[0.0; E]; MOST_COLUMNS];
            for &r in structure.seen.of(task) {
                let r = r as usize;
                let w = &self.w[points.start[r]..points.start[r + 1]];
                let mut inverse = [[0.0; E]; E];
                inverse.as_flattened_mut().copy_from_slice(&inverses[r * E * E..][..E * E]);
                let g = &self.point_gradient[r * E..][..E];
                let cells = points.cells.of(r);
                for (i, cell) in cells.iter().enumerate() {
                    let b = cell.block as usize;
                    if !blocks.contains(&b) {
                        continue;
                    }
                    let y = &mut y[..cell.size as usize];
                    let own = &w[E * cell.place as usize..];
                    times_inverse(&inverse, own, y);
                    let gradient = &mut gradient[structure.blocks[b].column - first_column..][..y.len()];
                    for (gradient, y) in gradient.iter_mut().zip(&*y) {
                        *gradient -= y.iter().zip(g).map(|(y, g)| y * g).sum::<f64>();
                    }
                    let height = structure.pattern.height[b];
                    let values = &mut values[structure.pattern.start[b] - first_value..];
                    for other in &cells[i..] {
                        let out = &mut values[structure.pattern.row(b, other.block)..];
                        let wide = &w[E * other.place as usize..][..E * other.size as usize];
                        subtract_product(wide, y, out, height);
                    }
                }
            }
        });
        Ok(())
    }

    /// `V⁻¹` of an eliminated block, by its rank, and its cross terms `W`: for each of its cells a row for each of its degrees of freedom.
    pub(super) fn point<'a>(&'a self, points: &Points, reduced: &'a Reduced, r: usize) -> (&'a [f64], &'a [f64]) {
        let e = points.size;
        (&reduced.inverses[r * e * e..][..e * e], &self.w[points.start[r]..points.start[r + 1]])
    }

    /// The eliminated blocks' step `δ_p = −V⁻¹ (g_p + Wᵀ δ)` for a step of the others, by rank.
    pub(super) fn back_substitute(&self, structure: &Structure, reduced: &Reduced, step: &[f64]) -> Vec<f64> {
        let Some(points) = &structure.points else { return Vec::new() };
        let e = points.size;
        let mut by_rank = vec![0.0; points.count * e];
        by_rank.par_chunks_mut(e).enumerate().with_min_len(256).for_each(|(r, out)| {
            let (inverse, w) = self.point(points, reduced, r);
            let mut sum = [0.0; 6];
            sum[..e].copy_from_slice(&self.point_gradient[r * e..][..e]);
            for cell in points.cells.of(r) {
                let size = cell.size as usize;
                let step = &step[structure.blocks[cell.block as usize].column..][..size];
                let w = w[e * cell.place as usize..].chunks_exact(size);
                for (sum, w) in sum[..e].iter_mut().zip(w) {
                    *sum += w.iter().zip(step).map(|(a, b)| a * b).sum::<f64>();
                }
            }
            for (out, inverse) in out.iter_mut().zip(inverse.chunks_exact(e)) {
                *out = -inverse.iter().zip(&sum).map(|(v, s)| v * s).sum::<f64>();
            }
        });
        by_rank
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

/// Calls `of` for each of [`Structure::tasks`], in parallel, with its number, its blocks, and their parts of values of [`super::structure::Pattern`] and of a
/// vector by columns.
fn for_tasks(
    structure: &Structure,
    values: &mut [f64],
    vector: &mut [f64],
    of: impl Fn(usize, Range<usize>, &mut [f64], &mut [f64]) + Sync,
) {
    let tasks = &structure.tasks;
    let column = |b: &usize| structure.blocks.get(*b).map_or(structure.columns, |b| b.column);
    let starts: Vec<usize> = tasks.iter().map(|b| structure.pattern.start[*b]).collect();
    let columns: Vec<usize> = tasks.iter().map(column).collect();
    let parts = slices(values, &starts).zip(slices(vector, &columns)).enumerate();
    parts.for_each(|(t, (values, vector))| of(t, tasks[t]..tasks[t + 1], values, vector));
}
