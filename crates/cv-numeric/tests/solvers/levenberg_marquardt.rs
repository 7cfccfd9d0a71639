//! Levenberg–Marquardt on small problems with known minima.

use cv_numeric::{LeastSquares, LmOptions, NormalEquations, levenberg_marquardt};
use nalgebra::{Const, DVector, Dyn, Vector2};

/// Rosenbrock's function as least squares: r = (1 − x, 10 (y − x²)), minimum 0 at (1, 1).
struct Rosenbrock;

impl LeastSquares for Rosenbrock {
    type Dim = Const<2>;
    type Params = Vector2<f64>;

    fn dim(&self) -> Const<2> {
        Const
    }

    fn cost(&self, p: &Vector2<f64>) -> f64 {
        (1.0 - p.x).powi(2) + 100.0 * (p.y - p.x * p.x).powi(2)
    }

    fn linearize(&self, p: &Vector2<f64>) -> NormalEquations<Const<2>> {
        let mut n = NormalEquations::zeros(Const);
        n.add(1.0 - p.x, &Vector2::new(-1.0, 0.0), 1.0);
        n.add(10.0 * (p.y - p.x * p.x), &Vector2::new(-20.0 * p.x, 10.0), 1.0);
        n.cost = self.cost(p);
        n
    }

    fn step(&self, p: &Vector2<f64>, d: &Vector2<f64>) -> Vector2<f64> {
        p + d
    }
}

#[test]
fn rosenbrocks_function_is_minimized() {
    let options = LmOptions { max_iterations: 100, ..LmOptions::default() };
    let report = levenberg_marquardt(&Rosenbrock, Vector2::new(-1.2, 1.0), &options);
    // Quadratic convergence to an exact zero: what is left is rounding.
    assert!((report.params - Vector2::new(1.0, 1.0)).norm() < 1e-8, "{:?}", report.params);
    assert!(report.converged && report.cost < 1e-16);
}

/// A line `a x + b` of run-time size with one unobserved parameter.
struct Line(Vec<(f64, f64)>);

impl LeastSquares for Line {
    type Dim = Dyn;
    type Params = DVector<f64>;

    fn dim(&self) -> Dyn {
        Dyn(3)
    }

    fn cost(&self, p: &DVector<f64>) -> f64 {
        self.0.iter().map(|&(x, y)| (p[0] * x + p[1] - y).powi(2)).sum()
    }

    fn linearize(&self, p: &DVector<f64>) -> NormalEquations<Dyn> {
        let mut n = NormalEquations::zeros(self.dim());
        for &(x, y) in &self.0 {
            n.add(p[0] * x + p[1] - y, &DVector::from_vec(vec![x, 1.0, 0.0]), 1.0);
        }
        n.cost = self.cost(p);
        n
    }

    fn step(&self, p: &DVector<f64>, d: &DVector<f64>) -> DVector<f64> {
        p + d
    }
}

#[test]
fn an_unobserved_parameter_is_unchanged() {
    // By hand: the least-squares line through (0,1), (1,3), (2,4) is 1.5 x + 7/6.
    let line = Line(vec![(0.0, 1.0), (1.0, 3.0), (2.0, 4.0)]);
    let report = levenberg_marquardt(&line, DVector::from_vec(vec![0.0, 0.0, 5.0]), &LmOptions::default());
    assert!((report.params[0] - 1.5).abs() < 1e-9 && (report.params[1] - 7.0 / 6.0).abs() < 1e-9);
    assert_eq!(report.params[2], 5.0);
}

#[test]
fn a_nan_start_is_returned() {
    let report = levenberg_marquardt(&Rosenbrock, Vector2::new(f64::NAN, 1.0), &LmOptions::default());
    assert!(report.params.x.is_nan() && !report.converged);
}

#[test]
fn no_data_leaves_the_parameters_unchanged() {
    let report = levenberg_marquardt(&Line(vec![]), DVector::from_vec(vec![1.0, 2.0, 3.0]), &LmOptions::default());
    assert_eq!(report.params.as_slice(), [1.0, 2.0, 3.0]);
}
