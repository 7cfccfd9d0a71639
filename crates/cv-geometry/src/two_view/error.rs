//! Why two views could not be reconstructed.

use crate::EstimateError;
use cv_core::{CameraError, Cancelled};

/// Why two views could not be reconstructed.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum TwoViewError {
    /// A match refers to a keypoint that there is not.
    #[error("match {index} is between keypoints {query} and {train} of {} and {}", keypoints.0, keypoints.1)]
    MatchOutOfRange {
        /// Which match.
        index: usize,
        /// Its keypoint in the first photograph.
        query: u32,
        /// Its keypoint in the second photograph.
        train: u32,
        /// Numbers of keypoints.
        keypoints: (usize, usize),
    },
    /// A camera is not one.
    #[error("camera {index}: {source}")]
    Camera {
        /// 1 or 2.
        index: usize,
        /// Why.
        source: CameraError,
    },
    /// A camera is not that of its photograph.
    #[error("camera {index} takes pictures of {camera:?} px, but its photograph is of {photo:?} px")]
    CameraSize {
        /// 1 or 2.
        index: usize,
        /// Width and height by the camera.
        camera: (usize, usize),
        /// Width and height of the photograph.
        photo: (usize, usize),
    },
    /// Too few tentative matches.
    #[error("{got} matches are too few: at least {needed} are needed")]
    TooFewMatches {
        /// Matches found.
        got: usize,
        /// Matches needed.
        needed: usize,
    },
    /// Too few matches agree on a motion.
    #[error("only {inliers} of {matches} matches ({:.0} %) agree on a camera motion; at least {needed} must", 100.0 * *inliers as f64 / *matches as f64)]
    TooFewInliers {
        /// Matches that agree.
        inliers: usize,
        /// Matches.
        matches: usize,
        /// Matches that must agree.
        needed: usize,
    },
    /// The camera turned without moving.
    #[error("the camera only turned, or hardly moved: a rotation by {degrees:.1} degrees explains {:.0} % of the matches", 100.0 * share)]
    PureRotation {
        /// Share of the inliers that the rotation explains.
        share: f64,
        /// Its angle in degrees.
        degrees: f64,
    },
    /// All points lie on one plane.
    #[error("the scene is one plane: a homography explains {:.0} % of the matches", 100.0 * share)]
    Planar {
        /// Share of the inliers that the homography explains.
        share: f64,
    },
    /// A homography explains the matches, and the focal length, by which a plane and a turn could be told apart, is unknown.
    #[error("the scene is one plane, or the camera only turned: a homography explains {:.0} % of the matches", 100.0 * share)]
    PlanarOrTurned {
        /// Share of the inliers that the homography explains.
        share: f64,
    },
    /// The rays to the points are nearly parallel.
    #[error(
        "too little parallax: the median angle between the two rays of a point is {degrees:.2} degrees; {needed:.2} are needed"
    )]
    LittleParallax {
        /// Median angle in degrees.
        degrees: f64,
        /// Angle needed, in degrees.
        needed: f64,
    },
    /// The matches do not tell the motion well enough.
    #[error(
        "the motion is uncertain: {degrees:.1} degrees in its direction, {allowed:.1} are allowed ({inliers} of {matches} matches agree)"
    )]
    UncertainPose {
        /// Standard deviation of the direction, or angle to another direction that fits as well, in degrees.
        degrees: f64,
        /// Angle allowed, in degrees.
        allowed: f64,
        /// Matches that agree.
        inliers: usize,
        /// Matches.
        matches: usize,
    },
    /// Another focal length explains the matches far better than the one that was given.
    #[error(
        "the focal length given, {given:.0} px, fits the matches worse than one of about {better:.0} px, by {deviations:.0} standard deviations"
    )]
    WrongFocal {
        /// Focal length given, in pixels.
        given: f64,
        /// One that fits better, in pixels.
        better: f64,
        /// By how much better, in standard deviations of the difference.
        deviations: f64,
        /// Matches that agree by the better one.
        inliers: usize,
    },
    /// A focal length that no photograph has.
    #[error(
        "the focal length given, {given:.0} px, is none of a photograph of this size: {low:.0} to {high:.0} px are"
    )]
    ImplausibleFocal {
        /// Focal length given, in pixels.
        given: f64,
        /// That of a field of view of 136 degrees, in pixels.
        low: f64,
        /// That of a field of view of 3 degrees, in pixels.
        high: f64,
    },
    /// The search for a model failed.
    #[error(transparent)]
    Estimate(EstimateError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

impl TwoViewError {
    /// Refuses a focal length (pixels) that no lens of a photograph has, whose longer side is of `side` pixels.
    pub(super) fn check_focal(given: f64, side: usize) -> Result<(), Self> {
        // Fields of view along the longer side of 136 degrees, beyond which lenses are fisheyes, and of 3 degrees: 690 mm before a film of 36 mm.
        let [low, high] = [68f64, 1.5].map(|half| 0.5 * side as f64 / half.to_radians().tan());
        if (low..=high).contains(&given) { Ok(()) } else { Err(Self::ImplausibleFocal { given, low, high }) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_focal_length_of_millimeters_is_told() {
        assert_eq!(TwoViewError::check_focal(1000.0, 1200), Ok(()));
        // A millimeter's number, and a telescope's.
        for given in [35.0, 60_000.0] {
            let error = TwoViewError::check_focal(given, 1200).unwrap_err();
            assert!(
                matches!(error, TwoViewError::ImplausibleFocal { low, high, .. } if low > 200.0 && high < 30_000.0)
            );
        }
    }
}
