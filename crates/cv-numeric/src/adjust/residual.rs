//! Residuals of one kind: their parameter blocks, and their contribution to the normal equations.

use super::manifold::Manifold;
use super::product::{add_gradient, add_product};
use super::structure::{Incidence, NONE, Structure};
use crate::RobustLoss;
use cv_parallel::prelude::*;
use nalgebra::{SMatrix, SVector};
use std::ops::Range;

/// Residuals of one kind: `R` components for each item, which depend on `B` parameter blocks (1 to 4) with `C` degrees of freedom
/// in total.
///
/// The sizes are compile-time constants, so that the loop over the items is monomorphized for each kind and allocates nothing. A
/// residual may depend on the same block twice.
pub trait Residual<const R: usize, const B: usize, const C: usize>: Send + Sync {
    /// Degrees of freedom of each block; they add up to `C`.
    const DIMS: [usize; B];

    /// Evaluates the residual of an item, given the values of its blocks ([`Manifold::ambient`] numbers each). Where `jacobian` is given
    /// (zero on entry), also the derivatives by the blocks' degrees of freedom, side by side.
    ///
    /// `None` where the residual is undefined, such as for a point behind a camera: the step is then rejected.
    fn evaluate(
        &self,
        item: usize,
        blocks: [&[f64]; B],
        jacobian: Option<&mut SMatrix<f64, R, C>>,
    ) -> Option<SVector<f64, R>>;
}

/// A Gaussian prior on blocks of `N` numbers: residuals `(x − mean) · weight`, the weight one over the standard deviation, in the unit of
/// the other residuals.
#[derive(Debug, Clone, PartialEq)]
pub struct Prior<const N: usize> {
    /// Means and weights of the `N` numbers of each item.
    pub items: Vec<([f64; N], [f64; N])>,
}

impl<const N: usize> Residual<N, 1, N> for Prior<N> {
    const DIMS: [usize; 1] = [N];

    #[inline]
    fn evaluate(
        &self,
        item: usize,
        [x]: [&[f64]; 1],
        jacobian: Option<&mut SMatrix<f64, N, N>>,
    ) -> Option<SVector<f64, N>> {
        let (mean, weight) = self.items.get(item)?;
        if let Some(j) = jacobian {
            for (k, weight) in weight.iter().enumerate() {
                j[(k, k)] = *weight;
            }
        }
        Some(SVector::from_fn(|i, _| (x[i] - mean[i]) * weight[i]))
    }
}

/// The values of all blocks, by group.
#[derive(Debug, Clone)]
pub(super) struct Values {
    pub(super) numbers: Vec<Vec<f64>>,
    /// Ambient dimension of a block, by group.
    pub(super) ambient: Vec<usize>,
}

impl Values {
    #[inline]
    pub(super) fn block(&self, group: usize, index: usize) -> &[f64] {
        let n = self.ambient[group];
        &self.numbers[group][index * n..][..n]
    }
}

/// Sums over the residuals of a kind.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ResidualSums {
    /// `Σ ρ(‖r‖²)`.
    pub cost: f64,
    /// `Σ w ‖r‖²`, the weights `w = ρ'(‖r‖²)`.
    pub weighted_squares: f64,
    /// `Σ w` over residual components.
    pub weights: f64,
    /// Number of residual components.
    pub count: usize,
}

impl ResidualSums {
    /// Adds a residual of squared norm `squared`; returns its weight, or `None` where it is not finite.
    #[inline]
    fn add_residual(&mut self, loss: &RobustLoss, squared: f64, components: usize) -> Option<f64> {
        let weight = loss.weight(squared);
        self.cost += loss.value(squared);
        self.weighted_squares += weight * squared;
        self.weights += weight * components as f64;
        self.count += components;
        squared.is_finite().then_some(weight)
    }

    fn add(&mut self, other: &Self) {
        self.cost += other.cost;
        self.weighted_squares += other.weighted_squares;
        self.weights += other.weights;
        self.count += other.count;
    }
}

/// Sums the parts in order.
fn sum_in_order(parts: Vec<Result<ResidualSums, usize>>) -> Result<ResidualSums, usize> {
    let mut sums = ResidualSums::default();
    for part in parts {
        sums.add(&part?);
    }
    Ok(sums)
}

