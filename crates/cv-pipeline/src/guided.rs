//! Matches along epipolar lines, once the geometry is known.

use cv_core::{Camera, Cancelled, DMatch, Matrix3, Point2, Progress};
pub(crate) use cv_features::GuidedOptions;
use cv_features::{Features, MatchError, TwoViewModel, match_guided};
use rayon::prelude::*;

/// Matches between features whose distance from the epipolar geometry `f` (of undistorted pixels) is small, each the best of both, in order of the first
/// photograph's features.
pub(crate) fn match_along_lines(
    a: &Features,
    b: &Features,
    cameras: &[Camera; 2],
    f: &Matrix3<f64>,
    options: &GuidedOptions,
    progress: &dyn Progress,
) -> Result<Vec<DMatch>, Cancelled> {
    let straight = |features: &Features, camera: &Camera| -> Vec<Point2<f32>> {
        let points = features.keypoints.par_iter();
        points.map(|k| camera.undistort_pixel(k.position.cast::<f64>()).cast::<f32>()).collect()
    };
    let (pa, pb) = (straight(a, &cameras[0]), straight(b, &cameras[1]));
    // Sets that cannot be compared have no matches.
    match match_guided(a, b, Some([&pa, &pb]), &TwoViewModel::Fundamental(*f), options, progress) {
        Err(MatchError::Cancelled(stop)) => Err(stop),
        found => Ok(found.unwrap_or_default()),
    }
}
