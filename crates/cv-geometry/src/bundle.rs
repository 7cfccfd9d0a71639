//! Two-view bundle adjustment.

use crate::essential::tangent_of;
use crate::rotation::orthonormalized;
use cv_core::{Camera, Correspondence, Matrix3, Point2, Point3, Pose, Rotation3, Vector3};
use cv_numeric::{RobustLoss, solve_positive_definite};
use nalgebra::{Matrix2, Matrix2x3, SMatrix, SVector};
use rayon::prelude::*;

/// Settings of [`adjust_two_views`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BundleOptions {
    /// Loss of the reprojection error of a point in one image, in pixels. Default Cauchy with scale 1 px: SIFT points are good
    /// to about that.
    pub loss: RobustLoss,
    /// Whether the focal lengths may change, by one common factor. Default false.
    pub refine_focal: bool,
    /// Most linearisations. Default 50.
    pub max_iterations: usize,
}

impl Default for BundleOptions {
    fn default() -> Self {
        Self { loss: RobustLoss::Cauchy { scale: 1.0 }, refine_focal: false, max_iterations: 50 }
    }
}

/// Two cameras and the points they see.
#[derive(Debug, Clone, PartialEq)]
pub struct TwoViewBundle {
    /// The cameras; changed only where focal lengths are refined.
    pub cameras: [Camera; 2],
    /// First camera frame to second; the translation has length one.
    pub pose: Pose,
    /// Points in the first camera's frame.
    pub points: Vec<Point3<f64>>,
}

/// What [`adjust_two_views`] found beside the bundle itself.
#[derive(Debug, Clone, PartialEq)]
pub struct BundleReport {
    /// Cost, `Σ ρ(r²)` in square pixels over both images, at the start and at the end.
    pub cost: [f64; 2],
    /// Linearisations.
    pub iterations: usize,
    /// Covariance of each point in the unit of the base line, for the noise that the residuals show (robustly weighted). The length of
    /// the base line, which nothing determines, counts as exact. Of generated points with normal noise, 93 to 95 in a hundred lie within the
    /// ellipsoid of 95 %.
    pub covariances: Vec<Matrix3<f64>>,
    /// Standard deviations in radians: of the rotation (about the axis it is worst known about) and of the direction of the translation.
    pub pose_deviation: [f64; 2],
    /// Standard deviation of the common factor of the focal lengths; 0 where they were held.
    pub focal_deviation: f64,
}

/// Degrees of freedom beside the points: rotation 3, direction 2, focal factor 1.
const C: usize = 6;

/// A camera's view of a point: residual, derivative by the point in the camera's frame, derivative by the log of the focal length.
#[inline]
fn view(
    camera: &Camera,
    p: &Vector3<f64>,
    observed: Point2<f64>,
) -> Option<(nalgebra::Vector2<f64>, Matrix2x3<f64>, nalgebra::Vector2<f64>)> {
    if p.z <= 0.0 || p.z.is_nan() {
        return None;
    }
    let i = 1.0 / p.z;
    let ideal = Point2::new(p.x * i, p.y * i);
    let (d, j) = camera.distortion.distort_with_jacobian(ideal);
    let focal = nalgebra::Vector2::new(camera.fx * d.x, camera.fy * d.y);
    let residual = nalgebra::Vector2::new(focal.x + camera.cx - observed.x, focal.y + camera.cy - observed.y);
    let to_ideal = Matrix2x3::new(i, 0.0, -ideal.x * i, 0.0, i, -ideal.y * i);
    let scale = Matrix2::new(camera.fx, 0.0, 0.0, camera.fy);
    Some((residual, scale * j * to_ideal, focal))
}

/// The part of the normal equations that belongs to one point.
struct PointBlock {
    cost: f64,
    /// Weighted sum of squared residuals, and the sum of weights of the two views.
    weighted: [f64; 2],
    u: SMatrix<f64, C, C>,
    gc: SVector<f64, C>,
    v: Matrix3<f64>,
    gp: Vector3<f64>,
    w: SMatrix<f64, C, 3>,
}

