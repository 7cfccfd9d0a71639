//! Geometric verification of a pair of views: the matches that are inliers of a two-view geometry.

use crate::CameraKnowledge;
use cv_core::{Camera, Cancelled, Correspondence, DMatch, Keypoint, Matrix3, Pose, Progress};
use cv_geometry::{
    Degeneracy, EstimateError, LocalOptimization, RobustOptions, Scoring, essential_from_pose, estimate_fundamental,
    estimate_homography, estimate_relative_pose, normalize_matches,
};

/// Settings of [`verify_view_pair`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct ViewPairOptions {
    /// Inlier threshold in pixels where both cameras are calibrated, including their distortion. Default 2.
    pub threshold: f64,
    /// Inlier threshold in pixels where one is not; large enough for the effect of an unknown distortion. Default 4,
    /// COLMAP's.
    pub threshold_uncalibrated: f64,
    /// Minimum number of inliers. Default 15, COLMAP's.
    pub min_inliers: usize,
    /// Inlier ratio at which RANSAC finds the inliers with 95 % probability, above 0 and below 1; it determines the
    /// number of samples. Default 3/8, which needs 400 samples of five matches. Views with fewer inliers are connected
    /// by way of other pairs.
    #[cfg_attr(feature = "serde", serde(rename = "min_share"))]
    pub min_inlier_ratio: f64,
    /// Seed of RANSAC. Default 0.
    pub seed: u64,
}

impl Default for ViewPairOptions {
    fn default() -> Self {
        Self { threshold: 2.0, threshold_uncalibrated: 4.0, min_inliers: 15, min_inlier_ratio: 0.375, seed: 0 }
    }
}

/// Number of matches from which on local optimization is iterative: with fewer, several local optima have nearly as
/// many inliers, and an inner RANSAC is needed.
const ITERATIVE_MIN_MATCHES: usize = 200;
/// Maximum number of samples.
const MAX_SAMPLES: usize = 20_000;

/// A two-view geometry.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum ViewPairModel {
    /// Calibrated cameras: first camera frame to second, with a unit translation.
    Pose(Pose),
    /// Uncalibrated cameras: `bᵀ F a = 0` in distorted pixels.
    Fundamental(Matrix3<f64>),
    /// A planar scene or a rotation: `b ~ H a` in distorted pixels.
    Homography(Matrix3<f64>),
}

impl ViewPairModel {
    /// Returns the fundamental matrix, between undistorted pixels for a pose or distorted pixels for an uncalibrated
    /// pair; `None` for a homography.
    pub fn fundamental(&self, cameras: [&Camera; 2]) -> Option<Matrix3<f64>> {
        match self {
            Self::Pose(pose) => {
                let [a, b] = cameras.map(Camera::inverse_matrix);
                Some(b.transpose() * essential_from_pose(pose) * a)
            }
            Self::Fundamental(f) => Some(*f),
            Self::Homography(_) => None,
        }
    }
}

/// A verified pair of views.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct ViewPair {
    /// The two-view geometry.
    pub model: ViewPairModel,
    /// Indices of the inliers, ascending.
    pub inliers: Vec<usize>,
    /// Root mean square of the inliers' residuals, in pixels.
    pub rms: f64,
}

/// Why a pair of views cannot be verified.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum ViewPairError {
    /// Too few inliers.
    #[error("{got} of {matches} matches agree, {needed} are needed")]
    TooFewInliers {
        /// Number of inliers.
        got: usize,
        /// Number of matches.
        matches: usize,
        /// Number that is needed.
        needed: usize,
    },
    /// No geometry was found.
    #[error("no geometry: {0}")]
    NoModel(EstimateError),
    /// The job was stopped.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

impl From<EstimateError> for ViewPairError {
    fn from(error: EstimateError) -> Self {
        match error {
            EstimateError::Cancelled(stop) => Self::Cancelled(stop),
            other => Self::NoModel(other),
        }
    }
}

/// Estimates the two-view geometry of a pair and its inlier matches: a relative pose where both cameras are calibrated,
/// else a fundamental matrix, or a homography in a planar degenerate configuration.
///
/// # Errors
/// [`ViewPairError`].
pub fn verify_view_pair(
    cameras: [(&Camera, &CameraKnowledge); 2],
    keypoints: [&[Keypoint]; 2],
    matches: &[DMatch],
    options: &ViewPairOptions,
    progress: &dyn Progress,
) -> Result<ViewPair, ViewPairError> {
    let is_calibrated = cameras.iter().all(|c| c.1.is_calibrated());
    let is_known = cameras.iter().all(|c| *c.1 == CameraKnowledge::Known);
    let mut index = Vec::with_capacity(matches.len());
    let mut pairs = Vec::with_capacity(matches.len());
    for (i, m) in matches.iter().enumerate() {
        if let Some(pair) = m.correspondence(keypoints[0], keypoints[1]) {
            index.push(i);
            pairs.push(pair);
        }
    }
    let too_few = |got| ViewPairError::TooFewInliers { got, matches: matches.len(), needed: options.min_inliers };
    if pairs.len() < options.min_inliers {
        return Err(too_few(pairs.len()));
    }
    // With few matches, the minimum number of inliers is a larger ratio.
    let inlier_ratio = (options.min_inliers as f64 / pairs.len() as f64).clamp(options.min_inlier_ratio, 0.99);
    let samples =
        |size: i32| ((0.05f64.ln() / (-inlier_ratio.powi(size)).ln_1p()).ceil() as usize).clamp(16, MAX_SAMPLES);
    let robust = RobustOptions {
        max_iterations: samples(if is_calibrated { 5 } else { 7 }),
        seed: options.seed,
        scoring: Scoring::Msac,
        local_optimization: if pairs.len() < ITERATIVE_MIN_MATCHES {
            LocalOptimization::InnerRansac
        } else {
            LocalOptimization::Iterative
        },
        ..RobustOptions::default()
    };
    let (model, inliers, rms) = if is_calibrated {
        let (rays, unit) = normalize_matches(&pairs, cameras[0].0, cameras[1].0);
        // Pixels beyond the range of the distortion model have no normalized coordinates.
        let finite: Vec<usize> = (0..rays.len()).filter(|i| rays[*i].is_finite()).collect();
        let rays: Vec<Correspondence> = finite.iter().map(|i| rays[*i]).collect();
        let threshold = if is_known { options.threshold } else { options.threshold_uncalibrated };
        let robust = RobustOptions { threshold: threshold * unit, ..robust };
        let estimate = estimate_relative_pose(&rays, &robust, progress)?;
        (
            ViewPairModel::Pose(estimate.model),
            estimate.inliers.into_iter().map(|i| finite[i]).collect::<Vec<_>>(),
            estimate.rms / unit,
        )
    } else {
        let robust = RobustOptions { threshold: options.threshold_uncalibrated, ..robust };
        match estimate_fundamental(&pairs, &robust, progress) {
            Ok(estimate) => (ViewPairModel::Fundamental(estimate.model), estimate.inliers, estimate.rms),
            Err(EstimateError::Degenerate { kind: Degeneracy::Planar }) => {
                let estimate = estimate_homography(&pairs, &robust, progress)?;
                (ViewPairModel::Homography(estimate.model), estimate.inliers, estimate.rms)
            }
            Err(error) => return Err(error.into()),
        }
    };
    if inliers.len() < options.min_inliers {
        return Err(too_few(inliers.len()));
    }
    Ok(ViewPair { model, inliers: inliers.into_iter().map(|i| index[i]).collect(), rms })
}
