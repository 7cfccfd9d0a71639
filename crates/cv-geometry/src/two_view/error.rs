//! Errors of two-view reconstruction.

use crate::EstimateError;
use cv_core::{CameraError, Cancelled};

/// Why two views could not be reconstructed.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum TwoViewError {
    /// A match has a keypoint index out of range.
    #[error("match {index} has keypoint indices {query} and {train}, but there are only {} and {} keypoints", keypoints.0, keypoints.1)]
    MatchOutOfRange {
        /// Index of the match.
        index: usize,
        /// Its keypoint index in the first image.
        query: u32,
        /// Its keypoint index in the second image.
        train: u32,
        /// Numbers of keypoints of the two images.
        keypoints: (usize, usize),
    },
    /// A camera has invalid parameters.
    #[error("camera {index}: {source}")]
    Camera {
        /// Number of the camera, 1 or 2.
        index: usize,
        /// Reason.
        source: CameraError,
    },
    /// The image sizes of a camera and its image differ.
    #[error("camera {index} is for images of {camera:?} px, but its image has {photo:?} px")]
    CameraSize {
        /// Number of the camera, 1 or 2.
        index: usize,
        /// Width and height of the camera.
        camera: (usize, usize),
        /// Width and height of the image.
        photo: (usize, usize),
    },
    /// There are too few tentative matches.
    #[error("{got} matches are too few: at least {needed} are needed")]
    TooFewMatches {
        /// Number of matches.
        got: usize,
        /// Minimum number of matches.
        needed: usize,
    },
    /// The best relative pose has too few inliers.
    #[error("only {inliers} of {matches} matches ({:.0} %) agree on a camera motion; at least {needed} must", 100.0 * *inliers as f64 / *matches as f64)]
    TooFewInliers {
        /// Number of inliers.
        inliers: usize,
        /// Number of matches.
        matches: usize,
        /// Minimum number of inliers.
        needed: usize,
    },
    /// The motion is a pure rotation.
    #[error("the camera only turned, or hardly moved: a rotation by {degrees:.1} degrees explains {:.0} % of the matches", 100.0 * fraction)]
    PureRotation {
        /// Fraction of the inliers that fit the rotation.
        #[cfg_attr(feature = "serde", serde(rename = "share"))]
        fraction: f64,
        /// Angle of the rotation in degrees.
        degrees: f64,
    },
    /// The scene is planar.
    #[error("the scene is one plane: a homography explains {:.0} % of the matches", 100.0 * fraction)]
    Planar {
        /// Fraction of the inliers that fit the homography.
        #[cfg_attr(feature = "serde", serde(rename = "share"))]
        fraction: f64,
    },
    /// A homography fits the matches; a planar scene and a pure rotation cannot be distinguished, since the focal
    /// length is unknown.
    #[error("the scene is one plane, or the camera only turned: a homography explains {:.0} % of the matches", 100.0 * fraction)]
    #[cfg_attr(feature = "serde", serde(rename = "PlanarOrTurned"))]
    PlanarOrPureRotation {
        /// Fraction of the inliers that fit the homography.
        #[cfg_attr(feature = "serde", serde(rename = "share"))]
        fraction: f64,
    },
    /// The parallax is too small.
    #[error(
        "too little parallax: the median angle between the two rays of a point is {degrees:.2} degrees; {needed:.2} are needed"
    )]
    LittleParallax {
        /// Median parallax angle in degrees.
        degrees: f64,
        /// Minimum median parallax angle in degrees.
        needed: f64,
    },
    /// The relative pose is too uncertain.
    #[error(
        "the camera motion is uncertain: {degrees:.1} degrees in its direction, {allowed:.1} are allowed ({inliers} of {matches} matches agree)"
    )]
    UncertainPose {
        /// Standard deviation of the direction of the translation, or angle to another direction that fits as well, in
        /// degrees.
        degrees: f64,
        /// Maximum angle in degrees.
        allowed: f64,
        /// Number of inliers.
        inliers: usize,
        /// Number of matches.
        matches: usize,
    },
    /// Another focal length fits the matches significantly better than the given one.
    #[error(
        "the focal length given, {given:.0} px, fits the matches worse than one of about {better:.0} px, by {deviations:.0} standard deviations"
    )]
    WrongFocal {
        /// Given focal length in pixels.
        given: f64,
        /// Focal length with a better fit, in pixels.
        better: f64,
        /// Difference of the losses in standard deviations of it.
        deviations: f64,
        /// Number of inliers with the better one.
        inliers: usize,
    },
    /// The given focal length is implausible for any lens.
    #[error(
        "the focal length given, {given:.0} px, is implausible for a photograph of this size: it must be in pixels, from {low:.0} to {high:.0} px"
    )]
    ImplausibleFocal {
        /// Given focal length in pixels.
        given: f64,
        /// Minimum: a field of view of 136 degrees, in pixels.
        low: f64,
        /// Maximum: a field of view of 3 degrees, in pixels.
        high: f64,
    },
    /// The estimation of a model failed.
    #[error(transparent)]
    Estimate(EstimateError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

impl TwoViewError {
    /// Checks that a focal length in pixels is plausible for an image whose longer side is `side` pixels.
    pub(super) fn check_focal(given: f64, side: usize) -> Result<(), Self> {
        // Fields of view along the longer side of 136 degrees, beyond which lenses are fisheyes, and of 3 degrees: 690
        // mm for 35 mm film.
        let [low, high] = [68f64, 1.5].map(|half| 0.5 * side as f64 / half.to_radians().tan());
        if (low..=high).contains(&given) { Ok(()) } else { Err(Self::ImplausibleFocal { given, low, high }) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn implausible_focal_lengths_are_rejected() {
        assert_eq!(TwoViewError::check_focal(1000.0, 1200), Ok(()));
        // A focal length in millimeters, and that of a telescope.
        for given in [35.0, 60_000.0] {
            let error = TwoViewError::check_focal(given, 1200).unwrap_err();
            assert!(
                matches!(error, TwoViewError::ImplausibleFocal { low, high, .. } if low > 200.0 && high < 30_000.0)
            );
        }
    }
}
