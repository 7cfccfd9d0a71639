//! Robust estimation of the relative pose and the shared focal length of two views.

use crate::epipolar::{Epipolar, SampsonKernel, SampsonProblem, refine_sampson, sampson};
use crate::error::{Degeneracy, EstimateError};
use crate::essential::{decompose_essential, essential_from_pose, in_front};
use crate::match_blocks::{
    LANES, MatchBlock, NormalizedMatches, Normalizer, PairBlocks, check_matches, point_degeneracy,
};
use crate::ransac::{Estimator, RobustOptions, Scorer, TukeyBiweight, ransac};
use crate::robust::RobustModel;
use crate::rotation::orthonormalized;
use crate::six_point::fundamental_six_point;
use cv_core::{Correspondence, Matrix3, Point2, Pose, Progress, Vector3};
use cv_numeric::LeastSquares;
use nalgebra::{SMatrix, SVector};

/// A relative pose and the focal length of both cameras.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SharedFocalPose {
    /// First camera frame to second; the translation has length one.
    pub pose: Pose,
    /// Focal length, in the unit of the matches.
    pub focal: f64,
}

impl SharedFocalPose {
    /// Returns the fundamental matrix between coordinates relative to the principal points, times the squared focal
    /// length.
    pub fn fundamental(&self) -> Matrix3<f64> {
        let k = self.scaling();
        k * essential_from_pose(&self.pose) * k
    }

    /// Returns K⁻¹ times the focal length.
    fn scaling(&self) -> Matrix3<f64> {
        Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, self.focal))
    }

    fn scaled(self, factor: f64) -> Self {
        Self { focal: self.focal * factor, ..self }
    }
}

