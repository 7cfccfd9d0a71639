//! Sparse robust least squares over blocks of parameters: bundle adjustment, calibration, alignment.
//!
//! A problem has *groups* of blocks (poses, lenses, points), each with a name, a [`Manifold`] and the numbers of its blocks, and *kinds* of residuals
//! ([`Residual`]), of which each item names the blocks it depends on. One group may be eliminated ([`Adjustment::eliminate`]): that of which there are many and
//! of which no residual sees two, the points. What is left is solved densely where it is small or full, else by faer's sparse Cholesky
//! factorization. [`Adjustment::solve`] moves the values to the least cost, [`Adjustment::covariance`] tells how well they are known.
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
#[cfg(test)]
mod tests;

use crate::RobustLoss;
pub use covariance::Covariance;
pub use error::AdjustError;
pub use manifold::{Euclidean, Manifold, RelativeMotion, RigidMotion, RotationManifold, UnitVector};
use residual::{Group, Kind, Typed, Values};
pub use residual::{Prior, Residual, ResidualSums};
pub use solve::{AdjustIteration, AdjustOptions, AdjustReport, Termination};

/// A group of blocks of an [`Adjustment`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GroupId(usize);

/// A least-squares problem over blocks of parameters, and the values that they have. See the [module](self).
pub struct Adjustment<'a> {
    groups: Vec<Group<'a>>,
    kinds: Vec<Box<dyn Kind + 'a>>,
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
    /// Adds a group of blocks; `values` are the numbers that store them, block after block. The name is for error messages.
    ///
    /// # Errors
    /// [`AdjustError::Length`] where the values are not whole blocks, [`AdjustError::Size`] of blocks without or with more than 64 degrees of freedom.
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
            held: vec![0; count],
            considered: Vec::new(),
        });
        self.values.numbers.push(values);
        self.values.ambient.push(ambient);
        Ok(GroupId(self.groups.len() - 1))
    }

    /// Adds residuals of one kind: item `i` depends on the blocks with the numbers `blocks[i]` of the `groups`. The name is for error messages.
    ///
    /// # Errors
    /// [`AdjustError::Dimension`] where a group's blocks have other degrees of freedom than the residual's, [`AdjustError::Index`] of a block
    /// that there is not.
    pub fn add_residuals<const R: usize, const B: usize, const C: usize>(
        &mut self,
        name: &str,
        residual: impl Residual<R, B, C> + 'a,
        groups: [GroupId; B],
        blocks: Vec<[u32; B]>,
        loss: RobustLoss,
    ) -> Result<(), AdjustError> {
        let groups = groups.map(|g| g.0);
        let typed = Typed { name: name.to_owned(), residual, groups, blocks, loss };
        for (g, expected) in groups.into_iter().zip(dims(&typed)) {
            let group = self.groups.get(g).ok_or_else(|| self.no_group(g))?;
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

    /// Eliminates the blocks of a group from the equations before they are solved (Schur complement): the group with most blocks. Every residual may depend on one of
    /// them at most.
    ///
    /// # Errors
    /// [`AdjustError::Size`] where blocks have more than 6 degrees of freedom.
    pub fn eliminate(&mut self, group: GroupId) -> Result<(), AdjustError> {
        let of = self.groups.get(group.0).ok_or_else(|| self.no_group(group.0))?;
        if of.size > 6 {
            return Err(AdjustError::Size { group: of.name.clone(), got: of.size, most: 6 });
        }
        self.eliminated = Some(group.0);
        Ok(())
    }

    /// Holds a block where it is.
    ///
    /// # Errors
    /// [`AdjustError::Index`] where there is no such block.
    pub fn hold(&mut self, group: GroupId, block: usize) -> Result<(), AdjustError> {
        self.check_block(group, block)?;
        let group = &mut self.groups[group.0];
        group.held[block] = group.all();
        Ok(())
    }

    /// Holds some degrees of freedom of a block.
    ///
    /// # Errors
    /// [`AdjustError::Index`] where there is no such block or degree of freedom.
    pub fn hold_parameters(&mut self, group: GroupId, block: usize, parameters: &[usize]) -> Result<(), AdjustError> {
        self.check_block(group, block)?;
        let group = &mut self.groups[group.0];
        for &index in parameters {
            if index >= group.size {
                return Err(AdjustError::Index { name: group.name.clone(), index, len: group.size });
            }
            group.held[block] |= 1 << index;
        }
        Ok(())
    }

    /// Lets a block move again that was held or considered.
    ///
    /// # Errors
    /// [`AdjustError::Index`] where there is no such block.
    pub fn release(&mut self, group: GroupId, block: usize) -> Result<(), AdjustError> {
        self.check_block(group, block)?;
        self.groups[group.0].held[block] = 0;
        self.groups[group.0].considered.retain(|c| c.0 != block);
        Ok(())
    }

    /// Holds a block where it is, and has [`Adjustment::covariance`] count what not knowing it better than to these standard deviations means for all
    /// others: the covariance of an estimate that leaves something out (Schmidt, "Application of state-space methods to navigation problems", 1966).
    /// Not for blocks of the eliminated group, which are then only held.
    ///
    /// # Errors
    /// [`AdjustError::Index`] where there is no such block, [`AdjustError::Length`] where there are not as many deviations as degrees of freedom.
    pub fn consider(&mut self, group: GroupId, block: usize, deviations: &[f64]) -> Result<(), AdjustError> {
        self.hold(group, block)?;
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

    /// The numbers of one block.
    ///
    /// # Errors
    /// [`AdjustError::Index`] where there is no such block.
    pub fn block(&self, group: GroupId, block: usize) -> Result<&[f64], AdjustError> {
        self.check_block(group, block)?;
        Ok(self.values.block(group.0, block))
    }

    fn check_block(&self, group: GroupId, index: usize) -> Result<(), AdjustError> {
        let of = self.groups.get(group.0).ok_or_else(|| self.no_group(group.0))?;
        if index < of.count { Ok(()) } else { Err(AdjustError::Index { name: of.name.clone(), index, len: of.count }) }
    }

    fn no_group(&self, index: usize) -> AdjustError {
        AdjustError::Index { name: "groups".to_owned(), index, len: self.groups.len() }
    }

    /// Whether some residual depends on two blocks of the eliminated group.
    fn check_eliminated(&self) -> Result<(), AdjustError> {
        for kind in &self.kinds {
            if kind.groups().iter().filter(|g| Some(**g) == self.eliminated).count() > 1 {
                return Err(AdjustError::TwoEliminated { residuals: kind.name().to_owned() });
            }
        }
        Ok(())
    }
}

fn dims<T: Residual<R, B, C>, const R: usize, const B: usize, const C: usize>(_: &Typed<T, R, B, C>) -> [usize; B] {
    T::DIMS
}
