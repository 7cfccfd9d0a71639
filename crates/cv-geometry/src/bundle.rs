//! Two-view bundle adjustment.

use crate::essential::tangent_of;
use crate::rotation::orthonormalized;
use cv_core::{Camera, Correspondence, DistortionModel, Matrix3, Point2, Point3, Pose, Rotation3, Vector2, Vector3};
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
    /// Whether k1 and k2 of lenses with [`DistortionModel::Radial`] may change, by as much in both cameras. Default false.
    pub refine_radial: bool,
    /// Most linearizations. Default 200; without focal lengths it takes ten or so.
    pub max_iterations: usize,
}

impl Default for BundleOptions {
    fn default() -> Self {
        Self { loss: RobustLoss::Cauchy { scale: 1.0 }, refine_focal: false, refine_radial: false, max_iterations: 200 }
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
    /// Linearizations.
    pub iterations: usize,
    /// Covariance of each point in the unit of the base line, for the noise that the residuals show (robustly weighted). The length of
    /// the base line, which nothing determines, counts as exact. Of generated points with normal noise, 93 to 95 in a hundred lie within the
    /// ellipsoid of 95 %.
    pub covariances: Vec<Matrix3<f64>>,
    /// Standard deviations in radians: of the rotation (about the axis it is worst known about) and of the direction of the translation.
    pub pose_deviation: [f64; 2],
    /// Standard deviation of the common factor of the focal lengths; 0 where they were held. Where they are free, the noise is not all there is to it: so it
    /// and the other deviations suppose that the two focal lengths may differ by 0.2 % (the camera focused anew), that the principal points are off the middle by 1 % of
    /// half the diagonal, and off each other by 0.2 % (stabilized pictures).
    pub focal_deviation: f64,
}

/// Degrees of freedom beside the points that are adjusted: rotation 3, direction 2, logarithm of the focal lengths 1, k1 and k2.
const FREE: usize = 8;
/// Beside those, what is held at its most likely value and may be otherwise: logarithm of the ratio of the focal lengths, principal points of both, and of the
/// second against the first.
const ALL: usize = 13;
/// Standard deviations before any match was seen, of all but the pose and the focal length. Displacements of the corners by k1 and k2, and of the principal points, as
/// shares of half the diagonal: a strong barrel has 0.1. A lens of 50 mm that is focused at 10 m and then at 7 m changes its focal length by 0.2 %.
const PRIOR: [f64; ALL - 6] = [0.1, 0.1, 0.002, 0.01, 0.01, 0.002, 0.002];
/// Square pixels: the noise of a SIFT point, by which the priors are weighed against the residuals.
const NOISE: f64 = 0.25;

/// Derivatives by the point in the camera's frame and by what belongs to the lens: logarithm of the focal length, k1, k2.
type Derivatives = (Matrix2x3<f64>, [Vector2<f64>; 3]);

/// A camera's view of a point: residual and derivatives.
#[inline]
fn view(camera: &Camera, p: &Vector3<f64>, observed: Point2<f64>) -> Option<(Vector2<f64>, Derivatives)> {
    if p.z <= 0.0 || p.z.is_nan() {
        return None;
    }
    let i = 1.0 / p.z;
    let ideal = Point2::new(p.x * i, p.y * i);
    let (d, j) = camera.distortion.distort_with_jacobian(ideal);
    let focal = Vector2::new(camera.fx * d.x, camera.fy * d.y);
    let residual = Vector2::new(focal.x + camera.cx - observed.x, focal.y + camera.cy - observed.y);
    let to_ideal = Matrix2x3::new(i, 0.0, -ideal.x * i, 0.0, i, -ideal.y * i);
    let scale = Matrix2::new(camera.fx, 0.0, 0.0, camera.fy);
    let r2 = ideal.coords.norm_squared();
    let k1 = Vector2::new(camera.fx * ideal.x, camera.fy * ideal.y) * r2;
    Some((residual, (scale * j * to_ideal, [focal, k1, k1 * r2])))
}

/// The part of the normal equations that belongs to one point.
struct PointBlock<const C: usize> {
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
    /// Whether the lenses have a k1 and a k2 that may change.
    radial: bool,
    /// One over the squares of [`PRIOR`], in the units of the degrees of freedom.
    prior: [f64; ALL - 6],
}

impl<'a> Problem<'a> {
    fn new(matches: &'a [Correspondence], options: &'a BundleOptions, cameras: &[Camera; 2]) -> Self {
        let radial = options.refine_radial && cameras.iter().all(|c| c.distortion.model() == DistortionModel::Radial);
        let camera = &cameras[0];
        let half = 0.5 * (camera.width as f64).hypot(camera.height as f64);
        let corner2 = (half / camera.fx).powi(2);
        let unit = [corner2, corner2 * corner2, 1.0, 1.0 / half, 1.0 / half, 1.0 / half, 1.0 / half];
        Self { matches, options, radial, prior: std::array::from_fn(|i| (unit[i] / PRIOR[i]).powi(2)) }
    }

