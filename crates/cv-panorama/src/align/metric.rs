//! Metric rectification of a planar scene.
//!
//! Homographies between images determine the plane only up to a projective transformation `F`; the frame of one image has that image's shear and
//! convergence. In a metric frame the first two columns of `M F⁻¹` are orthogonal and of equal length for every image `M` (Zhang 2000, "A flexible new
//! technique for camera calibration", §2.3). These two equations per image determine the four degrees of freedom of `F` beyond a similarity, in the
//! least-squares sense.

use crate::align::View;
use cv_numeric::{LeastSquares, LmOptions, NormalEquations, levenberg_marquardt};
use nalgebra::{Const, Matrix3, Point2, SVector, Vector3};

/// Weight of the regularization (toward the identity) relative to one equation of an image: decides only where the images do not determine `F`.
const PRIOR_WEIGHT: f64 = 1e-6;

/// Least-squares problem over the homographies of the images.
struct Squareness<'a>(&'a [Matrix3<f64>]);

/// Returns the first two columns of `F⁻¹`: stretched by `e^a` and `e^−a`, sheared by `b`, with vanishing line `(p, q)`.
fn axes(x: &SVector<f64, 4>) -> [Vector3<f64>; 2] {
    [Vector3::new(x[0].exp(), 0.0, x[2]), Vector3::new(x[1], (-x[0]).exp(), x[3])]
}

impl LeastSquares for Squareness<'_> {
    type Dim = Const<4>;
    type Params = SVector<f64, 4>;

    fn dim(&self) -> Const<4> {
        Const
    }

    fn cost(&self, x: &SVector<f64, 4>) -> f64 {
        self.linearize(x).cost
    }

    fn linearize(&self, x: &SVector<f64, 4>) -> NormalEquations<Const<4>> {
        let mut equations = NormalEquations::zeros(Const);
        let [u, v] = axes(x);
        let (by_a, by_b) = ([Vector3::x() * u.x, Vector3::y() * -v.y], Vector3::x());
        let mut add = |r: f64, j: &SVector<f64, 4>, weight: f64| {
            equations.cost += weight * r * r;
            equations.add(r, j, weight);
        };
        for m in self.0 {
            let (g, h) = (m * u, m * v);
            let size = g.norm_squared() + h.norm_squared();
            // Each residual is a quotient; d is a change of (u, v).
            let by = |du: Vector3<f64>, dv: Vector3<f64>| -> [f64; 3] {
                let (dg, dh) = (m * du, m * dv);
                let (gg, hh) = (2.0 * g.dot(&dg), 2.0 * h.dot(&dh));
                [gg - hh, 2.0 * (dg.dot(&h) + g.dot(&dh)), gg + hh]
            };
            let zero = Vector3::zeros();
            let changes = [by(by_a[0], by_a[1]), by(zero, by_b), by(Vector3::z(), zero), by(zero, Vector3::z())];
            let residuals = [(g.norm_squared() - h.norm_squared()) / size, 2.0 * g.dot(&h) / size];
            for (k, r) in residuals.into_iter().enumerate() {
                let j = SVector::from_fn(|i, _| (changes[i][k] - r * changes[i][2]) / size);
                add(r, &j, 1.0);
            }
        }
        for i in 0..4 {
            add(x[i], &SVector::ith(i, 1.0), PRIOR_WEIGHT);
        }
        equations
    }

    fn step(&self, x: &SVector<f64, 4>, delta: &SVector<f64, 4>) -> SVector<f64, 4> {
        x + delta
    }
}

