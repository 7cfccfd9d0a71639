//! How well parameters are known.

use super::error::AdjustError;
use super::factor::{Analysis, Factor};
use super::normal::{Normal, Reduced, determined};
use super::residual::LossModel;
use super::structure::{NONE, Structure};
use super::{Adjustment, GroupId};
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// Below this share of the diagonal, an eigenvalue of the reduced system is rounding: the sums that are eliminated cancel to about 1e-14 of it.
const SINGULAR: f64 = 1e-12;
/// Most parameters of a reduced system whose whole inverse is made where many blocks are asked for: 200 MB.
const MOST_INVERTED: usize = 5000;

/// Covariances of the blocks of an [`Adjustment`] at its values, in their tangent coordinates. See [`Adjustment::covariance`].
pub struct Covariance<'p> {
    of: &'p Adjustment<'p>,
    structure: Structure,
    normal: Normal,
    reduced: Reduced,
    factor: Option<Factor>,
    /// By how much the free columns move with the considered ones, `−S_FF⁻¹ S_FC`.
    moved: DMatrix<f64>,
    variance: f64,
}

/// A block as a linear function of the reduced system's columns: `x = Σ factors · column`, and noise of its own.
struct Lift {
    columns: Vec<usize>,
    /// A row for each column, a column for each degree of freedom.
    factors: DMatrix<f64>,
    /// Inverse information of the block itself, given all others.
    own: Option<DMatrix<f64>>,
}

impl Adjustment<'_> {
    /// What is needed to tell covariances: the normal equations at the present values, undamped, factored.
    ///
    /// `variance`: of a number of a residual with weight one; 1 where residuals are divided by their standard deviations, else as from
    /// [`Adjustment::variance`].
    /// Held parameters and what they fix (position, turn and scale of the coordinate system) count as exact: covariances are relative to them.
    /// To first order, with the weights of the robust loss, which understate the variance of large residuals.
    ///
    /// # Errors
    /// As [`Adjustment::solve`], and [`AdjustError::RankDeficient`] where the residuals leave the blocks free that are not eliminated.
    pub fn covariance(&self, variance: f64) -> Result<Covariance<'_>, AdjustError> {
        self.check_start()?;
        rayon::scope(|_| self.normal_covariance(variance))
    }

    fn normal_covariance(&self, variance: f64) -> Result<Covariance<'_>, AdjustError> {
        let structure = Structure::new(&self.groups, &self.kinds, self.eliminated, true);
        let mut normal = Normal::default();
        normal.linearize(&self.kinds, &structure, &self.values, LossModel::Weight).map_err(|u| self.undefined(u))?;
        let mut reduced = Reduced::default();
        normal.reduce(&structure, 0.0, &mut reduced).map_err(|block| self.deficient_point(block))?;
        let (free, all) = (structure.free, structure.columns);
        let factor = if free == 0 { None } else { Some(self.factor(&structure, &normal, &reduced)?) };
        let mut moved = DMatrix::zeros(free, all - free);
        for (b, block) in structure.blocks.iter().enumerate().take_while(|(_, b)| b.column < free) {
            for &(other, row) in
                structure.pattern.rows[b].iter().filter(|r| structure.blocks[r.0 as usize].column >= free)
            {
                let other = &structure.blocks[other as usize];
                for c in 0..block.size {
                    let from = structure.pattern.start[b] + c * structure.pattern.height[b] + row as usize;
                    for k in 0..other.size {
                        moved[(block.column + c, other.column - free + k)] = -reduced.s[from + k];
                    }
                }
            }
        }
        if let Some(factor) = &factor {
            factor.solve(free, moved.as_mut_slice());
        }
        Ok(Covariance { of: self, structure, normal, reduced, factor, moved, variance })
    }

    /// Variance of a number of a residual with weight one, as the residuals show it: `Σ w r² / Σ w`, corrected for the degrees of freedom that were
    /// fitted. 0 where there are no more numbers than degrees of freedom.
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
            let seen = |kind: usize, p: usize| {
                let links = &structure.links[kind];
                links.eliminated.is_some() && !links.of_point(p).is_empty()
            };
            let observed = (0..points.count).filter(|p| (0..self.kinds.len()).any(|k| seen(k, *p)));
            observed.map(|p| points.size - points.held[p].count_ones() as usize).sum()
        });
        let spare = count as f64 - (structure.columns + points) as f64;
        Ok(if spare > 0.0 && weights > 0.0 { squares / (weights * spare / count as f64) } else { 0.0 })
    }

    fn deficient_point(&self, block: usize) -> AdjustError {
        let group = self.eliminated.map_or(String::new(), |e| self.groups[e].name.clone());
        AdjustError::RankDeficient { group, block }
    }

    /// The factor of the free columns; where they are singular, the block that moves most in the direction that is free.
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
        // A ridge far below what counts as singular makes a factor of a singular system too.
        let factor = analysis.factor(structure, &reduced.s).map(|f| (f, false)).or_else(|| {
            let mut ridge = reduced.s.clone();
            for (b, block) in structure.blocks.iter().enumerate().take_while(|(_, b)| b.column < free) {
                for c in 0..block.size {
                    let at = structure.pattern.start[b] + c * (structure.pattern.height[b] + 1);
                    ridge[at] += 0.1 * SINGULAR * scale[block.column + c];
                }
            }
            analysis.factor(structure, &ridge).map(|f| (f, true))
        });
        let Some((factor, singular)) = factor else { return Err(name(0)) };
        // Inverse iteration for the least eigenvalue of S x = λ diag(U) x. No coordinate axis as the start: those may be eigenvectors.
        let mut x: Vec<f64> = scale.iter().enumerate().map(|(i, d)| (1.0 + 0.1 * (i % 7) as f64) / d.sqrt()).collect();
        let mut least = f64::INFINITY;
        for _ in 0..8 {
            let norm = x.iter().zip(&scale).map(|(x, d)| x * x * d).sum::<f64>().sqrt();
            x.iter_mut().zip(&scale).for_each(|(x, d)| *x *= d / norm);
            factor.solve(free, &mut x);
            least = 1.0 / x.iter().zip(&scale).map(|(x, d)| x * x * d).sum::<f64>().sqrt();
        }
        if singular || least.is_nan() || least < SINGULAR {
            let weight = |i: &usize| x[*i] * x[*i] * scale[*i];
            let worst = (0..free).max_by(|a, b| weight(a).total_cmp(&weight(b))).unwrap_or(0);
            return Err(name(worst));
        }
        Ok(factor)
    }
}

