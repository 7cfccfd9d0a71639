//! Advice on failed jobs.

use crate::{DenseError, DepthError, MatchingError, NoPairCause, RangeError, ReconstructError};
use cv_geometry::TwoViewError;
use cv_stereo::{RectifyError, StereoError};

/// What a person can do about a failed job, with the numbers to do it by. A program words it and names its own options.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Advice {
    /// Sharper photographs, with more texture.
    SharperPhotographs,
    /// Photographs with more overlap, from viewpoints closer to each other.
    ShareMore,
    /// Two photographs of the same scene, with texture.
    SameScene,
    /// Photographs from closer viewpoints, of a static scene with texture.
    NearerAndStill,
    /// Larger photographs.
    LargerPhotographs,
    /// A baseline: stepping aside between the photographs. A pure rotation makes a panorama.
    StepAside,
    /// A baseline, and a scene that is not planar; with a known focal length, a plane can be told from a rotation.
    StepAsideOrGiveFocal,
    /// Stepping aside rather than moving along the optical axis.
    StepAsideNotAhead,
    /// A scene that is not planar.
    LeaveThePlane,
    /// The same feature method for both photographs.
    SameFeatures,
    /// A longer baseline.
    FartherApart,
    /// Objects at different depths all over the photographs, or more features.
    MoreDepthOrFeatures,
    /// A better value of the focal length, in pixels of the photograph.
    FocalBetter {
        /// In pixels.
        px: f64,
    },
    /// Leave the focal length out, or give it in pixels.
    LeaveOutFocal,
    /// Check the camera: it is not that of the photographs.
    CheckCamera,
    /// Inspect the matches.
    CheckMatches,
    /// Rectify the pair.
    Rectify,
    /// Exchange left and right; if they are in order, try smaller disparities.
    Exchange {
        /// Smallest disparity of the feature matches, in px.
        min_disparity: i32,
    },
    /// Try another range of disparities.
    TryDisparities {
        /// Smallest disparity of the feature matches, in px.
        min: i32,
        /// Number of disparities.
        count: usize,
    },
    /// Keep another range of depths.
    KeepDepths {
        /// The nearest depth found, in the unit of the baseline.
        near: f32,
        /// The farthest depth found.
        far: f32,
    },
    /// Check the principal points: they are not those of the photographs.
    CheckOffset,
    /// Give the number of disparities, or rectify the pair.
    GiveDisparities,
    /// A larger matching window, or a brighter scene.
    LargerWindow,
    /// More memory, or less to match.
    MoreMemory {
        /// Bytes that are needed at least.
        needed: usize,
    },
    /// Reduce the photographs less before matching.
    ReduceLess,
    /// An option is out of its range.
    CheckOptions,
    /// The job was stopped.
    RunAgain,
}

impl ReconstructError {
    /// Returns the advice on this error.
    pub fn advice(&self) -> Advice {
        match self {
            Self::Matching(error) => error.advice(),
            Self::TwoView(error) => two_view_advice(error),
            Self::Cancelled(_) => Advice::RunAgain,
        }
    }
}

/// Returns the advice on an error of two-view reconstruction.
fn two_view_advice(error: &TwoViewError) -> Advice {
    match error {
        TwoViewError::Camera { .. } | TwoViewError::CameraSize { .. } => Advice::CheckCamera,
        TwoViewError::TooFewMatches { .. } | TwoViewError::TooFewInliers { .. } => Advice::ShareMore,
        TwoViewError::PureRotation { .. } => Advice::StepAside,
        TwoViewError::PlanarOrPureRotation { .. } => Advice::StepAsideOrGiveFocal,
        TwoViewError::Planar { .. } => Advice::LeaveThePlane,
        TwoViewError::UncertainPose { .. } => Advice::MoreDepthOrFeatures,
        TwoViewError::LittleParallax { .. } => Advice::FartherApart,
        TwoViewError::WrongFocal { better, .. } => Advice::FocalBetter { px: *better },
        TwoViewError::ImplausibleFocal { .. } => Advice::LeaveOutFocal,
        TwoViewError::Estimate(_) | TwoViewError::MatchOutOfRange { .. } => Advice::CheckMatches,
        TwoViewError::Cancelled(_) => Advice::RunAgain,
    }
}

