//! Estimates heights of marks from measured differences: one is fixed, another has a prior.
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{AdjustOptions, Adjustment, Euclidean, Prior, Residual};
use nalgebra::{SMatrix, Vector1};
use std::ops::ControlFlow::Continue;

struct Difference(Vec<f64>);

impl Residual<1, 2, 2> for Difference {
    const DIMS: [usize; 2] = [1, 1];

    fn evaluate(&self, i: usize, [a, b]: [&[f64]; 2], j: Option<&mut SMatrix<f64, 1, 2>>) -> Option<Vector1<f64>> {
        j.into_iter().for_each(|j| *j = SMatrix::from([[-100.0], [100.0]]));
        Some(Vector1::new((b[0] - a[0] - self.0[i]) / 0.01))
    }
}

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut problem = Adjustment::default();
    let marks = problem.add_group("marks", Euclidean(1), vec![0.0; 4])?;
    let (pairs, differences) = (vec![[0, 1], [1, 2], [2, 3], [3, 0], [0, 2]], vec![1.0, 2.01, -0.5, -2.49, 3.0]);
    problem.add_residuals("differences", Difference(differences), [marks; 2], pairs, RobustLoss::Trivial)?;
    let prior = Prior { items: vec![([2.4], [1.0 / 0.1])] };
    problem.add_residuals("prior", prior, [marks], vec![[3]], RobustLoss::Trivial)?;
    problem.fix(marks, 0)?;
    problem.solve(&AdjustOptions::default(), |_| Continue(()))?;
    println!("{:?}, the last ± {}", problem.values(marks), problem.covariance(1.0)?.of(marks, 3)?[(0, 0)].sqrt());
    Ok(())
}