impl Covariance<'_> {
    /// Covariance of a block's degrees of freedom; zero for those that are held.
    ///
    /// # Errors
    /// [`AdjustError::RankDeficient`] where the residuals do not determine the block, [`AdjustError::Index`] where there is none.
    pub fn of(&self, group: GroupId, block: usize) -> Result<DMatrix<f64>, AdjustError> {
        self.between((group, block), (group, block))
    }

    /// Covariance of the degrees of freedom of one block, by rows, with those of another.
    ///
    /// # Errors
    /// As [`Covariance::of`].
    pub fn between(&self, a: (GroupId, usize), b: (GroupId, usize)) -> Result<DMatrix<f64>, AdjustError> {
        let (left, right) = (self.lift(a.0, a.1)?, self.lift(b.0, b.1)?);
        let mut x = DMatrix::zeros(self.structure.columns, right.factors.ncols());
        for (row, &column) in right.columns.iter().enumerate() {
            x.row_mut(column).copy_from(&right.factors.row(row));
        }
        self.times(&mut x);
        let rows = DMatrix::from_fn(left.columns.len(), x.ncols(), |i, j| x[(left.columns[i], j)]);
        let mut covariance = left.factors.transpose() * rows;
        if let (true, Some(own)) = (a == b, left.own) {
            covariance += own * self.variance;
        }
        Ok(covariance)
    }

    /// Covariances of all blocks of a group, in parallel.
    pub fn of_group(&self, group: GroupId) -> Vec<Result<DMatrix<f64>, AdjustError>> {
        let Some(of) = self.of.groups.get(group.0) else { return Vec::new() };
        let n = self.structure.columns;
        // As many solutions as there are columns give them all.
        if n > MOST_INVERTED || of.count * of.size < n {
            return (0..of.count).into_par_iter().map(|block| self.of(group, block)).collect();
        }
        let mut all = DMatrix::identity(n, n);
        self.times(&mut all);
        let one = |block: usize| {
            let lift = self.lift(group, block)?;
            let k = lift.columns.len();
            let part = DMatrix::from_fn(k, k, |i, j| all[(lift.columns[i], lift.columns[j])]);
            let mut covariance = lift.factors.transpose() * part * &lift.factors;
            if let Some(own) = lift.own {
                covariance += own * self.variance;
            }
            Ok(covariance)
        };
        (0..of.count).into_par_iter().map(one).collect()
    }

    /// `x ← C x`, the covariance of all columns of the reduced system.
    fn times(&self, x: &mut DMatrix<f64>) {
        let (free, all) = (self.structure.free, self.structure.columns);
        let deviations = DVector::from_column_slice(&self.structure.considered);
        // What the considered columns move: themselves, and the free ones with them.
        let mut by_considered = self.moved.transpose() * x.rows(0, free) + x.rows(free, all - free);
        for (mut row, d) in by_considered.row_iter_mut().zip(&deviations) {
            row *= d * d;
        }
        let mut solved = x.rows(0, free).into_owned();
        if let Some(factor) = &self.factor {
            factor.solve(free, solved.as_mut_slice());
        }
        x.rows_mut(0, free).copy_from(&(solved * self.variance + &self.moved * &by_considered));
        x.rows_mut(free, all - free).copy_from(&by_considered);
    }

    fn lift(&self, group: GroupId, block: usize) -> Result<Lift, AdjustError> {
        self.of.check_block(group, block)?;
        let of = &self.of.groups[group.0];
        let deficient = || AdjustError::RankDeficient { group: of.name.clone(), block };
        if let Some(points) = self.structure.points.as_ref().filter(|p| p.group == group.0) {
            let e = points.size;
            let rank = points.rank[block] as usize;
            let held = points.held[rank];
            if held != of.all() && !determined(&self.normal.v[rank * e * e..][..e * e], e) {
                return Err(deficient());
            }
            let (inverse, w) = self.normal.point(points, &self.reduced, rank);
            let free = |k: usize| held >> k & 1 == 0;
            let own = DMatrix::from_fn(e, e, |i, j| if free(i) && free(j) { inverse[i * e + j] } else { 0.0 });
            // Each column, where its cross terms begin, and how far they are apart.
            let columns = points.cells.of(rank).iter().flat_map(|cell| {
                let first = self.structure.blocks[cell.block as usize].column;
                let (size, place) = (cell.size as usize, e * cell.place as usize);
                (0..size).map(move |c| (first + c, place + c, size))
            });
            let columns: Vec<(usize, usize, usize)> = columns.collect();
            let factors = DMatrix::from_fn(columns.len(), e, |i, j| {
                let (_, at, step) = columns[i];
                -(0..e).map(|k| own[(j, k)] * w[at + k * step]).sum::<f64>()
            });
            return Ok(Lift { columns: columns.into_iter().map(|c| c.0).collect(), factors, own: Some(own) });
        }
        let (at, member) = self.structure.place[group.0][block];
        if at == NONE {
            let held = of.held[block] == of.all();
            let nothing = Lift { columns: Vec::new(), factors: DMatrix::zeros(0, of.size), own: None };
            return if held { Ok(nothing) } else { Err(deficient()) };
        }
        let reduced = &self.structure.blocks[at as usize];
        let member = reduced.members[member as usize];
        let considered = reduced.column >= self.structure.free;
        let free: Vec<usize> = (0..of.size).filter(|k| considered || of.held[block] >> k & 1 == 0).collect();
        let first = reduced.column + member.within;
        let factors = DMatrix::from_fn(free.len(), of.size, |i, j| f64::from(u8::from(free[i] == j)));
        Ok(Lift { columns: (first..first + member.width).collect(), factors, own: None })
    }
}