    /// k1 and k2, 0 where they are held.
    fn lens(&self, b: &TwoViewBundle) -> [f64; 2] {
        match *b.cameras[0].distortion.parameters() {
            [k1, k2] if self.radial => [k1, k2],
            _ => [0.0; 2],
        }
    }

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
        b.points.iter().zip(self.matches).map(cost).sum::<f64>() + self.prior_cost(b)
    }

    fn prior_cost(&self, b: &TwoViewBundle) -> f64 {
        let [k1, k2] = self.lens(b);
        NOISE * (self.prior[0] * k1 * k1 + self.prior[1] * k2 * k2)
    }

    fn linearize<const C: usize>(
        &self,
        b: &TwoViewBundle,
        x: &Point3<f64>,
        m: &Correspondence,
    ) -> Option<PointBlock<C>> {
        let loss = &self.options.loss;
        let q = b.pose.transform(x);
        let (r1, (j1, lens1)) = view(&b.cameras[0], &x.coords, m.a)?;
        let (r2, (j2, lens2)) = view(&b.cameras[1], &q.coords, m.b)?;
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
        let free = [self.options.refine_focal, self.radial, self.radial];
        for (k, (one, two)) in lens1.iter().zip(&lens2).enumerate().filter(|(k, _)| free[*k]) {
            jc1.set_column(5 + k, one);
            jc2.set_column(5 + k, two);
        }
        if C == ALL && self.options.refine_focal {
            jc1.set_column(8, &(lens1[0] * -0.5));
            jc2.set_column(8, &(lens2[0] * 0.5));
            for (k, axis) in [Vector2::x(), Vector2::y()].into_iter().enumerate() {
                jc1.set_column(9 + k, &axis);
                jc2.set_column(9 + k, &axis);
                jc2.set_column(11 + k, &axis);
            }
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

    fn blocks<const C: usize>(&self, b: &TwoViewBundle) -> Option<Vec<PointBlock<C>>> {
        b.points.par_iter().zip(self.matches).map(|(x, m)| self.linearize(b, x, m)).collect()
    }

    /// The cameras' part of the normal equations with the points eliminated, `S δ = g`, and what gives the points back. `noise`: see [`NOISE`].
    fn reduce<const C: usize>(
        &self,
        b: &TwoViewBundle,
        blocks: &[PointBlock<C>],
        damping: f64,
        noise: f64,
    ) -> Option<Reduced<C>> {
        let mut s = SMatrix::<f64, C, C>::zeros();
        let mut g = SVector::<f64, C>::zeros();
        for b in blocks {
            s += b.u;
            g += b.gc;
        }
        for (k, (prior, value)) in self.prior.iter().zip(self.lens(b).into_iter().chain([0.0; ALL - 8])).enumerate() {
            if 6 + k < C {
                s[(6 + k, 6 + k)] += noise * prior;
                g[6 + k] += noise * prior * value;
            }
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

struct Reduced<const C: usize> {
    s: SMatrix<f64, C, C>,
    g: SVector<f64, C>,
    inverses: Vec<Matrix3<f64>>,
}

/// Refines a relative pose and its points (and, if asked, a common factor of the focal lengths and a radial distortion) to the least robust reprojection
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
    let problem = Problem::new(matches, options, &bundle.cameras);
    let mut blocks = problem.blocks::<FREE>(bundle)?;
    let initial: f64 = blocks.iter().map(|b| b.cost).sum::<f64>() + problem.prior_cost(bundle);
    let mut cost = initial;
    if !cost.is_finite() || blocks.is_empty() {
        return None;
    }
    let mut damping = 1e-4;
    let mut iterations = 1;
    while iterations < options.max_iterations && damping < 1e12 {
        let Some(reduced) = problem.reduce(bundle, &blocks, damping, NOISE) else {
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
        if problem.radial {
            for camera in &mut moved.cameras {
                if let [k1, k2] = camera.distortion.parameters_mut() {
                    (*k1, *k2) = (*k1 + step[6], *k2 + step[7]);
                }
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
            // Focal length, distortion and motion nearly make up for each other: a step of a hundred-millionth may be followed by a thousand like it.
            if gain < 1e-9 {
                break;
            }
        } else {
            damping *= 10.0;
        }
    }
    report(&problem, bundle, [initial, cost], iterations)
}

fn report(problem: &Problem<'_>, bundle: &TwoViewBundle, cost: [f64; 2], iterations: usize) -> Option<BundleReport> {
    let blocks = problem.blocks::<ALL>(bundle)?;
    let (sum, weights) = blocks.iter().fold((0.0, 0.0), |(s, w), b| (s + b.weighted[0], w + b.weighted[1]));
    // Two residuals to a view, four to a point, three of which the point takes up and five the pose.
    let n = blocks.len() as f64;
    let freedom = (weights * 2.0 * (n - 5.0) / (4.0 * n)).max(1.0);
    let variance = sum / freedom;
    let reduced = problem.reduce(bundle, &blocks, 0.0, variance)?;
    // What is held moves what is free with it: the covariance of an estimate that leaves something out, not that of the best one.
    let inverse = reduced.s.fixed_view::<FREE, FREE>(0, 0).try_inverse()?;
    let moved = inverse * reduced.s.fixed_view::<FREE, { ALL - FREE }>(0, FREE);
    let held = SMatrix::<f64, { ALL - FREE }, { ALL - FREE }>::from_fn(|i, j| {
        if i == j { 1.0 / problem.prior[FREE - 6 + i] } else { 0.0 }
    });
    let mut covariance = SMatrix::<f64, ALL, ALL>::zeros();
    let free = inverse * variance + moved * held * moved.transpose();
    covariance.fixed_view_mut::<FREE, FREE>(0, 0).copy_from(&free);
    covariance.fixed_view_mut::<FREE, { ALL - FREE }>(0, FREE).copy_from(&(-moved * held));
    covariance.fixed_view_mut::<{ ALL - FREE }, FREE>(FREE, 0).copy_from(&(-held * moved.transpose()));
    covariance.fixed_view_mut::<{ ALL - FREE }, { ALL - FREE }>(FREE, FREE).copy_from(&held);
    let covariances = blocks
        .iter()
        .zip(&reduced.inverses)
        .map(|(b, v)| {
            let y = v * b.w.transpose();
            v * variance + y * covariance * y.transpose()
        })
        .collect();
    let rotation = covariance.fixed_view::<3, 3>(0, 0).into_owned();
    let direction = covariance.fixed_view::<2, 2>(3, 3).into_owned();
    let largest = |values: &[f64]| values.iter().fold(0.0f64, |m, v| m.max(*v)).sqrt();
    Some(BundleReport {
        cost,
        iterations,
        covariances,
        pose_deviation: [
            largest(rotation.symmetric_eigenvalues().as_slice()),
            largest(direction.symmetric_eigenvalues().as_slice()),
        ],
        focal_deviation: if problem.options.refine_focal { covariance[(5, 5)].max(0.0).sqrt() } else { 0.0 },
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
        views.camera.distortion = Distortion::radial(-0.1, 0.01);
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
            let options = BundleOptions {
                loss: RobustLoss::Trivial,
                refine_focal: true,
                refine_radial: true,
                ..BundleOptions::default()
            };
            let problem = Problem::new(&matches, &options, &start.cameras);
            let block = problem.linearize::<ALL>(&start, &start.points[0], &matches[0]).unwrap();
            let [tu, tv] = tangent_of(&start.pose.translation);
            let moved = |i: usize, h: f64| {
                let mut b = start.clone();
                match i {
                    0..3 => b.pose.rotation *= Rotation3::new(Vector3::ith(i, h)),
                    3 => b.pose.translation += tu * h,
                    4 => b.pose.translation += tv * h,
                    5 => b.cameras.iter_mut().for_each(|c| (c.fx, c.fy) = (c.fx * h.exp(), c.fy * h.exp())),
                    6 | 7 => {
                        for camera in &mut b.cameras {
                            camera.distortion.parameters_mut()[i - 6] += h;
                        }
                    }
                    8 => {
                        for (camera, sign) in b.cameras.iter_mut().zip([-0.5, 0.5]) {
                            (camera.fx, camera.fy) = (camera.fx * (sign * h).exp(), camera.fy * (sign * h).exp());
                        }
                    }
                    9 => b.cameras.iter_mut().for_each(|c| c.cx += h),
                    10 => b.cameras.iter_mut().for_each(|c| c.cy += h),
                    11 => b.cameras[1].cx += h,
                    12 => b.cameras[1].cy += h,
                    _ => b.points[0][i - ALL] += h,
                }
                problem.cost(&b) - problem.prior_cost(&b)
            };
            for i in 0..ALL + 3 {
                let numeric = (moved(i, 1e-6) - moved(i, -1e-6)) / 2e-6;
                let analytic = 2.0 * if i < ALL { block.gc[i] } else { block.gp[i - ALL] };
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
    fn unknown_focal_lengths_are_as_far_off_as_is_said() {
        let mut squares = Vec::new();
        for seed in 0..60 {
            let (_, truth, _) = problem(seed, 300, 0.0);
            let mut rng = ChaCha8Rng::seed_from_u64(seed + 5000);
            let mut e = || gauss(&mut rng);
            // What no two lenses have alike: k2, a principal point off the middle by 4 of 400 px, another focus for the second picture.
            let mut cameras = truth.cameras;
            let (k2, cx, cy, ratio) = (0.03 * e(), 4.0 * e(), 4.0 * e(), 0.002 * e());
            for (camera, sign) in cameras.iter_mut().zip([-0.5, 0.5]) {
                camera.distortion = Distortion::radial(-0.1, k2);
                (camera.cx, camera.cy) = (camera.cx + cx, camera.cy + cy);
                (camera.fx, camera.fy) = (camera.fx * f64::exp(sign * ratio), camera.fy * f64::exp(sign * ratio));
            }
            (cameras[1].cx, cameras[1].cy) = (cameras[1].cx + 0.8 * e(), cameras[1].cy + 0.8 * e());
            let seen = |x: &Point3<f64>| Some((cameras[0].project(x)?, cameras[1].project(&truth.pose.transform(x))?));
            let (mut matches, mut points) = (Vec::new(), Vec::new());
            for (x, (a, b)) in truth.points.iter().filter_map(|x| Some((x, seen(x)?))) {
                matches.push(Correspondence::new(a.x + 0.4 * e(), a.y + 0.4 * e(), b.x + 0.4 * e(), b.y + 0.4 * e()));
                points.push(*x);
            }
            let mut start = TwoViewBundle { points, ..truth.clone() };
            start.cameras.iter_mut().for_each(|c| c.distortion = Distortion::radial(-0.1, 0.0));
            let options = BundleOptions { refine_focal: true, refine_radial: true, ..BundleOptions::default() };
            let report = adjust_two_views(&mut start, &matches, &options).unwrap();
            let off = (start.cameras[0].fx / truth.cameras[0].fx).ln();
            squares.push((off / report.focal_deviation).powi(2));
        }
        squares.sort_by(f64::total_cmp);
        let mean = squares.iter().sum::<f64>() / 60.0;
        // Of a normal error the mean square is 1 ± 0.18 and the median 0.45; where the focal length hardly shows, the error is not normal.
        assert!((0.6..1.8).contains(&mean) && (0.25..0.9).contains(&squares[30]), "{squares:?}");
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