/// Estimates the relative pose of two cameras with the same unknown focal length, and that focal length, robustly from
/// tentative matches in pixels relative to the principal points.
///
/// RANSAC with the six-point algorithm ([`fundamental_six_point`]) and joint local optimization of pose and focal
/// length on the Sampson error. Inliers lie in front of both cameras.
///
/// # Errors
/// [`EstimateError`]: fewer than seven matches, a coordinate that is not finite, coincident or collinear points, or no
/// model with a small enough number of false alarms.
pub fn estimate_shared_focal_pose(
    matches: &[Correspondence],
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<RobustModel<SharedFocalPose>, EstimateError> {
    options.check()?;
    check_matches(matches, 7)?;
    let largest_coordinate = largest_coordinate(matches);
    if largest_coordinate <= 0.0 {
        return Err(EstimateError::Degenerate { kind: Degeneracy::Coincident });
    }
    let normalizer = Normalizer { center: Point2::origin(), scale: 1.0 / largest_coordinate };
    let set = NormalizedMatches::with(matches, normalizer, normalizer);
    if let Some(kind) = point_degeneracy(set.pairs.iter(), 7, 0.0) {
        return Err(EstimateError::Degenerate { kind });
    }
    let consensus = ransac(&FocalEstimator { set, scale: 1.0 / largest_coordinate }, options, progress)?;
    let model = consensus.model.scaled(largest_coordinate);
    let f = model.fundamental();
    let residual = |m: &SharedFocalPose, pair: &Correspondence| {
        let ray = |p: &Point2<f64>| Vector3::new(p.x, p.y, m.focal);
        let is_in_front = in_front(m.pose.rotation.matrix(), &m.pose.translation, &ray(&pair.a), &ray(&pair.b));
        if is_in_front { sampson(&f, pair) } else { f64::INFINITY }
    };
    Ok(RobustModel::new(model, matches, options.threshold, &consensus, residual))
}

/// Refines a relative pose and a focal length by minimizing the robust Sampson error of `matches` (pixels relative to
/// the principal points).
///
/// Returns them and the loss, to which each match adds 0 (exact) to 1 (beyond 2.5 thresholds, in pixels).
pub fn refine_shared_focal_pose(
    start: &SharedFocalPose,
    matches: &[Correspondence],
    threshold: f64,
) -> (SharedFocalPose, f64) {
    let largest_coordinate = largest_coordinate(matches).max(f64::MIN_POSITIVE);
    let scaled = |m: &Correspondence| {
        [m.a.x / largest_coordinate, m.a.y / largest_coordinate, m.b.x / largest_coordinate, m.b.y / largest_coordinate]
    };
    let pairs: Vec<[f64; 4]> = matches.iter().map(scaled).collect();
    let pairs = PairBlocks::new(&pairs);
    let problem = SampsonProblem::new(&pairs, &TukeyBiweight, threshold / largest_coordinate);
    let start = start.scaled(1.0 / largest_coordinate);
    let refined = refine_sampson(&problem, start, 50).and_then(with_orthonormal_rotation).unwrap_or(start);
    (refined.scaled(largest_coordinate), problem.cost(&refined))
}

/// Returns the largest coordinate magnitude.
fn largest_coordinate(matches: &[Correspondence]) -> f64 {
    let largest = |m: &Correspondence| m.a.coords.amax().max(m.b.coords.amax());
    matches.iter().map(largest).fold(0.0, f64::max)
}

/// Re-orthonormalizes the rotation after many small updates.
fn with_orthonormal_rotation(model: SharedFocalPose) -> Option<SharedFocalPose> {
    let rotation = orthonormalized(&model.pose.rotation)?;
    Some(SharedFocalPose { pose: Pose::new(rotation, model.pose.translation), ..model })
}

/// Five degrees of freedom of the pose, and the logarithm of the focal length.
impl Epipolar<6> for SharedFocalPose {
    fn matrix(&self) -> Matrix3<f64> {
        self.fundamental()
    }

    fn tangent(&self) -> SMatrix<f64, 9, 6> {
        let k = self.scaling();
        let pose_tangent = Epipolar::<5>::tangent(&self.pose);
        let f = self.fundamental();
        SMatrix::from_fn(|i, d| {
            let (row, column) = (i / 3, i % 3);
            if d < 5 {
                pose_tangent[(i, d)] * k[(row, row)] * k[(column, column)]
            } else {
                // The entries are of degree one in the focal length for each third coordinate.
                f[(row, column)] * f64::from(u8::from(row == 2) + u8::from(column == 2))
            }
        })
    }

    fn step(&self, d: &SVector<f64, 6>) -> Self {
        let pose = Epipolar::<5>::step(&self.pose, &d.fixed_rows::<5>(0).into_owned());
        // Steps are limited to a factor of two, beyond which the linearization is not valid.
        Self { pose, focal: self.focal * d[5].clamp(-0.7, 0.7).exp() }
    }
}

struct FocalEstimator {
    set: NormalizedMatches,
    scale: f64,
}

impl Estimator for FocalEstimator {
    type Model = SharedFocalPose;
    type Data = NormalizedMatches;
    type Kernel = SampsonKernel;
    const SAMPLE_SIZE: usize = 6;
    const RESIDUAL_DIMENSION: i32 = 1;
    // The same as for calibrated poses.
    const INNER_SAMPLES: usize = 20;

    fn data(&self) -> &NormalizedMatches {
        &self.set
    }

    fn threshold_scale(&self) -> f64 {
        self.scale
    }

    fn solve(&self, sample: &[u32], models: &mut Vec<SharedFocalPose>) {
        let pair = |i: usize| &self.set.pairs[sample[i] as usize];
        let a: [Point2<f64>; 6] = std::array::from_fn(|i| Point2::new(pair(i)[0], pair(i)[1]));
        let b: [Point2<f64>; 6] = std::array::from_fn(|i| Point2::new(pair(i)[2], pair(i)[3]));
        fundamental_six_point(&a, &b, |f, focal| {
            let k = Matrix3::from_diagonal(&Vector3::new(focal, focal, 1.0));
            let ray = |p: &Point2<f64>| Vector3::new(p.x, p.y, focal);
            for pose in decompose_essential(&(k * f * k)).into_iter().flatten() {
                let (r, t) = (pose.rotation.matrix(), &pose.translation);
                // Cheirality: at most one of the four poses has all six points in front, and for most samples with
                // outliers none.
                if (0..6).all(|i| in_front(r, t, &ray(&a[i]), &ray(&b[i]))) {
                    models.push(SharedFocalPose { pose, focal });
                    return;
                }
            }
        });
    }

    fn kernel(&self, model: &SharedFocalPose) -> SampsonKernel {
        SampsonKernel::new(&model.fundamental())
    }

    #[inline(always)]
    fn squared_residuals(kernel: &SampsonKernel, block: &MatchBlock) -> [f32; LANES] {
        kernel.squared_residuals(block)
    }

    fn refine(
        &self,
        model: &SharedFocalPose,
        scorer: &dyn Scorer,
        threshold: f64,
        iterations: usize,
    ) -> Option<SharedFocalPose> {
        let problem = SampsonProblem::new(&self.set.pair_blocks, scorer, threshold);
        refine_sampson(&problem, *model, iterations).and_then(with_orthonormal_rotation)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::TwoViews;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_analytic_tangent_equals_the_numeric_derivative(seed: u64, focal in 0.3..3.0f64) {
            let model = SharedFocalPose { pose: TwoViews::random(seed).pose, focal };
            let tangent = Epipolar::<6>::tangent(&model);
            for i in 0..6 {
                let mut d = SVector::<f64, 6>::zeros();
                d[i] = 1e-6;
                let numeric = (model.step(&d).fundamental() - model.step(&-d).fundamental()) / 2e-6;
                for k in 0..9 {
                    // Central differences of a smooth function of size up to ten: 1e-11 truncation, 1e-9 rounding.
                    prop_assert!((numeric[(k / 3, k % 3)] - tangent[(k, i)]).abs() < 1e-7);
                }
            }
        }
    }
}