struct Problem<'a> {
    matches: &'a [Correspondence],
    options: &'a BundleOptions,
}

impl Problem<'_> {
    fn cost(&self, b: &TwoViewBundle) -> f64 {
        let cost = |(x, m): (&Point3<f64>, &Correspondence)| {
            let q = b.pose.transform(x);
            let one = |camera: &Camera, p: &Vector3<f64>, o| match view(camera, p, o) {
                Some((r, ..)) => self.options.loss.value(r.norm_squared()),
                None => f64::INFINITY,
            };
            one(&b.cameras[0], &x.coords, m.a) + one(&b.cameras[1], &q.coords, m.b)
        };
        // Summed in order, so that the number of threads changes nothing.
        b.points.iter().zip(self.matches).map(cost).sum()
    }

    fn linearize(&self, b: &TwoViewBundle, x: &Point3<f64>, m: &Correspondence) -> Option<PointBlock> {
        let loss = &self.options.loss;
        let q = b.pose.transform(x);
        let (r1, j1, f1) = view(&b.cameras[0], &x.coords, m.a)?;
        let (r2, j2, f2) = view(&b.cameras[1], &q.coords, m.b)?;
        let (w1, w2) = (loss.weight(r1.norm_squared()), loss.weight(r2.norm_squared()));
        let rotation = b.pose.rotation.matrix();
        let by_point = j2 * rotation;
        // R exp(ω) x ≈ R x − R [x]× ω.
        let by_rotation = -by_point * x.coords.cross_matrix();
        let [tu, tv] = tangent_of(&b.pose.translation);
        let (by_u, by_v) = (j2 * tu, j2 * tv);
        let mut jc1 = SMatrix::<f64, 2, C>::zeros();
        let mut jc2 = SMatrix::<f64, 2, C>::zeros();
        jc2.fixed_columns_mut::<3>(0).copy_from(&by_rotation);
        jc2.set_column(3, &by_u);
        jc2.set_column(4, &by_v);
        if self.options.refine_focal {
            jc1.set_column(5, &f1);
            jc2.set_column(5, &f2);
        }
        let (wj1, wj2) = (j1.transpose() * w1, by_point.transpose() * w2);
        Some(PointBlock {
            cost: loss.value(r1.norm_squared()) + loss.value(r2.norm_squared()),
            weighted: [w1 * r1.norm_squared() + w2 * r2.norm_squared(), w1 + w2],
            u: jc1.transpose() * jc1 * w1 + jc2.transpose() * jc2 * w2,
            gc: jc1.transpose() * r1 * w1 + jc2.transpose() * r2 * w2,
            v: wj1 * j1 + wj2 * by_point,
            gp: wj1 * r1 + wj2 * r2,
            w: jc1.transpose() * j1 * w1 + jc2.transpose() * by_point * w2,
        })
    }

    fn blocks(&self, b: &TwoViewBundle) -> Option<Vec<PointBlock>> {
        b.points.par_iter().zip(self.matches).map(|(x, m)| self.linearize(b, x, m)).collect()
    }

    /// The camera's part of the normal equations with the points eliminated, `S δ = g`, and what gives the points back.
    fn reduce(&self, blocks: &[PointBlock], damping: f64) -> Option<Reduced> {
        let mut s = SMatrix::<f64, C, C>::zeros();
        let mut g = SVector::<f64, C>::zeros();
        for b in blocks {
            s += b.u;
            g += b.gc;
        }
        for i in 0..C {
            s[(i, i)] *= 1.0 + damping;
        }
        if !self.options.refine_focal {
            s[(5, 5)] = 1.0;
        }
        let mut inverses = Vec::with_capacity(blocks.len());
        for b in blocks {
            let mut v = b.v;
            // A point near infinity has next to no depth information; this keeps it where it is.
            let floor = 1e-12 * v.trace();
            for i in 0..3 {
                v[(i, i)] += damping * v[(i, i)] + floor;
            }
            let inverse = v.try_inverse()?;
            let y = b.w * inverse;
            s -= y * b.w.transpose();
            g -= y * b.gp;
            inverses.push(inverse);
        }
        Some(Reduced { s, g, inverses })
    }
}