impl MatchingError {
    /// Returns the advice on this error.
    pub fn advice(&self) -> Advice {
        match self {
            Self::Cancelled(_) => Advice::RunAgain,
            Self::NoModel { .. } => Advice::SameScene,
            Self::Features { .. } | Self::NoFeatures { .. } => Advice::SharperPhotographs,
            // Features of different kinds, from elsewhere.
            Self::Match(_) => Advice::SameFeatures,
        }
    }
}

impl DenseError {
    /// Returns the advice on this error.
    pub fn advice(&self) -> Advice {
        match self {
            Self::Rectify(RectifyError::TooFarTurned { .. }) => Advice::StepAsideNotAhead,
            Self::Rectify(_) => Advice::ShareMore,
            Self::Stereo(StereoError::Memory { needed, .. }) => Advice::MoreMemory { needed: *needed },
            Self::Stereo(_) => Advice::ReduceLess,
            Self::LittleConfirmed { .. } => Advice::NearerAndStill,
            Self::Option(_) => Advice::CheckOptions,
            Self::Cancelled(_) => Advice::RunAgain,
        }
    }
}

impl DepthError {
    /// Returns the advice on this error.
    pub fn advice(&self) -> Advice {
        match self {
            Self::NoPair { cause, .. } => cause.advice(),
            Self::NoRange(error) => error.advice(),
            Self::NoDepth { found: Some((near, far)), .. } => Advice::KeepDepths { near: *near, far: *far },
            Self::NoDepth { found: None, .. } => Advice::CheckOffset,
            Self::Stereo(StereoError::TooSmall { .. }) => Advice::LargerPhotographs,
            Self::Stereo(StereoError::Memory { needed, .. }) => Advice::MoreMemory { needed: *needed },
            Self::Rectify(_) => Advice::CheckCamera,
            Self::Stereo(_) | Self::Geometry(_) | Self::Range { .. } => Advice::CheckOptions,
            Self::Cancelled(_) => Advice::RunAgain,
        }
    }
}

impl NoPairCause {
    /// Returns the advice on this error.
    pub fn advice(&self) -> Advice {
        match self {
            Self::Unrelated { .. } => Advice::SameScene,
            Self::VerticalDisparity { .. } => Advice::Rectify,
            Self::Exchanged { range: (low, _) } => Advice::Exchange { min_disparity: *low },
            Self::Range { range: (low, high) } => {
                Advice::TryDisparities { min: *low, count: (i64::from(*high) - i64::from(*low) + 1).max(1) as usize }
            }
            Self::Unknown => Advice::LargerWindow,
        }
    }
}

impl RangeError {
    /// Returns the advice on this error.
    pub fn advice(&self) -> Advice {
        match self {
            Self::Cancelled(_) => Advice::RunAgain,
            Self::Exchanged { range: (low, _) } => Advice::Exchange { min_disparity: *low },
            Self::Matching(_) | Self::TooFew { .. } => Advice::GiveDisparities,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advice_carries_the_numbers() {
        let error = ReconstructError::from(TwoViewError::WrongFocal {
            given: 35.0,
            better: 960.0,
            deviations: 9.0,
            inliers: 80,
        });
        assert_eq!(error.advice(), Advice::FocalBetter { px: 960.0 });
        let cause = NoPairCause::Range { range: (-7, 56) };
        let error = DepthError::NoPair { matched: 0.1, needed: 0.18, cause };
        assert_eq!(error.advice(), Advice::TryDisparities { min: -7, count: 64 });
        let error = DenseError::from(StereoError::Memory { needed: 5000, allowed: 100 });
        assert_eq!(error.advice(), Advice::MoreMemory { needed: 5000 });
    }
}
