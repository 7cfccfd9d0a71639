//! Sparse robust least squares over blocks of parameters: bundle adjustment, calibration, alignment.
//!
//! A problem has *groups* of parameter blocks (poses, lenses, points), each with a name, a [`Manifold`] and values, and *kinds* of
//! residuals ([`Residual`]), whose items list the blocks they depend on. One group may be eliminated by the Schur complement
//! ([`Adjustment::eliminate`]): the most numerous one, usually the points, of which a residual may depend on at most one. The reduced
//! system is solved densely where it is small or full, else by faer's sparse Cholesky factorization. [`Adjustment::solve`] minimizes
//! the cost, [`Adjustment::covariance`] computes covariances.
//!
//! ```
//! use cv_numeric::RobustLoss;
//! use cv_numeric::adjust::{AdjustOptions, Adjustment, Euclidean, Residual};
//! use nalgebra::{SMatrix, SVector};
//! use std::ops::ControlFlow;
//!
//! /// Heights above a line `y = a x + b`.
//! struct Line(Vec<(f64, f64)>);
//!
//! impl Residual<1, 1, 2> for Line {
//!     const DIMS: [usize; 1] = [2];
//!
//!     fn evaluate(&self, item: usize, [line]: [&[f64]; 1], jacobian: Option<&mut SMatrix<f64, 1, 2>>) -> Option<SVector<f64, 1>> {
//!         let (x, y) = self.0[item];
//!         if let Some(j) = jacobian {
//!             *j = SMatrix::from([[x], [1.0]]);
//!         }
//!         Some(SVector::from([line[0] * x + line[1] - y]))
//!     }
//! }
//!
//! let mut problem = Adjustment::default();
//! let line = problem.add_group("line", Euclidean(2), vec![0.0, 0.0])?;
//! let points = Line(vec![(0.0, 1.0), (1.0, 3.0), (2.0, 5.0), (3.0, 50.0)]);
//! problem.add_residuals("points", points, [line], vec![[0]; 4], RobustLoss::Cauchy { scale: 0.1 })?;
//! let report = problem.solve(&AdjustOptions::default(), |_| ControlFlow::Continue(()))?;
//! assert!(report.converged() && (problem.values(line)[0] - 2.0).abs() < 0.01);
//! # Ok::<(), cv_numeric::adjust::AdjustError>(())
//! ```

mod covariance;
mod error;
mod factor;
mod manifold;
mod normal;
mod product;
mod residual;
mod schedule;
mod solve;
mod structure;

use crate::RobustLoss;
pub use covariance::Covariance;
pub use error::AdjustError;
pub use manifold::{Euclidean, Manifold, RelativeMotion, RigidMotion, RotationManifold, UnitVector};
use residual::{Group, ResidualKind, TypedResiduals, Values};
pub use residual::{Prior, Residual, ResidualSums};
pub use solve::{AdjustIteration, AdjustOptions, AdjustReport, Termination};

/// A group of blocks of an [`Adjustment`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GroupId(usize);

/// A least-squares problem over parameter blocks, with their present values. See the [module](self).
pub struct Adjustment<'a> {
    groups: Vec<Group<'a>>,
    kinds: Vec<Box<dyn ResidualKind + 'a>>,
    values: Values,
    eliminated: Option<usize>,
}

impl Default for Adjustment<'_> {
    fn default() -> Self {
        let values = Values { numbers: Vec::new(), ambient: Vec::new() };
        Self { groups: Vec::new(), kinds: Vec::new(), values, eliminated: None }
    }
}

impl<'a> Adjustment<'a> {
    /// Adds a group of blocks with their initial values, block after block. The name is for error messages.
    ///
    /// # Errors
    /// [`AdjustError::Length`] where the values are not whole blocks, [`AdjustError::Size`] where blocks have no or more than 64 degrees of freedom.
    pub fn add_group(
        &mut self,
        name: &str,
        manifold: impl Manifold + 'a,
        values: Vec<f64>,
    ) -> Result<GroupId, AdjustError> {
        let (ambient, size) = (manifold.ambient(), manifold.tangent());
        if size == 0 || size > 64 || ambient == 0 {
            return Err(AdjustError::Size { group: name.to_owned(), got: size, most: 64 });
        }
        if !values.len().is_multiple_of(ambient) {
            return Err(AdjustError::Length { group: name.to_owned(), got: values.len(), block: ambient });
        }
        let count = values.len() / ambient;
        self.groups.push(Group {
            name: name.to_owned(),
            manifold: Box::new(manifold),
            count,
            size,
            fixed: vec![0; count],
            considered: Vec::new(),
        });
        self.values.numbers.push(values);
        self.values.ambient.push(ambient);
        Ok(GroupId(self.groups.len() - 1))
    }