struct Reduced {
    s: SMatrix<f64, C, C>,
    g: SVector<f64, C>,
    inverses: Vec<Matrix3<f64>>,
}

/// Refines a relative pose and its points (and, if asked, a common factor of the focal lengths) to the least robust reprojection
/// error in both images, distortion included (Triggs et al., "Bundle adjustment — a modern synthesis", 2000).
///
/// `matches` are in pixels, one for each point of the bundle; more of either are left alone. Levenberg–Marquardt with the points
/// eliminated by the Schur complement, O(points) for each iteration. Never worse than the start. `None` where a point starts behind a
/// camera or a residual is not finite.
pub fn adjust_two_views(
    bundle: &mut TwoViewBundle,
    matches: &[Correspondence],
    options: &BundleOptions,
) -> Option<BundleReport> {
    let problem = Problem { matches, options };
    let mut blocks = problem.blocks(bundle)?;
    let initial: f64 = blocks.iter().map(|b| b.cost).sum();
    let mut cost = initial;
    if !cost.is_finite() || blocks.is_empty() {
        return None;
    }
    let mut damping = 1e-4;
    let mut iterations = 1;
    while iterations < options.max_iterations && damping < 1e12 {
        let Some(reduced) = problem.reduce(&blocks, damping) else {
            damping *= 10.0;
            continue;
        };
        let Ok(step) = solve_positive_definite(&reduced.s, &reduced.g) else {
            damping *= 10.0;
            continue;
        };
        let step = -step;
        let mut moved = bundle.clone();
        let [tu, tv] = tangent_of(&bundle.pose.translation);
        moved.pose.rotation *= Rotation3::new(Vector3::new(step[0], step[1], step[2]));
        let Some(rotation) = orthonormalized(&moved.pose.rotation) else {
            damping *= 10.0;
            continue;
        };
        moved.pose.rotation = rotation;
        moved.pose.translation = (bundle.pose.translation + tu * step[3] + tv * step[4]).normalize();
        if options.refine_focal {
            for camera in &mut moved.cameras {
                camera.fx *= step[5].exp();
                camera.fy *= step[5].exp();
            }
        }
        for ((x, b), inverse) in moved.points.iter_mut().zip(&blocks).zip(&reduced.inverses) {
            *x -= inverse * (b.gp + b.w.transpose() * step);
        }
        let next = problem.cost(&moved);
        if next < cost {
            let gain = (cost - next) / cost;
            *bundle = moved;
            cost = next;
            damping = (damping * 0.1).max(1e-12);
            // Behind a camera no cost is finite, so this cannot fail after a step down.
            blocks = problem.blocks(bundle)?;
            iterations += 1;
            // A ten-millionth of the cost moves nothing by more than a thousandth of its own deviation.
            if gain < 1e-7 {
                break;
            }
        } else {
            damping *= 10.0;
        }
    }
    report(&problem, &blocks, [initial, cost], iterations)
}

