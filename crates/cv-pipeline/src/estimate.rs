//! A model of two views from matches.

use crate::{Progress, Stopwatch};
use cv_core::{Correspondence, Matrix3};
use cv_geometry::{EstimateError, RobustModel, RobustOptions, estimate_fundamental, estimate_homography};

/// Which model of two views.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ModelKind {
    /// `b ~ H a`: a plane, or a camera that only turned. Residual: symmetric transfer error.
    Homography,
    /// `bᵀ F a = 0`: a general scene. Residual: Sampson distance.
    Fundamental,
}

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
    let mut watch = Stopwatch::new();
    progress.report("estimate", 0, 1);
    let robust = match kind {
        ModelKind::Homography => estimate_homography(pairs, options),
        ModelKind::Fundamental => estimate_fundamental(pairs, options),
    }?;
    progress.report("estimate", 1, 1);
    watch.lap("estimate");
    Ok(EstimateResult { robust, stages: watch.into_stages() })
}
