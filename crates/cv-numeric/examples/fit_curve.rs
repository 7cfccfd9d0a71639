//! Fits `y = a exp(b x)` robustly to measurements with one outlier, and prints the standard deviations of `a` and `b`.
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{AdjustOptions, Adjustment, Euclidean, Residual};
use nalgebra::{SMatrix, Vector1};
use std::ops::ControlFlow::Continue;

struct Growth(Vec<[f64; 2]>);

impl Residual<1, 1, 2> for Growth {
    const DIMS: [usize; 1] = [2];

    fn evaluate(&self, i: usize, [p]: [&[f64]; 1], j: Option<&mut SMatrix<f64, 1, 2>>) -> Option<Vector1<f64>> {
        let ([x, y], e) = (self.0[i], (p[1] * self.0[i][0]).exp());
        j.into_iter().for_each(|j| *j = SMatrix::from([[e], [p[0] * x * e]]));
        Some(Vector1::new(p[0] * e - y))
    }
}

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let y = |x: f64| if x == 0.5 { 9.0 } else { 2.0 * (0.7 * x).exp() + 0.01 * (50.0 * x).sin() };
    let data = (0..20).map(|i| f64::from(i) / 10.0).map(|x| [x, y(x)]).collect();
    let mut problem = Adjustment::default();
    let curve = problem.add_group("curve", Euclidean(2), vec![1.0, 0.0])?;
    problem.add_residuals("data", Growth(data), [curve], vec![[0]; 20], RobustLoss::Cauchy { scale: 0.02 })?;
    let report = problem.solve(&AdjustOptions::default(), |_| Continue(()))?;
    let deviations = problem.covariance(problem.variance()?)?.of(curve, 0)?.diagonal().map(f64::sqrt);
    println!("{:?} ± {:?}, {report:?}", problem.values(curve), deviations.as_slice());
    Ok(())
}