    /// Adds residuals of one kind: item `i` depends on the blocks `blocks[i]` of the `groups`. The name is for error messages.
    ///
    /// # Errors
    /// [`AdjustError::Dimension`] where a group's blocks have other degrees of freedom than [`Residual::DIMS`], [`AdjustError::Index`]
    /// where a block does not exist.
    pub fn add_residuals<const R: usize, const B: usize, const C: usize>(
        &mut self,
        name: &str,
        residual: impl Residual<R, B, C> + 'a,
        groups: [GroupId; B],
        blocks: Vec<[u32; B]>,
        loss: RobustLoss,
    ) -> Result<(), AdjustError> {
        let groups = groups.map(|g| g.0);
        let typed = TypedResiduals { name: name.to_owned(), residual, groups, blocks, loss };
        for (g, expected) in groups.into_iter().zip(block_dimensions(&typed)) {
            let group = self.groups.get(g).ok_or_else(|| self.group_error(g))?;
            if group.size != expected {
                return Err(AdjustError::Dimension {
                    residuals: name.to_owned(),
                    group: group.name.clone(),
                    expected,
                    got: group.size,
                });
            }
        }
        for blocks in &typed.blocks {
            for (&g, &index) in groups.iter().zip(blocks) {
                self.check_block(GroupId(g), index as usize)?;
            }
        }
        self.kinds.push(Box::new(typed));
        Ok(())
    }

    /// Marks a group for elimination from the normal equations by the Schur complement. Choose the group with the most blocks; a residual
    /// may depend on at most one of them.
    ///
    /// # Errors
    /// [`AdjustError::Size`] where blocks have more than 6 degrees of freedom.
    pub fn eliminate(&mut self, group: GroupId) -> Result<(), AdjustError> {
        let of = self.groups.get(group.0).ok_or_else(|| self.group_error(group.0))?;
        if of.size > 6 {
            return Err(AdjustError::Size { group: of.name.clone(), got: of.size, most: 6 });
        }
        self.eliminated = Some(group.0);
        Ok(())
    }

    /// Fixes a block at its present value.
    ///
    /// # Errors
    /// [`AdjustError::Index`] where there is no such block.
    pub fn fix(&mut self, group: GroupId, block: usize) -> Result<(), AdjustError> {
        self.check_block(group, block)?;
        let group = &mut self.groups[group.0];
        group.fixed[block] = group.all_mask();
        Ok(())
    }

    /// Fixes some degrees of freedom of a block.
    ///
    /// # Errors
    /// [`AdjustError::Index`] where there is no such block or degree of freedom.
    pub fn fix_parameters(&mut self, group: GroupId, block: usize, parameters: &[usize]) -> Result<(), AdjustError> {
        self.check_block(group, block)?;
        let group = &mut self.groups[group.0];
        for &index in parameters {
            if index >= group.size {
                return Err(AdjustError::Index { name: group.name.clone(), index, len: group.size });
            }
            group.fixed[block] |= 1 << index;
        }
        Ok(())
    }

    /// Makes a fixed or considered block variable again.
    ///
    /// # Errors
    /// [`AdjustError::Index`] where there is no such block.
    pub fn release(&mut self, group: GroupId, block: usize) -> Result<(), AdjustError> {
        self.check_block(group, block)?;
        self.groups[group.0].fixed[block] = 0;
        self.groups[group.0].considered.retain(|c| c.0 != block);
        Ok(())
    }

    /// Fixes a block as a consider parameter: [`Adjustment::covariance`] propagates its uncertainty, given as standard deviations of its
    /// degrees of freedom, to all other blocks (Schmidt, "Application of state-space methods to navigation problems", 1966). Blocks of
    /// the eliminated group are only fixed.
    ///
    /// # Errors
    /// [`AdjustError::Index`] where there is no such block, [`AdjustError::Length`] where the number of standard deviations is not that of the
    /// degrees of freedom.
    pub fn consider(&mut self, group: GroupId, block: usize, deviations: &[f64]) -> Result<(), AdjustError> {
        self.fix(group, block)?;
        let of = &mut self.groups[group.0];
        if deviations.len() != of.size {
            return Err(AdjustError::Length { group: of.name.clone(), got: deviations.len(), block: of.size });
        }
        if self.eliminated != Some(group.0) {
            of.considered.retain(|c| c.0 != block);
            of.considered.push((block, deviations.to_vec()));
        }
        Ok(())
    }

    /// Returns the present value of one block.
    ///
    /// # Errors
    /// [`AdjustError::Index`] where there is no such block.
    pub fn block(&self, group: GroupId, block: usize) -> Result<&[f64], AdjustError> {
        self.check_block(group, block)?;
        Ok(self.values.block(group.0, block))
    }

    fn check_block(&self, group: GroupId, index: usize) -> Result<(), AdjustError> {
        let of = self.groups.get(group.0).ok_or_else(|| self.group_error(group.0))?;
        if index < of.count { Ok(()) } else { Err(AdjustError::Index { name: of.name.clone(), index, len: of.count }) }
    }

    fn group_error(&self, index: usize) -> AdjustError {
        AdjustError::Index { name: "groups".to_owned(), index, len: self.groups.len() }
    }

    /// Checks that no residual depends on two blocks of the eliminated group.
    fn check_eliminated(&self) -> Result<(), AdjustError> {
        for kind in &self.kinds {
            if kind.groups().iter().filter(|g| Some(**g) == self.eliminated).count() > 1 {
                return Err(AdjustError::TwoEliminated { residuals: kind.name().to_owned() });
            }
        }
        Ok(())
    }
}

fn block_dimensions<T: Residual<R, B, C>, const R: usize, const B: usize, const C: usize>(
    _: &TypedResiduals<T, R, B, C>,
) -> [usize; B] {
    T::DIMS
}
