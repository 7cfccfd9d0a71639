//! Robust estimation of a two-view model from matches.

use crate::Progress;
use cv_core::{Camera, Cancelled, Correspondence, Matrix3, Pose, StageClock};
use cv_geometry::{
    EstimateError, RobustModel, RobustOptions, essential_from_pose, estimate_fundamental, estimate_homography,
    estimate_relative_pose, normalize_matches,
};

/// Kind of a two-view model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum ModelKind {
    /// `b ~ H a`: a planar scene or a rotation. Residual: symmetric transfer error.
    Homography,
    /// `bᵀ F a = 0`: a general scene. Residual: Sampson distance.
    Fundamental,
}

cv_core::named!(ModelKind {
    Homography = "homography": "a plane, or a camera that only turned: b ~ H a",
    Fundamental = "fundamental": "a general scene: bᵀ F a = 0",
});

impl ModelKind {
    /// Returns the default options of the estimator: threshold 3 px for homographies, 1 px for fundamental matrices.
    pub fn options(self) -> RobustOptions {
        match self {
            Self::Homography => RobustOptions::homography(),
            Self::Fundamental => RobustOptions::fundamental(),
        }
    }
}

/// Result of [`estimate`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct EstimateResult {
    /// The model and its inliers.
    pub robust: RobustModel<Matrix3<f64>>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Estimates a model from matches with outliers.
///
/// # Errors
/// [`EstimateError`]: too few matches, coordinates that are not finite, a degenerate configuration, no consensus,
/// invalid options.
pub fn estimate(
    pairs: &[Correspondence],
    kind: ModelKind,
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<EstimateResult, EstimateError> {
    let mut clock = StageClock::new();
    let robust = match kind {
        ModelKind::Homography => estimate_homography(pairs, options, progress),
        ModelKind::Fundamental => estimate_fundamental(pairs, options, progress),
    }?;
    clock.lap("estimate");
    Ok(EstimateResult { robust, stages: clock.into_stages() })
}

/// The model with the most support among the kinds.
#[derive(Debug, Clone, PartialEq)]
pub struct PrevailingModel {
    /// Its kind.
    pub kind: ModelKind,
    /// The model and its inliers.
    pub robust: RobustModel<Matrix3<f64>>,
}

/// Estimates both kinds of model with the default options and a seed, and selects one; `None` where neither can be
/// estimated. A fundamental matrix always has somewhat more inliers than a homography: it must have a tenth more.
///
/// # Errors
/// [`Cancelled`].
pub fn prevailing_model(
    pairs: &[Correspondence],
    seed: u64,
    progress: &dyn Progress,
) -> Result<Option<PrevailingModel>, Cancelled> {
    let estimate_kind =
        |kind: ModelKind| match estimate(pairs, kind, &RobustOptions { seed, ..kind.options() }, progress) {
            Ok(estimated) => Ok(Some(PrevailingModel { kind, robust: estimated.robust })),
            Err(EstimateError::Cancelled(stop)) => Err(stop),
            Err(_) => Ok(None),
        };
    Ok(match (estimate_kind(ModelKind::Homography)?, estimate_kind(ModelKind::Fundamental)?) {
        (Some(h), Some(f)) => Some(if h.robust.inliers.len() * 10 >= f.robust.inliers.len() * 9 { h } else { f }),
        (h, f) => h.or(f),
    })
}

/// Result of [`estimate_calibrated`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct CalibratedResult {
    /// The essential matrix (in normalized coordinates; singular values 1, 1, 0) and its inliers; residuals in pixels.
    pub robust: RobustModel<Matrix3<f64>>,
    /// First camera frame to second, with a unit translation.
    pub pose: Pose,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Estimates the essential matrix of two calibrated cameras from pixel matches with outliers. The threshold and the
/// residuals are in pixels.
///
/// # Errors
/// [`EstimateError`] as of [`estimate`]; a pixel beyond the range of the distortion model counts as not finite.
pub fn estimate_calibrated(
    pairs: &[Correspondence],
    cameras: &[Camera; 2],
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<CalibratedResult, EstimateError> {
    let mut clock = StageClock::new();
    let (normalized, unit) = normalize_matches(pairs, &cameras[0], &cameras[1]);
    let options = RobustOptions { threshold: options.threshold * unit, ..*options };
    let estimated = estimate_relative_pose(&normalized, &options, progress)?;
    clock.lap("estimate");
    let robust = RobustModel {
        model: essential_from_pose(&estimated.model),
        inliers: estimated.inliers,
        rms: estimated.rms / unit,
        iterations: estimated.iterations,
        log_nfa: estimated.log_nfa,
    };
    Ok(CalibratedResult { robust, pose: estimated.model, stages: clock.into_stages() })
}
