//! Why two photographs could not be reconstructed, and what to try.

use crate::MatchingError;
use cv_core::Cancelled;
use cv_geometry::TwoViewError;

/// Why two photographs could not be reconstructed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ReconstructError {
    /// The photographs could not be matched at all.
    #[error(transparent)]
    Matching(MatchingError),
    /// The matches tell no motion, or no points.
    #[error(transparent)]
    TwoView(TwoViewError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

impl From<MatchingError> for ReconstructError {
    fn from(error: MatchingError) -> Self {
        match error {
            MatchingError::Cancelled(stop) => Self::Cancelled(stop),
            other => Self::Matching(other),
        }
    }
}

impl From<TwoViewError> for ReconstructError {
    fn from(error: TwoViewError) -> Self {
        match error {
            TwoViewError::Cancelled(stop) => Self::Cancelled(stop),
            other => Self::TwoView(other),
        }
    }
}

impl ReconstructError {
    /// What a person can do about it.
    pub fn advice(&self) -> String {
        let words = match self {
            Self::Matching(_) => "take sharper photographs with more texture",
            Self::TwoView(error) => return advice(error),
            Self::Cancelled(_) => "run it again",
        };
        words.to_owned()
    }
}

fn advice(error: &TwoViewError) -> String {
    let words = match error {
        TwoViewError::Camera { .. } | TwoViewError::CameraSize { .. } => "check the camera file",
        TwoViewError::TooFewMatches { .. } | TwoViewError::TooFewInliers { .. } => {
            "take photographs that share more of the scene, from places nearer to each other"
        }
        TwoViewError::PureRotation { .. } => {
            "step aside between the photographs; to join photographs from one place use `cv panorama`"
        }
        TwoViewError::PlanarOrTurned { .. } => {
            "step aside between the photographs and include things in front of the plane or behind it; --focal tells a plane from a turn; to join photographs from one place use `cv panorama`"
        }
        TwoViewError::Planar { .. } => "include things in front of the plane or behind it",
        TwoViewError::UncertainPose { .. } => {
            "take photographs that share more of the scene, with things near and far all over them, or find more features (--features)"
        }
        TwoViewError::LittleParallax { .. } => "take the photographs farther apart",
        TwoViewError::WrongFocal { better, .. } => {
            return format!(
                "check the focal length, which is in pixels of the photograph: --focal {better:.0}, or leave it out (--ignore-exif where the photograph has a wrong one)"
            );
        }
        TwoViewError::NoPerspective { side } | TwoViewError::UnknownFocal { side, .. } => {
            let phone = 0.8 * *side as f64;
            return format!(
                "give the focal length in pixels: --focal {phone:.0} (a phone's main camera: about 0.8 times the longer side), or a camera file (--camera)"
            );
        }
        TwoViewError::Estimate(_) | TwoViewError::MatchOutOfRange { .. } => "check the matches with `cv match`",
        TwoViewError::Cancelled(_) => "run it again",
    };
    words.to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_focal_length_that_cannot_be_told_is_asked_for() {
        let error = ReconstructError::from(TwoViewError::UnknownFocal { low: 800.0, high: 1250.0, side: 1200 });
        assert!(error.advice().contains("--focal 960"));
    }
}