/// Computes `F⁻¹`, which takes homographies (of a plane to cameras of focal length 1) to the metric frame: `M ← M F⁻¹`. The centroid of the images is
/// at the origin, their median scale is 1, and they are upright on average. `None` where there is no such frame.
pub(crate) fn metric_frame(motions: &[Matrix3<f64>]) -> Option<Matrix3<f64>> {
    let options = LmOptions { max_iterations: 100, ..LmOptions::default() };
    let [u, v] = axes(&levenberg_marquardt(&Squareness(motions), SVector::zeros(), &options).params);
    let plan = Matrix3::from_columns(&[u, v, Vector3::z()]);
    // Intersection of each optical axis with the plane, and its derivatives by pixels.
    let mut scales = Vec::with_capacity(motions.len());
    let (mut middle, mut heading) = (Point2::origin(), [0.0; 2]);
    for m in motions {
        let g = (m * plan).try_inverse()?;
        let (x, y, w) = (g.m13 / g.m33, g.m23 / g.m33, g.m33);
        let by_x = [(g.m11 - x * g.m31) / w, (g.m21 - y * g.m31) / w];
        let by_y = [(g.m12 - x * g.m32) / w, (g.m22 - y * g.m32) / w];
        scales.push((by_x[0] * by_y[1] - by_x[1] * by_y[0]).abs().sqrt());
        middle += nalgebra::Vector2::new(x, y) / motions.len() as f64;
        let turn = [by_x[0] + by_y[1], by_x[1] - by_y[0]];
        let length = turn[0].hypot(turn[1]);
        heading = [heading[0] + turn[0] / length, heading[1] + turn[1] / length];
    }
    let scale = cv_core::median(&mut scales)?;
    // Images of all orientations have no mean heading: the frame is not rotated.
    let length = heading[0].hypot(heading[1]);
    let [c, s] = if length > 0.5 * motions.len() as f64 { heading.map(|v| v / length) } else { [1.0, 0.0] };
    // Maps points of the final frame to the former one.
    let back = Matrix3::new(scale * c, -scale * s, middle.x, scale * s, scale * c, middle.y, 0.0, 0.0, 1.0);
    let frame = plan * back;
    frame.iter().all(|v| v.is_finite()).then_some(frame)
}

/// Returns whether no image reaches the vanishing line of the plane.
pub(crate) fn in_front(views: &[View]) -> bool {
    views.iter().all(|view| {
        let Some(inverse) = view.from_world.try_inverse() else { return false };
        view.border(1).iter().all(|&p| {
            let n = view.camera.normalize(p);
            let ray = inverse * Vector3::new(n.x, n.y, 1.0);
            ray.z > 0.05 * ray.norm()
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;

    /// Cameras over a plane at distances around 1, tilted by up to some ten degrees, on a grid of 4 × 3.
    fn cameras() -> Vec<Matrix3<f64>> {
        let tilt = |k: usize, m: usize| 0.18 * (((k * m) % 7) as f64 / 3.0 - 1.0);
        (0..12)
            .map(|k| {
                let r = Rotation3::from_euler_angles(tilt(k, 3), tilt(k, 5), 0.5 * tilt(k, 2)).into_inner();
                let from = Vector3::new(0.5 * (k % 4) as f64, 0.4 * (k / 4) as f64, -1.0 - 0.3 * tilt(k, 4));
                let t = -(r * from);
                Matrix3::from_columns(&[r.column(0).into_owned(), r.column(1).into_owned(), t])
            })
            .collect()
    }

    #[test]
    fn exact_cameras_give_the_plan_from_any_photographs_frame() {
        let truth = cameras();
        for reference in [0, 5, 11] {
            let world = truth[reference].try_inverse().unwrap();
            let seen: Vec<Matrix3<f64>> = truth.iter().map(|m| m * world).collect();
            let frame = metric_frame(&seen).unwrap();
            for m in &seen {
                let m = m * frame;
                let (g, h) = (m.column(0), m.column(1));
                // The prior of 1e-6 beside 24 equations, on a frame that is off by some tenths.
                assert!((g.norm() / h.norm() - 1.0).abs() < 1e-5, "{reference}: {m}");
                assert!(g.dot(&h).abs() < 1e-5 * g.norm() * h.norm(), "{reference}: {m}");
            }
        }
    }

    #[test]
    fn derivatives_are_those_of_the_cost() {
        let problem = cameras();
        let problem = Squareness(&problem);
        let x = SVector::<f64, 4>::new(0.1, -0.2, 0.15, 0.05);
        let exact = problem.linearize(&x).gradient;
        for i in 0..4 {
            let h = SVector::<f64, 4>::ith(i, 1e-5);
            // The gradient is half the derivative of the cost. Truncation of 1e-10 by third derivatives of some thousands.
            let numeric = (problem.cost(&(x + h)) - problem.cost(&(x - h))) / 4e-5;
            assert!((numeric - exact[i]).abs() < 1e-6, "{i}: {numeric} {}", exact[i]);
        }
    }
}
