//! A model of two views from matches.

use crate::Progress;
use cv_core::{Camera, Cancelled, Correspondence, Matrix3, Pose, StageClock};
use cv_geometry::{
    EstimateError, RobustModel, RobustOptions, essential_from_pose, estimate_fundamental, estimate_homography,
    estimate_relative_pose, normalize_matches,
};

/// Which model of two views.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum ModelKind {
    /// `b ~ H a`: a plane, or a camera that only turned. Residual: symmetric transfer error.
    Homography,
    /// `bᵀ F a = 0`: a general scene. Residual: Sampson distance.
    Fundamental,
}

cv_core::named!(ModelKind {
    Homography = "homography": "a plane, or a camera that only turned: b ~ H a",
    Fundamental = "fundamental": "a general scene: bᵀ F a = 0",
});

impl ModelKind {
    /// The defaults of the estimator: threshold 3 px for homographies, 1 px for fundamental matrices.
    pub fn options(self) -> RobustOptions {
        match self {
            Self::Homography => RobustOptions::homography(),
            Self::Fundamental => RobustOptions::fundamental(),
        }
    }
}

/// What [`estimate`] found.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct EstimateResult {
    /// The model and the matches that fit it.
    pub robust: RobustModel<Matrix3<f64>>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Estimates a model from matches of which many may be wrong.
///
/// # Errors
/// [`EstimateError`]: too few matches, coordinates that are not numbers, degenerate points, no consensus, bad options.
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

/// The model that most matches agree on, and which those are.
#[derive(Debug, Clone, PartialEq)]
pub struct PrevailingModel {
    /// Which.
    pub kind: ModelKind,
    /// The model and the matches that fit it.
    pub robust: RobustModel<Matrix3<f64>>,
}

/// The model that most matches agree on, by the default options and a seed; `None` where neither can be estimated. A fundamental matrix always
/// fits somewhat more matches than a homography of the same scene: it must fit a tenth more.
///
/// # Errors
/// [`Cancelled`] where `progress` says so.
pub fn prevailing_model(
    pairs: &[Correspondence],
    seed: u64,
    progress: &dyn Progress,
) -> Result<Option<PrevailingModel>, Cancelled> {
    let fit = |kind: ModelKind| match estimate(pairs, kind, &RobustOptions { seed, ..kind.options() }, progress) {
        Ok(found) => Ok(Some(PrevailingModel { kind, robust: found.robust })),
        Err(EstimateError::Cancelled(stop)) => Err(stop),
        Err(_) => Ok(None),
    };
    Ok(match (fit(ModelKind::Homography)?, fit(ModelKind::Fundamental)?) {
        (Some(h), Some(f)) => Some(if h.robust.inliers.len() * 10 >= f.robust.inliers.len() * 9 { h } else { f }),
        (h, f) => h.or(f),
    })
}

/// What [`estimate_calibrated`] found.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct CalibratedResult {
    /// The essential matrix (of normalized coordinates; singular values 1, 1, 0) and the matches that fit it, in pixels.
    pub robust: RobustModel<Matrix3<f64>>,
    /// First camera frame to second; the translation has length one.
    pub pose: Pose,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Estimates the essential matrix of two calibrated cameras from matches in pixels of which many may be wrong. The threshold is in pixels, as
/// are the residuals.
///
/// # Errors
/// [`EstimateError`] as of [`estimate`]; a pixel that no ray of its camera reaches counts as a coordinate that is not a number.
pub fn estimate_calibrated(
    pairs: &[Correspondence],
    cameras: &[Camera; 2],
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<CalibratedResult, EstimateError> {
    let mut clock = StageClock::new();
    let (normalized, unit) = normalize_matches(pairs, &cameras[0], &cameras[1]);
    let options = RobustOptions { threshold: options.threshold * unit, ..*options };
    let found = estimate_relative_pose(&normalized, &options, progress)?;
    clock.lap("estimate");
    let robust = RobustModel {
        model: essential_from_pose(&found.model),
        inliers: found.inliers,
        rms: found.rms / unit,
        iterations: found.iterations,
        log_nfa: found.log_nfa,
    };
    Ok(CalibratedResult { robust, pose: found.model, stages: clock.into_stages() })
}
