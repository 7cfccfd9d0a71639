//! Guided matching along epipolar lines of calibrated cameras.

use cv_core::{Camera, Cancelled, DMatch, Matrix3, Point2, Progress};
pub(crate) use cv_features::GuidedOptions;
use cv_features::{Features, MatchError, TwoViewModel, match_guided};
use cv_parallel::prelude::*;

/// Matches features near each other's epipolar lines, for a fundamental matrix `f` of undistorted pixels. The matches
/// are mutual nearest neighbors, in the order of the first image's features.
pub(crate) fn match_epipolar(
    a: &Features,
    b: &Features,
    cameras: &[Camera; 2],
    f: &Matrix3<f64>,
    options: &GuidedOptions,
    progress: &dyn Progress,
) -> Result<Vec<DMatch>, Cancelled> {
    let undistort = |features: &Features, camera: &Camera| -> Vec<Point2<f32>> {
        let points = features.keypoints.par_iter();
        points.map(|k| camera.undistort_pixel(k.position.cast::<f64>()).cast::<f32>()).collect()
    };
    let (pa, pb) = (undistort(a, &cameras[0]), undistort(b, &cameras[1]));
    // Sets that cannot be compared have no matches.
    match match_guided(a, b, Some([&pa, &pb]), &TwoViewModel::Fundamental(*f), options, progress) {
        Err(MatchError::Cancelled(stop)) => Err(stop),
        found => Ok(found.unwrap_or_default()),
    }
}
