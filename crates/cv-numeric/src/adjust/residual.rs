//! Residuals of one kind: what they depend on, and their part of the normal equations.

use super::manifold::Manifold;
use super::product::{add_gradient, add_product};
use super::structure::{Links, NONE, Structure};
use crate::RobustLoss;
use crate::parallel_map;
use nalgebra::{SMatrix, SVector};
use rayon::prelude::*;
use std::ops::Range;

/// Residuals of one kind: `R` numbers for each item, which depend on `B` blocks of parameters (1 to 4) with `C` degrees of freedom
/// between them.
///
/// The sizes are known to the compiler, so that the loop over the items is compiled for each kind and allocates nothing. One
/// block may be given twice to one residual.
pub trait Residual<const R: usize, const B: usize, const C: usize>: Send + Sync {
    /// Degrees of freedom of each block; they add up to `C`.
    const DIMS: [usize; B];

    /// The residual of an item, given the numbers that store its blocks ([`Manifold::ambient`] of each). Where asked for, its
    /// derivatives by the degrees of freedom of the blocks, side by side; `jacobian` comes filled with zeros.
    ///
    /// `None` where the residual is not defined, such as for a point behind a camera: a step there is not taken.
    fn evaluate(
        &self,
        item: usize,
        blocks: [&[f64]; B],
        jacobian: Option<&mut SMatrix<f64, R, C>>,
    ) -> Option<SVector<f64, R>>;
}

/// What is known of blocks of `N` numbers beforehand: residuals `(x − mean) · weight`, the weight one over the standard deviation in the
/// unit of the other residuals.
#[derive(Debug, Clone, PartialEq)]
pub struct Prior<const N: usize> {
    /// Mean and weight of each number, of each item.
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

/// The numbers of all blocks, by group.
#[derive(Debug, Clone)]
pub(super) struct Values {
    pub(super) numbers: Vec<Vec<f64>>,
    /// Numbers of a block, by group.
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
    /// `Σ w`, each residual counted with as many numbers as it has.
    pub weights: f64,
    /// Count of numbers.
    pub count: usize,
}

impl ResidualSums {
    /// Adds a residual of `numbers` numbers; its weight, or `None` where it is not finite.
    #[inline]
    fn count_in(&mut self, loss: &RobustLoss, squared: f64, numbers: usize) -> Option<f64> {
        let weight = loss.weight(squared);
        self.cost += loss.value(squared);
        self.weighted_squares += weight * squared;
        self.weights += weight * numbers as f64;
        self.count += numbers;
        squared.is_finite().then_some(weight)
    }

    fn add(&mut self, other: &Self) {
        self.cost += other.cost;
        self.weighted_squares += other.weighted_squares;
        self.weights += other.weights;
        self.count += other.count;
    }
}

/// The sum of parts in their order.
fn total(parts: Vec<Result<ResidualSums, usize>>) -> Result<ResidualSums, usize> {
    let mut sums = ResidualSums::default();
    for part in parts {
        sums.add(&part?);
    }
    Ok(sums)
}

/// How a robust loss enters the normal equations. The gradient is the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LossModel {
    /// By its weight alone (iteratively reweighted least squares): a parabola that lies above the loss.
    Weight,
    /// By its weight across the residual, and along it by its curvature, as far as that is positive.
    Curvature,
}

/// Least curvature along a residual, as a share of that across it: a loss that bends downward would make the normal equations indefinite, and one that is nearly straight
/// makes steps too long. On a generated block of 100 photographs with Cauchy's loss 0.3 takes 17 iterations, 0.05 takes 22, and weights alone take 32.
const LEAST_CURVATURE: f64 = 0.3;

/// Residuals and derivatives of all items of a kind, multiplied by the square roots of their weights, in the order of [`Links::items`].
#[derive(Debug, Clone, Default)]
pub(super) struct Rows {
    /// `R` numbers for each item.
    residuals: Vec<f64>,
    /// `R` rows of `C` numbers for each item. Columns of held parameters are left out, the free ones of a block moved together; of eliminated
    /// blocks they are zero.
    jacobians: Vec<f64>,
}

/// An eliminated block's part of the normal equations.
pub(super) struct PointSums<'a> {
    /// `E × E`.
    pub(super) v: &'a mut [f64],
    /// `E`.
    pub(super) g: &'a mut [f64],
    /// Cross terms with the blocks that the point is seen with: for each `E` rows, as long as that has columns.
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

