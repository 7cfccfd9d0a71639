//! Estimation of essential matrices and relative poses of calibrated cameras.

mod decompose;
mod five_point;
mod jackknife;

pub(crate) use decompose::in_front;
pub use decompose::{
    RecoveredPose, decompose_essential, essential_from_fundamental, essential_from_pose, recover_pose,
};
pub use five_point::essential_five_point;
pub use jackknife::{jackknife_pose_deviation, pose_difference, poses_are_indistinguishable};

use crate::epipolar::{Epipolar, SampsonKernel, SampsonProblem, refine_sampson, sampson};
use crate::error::{Degeneracy, EstimateError};
use crate::match_blocks::{
    LANES, MatchBlock, NormalizedMatches, Normalizer, PairBlocks, check_matches, ray_degeneracy,
};
use crate::ransac::{Estimator, RobustOptions, Scorer, TukeyBiweight, ransac};
use crate::robust::RobustModel;
use crate::rotation::orthonormalized;
use cv_core::{Camera, Correspondence, Matrix3, Point2, Pose, Progress, Rotation3, Vector3};
use cv_numeric::adjust::UnitVector;
use cv_numeric::{LeastSquares, svd3};
use decompose::rotations_and_translation;
use nalgebra::{SMatrix, SVector};

/// Estimates the relative pose of two calibrated cameras robustly from tentative matches in normalized coordinates.
///
/// RANSAC with the five-point algorithm and local optimization of the pose on the Sampson error. The pose maps the
/// first camera's coordinates to the second's; its translation has length one. `options.threshold` is in normalized
/// units: pixels divided by the focal length. Inliers satisfy the cheirality constraint; during the search, it is
/// relaxed by the threshold.
///
/// Five matches have up to ten solutions, so a sixth is needed to disambiguate. A planar scene has up to two
/// (Longuet-Higgins, "The reconstruction of a plane surface from two perspective projections", 1986); the one with the
/// lower loss is returned. A pure rotation leaves the direction of the translation undetermined: see
/// [`estimate_rotation`].
///
/// # Errors
/// [`EstimateError`]: fewer than six matches, a coordinate that is not finite, coincident or collinear points, or no
/// model with a small enough number of false alarms.
pub fn estimate_relative_pose(
    matches: &[Correspondence],
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<RobustModel<Pose>, EstimateError> {
    options.check()?;
    check_matches(matches, 6)?;
    let set = NormalizedMatches::with(matches, Normalizer::IDENTITY, Normalizer::IDENTITY);
    let degenerate = |kind| EstimateError::Degenerate { kind };
    // Rays that are coplanar within a third of the threshold, about their noise, are degenerate.
    let width = options.threshold / 3.0;
    // Before RANSAC, which would draw the maximum number of samples in vain.
    if let Some(kind) = ray_degeneracy(set.pairs.iter(), 6, width) {
        return Err(degenerate(kind));
    }
    let estimator = PoseEstimator { set, threshold: options.threshold };
    let consensus = ransac(&estimator, options, progress)?;
    let pose = consensus.model;
    let e = essential_from_pose(&pose);
    let residual = |_: &Pose, m: &Correspondence| {
        let is_in_front =
            in_front(pose.rotation.matrix(), &pose.translation, &m.a.to_homogeneous(), &m.b.to_homogeneous());
        if is_in_front { sampson(&e, m) } else { f64::INFINITY }
    };
    let result = RobustModel::new(pose, matches, options.threshold, &consensus, residual);
    match ray_degeneracy(result.inliers.iter().map(|&i| &estimator.set.pairs[i]), 6, width) {
        Some(kind) => Err(degenerate(kind)),
        None => Ok(result),
    }
}

/// Estimates the essential matrix `[t]× R` (singular values 1, 1, 0) robustly, by [`estimate_relative_pose`].
///
/// # Errors
/// As [`estimate_relative_pose`].
pub fn estimate_essential(
    matches: &[Correspondence],
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<RobustModel<Matrix3<f64>>, EstimateError> {
    let estimate = estimate_relative_pose(matches, options, progress)?;
    Ok(estimate.map(|pose| essential_from_pose(&pose)))
}

/// Refines a relative pose by minimizing the robust Sampson error of `matches` (normalized).
///
/// Returns the pose and its loss, to which each match adds 0 (exact) to 1 (beyond 2.5 thresholds). `threshold` in
/// normalized units.
pub fn refine_relative_pose(pose: &Pose, matches: &[Correspondence], threshold: f64) -> (Pose, f64) {
    let pairs: Vec<[f64; 4]> = matches.iter().map(|m| [m.a.x, m.a.y, m.b.x, m.b.y]).collect();
    let pairs = PairBlocks::new(&pairs);
    let problem = SampsonProblem::new(&pairs, &TukeyBiweight, threshold);
    let refined = refine_sampson(&problem, *pose, 30).and_then(with_orthonormal_rotation).unwrap_or(*pose);
    (refined, problem.cost(&refined))
}

/// Re-orthonormalizes the rotation after many small updates.
fn with_orthonormal_rotation(pose: Pose) -> Option<Pose> {
    Some(Pose::new(orthonormalized(&pose.rotation)?, pose.translation))
}

/// Estimates the rotation that aligns the rays of the first camera with those of the second (Kabsch 1976 on unit rays,
/// iteratively reweighted five times), and the inlier ratio within `threshold`. All in normalized coordinates.
///
/// An inlier ratio near one means a pure rotation or a distant scene: the translation is undetermined.
///
/// # Errors
/// [`EstimateError`]: fewer than two matches, or a coordinate that is not finite.
pub fn estimate_rotation(matches: &[Correspondence], threshold: f64) -> Result<(Rotation3<f64>, f64), EstimateError> {
    check_matches(matches, 2)?;
    let rays: Vec<_> =
        matches.iter().map(|m| (m.a.to_homogeneous().normalize(), m.b.to_homogeneous().normalize())).collect();
    let mut rotation = Rotation3::identity();
    let mut weights = vec![1.0; rays.len()];
    for _ in 0..6 {
        let sum: Matrix3<f64> = rays.iter().zip(&weights).map(|((a, b), w)| b * a.transpose() * *w).sum();
        let svd = svd3(&sum).map_err(|_| EstimateError::Degenerate { kind: Degeneracy::Coincident })?;
        rotation = svd.nearest_rotation();
        for ((a, b), w) in rays.iter().zip(&mut weights) {
            *w = 1.0 / ((rotation * a - b).norm() / threshold).max(1.0);
        }
    }
    let is_inlier = |m: &&Correspondence| {
        let q = rotation * m.a.to_homogeneous();
        q.z > 0.0 && (q.x / q.z - m.b.x).hypot(q.y / q.z - m.b.y) < threshold
    };
    let inlier_ratio = matches.iter().filter(is_inlier).count() as f64 / matches.len() as f64;
    Ok((rotation, inlier_ratio))
}

/// Converts matches from pixels to normalized coordinates; returns them and the scale from pixels to normalized units.
///
/// Points outside the valid range of a distortion model become NaN: see [`Camera::normalize`].
pub fn normalize_matches(matches: &[Correspondence], a: &Camera, b: &Camera) -> (Vec<Correspondence>, f64) {
    let normalized = matches.iter().map(|m| Correspondence { a: a.normalize(m.a), b: b.normalize(m.b) }).collect();
    // The mean of 1/f over both images and axes.
    (normalized, 0.25 * (1.0 / a.fx + 1.0 / a.fy + 1.0 / b.fx + 1.0 / b.fy))
}

/// Relative poses with five degrees of freedom: a rotation vector applied on the right of R, and the direction of t.
impl Epipolar<5> for Pose {
    fn matrix(&self) -> Matrix3<f64> {
        essential_from_pose(self)
    }

    fn tangent(&self) -> SMatrix<f64, 9, 5> {
        let flat = |m: Matrix3<f64>| SVector::<f64, 9>::from_fn(|i, _| m[(i / 3, i % 3)]);
        let (e, r) = (essential_from_pose(self), self.rotation.matrix());
        let [u, v] = UnitVector::basis(&self.translation);
        SMatrix::from_columns(&[
            flat(e * Vector3::x().cross_matrix()),
            flat(e * Vector3::y().cross_matrix()),
            flat(e * Vector3::z().cross_matrix()),
            flat(u.cross_matrix() * r),
            flat(v.cross_matrix() * r),
        ])
    }

    fn step(&self, d: &SVector<f64, 5>) -> Self {
        let [u, v] = UnitVector::basis(&self.translation);
        Self::new(
            self.rotation * Rotation3::new(Vector3::new(d[0], d[1], d[2])),
            (self.translation + u * d[3] + v * d[4]).normalize(),
        )
    }
}

struct PoseEstimator {
    set: NormalizedMatches,
    /// In normalized units.
    threshold: f64,
}

/// An essential matrix and its pose, in f32.
struct PoseKernel {
    sampson: SampsonKernel,
    r: [f32; 9],
    t: [f32; 3],
    squared_threshold: f32,
}

impl PoseKernel {
    fn new(pose: &Pose, threshold: f64) -> Self {
        let r = pose.rotation.matrix();
        Self {
            sampson: SampsonKernel::new(&essential_from_pose(pose)),
            r: std::array::from_fn(|i| r[(i / 3, i % 3)] as f32),
            t: std::array::from_fn(|i| pose.translation[i] as f32),
            squared_threshold: (threshold * threshold) as f32,
        }
    }

    /// Computes squared Sampson distances; infinite where the match is behind a camera by more than the threshold.
    #[inline(always)]
    fn squared_residuals(&self, block: &MatchBlock) -> [f32; LANES] {
        let mut out = self.sampson.squared_residuals(block);
        let (r, t) = (&self.r, &self.t);
        for (i, r2) in out.iter_mut().enumerate() {
            let (x, y, u, v) = (block.x1[i], block.y1[i], block.x2[i], block.y2[i]);
            let p = [r[0] * x + r[1] * y + r[2], r[3] * x + r[4] * y + r[5], r[6] * x + r[7] * y + r[8]];
            // b × Ra, b × t, Ra × t.
            let n = [v * p[2] - p[1], p[0] - u * p[2], u * p[1] - v * p[0]];
            let bt = [v * t[2] - t[1], t[0] - u * t[2], u * t[1] - v * t[0]];
            let pt = [p[1] * t[2] - p[2] * t[1], p[2] * t[0] - p[0] * t[2], p[0] * t[1] - p[1] * t[0]];
            let first = n[0] * bt[0] + n[1] * bt[1] + n[2] * bt[2];
            let second = n[0] * pt[0] + n[1] * pt[1] + n[2] * pt[2];
            let (lb, lp) = (u * u + v * v + 1.0, p[0] * p[0] + p[1] * p[1] + p[2] * p[2]);
            // Behind a camera: a positive product, relative to the lengths of its factors, beyond the threshold.
            let behind_first =
                first * first.max(0.0) > self.squared_threshold * lp * (bt[0] * bt[0] + bt[1] * bt[1] + bt[2] * bt[2]);
            let behind_second = second * second.max(0.0)
                > self.squared_threshold * lb * (pt[0] * pt[0] + pt[1] * pt[1] + pt[2] * pt[2]);
            *r2 = if behind_first | behind_second { f32::INFINITY } else { *r2 };
        }
        out
    }
}

impl Estimator for PoseEstimator {
    type Model = Pose;
    type Data = NormalizedMatches;
    type Kernel = PoseKernel;
    const SAMPLE_SIZE: usize = 5;
    const RESIDUAL_DIMENSION: i32 = 1;
    const INNER_SAMPLES: usize = 20;

    fn data(&self) -> &NormalizedMatches {
        &self.set
    }

    fn threshold_scale(&self) -> f64 {
        1.0
    }

    fn solve(&self, sample: &[u32], models: &mut Vec<Pose>) {
        let pair = |i: usize| &self.set.pairs[sample[i] as usize];
        let a: [Point2<f64>; 5] = std::array::from_fn(|i| Point2::new(pair(i)[0], pair(i)[1]));
        let b: [Point2<f64>; 5] = std::array::from_fn(|i| Point2::new(pair(i)[2], pair(i)[3]));
        let (ha, hb) = (a.map(|p| p.to_homogeneous()), b.map(|p| p.to_homogeneous()));
        essential_five_point(&a, &b, |e| {
            let (r1, r2, t) = rotations_and_translation(&e);
            for r in [r1, r2] {
                for t in [t, -t] {
                    // Cheirality: at most one of the four poses has all five points in front, and for most samples with
                    // outliers none.
                    if (0..5).all(|i| in_front(&r, &t, &ha[i], &hb[i])) {
                        models.push(Pose::new(Rotation3::from_matrix_unchecked(r), t));
                        return;
                    }
                }
            }
        });
    }

    fn kernel(&self, model: &Pose) -> PoseKernel {
        PoseKernel::new(model, self.threshold)
    }

    #[inline(always)]
    fn squared_residuals(kernel: &PoseKernel, block: &MatchBlock) -> [f32; LANES] {
        kernel.squared_residuals(block)
    }

    fn refine(&self, model: &Pose, scorer: &dyn Scorer, threshold: f64, iterations: usize) -> Option<Pose> {
        let problem = SampsonProblem::new(&self.set.pair_blocks, scorer, threshold);
        refine_sampson(&problem, *model, iterations).and_then(with_orthonormal_rotation)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{TwoViews, cosine};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn both_decompositions_recover_the_pose(seed: u64) {
            let views = TwoViews::random(seed);
            let (e, pose) = (views.essential() * -3.0, views.pose);
            let poses = decompose_essential(&e).unwrap();
            let near = |r: &Matrix3<f64>, t: &Vector3<f64>| (r - pose.rotation.matrix()).norm() + (t - pose.translation).norm() < 1e-12;
            prop_assert!(poses.iter().filter(|p| near(p.rotation.matrix(), &p.translation)).count() == 1);
            for p in poses {
                prop_assert!((p.rotation.matrix().determinant() - 1.0).abs() < 1e-12);
                prop_assert!(cosine(&essential_from_pose(&p), &e) > 1.0 - 1e-12);
            }
            let (r1, r2, t) = rotations_and_translation(&e);
            prop_assert!([r1, r2].iter().any(|r| near(r, &t) || near(r, &-t)));
            let m = views.normalized_matches(20, 0.0);
            let recovered = recover_pose(&e, &m).unwrap();
            prop_assert!(near(recovered.pose.rotation.matrix(), &recovered.pose.translation));
            prop_assert_eq!(recovered.in_front.len(), 20);
            // The twisted pair has some points behind a camera.
            prop_assert!(recovered.runner_up < 20);
        }

        #[test]
        fn the_analytic_tangent_equals_the_numeric_derivative(seed: u64) {
            let pose = TwoViews::random(seed).pose;
            let tangent = Epipolar::<5>::tangent(&pose);
            for i in 0..5 {
                let mut d = SVector::<f64, 5>::zeros();
                d[i] = 1e-6;
                let numeric = (essential_from_pose(&Epipolar::step(&pose, &d)) - essential_from_pose(&Epipolar::step(&pose, &-d))) / 2e-6;
                for k in 0..9 {
                    // Central differences of a smooth function: 1e-12 truncation, 1e-10 rounding.
                    prop_assert!((numeric[(k / 3, k % 3)] - tangent[(k, i)]).abs() < 1e-8);
                }
            }
        }
    }

    #[test]
    fn simd_residuals_equal_the_scalar_ones_and_are_infinite_behind_a_camera() {
        let (mut behind, mut front) = (0, 0);
        for seed in 0..40 {
            let views = TwoViews::random(seed);
            let mut m = views.matches(30, 1.0);
            m.extend(views.outliers(30));
            let (m, unit) = normalize_matches(&m, &views.camera, &views.camera);
            let set = NormalizedMatches::with(&m, Normalizer::IDENTITY, Normalizer::IDENTITY);
            let (r, t) = (views.pose.rotation.matrix(), &views.pose.translation);
            let kernel = PoseKernel::new(&views.pose, 2.0 * unit);
            let fast: Vec<f32> = set.blocks.iter().flat_map(|b| kernel.squared_residuals(b)).collect();
            for (&i, fast) in set.order.iter().zip(&fast) {
                let m = &m[i as usize];
                let plain = sampson(&views.essential(), m);
                if fast.is_finite() {
                    front += 1;
                    // Coordinates of order one in f32.
                    assert!((f64::from(*fast).sqrt() - plain).abs() < 1e-5, "{fast} {plain}");
                } else {
                    behind += 1;
                    assert!(!in_front(r, t, &m.a.to_homogeneous(), &m.b.to_homogeneous()));
                }
            }
        }
        // A noise of one pixel does not move an inlier behind a camera by a threshold of two; about two in three
        // outliers are behind a camera.
        assert!(front > 40 * 30 && behind > 40 * 10, "{front} {behind}");
    }
}