fn report(problem: &Problem<'_>, blocks: &[PointBlock], cost: [f64; 2], iterations: usize) -> Option<BundleReport> {
    let reduced = problem.reduce(blocks, 0.0)?;
    let (sum, weights) = blocks.iter().fold((0.0, 0.0), |(s, w), b| (s + b.weighted[0], w + b.weighted[1]));
    // Two residuals to a view, four to a point, three of which the point takes up and five the pose.
    let n = blocks.len() as f64;
    let freedom = (weights * 2.0 * (n - 5.0) / (4.0 * n)).max(1.0);
    let variance = sum / freedom;
    let inverse = reduced.s.try_inverse()?;
    let covariances = blocks
        .iter()
        .zip(&reduced.inverses)
        .map(|(b, v)| {
            let y = v * b.w.transpose();
            (v + y * inverse * y.transpose()) * variance
        })
        .collect();
    let rotation = inverse.fixed_view::<3, 3>(0, 0).into_owned() * variance;
    let direction = inverse.fixed_view::<2, 2>(3, 3).into_owned() * variance;
    let largest = |values: &[f64]| values.iter().fold(0.0f64, |m, v| m.max(*v)).sqrt();
    Some(BundleReport {
        cost,
        iterations,
        covariances,
        pose_deviation: [
            largest(rotation.symmetric_eigenvalues().as_slice()),
            largest(direction.symmetric_eigenvalues().as_slice()),
        ],
        focal_deviation: if problem.options.refine_focal { (inverse[(5, 5)] * variance).max(0.0).sqrt() } else { 0.0 },
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{TwoViews, gauss, uniform};
    use crate::{pose_difference, triangulate};
    use cv_core::Distortion;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;

    /// Matches of a distorting camera, the truth, and a start that is a little off.
    fn problem(seed: u64, n: usize, noise: f64) -> (Vec<Correspondence>, TwoViewBundle, TwoViewBundle) {
        let mut views = TwoViews::random(seed);
        views.camera.distortion = Distortion::Radial { k1: -0.1, k2: 0.01 };
        let mut rng = ChaCha8Rng::seed_from_u64(seed + 1000);
        let (mut points, mut matches) = (Vec::new(), Vec::new());
        while points.len() < n {
            let (p, m) = views.point(None);
            // Points without parallax have no depth to compare.
            if crate::parallax_angle(&p, &views.pose) < 0.03 {
                continue;
            }
            let mut e = || noise * gauss(&mut rng);
            matches.push(Correspondence::new(m.a.x + e(), m.a.y + e(), m.b.x + e(), m.b.y + e()));
            points.push(p);
        }
        let truth = TwoViewBundle { cameras: [views.camera; 2], pose: views.pose, points };
        let mut start = truth.clone();
        let mut e = || 0.02 * (uniform(&mut rng) - 0.5);
        start.pose.rotation *= Rotation3::new(Vector3::new(e(), e(), e()));
        start.pose.translation = (start.pose.translation + Vector3::new(e(), e(), e())).normalize();
        for x in &mut start.points {
            *x *= 1.0 + e();
        }
        (matches, truth, start)
    }

    #[test]
    fn derivatives_are_those_of_the_residuals() {
        for seed in 0..20 {
            let (matches, _, start) = problem(seed, 1, 0.0);
            let options = BundleOptions { loss: RobustLoss::Trivial, refine_focal: true, ..BundleOptions::default() };
            let problem = Problem { matches: &matches, options: &options };
            let block = problem.linearize(&start, &start.points[0], &matches[0]).unwrap();
            let [tu, tv] = tangent_of(&start.pose.translation);
            let moved = |i: usize, h: f64| {
                let mut b = start.clone();
                match i {
                    0..3 => b.pose.rotation *= Rotation3::new(Vector3::ith(i, h)),
                    3 => b.pose.translation += tu * h,
                    4 => b.pose.translation += tv * h,
                    5 => b.cameras.iter_mut().for_each(|c| (c.fx, c.fy) = (c.fx * h.exp(), c.fy * h.exp())),
                    _ => b.points[0][i - 6] += h,
                }
                problem.cost(&b)
            };
            for i in 0..9 {
                let numeric = (moved(i, 1e-6) - moved(i, -1e-6)) / 2e-6;
                let analytic = 2.0 * if i < 6 { block.gc[i] } else { block.gp[i - 6] };
                // Residuals of a few pixels with derivatives up to a thousand: central differences are good to 1e-7 of that.
                assert!((numeric - analytic).abs() < 1e-3 + 1e-6 * analytic.abs(), "{i}: {numeric} {analytic}");
            }
        }
    }

    #[test]
    fn exact_matches_lead_to_the_exact_scene() {
        for refine_focal in [false, true] {
            for seed in 0..30 {
                let (matches, truth, mut start) = problem(seed, 60, 0.0);
                if refine_focal {
                    start.cameras.iter_mut().for_each(|c| (c.fx, c.fy) = (c.fx * 1.01, c.fy * 1.01));
                }
                let options = BundleOptions { refine_focal, max_iterations: 200, ..BundleOptions::default() };
                let report = adjust_two_views(&mut start, &matches, &options).unwrap();
                // Rounding of pixels: 1e-13 of a few hundred, squared, over 240 residuals; Newton's method goes on until it is all that is left.
                assert!(report.cost[1] < 1e-17, "{report:?}");
                let [turn, shift] = pose_difference(&start.pose, &truth.pose);
                let focal = (start.cameras[0].fx / truth.cameras[0].fx - 1.0).abs();
                let off = start.points.iter().zip(&truth.points).map(|(x, t)| (x - t).norm()).fold(0.0, f64::max);
                // That rounding is 1e-16 of a focal length; the motion that shows least of the pose and the focal length, and the point at twelve
                // units with 0.03 rad of parallax, make 1e-12 and 1e-11 of it. A hundred times that for other seeds.
                assert!(
                    turn < 1e-10 && shift < 1e-10 && focal < 1e-10 && off < 1e-9,
                    "{seed}: {turn} {shift} {focal} {off}"
                );
            }
        }
    }

    #[test]
    fn errors_are_as_large_as_the_covariances_say() {
        for loss in [RobustLoss::Trivial, BundleOptions::default().loss] {
            let (mut sum, mut count, mut within) = (0.0, 0.0, 0.0);
            let (mut turns, mut directions) = (0.0, 0.0);
            for seed in 0..40 {
                let (matches, truth, mut start) = problem(seed, 60, 0.5);
                for (x, m) in start.points.iter_mut().zip(&matches) {
                    let m = Correspondence { a: truth.cameras[0].normalize(m.a), b: truth.cameras[0].normalize(m.b) };
                    *x = triangulate(&m, &truth.pose).unwrap();
                }
                let options = BundleOptions { loss, ..BundleOptions::default() };
                let report = adjust_two_views(&mut start, &matches, &options).unwrap();
                for ((x, t), c) in start.points.iter().zip(&truth.points).zip(&report.covariances) {
                    let d = x - t;
                    let squared = d.dot(&(c.try_inverse().unwrap() * d));
                    sum += squared;
                    count += 1.0;
                    within += f64::from(u8::from(squared < 7.815));
                }
                turns += (pose_difference(&start.pose, &truth.pose)[0] / report.pose_deviation[0]).powi(2);
                let sine = start.pose.translation.cross(&truth.pose.translation).norm();
                directions += (sine / report.pose_deviation[1]).powi(2);
            }
            // The squared Mahalanobis distance has the expectation 3; errors of one scene's points go together, so 40 scenes average to
            // about 3 ± 0.5, and depth is not quite linear in the measurements.
            assert!((2.25..4.05).contains(&(sum / count)), "{}", sum / count);
            // 95 % of chi-squared with three degrees of freedom are below 7.815. Squares: 94.8 % of these points; Cauchy's loss gives large residuals less
            // weight than they have, and its deviations are 4 % too small: 92.6 %.
            assert!((0.91..0.97).contains(&(within / count)), "{}", within / count);
            // Of three (two) axes the worst one is reported: the mean square is between one and three (two), ± 0.3 over 40 scenes.
            assert!(
                (0.6..3.0).contains(&(turns / 40.0)) && (0.6..2.4).contains(&(directions / 40.0)),
                "{turns} {directions}"
            );
        }
    }

    #[test]
    fn a_wrong_match_bends_nothing() {
        let (mut matches, truth, mut start) = problem(3, 80, 0.2);
        matches[7].b.x += 40.0;
        adjust_two_views(&mut start, &matches, &BundleOptions::default()).unwrap();
        let turn = pose_difference(&start.pose, &truth.pose)[0];
        // 0.2 px is 4e-4 rad for one ray, much less for 80; 40 px undamped would be 0.08 rad for one.
        assert!(turn < 2e-3, "{turn}");
    }

    #[test]
    fn a_point_behind_a_camera_is_no_start() {
        let (matches, _, mut start) = problem(3, 20, 0.2);
        start.points[4].z = -1.0;
        assert!(adjust_two_views(&mut start, &matches, &BundleOptions::default()).is_none());
        start.points.clear();
        assert!(adjust_two_views(&mut start, &matches, &BundleOptions::default()).is_none());
    }
}
