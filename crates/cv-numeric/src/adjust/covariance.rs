//! Covariances of the estimated parameters.

use super::error::AdjustError;
use super::factor::{Analysis, Factor};
use super::normal::{Normal, Reduced, is_determined};
use super::residual::LossModel;
use super::structure::{NONE, Structure};
use super::{Adjustment, GroupId};
use cv_parallel::prelude::*;
use nalgebra::{DMatrix, DVector};

/// Relative eigenvalue of the reduced system, scaled by its diagonal, below which it counts as singular: elimination cancels to about 1e-14.
const EIGENVALUE_TOLERANCE: f64 = 1e-12;
/// Maximum columns of a reduced system that is inverted as a whole to get the covariances of many blocks: 200 MB.
const MAX_INVERTED_COLUMNS: usize = 5000;

/// Covariances of the blocks of an [`Adjustment`] at its present values, in tangent coordinates. See [`Adjustment::covariance`].
pub struct Covariance<'p> {
    of: &'p Adjustment<'p>,
    structure: Structure,
    normal: Normal,
    reduced: Reduced,
    factor: Option<Factor>,
    /// Sensitivity of the free columns to the considered ones, `−S_FF⁻¹ S_FC`.
    sensitivity: DMatrix<f64>,
    variance: f64,
}

/// A block as a linear function of the reduced system's columns, `x = Σ factors · column`, plus independent noise.
struct LinearForm {
    columns: Vec<usize>,
    /// A row per column of the reduced system, a column per degree of freedom.
    factors: DMatrix<f64>,
    /// Conditional covariance of the block given all others, `V⁻¹`, for eliminated blocks.
    conditional: Option<DMatrix<f64>>,
}

