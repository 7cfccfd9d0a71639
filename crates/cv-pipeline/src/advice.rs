//! What can be done about a job that failed.

use crate::{DenseError, DepthError, MatchingError, NoPairCause, RangeError, ReconstructError};
use cv_geometry::TwoViewError;
use cv_stereo::{RectifyError, StereoError};

/// What a person can do about a job that failed, with the numbers to do it by. A program words it and names its own options.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Advice {
    /// Sharper photographs, with more texture.
    SharperPhotographs,
    /// Photographs that share more of the scene, from places nearer to each other.
    ShareMore,
    /// Two photographs of the same things, with texture on them.
    SameScene,
    /// Photographs nearer to each other, of things with texture that stand still.
    NearerAndStill,
    /// Larger photographs.
    LargerPhotographs,
    /// Stepping aside between the photographs; those from one place make a panorama.
    StepAside,
    /// Stepping aside, and things in front of the plane or behind it; a known focal length tells a plane from a turn.
    StepAsideOrGiveFocal,
    /// Stepping aside rather than ahead.
    StepAsideNotAhead,
    /// Things in front of the plane or behind it.
    LeaveThePlane,
    /// Features of one kind for both photographs.
    SameFeatures,
    /// Photographs taken farther apart.
    FartherApart,
    /// Things near and far all over the photographs, or more features.
    MoreDepthOrFeatures,
    /// The focal length, in pixels of the photograph, is rather this.
    FocalBetter {
        /// In pixels.
        px: f64,
    },
    /// The focal length is to be left out, or given in pixels.
    LeaveOutFocal,
    /// The camera is not that of the photographs.
    CheckCamera,
    /// The matches are to be looked at.
    CheckMatches,
    /// The pair is to be rectified.
    Rectify,
    /// Left and right are to be exchanged; if they are in order, smaller disparities are to be tried.
    Exchange {
        /// Smallest disparity that features show, in px.
        min_disparity: i32,
    },
    /// Other disparities are to be tried.
    TryDisparities {
        /// Smallest that features show, in px.
        min: i32,
        /// How many.
        count: usize,
    },
    /// Other depths are to be kept.
    KeepDepths {
        /// The nearest there is, in the unit of the baseline.
        near: f32,
        /// The farthest there is.
        far: f32,
    },
    /// The principal points are not those of the photographs.
    CheckOffset,
    /// The number of disparities is to be given, or the pair to be rectified.
    GiveDisparities,
    /// A larger matching window, or more light.
    LargerWindow,
    /// More memory, or less to match.
    MoreMemory {
        /// Bytes needed at the least.
        needed: usize,
    },
    /// Photographs reduced less before matching.
    ReduceLess,
    /// An option is out of its range.
    CheckOptions,
    /// It was stopped.
    RunAgain,
}

impl ReconstructError {
    /// What a person can do about it.
    pub fn advice(&self) -> Advice {
        match self {
            Self::Matching(error) => error.advice(),
            Self::TwoView(error) => two_view(error),
            Self::Cancelled(_) => Advice::RunAgain,
        }
    }
}

fn two_view(error: &TwoViewError) -> Advice {
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
    /// What a person can do about it.
    pub fn advice(&self) -> Advice {
        match self {
            Self::Cancelled(_) => Advice::RunAgain,
            Self::NoModel { .. } => Advice::SameScene,
            Self::Features { .. } | Self::NoFeatures { .. } => Advice::SharperPhotographs,
            // Features of two kinds, from elsewhere.
            Self::Match(_) => Advice::SameFeatures,
        }
    }
}

impl DenseError {
    /// What a person can do about it.
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
    /// What a person can do about it.
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
    /// What a person can do about it.
    pub fn advice(&self) -> Advice {
        match self {
            Self::Unrelated { .. } => Advice::SameScene,
            Self::Rows { .. } => Advice::Rectify,
            Self::Exchanged { range: (low, _) } => Advice::Exchange { min_disparity: *low },
            Self::Range { range: (low, high) } => {
                Advice::TryDisparities { min: *low, count: (i64::from(*high) - i64::from(*low) + 1).max(1) as usize }
            }
            Self::Unknown => Advice::LargerWindow,
        }
    }
}

impl RangeError {
    /// What a person can do about it.
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