/// The second-order model of a robust loss in the normal equations. The gradient is the same for all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LossModel {
    /// Its weight alone (iteratively reweighted least squares): a quadratic that majorizes the loss.
    Weight,
    /// Triggs' correction: also its curvature along the residual, bounded from below by [`MIN_CURVATURE`].
    Curvature,
}

/// Minimum curvature of the loss along the residual, relative to that across it: negative curvature makes the normal equations indefinite,
/// small curvature makes steps too long. On a synthetic block of 100 images with Cauchy loss, 0.3 takes 17 iterations, 0.05 takes 22,
/// weights alone 32.
const MIN_CURVATURE: f64 = 0.3;

/// Residuals and Jacobians of all items of a kind, multiplied by the square roots of their weights, in the order of [`Incidence::items`].
#[derive(Debug, Clone, Default)]
pub(super) struct WeightedRows {
    /// `R` numbers per item.
    residuals: Vec<f64>,
    /// `R` rows of `C` numbers per item. Columns of fixed parameters are removed and the free ones of a block compacted; in eliminated
    /// blocks they are zero.
    jacobians: Vec<f64>,
}

/// The contribution of one eliminated block to the normal equations.
pub(super) struct PointSums<'a> {
    /// `E × E`.
    pub(super) v: &'a mut [f64],
    /// `E`.
    pub(super) g: &'a mut [f64],
    /// Cross terms with the reduced blocks that share residuals with the point: `E` rows per block, as long as the block has columns.
    pub(super) w: &'a mut [f64],
}

/// The columns of one of [`Structure::tasks`] in the reduced normal equations.
pub(super) struct ColumnSums<'a> {
    pub(super) structure: &'a Structure,
    pub(super) blocks: Range<usize>,
    /// Their part of the values of [`super::structure::Pattern`].
    pub(super) values: &'a mut [f64],
    pub(super) gradient: &'a mut [f64],
}

/// Number of items per parallel task; sums of tasks are added in order, so that results do not depend on the number of threads.
const ITEMS_PER_CHUNK: usize = 256;

