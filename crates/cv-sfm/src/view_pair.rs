//! Which matches of two views agree with their geometry.

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
    /// Largest error of a match that agrees, in pixels, where both cameras and their lenses are known. Default 2.
    pub threshold: f64,
    /// The same where one is not, so that what the lens bends stays. Default 4, COLMAP's.
    pub threshold_uncalibrated: f64,
    /// Fewest matches that agree. Default 15, COLMAP's.
    pub min_inliers: usize,
    /// Share of right matches that a search finds with 95 %, above 0 and below 1: the fewer, the more samples. Default 3/8, for five of which 400 samples are needed. Views with fewer right
    /// matches hold together by way of others.
    pub min_share: f64,
    /// Seed of the samples. Default 0.
    pub seed: u64,
}

impl Default for ViewPairOptions {
    fn default() -> Self {
        Self { threshold: 2.0, threshold_uncalibrated: 4.0, min_inliers: 15, min_share: 0.375, seed: 0 }
    }
}

/// Matches from which on the loss of a pair has one minimum that matters: of fewer, several models agree with nearly as many, and the search has to go round each.
const MANY: usize = 200;
/// Most samples of a search.
const MOST_SAMPLES: usize = 20_000;

/// The geometry of two views.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum ViewPairModel {
    /// Of known cameras: first camera frame to second, the translation of length one.
    Pose(Pose),
    /// Of unknown ones: `bᵀ F a = 0` in pixels as they were taken.
    Fundamental(Matrix3<f64>),
    /// A plane, or a camera that only turned: `b ~ H a` in pixels as they were taken.
    Homography(Matrix3<f64>),
}

impl ViewPairModel {
    /// The fundamental matrix between undistorted pixels of known cameras, or pixels as they were taken of unknown ones; `None` of a homography.
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

/// Two views whose matches agree.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct ViewPair {
    /// Their geometry.
    pub model: ViewPairModel,
    /// Indices of the matches that agree with it, ascending.
    pub inliers: Vec<usize>,
    /// Root mean square of their distances from it, in pixels.
    pub rms: f64,
}

/// Why the matches of two views say nothing of their geometry.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum ViewPairError {
    /// Too few matches agree.
    #[error("{got} of {matches} matches agree where {needed} are needed")]
    TooFewInliers {
        /// Matches that agree.
        got: usize,
        /// Matches.
        matches: usize,
        /// How many are needed.
        needed: usize,
    },
    /// No geometry fits.
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

/// The geometry of two views and the matches that agree with it: a relative pose where both cameras are known, else a fundamental matrix, or a homography where that is all there
/// is.
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
    let calibrated = cameras.iter().all(|c| c.1.is_calibrated());
    let known = cameras.iter().all(|c| *c.1 == CameraKnowledge::Known);
    let mut index = Vec::with_capacity(matches.len());
    let mut pairs = Vec::with_capacity(matches.len());
    for (i, m) in matches.iter().enumerate() {
        if let Some(pair) = m.correspondence(keypoints[0], keypoints[1]) {
            index.push(i);
            pairs.push(pair);
        }
    }
    let few = |got| ViewPairError::TooFewInliers { got, matches: matches.len(), needed: options.min_inliers };
    if pairs.len() < options.min_inliers {
        return Err(few(pairs.len()));
    }
    // Where there are few matches, those that must agree are a larger share.
    let share = (options.min_inliers as f64 / pairs.len() as f64).clamp(options.min_share, 0.99);
    let samples = |size: i32| ((0.05f64.ln() / (-share.powi(size)).ln_1p()).ceil() as usize).clamp(16, MOST_SAMPLES);
    let robust = RobustOptions {
        max_iterations: samples(if calibrated { 5 } else { 7 }),
        seed: options.seed,
        scoring: Scoring::Msac,
        local_optimization: if pairs.len() < MANY {
            LocalOptimization::InnerRansac
        } else {
            LocalOptimization::Iterative
        },
        ..RobustOptions::default()
    };
    let (model, inliers, rms) = if calibrated {
        let (rays, unit) = normalize_matches(&pairs, cameras[0].0, cameras[1].0);
        // Beyond the range of a lens there are no rays.
        let finite: Vec<usize> = (0..rays.len()).filter(|i| rays[*i].is_finite()).collect();
        let rays: Vec<Correspondence> = finite.iter().map(|i| rays[*i]).collect();
        let pixels = if known { options.threshold } else { options.threshold_uncalibrated };
        let robust = RobustOptions { threshold: pixels * unit, ..robust };
        let found = estimate_relative_pose(&rays, &robust, progress)?;
        (
            ViewPairModel::Pose(found.model),
            found.inliers.into_iter().map(|i| finite[i]).collect::<Vec<_>>(),
            found.rms / unit,
        )
    } else {
        let robust = RobustOptions { threshold: options.threshold_uncalibrated, ..robust };
        match estimate_fundamental(&pairs, &robust, progress) {
            Ok(found) => (ViewPairModel::Fundamental(found.model), found.inliers, found.rms),
            Err(EstimateError::Degenerate { kind: Degeneracy::Planar }) => {
                let found = estimate_homography(&pairs, &robust, progress)?;
                (ViewPairModel::Homography(found.model), found.inliers, found.rms)
            }
            Err(error) => return Err(error.into()),
        }
    };
    if inliers.len() < options.min_inliers {
        return Err(few(inliers.len()));
    }
    Ok(ViewPair { model, inliers: inliers.into_iter().map(|i| index[i]).collect(), rms })
}