/// Items that one task works on; sums of tasks are added in order, so that the number of threads changes nothing.
const CHUNK: usize = 256;

/// A kind of residuals, its type forgotten.
pub(super) trait Kind: Send + Sync {
    fn name(&self) -> &str;
    fn len(&self) -> usize;
    /// Group of each block of a residual.
    fn groups(&self) -> &[usize];
    /// Number within its group of each block of an item.
    fn blocks(&self, item: usize) -> &[u32];
    /// `Σ ρ(‖r‖²)`, infinite where a residual is not defined.
    fn cost(&self, values: &Values) -> f64;
    /// Fills the rows. An item that is not defined as the error.
    fn linearize(&self, values: &Values, links: &Links, model: LossModel, rows: &mut Rows) -> Result<(), usize>;
    /// Sums over the items. The first item that is not defined as the error.
    fn sums(&self, values: &Values) -> Result<ResidualSums, usize>;
    /// Adds the places that see one eliminated block.
    fn add_to_point(&self, rows: &Rows, links: &Links, places: Range<usize>, point: PointSums<'_>);
    /// Adds the places that touch the columns of a task.
    fn add_to_columns(&self, rows: &Rows, links: &Links, places: &[u32], columns: ColumnSums<'_>);
    /// The numbers of an item and their common weight, for a plain reference.
    #[cfg(test)]
    fn plain(&self, values: &Values, item: usize) -> (Vec<f64>, f64);
}

/// A kind of residuals with the blocks that its items depend on.
pub(super) struct Typed<T, const R: usize, const B: usize, const C: usize> {
    pub(super) name: String,
    pub(super) residual: T,
    pub(super) groups: [usize; B],
    pub(super) blocks: Vec<[u32; B]>,
    pub(super) loss: RobustLoss,
}

impl<T: Residual<R, B, C>, const R: usize, const B: usize, const C: usize> Typed<T, R, B, C> {
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
    fn at<'v>(&self, values: &'v Values, item: usize) -> [&'v [f64]; B] {
        let blocks = &self.blocks[item];
        let mut all: [&[f64]; B] = [&[]; B];
        for (k, numbers) in all.iter_mut().enumerate() {
            *numbers = values.block(self.groups[k], blocks[k] as usize);
        }
        all
    }

    fn cost_of(&self, values: &Values, items: Range<usize>) -> f64 {
        let mut cost = 0.0;
        for item in items {
            match self.residual.evaluate(item, self.at(values, item), None) {
                Some(r) => cost += self.loss.value(r.norm_squared()),
                None => return f64::INFINITY,
            }
        }
        cost
    }

    fn linearize_chunk(
        &self,
        values: &Values,
        links: &Links,
        model: LossModel,
        items: &[u32],
        (jacobians, residuals): (&mut [f64], &mut [f64]),
    ) -> Result<(), usize> {
        let rows = jacobians.chunks_exact_mut(R * C).zip(residuals.chunks_exact_mut(R));
        for (item, (jacobian, residual)) in items.iter().zip(rows) {
            let item = *item as usize;
            let mut j = SMatrix::<f64, R, C>::zeros();
            let mut r = self.residual.evaluate(item, self.at(values, item), Some(&mut j)).ok_or(item)?;
            let squared = r.norm_squared();
            if !squared.is_finite() {
                return Err(item);
            }
            let root = self.loss.weight(squared).sqrt();
            if model == LossModel::Curvature {
                let along = self.loss.curvature(squared).max(LEAST_CURVATURE).sqrt();
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
            if links.any_held {
                self.leave_out_held(links, item, jacobian);
            }
        }
        Ok(())
    }

    fn leave_out_held(&self, links: &Links, item: usize, jacobian: &mut [f64]) {
        for k in 0..B {
            let held = links.held(self.groups[k], self.blocks[item][k]);
            if held == 0 {
                continue;
            }
            let compact = links.eliminated != Some(k);
            for row in jacobian.chunks_exact_mut(C) {
                let mut to = Self::FIRST[k];
                for c in 0..T::DIMS[k] {
                    let value = row[Self::FIRST[k] + c];
                    let free = held >> c & 1 == 0;
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

impl<T: Residual<R, B, C>, const R: usize, const B: usize, const C: usize> Kind for Typed<T, R, B, C> {
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
        let chunks = self.len().div_ceil(CHUNK);
        let of = |c: usize| self.cost_of(values, c * CHUNK..((c + 1) * CHUNK).min(self.len()));
        parallel_map(chunks, &of).iter().sum()
    }

    fn linearize(&self, values: &Values, links: &Links, model: LossModel, rows: &mut Rows) -> Result<(), usize> {
        rows.residuals.resize(self.len() * R, 0.0);
        rows.jacobians.resize(self.len() * R * C, 0.0);
        let chunks = rows.jacobians.par_chunks_mut(CHUNK * R * C).zip(rows.residuals.par_chunks_mut(CHUNK * R));
        let chunks = chunks.zip(links.items.par_chunks(CHUNK));
        let failed = chunks.filter_map(|(out, items)| self.linearize_chunk(values, links, model, items, out).err());
        failed.min().map_or(Ok(()), Err)
    }

    fn sums(&self, values: &Values) -> Result<ResidualSums, usize> {
        let chunk = |c: usize| {
            let mut sums = ResidualSums::default();
            for item in c * CHUNK..((c + 1) * CHUNK).min(self.len()) {
                let r = self.residual.evaluate(item, self.at(values, item), None).ok_or(item)?;
                sums.count_in(&self.loss, r.norm_squared(), R).ok_or(item)?;
            }
            Ok(sums)
        };
        total(parallel_map(self.len().div_ceil(CHUNK), &chunk))
    }

    #[cfg(test)]
    fn plain(&self, values: &Values, item: usize) -> (Vec<f64>, f64) {
        let r = self.residual.evaluate(item, self.at(values, item), None).unwrap();
        (r.as_slice().to_vec(), self.loss.weight(r.norm_squared()))
    }

    fn add_to_point(&self, rows: &Rows, links: &Links, places: Range<usize>, point: PointSums<'_>) {
        let Some(e) = links.eliminated else { return };
        let (size, first) = (T::DIMS[e], Self::FIRST[e]);
        let mut places = places;
        while !places.is_empty() {
            let (place, count) = (places.start, links.run(places.clone(), B));
            places.start += count;
            let j = (&rows.jacobians[place * R * C..][..count * R * C], C);
            add_product(j, (first, size), (first, size), point.v, size);
            add_gradient(j, (first, size), &rows.residuals[place * R..][..count * R], point.g);
            for (k, target) in links.targets(place, B).iter().enumerate() {
                if k != e && target.block != NONE {
                    let out = &mut point.w[size * target.place as usize + target.within as usize..];
                    let left = (Self::FIRST[k], target.width as usize);
                    add_product(j, left, (first, size), out, target.size as usize);
                }
            }
        }
    }

    fn add_to_columns(&self, rows: &Rows, links: &Links, places: &[u32], columns: ColumnSums<'_>) {
        let ColumnSums { structure: Structure { pattern, blocks, .. }, blocks: range, values, gradient } = columns;
        let Some(first) = blocks.get(range.start) else { return };
        let (first_value, first_column) = (pattern.start[range.start], first.column);
        let mut places = places;
        while let Some(&place) = places.first() {
            let (place, count) = (place as usize, links.run(places.iter().map(|p| *p as usize), B));
            places = &places[count..];
            let j = (&rows.jacobians[place * R * C..][..count * R * C], C);
            let r = &rows.residuals[place * R..][..count * R];
            let targets = links.targets(place, B);
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
                    // The rest of the row is in the columns of the other blocks.
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

/// A group of blocks: their name, how they move, and what of them is held.
pub(super) struct Group<'a> {
    pub(super) name: String,
    pub(super) manifold: Box<dyn Manifold + 'a>,
    pub(super) count: usize,
    /// Degrees of freedom of a block.
    pub(super) size: usize,
    /// A bit for each degree of freedom that is held, of each block.
    pub(super) held: Vec<u64>,
    /// Blocks that are held but counted as uncertain in covariances: standard deviations of the degrees of freedom.
    pub(super) considered: Vec<(usize, Vec<f64>)>,
}

impl Group<'_> {
    /// All degrees of freedom.
    pub(super) fn all(&self) -> u64 {
        if self.size >= 64 { u64::MAX } else { (1 << self.size) - 1 }
    }
}