/// A kind of residuals, type-erased.
pub(super) trait ResidualKind: Send + Sync {
    fn name(&self) -> &str;
    fn len(&self) -> usize;
    /// Group of each block of a residual.
    fn groups(&self) -> &[usize];
    /// Index within its group of each block of an item.
    fn blocks(&self, item: usize) -> &[u32];
    /// Computes `Σ ρ(‖r‖²)`, infinite where a residual is undefined.
    fn cost(&self, values: &Values) -> f64;
    /// Fills the rows. The error is an undefined item.
    fn linearize(
        &self,
        values: &Values,
        incidence: &Incidence,
        model: LossModel,
        rows: &mut WeightedRows,
    ) -> Result<(), usize>;
    /// Sums over the items. The error is the first undefined item.
    fn sums(&self, values: &Values) -> Result<ResidualSums, usize>;
    /// Adds the residuals (slots) of one eliminated block.
    fn add_to_point(&self, rows: &WeightedRows, incidence: &Incidence, slots: Range<usize>, point: PointSums<'_>);
    /// Adds the residuals (slots) that involve the columns of a task.
    fn add_to_columns(&self, rows: &WeightedRows, incidence: &Incidence, slots: &[u32], columns: ColumnSums<'_>);
}

/// A kind of residuals and the blocks that its items depend on.
pub(super) struct TypedResiduals<T, const R: usize, const B: usize, const C: usize> {
    pub(super) name: String,
    pub(super) residual: T,
    pub(super) groups: [usize; B],
    pub(super) blocks: Vec<[u32; B]>,
    pub(super) loss: RobustLoss,
}

impl<T: Residual<R, B, C>, const R: usize, const B: usize, const C: usize> TypedResiduals<T, R, B, C> {
    /// First column of each block.
    const FIRST: [usize; B] = {
        let mut first = [0; B];
        let mut k = 1;
        while k < B {
            first[k] = first[k - 1] + T::DIMS[k - 1];
            k += 1;
        }
        assert!(B > 0 && first[B - 1] + T::DIMS[B - 1] == C, "C is the sum of DIMS");
        first
    };

    #[inline(always)]
    fn block_values<'v>(&self, values: &'v Values, item: usize) -> [&'v [f64]; B] {
        let blocks = &self.blocks[item];
        let mut all: [&[f64]; B] = [&[]; B];
        for (k, numbers) in all.iter_mut().enumerate() {
            *numbers = values.block(self.groups[k], blocks[k] as usize);
        }
        all
    }

    fn cost_of_range(&self, values: &Values, items: Range<usize>) -> f64 {
        let mut cost = 0.0;
        for item in items {
            match self.residual.evaluate(item, self.block_values(values, item), None) {
                Some(r) => cost += self.loss.value(r.norm_squared()),
                None => return f64::INFINITY,
            }
        }
        cost
    }

    fn linearize_chunk(
        &self,
        values: &Values,
        incidence: &Incidence,
        model: LossModel,
        items: &[u32],
        (jacobians, residuals): (&mut [f64], &mut [f64]),
    ) -> Result<(), usize> {
        let rows = jacobians.chunks_exact_mut(R * C).zip(residuals.chunks_exact_mut(R));
        for (item, (jacobian, residual)) in items.iter().zip(rows) {
            let item = *item as usize;
            let mut j = SMatrix::<f64, R, C>::zeros();
            let mut r = self.residual.evaluate(item, self.block_values(values, item), Some(&mut j)).ok_or(item)?;
            let squared = r.norm_squared();
            if !squared.is_finite() {
                return Err(item);
            }
            let root = self.loss.weight(squared).sqrt();
            if model == LossModel::Curvature {
                let along = self.loss.curvature(squared).max(MIN_CURVATURE).sqrt();
                if along != 1.0 && squared > 0.0 {
                    // J − (1 − β) r̂ r̂ᵀ J and r / β (Triggs et al., §4.3).
                    let by_residual = r.transpose() * j * ((1.0 - along) / squared);
                    j -= r * by_residual;
                    r /= along;
                }
            }
            for row in 0..R {
                residual[row] = root * r[row];
                for column in 0..C {
                    jacobian[row * C + column] = root * j[(row, column)];
                }
            }
            if incidence.has_fixed {
                self.drop_fixed_columns(incidence, item, jacobian);
            }
        }
        Ok(())
    }

    fn drop_fixed_columns(&self, incidence: &Incidence, item: usize, jacobian: &mut [f64]) {
        for k in 0..B {
            let fixed = incidence.fixed(self.groups[k], self.blocks[item][k]);
            if fixed == 0 {
                continue;
            }
            let compact = incidence.eliminated != Some(k);
            for row in jacobian.chunks_exact_mut(C) {
                let mut to = Self::FIRST[k];
                for c in 0..T::DIMS[k] {
                    let value = row[Self::FIRST[k] + c];
                    let free = fixed >> c & 1 == 0;
                    if compact && free {
                        row[to] = value;
                        to += 1;
                    } else if !compact && !free {
                        row[Self::FIRST[k] + c] = 0.0;
                    }
                }
            }
        }
    }
}

impl<T: Residual<R, B, C>, const R: usize, const B: usize, const C: usize> ResidualKind for TypedResiduals<T, R, B, C> {
    fn name(&self) -> &str {
        &self.name
    }

    fn len(&self) -> usize {
        self.blocks.len()
    }

    fn groups(&self) -> &[usize] {
        &self.groups
    }

    fn blocks(&self, item: usize) -> &[u32] {
        &self.blocks[item]
    }

    fn cost(&self, values: &Values) -> f64 {
        let chunks = self.len().div_ceil(ITEMS_PER_CHUNK);
        let of =
            |c: usize| self.cost_of_range(values, c * ITEMS_PER_CHUNK..((c + 1) * ITEMS_PER_CHUNK).min(self.len()));
        (0..chunks).into_par_iter().map(of).collect().iter().sum()
    }

    fn linearize(
        &self,
        values: &Values,
        incidence: &Incidence,
        model: LossModel,
        rows: &mut WeightedRows,
    ) -> Result<(), usize> {
        rows.residuals.resize(self.len() * R, 0.0);
        rows.jacobians.resize(self.len() * R * C, 0.0);
        let chunks = rows
            .jacobians
            .par_chunks_mut(ITEMS_PER_CHUNK * R * C)
            .zip(rows.residuals.par_chunks_mut(ITEMS_PER_CHUNK * R));
        let chunks = chunks.zip(incidence.items.par_chunks(ITEMS_PER_CHUNK));
        let failed = chunks.map(|(out, items)| self.linearize_chunk(values, incidence, model, items, out).err());
        failed.collect().into_iter().flatten().min().map_or(Ok(()), Err)
    }

