//! Why two photographs could not be reconstructed, and what to try.

use crate::MatchingError;
use cv_core::CameraError;
use cv_geometry::EstimateError;

/// Why two photographs could not be reconstructed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ReconstructError {
    /// The photographs could not be matched at all.
    #[error(transparent)]
    Matching(#[from] MatchingError),
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
    #[error("the camera only turned: a rotation by {degrees:.1} degrees explains {:.0} % of the matches", 100.0 * share)]
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
    /// The focal length that was given fits the matches much worse than others, or none can be told.
    #[error("the focal length cannot be told from these photographs ({focal:.0} px, give or take {:.0} %)", 100.0 * deviation)]
    UnknownFocal {
        /// Best estimate in pixels.
        focal: f64,
        /// Relative standard deviation.
        deviation: f64,
    },
    /// The search for a model failed.
    #[error(transparent)]
    Estimate(EstimateError),
}

impl ReconstructError {
    /// What a person can do about it.
    pub fn advice(&self) -> &'static str {
        match self {
            Self::Matching(_) => "take sharper photographs with more texture",
            Self::Camera { .. } | Self::CameraSize { .. } => "check the camera file",
            Self::TooFewMatches { .. } | Self::TooFewInliers { .. } => {
                "take photographs that share more of the scene, from places nearer to each other"
            }
            Self::PureRotation { .. } => {
                "step aside between the photographs; to join photographs from one place use `cv panorama`"
            }
            Self::Planar { .. } => "include things in front of the plane or behind it",
            Self::UncertainPose { .. } => {
                "take photographs that share more of the scene, with things near and far all over them, or find more features (--features)"
            }
            Self::LittleParallax { .. } => "take the photographs farther apart",
            Self::UnknownFocal { .. } => "give the focal length (--focal) or a camera file (--camera)",
            Self::Estimate(_) => "check the matches with `cv match`",
        }
    }
}