impl Adjustment<'_> {
    /// Factors the undamped normal equations at the present values, from which covariances are computed.
    ///
    /// `variance`: the variance of a residual component of weight one; 1 where residuals are divided by their standard deviations, else
    /// that of [`Adjustment::variance`].
    /// Fixed parameters, and the gauge they fix (origin, orientation, scale), count as exact: covariances are relative to them.
    /// First-order propagation with the weights of the robust loss, which understates the variance of large residuals.
    ///
    /// # Errors
    /// As [`Adjustment::solve`], and [`AdjustError::RankDeficient`] where the reduced system is singular.
    pub fn covariance(&self, variance: f64) -> Result<Covariance<'_>, AdjustError> {
        self.check_start()?;
        rayon::scope(|_| self.covariance_in_pool(variance))
    }

    fn covariance_in_pool(&self, variance: f64) -> Result<Covariance<'_>, AdjustError> {
        let structure = Structure::new(&self.groups, &self.kinds, self.eliminated, true);
        let mut normal = Normal::default();
        normal.linearize(&self.kinds, &structure, &self.values, LossModel::Weight).map_err(|u| self.undefined(u))?;
        let mut reduced = Reduced::default();
        normal.reduce(&structure, 0.0, &mut reduced).map_err(|block| self.deficient_point(block))?;
        let (free, all) = (structure.free, structure.columns);
        let factor = if free == 0 { None } else { Some(self.factor(&structure, &normal, &reduced)?) };
        let mut sensitivity = DMatrix::zeros(free, all - free);
        for (b, block) in structure.blocks.iter().enumerate().take_while(|(_, b)| b.column < free) {
            for &(other, row) in
                structure.pattern.rows[b].iter().filter(|r| structure.blocks[r.0 as usize].column >= free)
            {
                let other = &structure.blocks[other as usize];
                for c in 0..block.size {
                    let from = structure.pattern.start[b] + c * structure.pattern.height[b] + row as usize;
                    for k in 0..other.size {
                        sensitivity[(block.column + c, other.column - free + k)] = -reduced.s[from + k];
                    }
                }
            }
        }
        if let Some(factor) = &factor {
            factor.solve(free, sensitivity.as_mut_slice());
        }
        Ok(Covariance { of: self, structure, normal, reduced, factor, sensitivity, variance })
    }

    /// Estimates the variance of a residual component of weight one from the residuals: `Σ w r² / Σ w`, corrected for the fitted degrees
    /// of freedom. 0 where there are no more residual components than degrees of freedom.
    ///
    /// # Errors
    /// As [`Adjustment::solve`].
    pub fn variance(&self) -> Result<f64, AdjustError> {
        let sums = self.residual_sums()?;
        let (mut squares, mut weights, mut count) = (0.0, 0.0, 0);
        for s in &sums {
            (squares, weights, count) = (squares + s.weighted_squares, weights + s.weights, count + s.count);
        }
        let structure = Structure::new(&self.groups, &self.kinds, self.eliminated, false);
        let points = structure.points.as_ref().map_or(0, |points| {
            let is_observed = |kind: usize, p: usize| {
                let incidence = &structure.incidence[kind];
                incidence.eliminated.is_some() && !incidence.residuals_of_point(p).is_empty()
            };
            let observed = (0..points.count).filter(|p| (0..self.kinds.len()).any(|k| is_observed(k, *p)));
            observed.map(|p| points.size - points.fixed[p].count_ones() as usize).sum()
        });
        let redundancy = count as f64 - (structure.columns + points) as f64;
        Ok(if redundancy > 0.0 && weights > 0.0 { squares / (weights * redundancy / count as f64) } else { 0.0 })
    }

    fn deficient_point(&self, block: usize) -> AdjustError {
        let group = self.eliminated.map_or(String::new(), |e| self.groups[e].name.clone());
        AdjustError::RankDeficient { group, block }
    }

    /// Factors the free columns; where they are singular, returns the block with the largest component in the null direction.
    fn factor(&self, structure: &Structure, normal: &Normal, reduced: &Reduced) -> Result<Factor, AdjustError> {
        let free = structure.free;
        let scale: Vec<f64> = normal.diagonal[..free].to_vec();
        let name = |column: usize| {
            let block = structure.blocks.iter().rfind(|b| b.column <= column);
            let member = block.and_then(|b| b.members.iter().rfind(|m| b.column + m.within <= column));
            let (group, block) = member.map_or((0, 0), |m| (m.group, m.block as usize));
            AdjustError::RankDeficient { group: self.groups[group].name.clone(), block }
        };
        if let Some(column) = scale.iter().position(|d| d.is_nan() || *d <= 0.0) {
            return Err(name(column));
        }
        let Some(analysis) = Analysis::new(structure) else { return Err(name(0)) };
        // A ridge far below the singularity tolerance makes a singular system factorizable too.
        let factor = analysis.factor(structure, &reduced.s).map(|f| (f, false)).or_else(|| {
            let mut ridge = reduced.s.clone();
            for (b, block) in structure.blocks.iter().enumerate().take_while(|(_, b)| b.column < free) {
                for c in 0..block.size {
                    let at = structure.pattern.start[b] + c * (structure.pattern.height[b] + 1);
                    ridge[at] += 0.1 * EIGENVALUE_TOLERANCE * scale[block.column + c];
                }
            }
            analysis.factor(structure, &ridge).map(|f| (f, true))
        });
        let Some((factor, singular)) = factor else { return Err(name(0)) };
        // Inverse iteration for the smallest eigenvalue of S x = λ diag(U) x. The start is no coordinate axis: those may be eigenvectors.
        let mut x: Vec<f64> = scale.iter().enumerate().map(|(i, d)| (1.0 + 0.1 * (i % 7) as f64) / d.sqrt()).collect();
        let mut smallest = f64::INFINITY;
        for _ in 0..8 {
            let norm = x.iter().zip(&scale).map(|(x, d)| x * x * d).sum::<f64>().sqrt();
            x.iter_mut().zip(&scale).for_each(|(x, d)| *x *= d / norm);
            factor.solve(free, &mut x);
            smallest = 1.0 / x.iter().zip(&scale).map(|(x, d)| x * x * d).sum::<f64>().sqrt();
        }
        if singular || smallest.is_nan() || smallest < EIGENVALUE_TOLERANCE {
            let weight = |i: &usize| x[*i] * x[*i] * scale[*i];
            let worst = (0..free).max_by(|a, b| weight(a).total_cmp(&weight(b))).unwrap_or(0);
            return Err(name(worst));
        }
        Ok(factor)
    }
}