    fn sums(&self, values: &Values) -> Result<ResidualSums, usize> {
        let chunk = |c: usize| {
            let mut sums = ResidualSums::default();
            for item in c * ITEMS_PER_CHUNK..((c + 1) * ITEMS_PER_CHUNK).min(self.len()) {
                let r = self.residual.evaluate(item, self.block_values(values, item), None).ok_or(item)?;
                sums.add_residual(&self.loss, r.norm_squared(), R).ok_or(item)?;
            }
            Ok(sums)
        };
        sum_in_order((0..self.len().div_ceil(ITEMS_PER_CHUNK)).into_par_iter().map(chunk).collect())
    }

    fn add_to_point(&self, rows: &WeightedRows, incidence: &Incidence, slots: Range<usize>, point: PointSums<'_>) {
        let Some(e) = incidence.eliminated else { return };
        let (size, first) = (T::DIMS[e], Self::FIRST[e]);
        let mut slots = slots;
        while !slots.is_empty() {
            let (slot, count) = (slots.start, incidence.run_length(slots.clone(), B));
            slots.start += count;
            let j = (&rows.jacobians[slot * R * C..][..count * R * C], C);
            add_product(j, (first, size), (first, size), point.v, size);
            add_gradient(j, (first, size), &rows.residuals[slot * R..][..count * R], point.g);
            for (k, target) in incidence.targets(slot, B).iter().enumerate() {
                if k != e && target.block != NONE {
                    let out = &mut point.w[size * target.offset as usize + target.within as usize..];
                    let left = (Self::FIRST[k], target.width as usize);
                    add_product(j, left, (first, size), out, target.size as usize);
                }
            }
        }
    }

    fn add_to_columns(&self, rows: &WeightedRows, incidence: &Incidence, slots: &[u32], columns: ColumnSums<'_>) {
        let ColumnSums { structure: Structure { pattern, blocks, .. }, blocks: range, values, gradient } = columns;
        let Some(first) = blocks.get(range.start) else { return };
        let (first_value, first_column) = (pattern.start[range.start], first.column);
        let mut slots = slots;
        while let Some(&slot) = slots.first() {
            let (slot, count) = (slot as usize, incidence.run_length(slots.iter().map(|p| *p as usize), B));
            slots = &slots[count..];
            let j = (&rows.jacobians[slot * R * C..][..count * R * C], C);
            let r = &rows.residuals[slot * R..][..count * R];
            let targets = incidence.targets(slot, B);
            for (k, right) in targets.iter().enumerate() {
                let b = right.block as usize;
                if !range.contains(&b) {
                    continue;
                }
                let (within, width) = (right.within as usize, right.width as usize);
                let right_columns = (Self::FIRST[k], width);
                add_gradient(j, right_columns, r, &mut gradient[blocks[b].column - first_column + within..]);
                let height = pattern.height[b];
                let values = &mut values[pattern.start[b] - first_value + within * height..];
                for (l, left) in targets.iter().enumerate() {
                    // Lower triangle only.
                    if left.block != NONE && left.block >= right.block {
                        let row = if left.block == right.block { 0 } else { pattern.row(b, left.block) };
                        let out = &mut values[row + left.within as usize..];
                        add_product(j, (Self::FIRST[l], left.width as usize), right_columns, out, height);
                    }
                }
            }
        }
    }
}

/// A group of blocks: name, manifold, and fixed degrees of freedom.
pub(super) struct Group<'a> {
    pub(super) name: String,
    pub(super) manifold: Box<dyn Manifold + 'a>,
    pub(super) count: usize,
    /// Degrees of freedom of a block.
    pub(super) size: usize,
    /// Bit mask of the fixed degrees of freedom, by block.
    pub(super) fixed: Vec<u64>,
    /// Consider parameters: block and standard deviations of its degrees of freedom.
    pub(super) considered: Vec<(usize, Vec<f64>)>,
}

impl Group<'_> {
    /// Returns the bit mask of all degrees of freedom.
    pub(super) fn all_mask(&self) -> u64 {
        if self.size >= 64 { u64::MAX } else { (1 << self.size) - 1 }
    }
}