impl Covariance<'_> {
    /// Computes the covariance of a block's degrees of freedom; zero for fixed ones.
    ///
    /// # Errors
    /// [`AdjustError::RankDeficient`] where the residuals do not determine the block, [`AdjustError::Index`] where it does not exist.
    pub fn of(&self, group: GroupId, block: usize) -> Result<DMatrix<f64>, AdjustError> {
        self.between((group, block), (group, block))
    }

    /// Computes the cross-covariance of the degrees of freedom of one block (rows) with those of another (columns).
    ///
    /// # Errors
    /// As [`Covariance::of`].
    pub fn between(&self, a: (GroupId, usize), b: (GroupId, usize)) -> Result<DMatrix<f64>, AdjustError> {
        let (left, right) = (self.linear_form(a.0, a.1)?, self.linear_form(b.0, b.1)?);
        let mut x = DMatrix::zeros(self.structure.columns, right.factors.ncols());
        for (row, &column) in right.columns.iter().enumerate() {
            x.row_mut(column).copy_from(&right.factors.row(row));
        }
        self.multiply(&mut x);
        let rows = DMatrix::from_fn(left.columns.len(), x.ncols(), |i, j| x[(left.columns[i], j)]);
        let mut covariance = left.factors.transpose() * rows;
        if let (true, Some(conditional)) = (a == b, left.conditional) {
            covariance += conditional * self.variance;
        }
        Ok(covariance)
    }

    /// Computes the covariances of all blocks of a group, in parallel.
    pub fn of_group(&self, group: GroupId) -> Vec<Result<DMatrix<f64>, AdjustError>> {
        let Some(of) = self.of.groups.get(group.0) else { return Vec::new() };
        let n = self.structure.columns;
        // Inverting the whole reduced system takes as many solves as columns: worthwhile where the group has at least as many.
        if n > MAX_INVERTED_COLUMNS || of.count * of.size < n {
            return (0..of.count).into_par_iter().map(|block| self.of(group, block)).collect();
        }
        let mut all = DMatrix::identity(n, n);
        self.multiply(&mut all);
        let one = |block: usize| {
            let linear_form = self.linear_form(group, block)?;
            let k = linear_form.columns.len();
            let part = DMatrix::from_fn(k, k, |i, j| all[(linear_form.columns[i], linear_form.columns[j])]);
            let mut covariance = linear_form.factors.transpose() * part * &linear_form.factors;
            if let Some(conditional) = linear_form.conditional {
                covariance += conditional * self.variance;
            }
            Ok(covariance)
        };
        (0..of.count).into_par_iter().map(one).collect()
    }

    /// `x ← C x`, the covariance of all columns of the reduced system.
    fn multiply(&self, x: &mut DMatrix<f64>) {
        let (free, all) = (self.structure.free, self.structure.columns);
        let deviations = DVector::from_column_slice(&self.structure.considered);
        // Contribution of the considered columns, to themselves and through the sensitivity to the free ones.
        let mut by_considered = self.sensitivity.transpose() * x.rows(0, free) + x.rows(free, all - free);
        for (mut row, d) in by_considered.row_iter_mut().zip(&deviations) {
            row *= d * d;
        }
        let mut solved = x.rows(0, free).into_owned();
        if let Some(factor) = &self.factor {
            factor.solve(free, solved.as_mut_slice());
        }
        x.rows_mut(0, free).copy_from(&(solved * self.variance + &self.sensitivity * &by_considered));
        x.rows_mut(free, all - free).copy_from(&by_considered);
    }

    fn linear_form(&self, group: GroupId, block: usize) -> Result<LinearForm, AdjustError> {
        self.of.check_block(group, block)?;
        let of = &self.of.groups[group.0];
        let deficient = || AdjustError::RankDeficient { group: of.name.clone(), block };
        if let Some(points) = self.structure.points.as_ref().filter(|p| p.group == group.0) {
            let e = points.size;
            let rank = points.rank[block] as usize;
            let fixed = points.fixed[rank];
            if fixed != of.all_mask() && !is_determined(&self.normal.v[rank * e * e..][..e * e], e) {
                return Err(deficient());
            }
            let (inverse, w) = self.normal.inverse_and_cross_terms(points, &self.reduced, rank);
            let free = |k: usize| fixed >> k & 1 == 0;
            let conditional = DMatrix::from_fn(e, e, |i, j| if free(i) && free(j) { inverse[i * e + j] } else { 0.0 });
            // Each column, the offset of its cross terms, and their stride.
            let columns = points.cross_blocks.of(rank).iter().flat_map(|cross_block| {
                let first = self.structure.blocks[cross_block.block as usize].column;
                let (size, offset) = (cross_block.size as usize, e * cross_block.offset as usize);
                (0..size).map(move |c| (first + c, offset + c, size))
            });
            let columns: Vec<(usize, usize, usize)> = columns.collect();
            let factors = DMatrix::from_fn(columns.len(), e, |i, j| {
                let (_, at, step) = columns[i];
                -(0..e).map(|k| conditional[(j, k)] * w[at + k * step]).sum::<f64>()
            });
            return Ok(LinearForm {
                columns: columns.into_iter().map(|c| c.0).collect(),
                factors,
                conditional: Some(conditional),
            });
        }
        let (at, member) = self.structure.location[group.0][block];
        if at == NONE {
            let fixed = of.fixed[block] == of.all_mask();
            let nothing = LinearForm { columns: Vec::new(), factors: DMatrix::zeros(0, of.size), conditional: None };
            return if fixed { Ok(nothing) } else { Err(deficient()) };
        }
        let reduced = &self.structure.blocks[at as usize];
        let member = reduced.members[member as usize];
        let considered = reduced.column >= self.structure.free;
        let free: Vec<usize> = (0..of.size).filter(|k| considered || of.fixed[block] >> k & 1 == 0).collect();
        let first = reduced.column + member.within;
        let factors = DMatrix::from_fn(free.len(), of.size, |i, j| f64::from(u8::from(free[i] == j)));
        Ok(LinearForm { columns: (first..first + member.width).collect(), factors, conditional: None })
    }
}
