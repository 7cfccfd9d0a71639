//! Why an estimate could not be made.

use cv_core::OptionError;

use cv_core::Cancelled;

/// A configuration of points that does not determine a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum Degeneracy {
    /// Too few different points.
    Coincident,
    /// The points lie on a line (or all but one do).
    Collinear,
    /// The points lie on a plane of the scene, or the camera only turned: a homography explains them all.
    Planar,
}

impl std::fmt::Display for Degeneracy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Coincident => "too few different points",
            Self::Collinear => "the points lie on a line",
            Self::Planar => "one homography explains all the points (a plane, or a camera that only turned)",
        })
    }
}

/// Why an estimate could not be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum EstimateError {
    /// There are fewer matches than the model has need of.
    #[error("{got} matches are too few: {needed} are needed")]
    NotEnoughMatches {
        /// Number of matches given.
        got: usize,
        /// Number needed.
        needed: usize,
    },
    /// A coordinate is NaN, infinite or beyond 1e12.
    #[error("match {index} has a coordinate that is not a number of any use")]
    NotFinite {
        /// Which match.
        index: usize,
    },
    /// The input determines no model.
    #[error("{kind}")]
    Degenerate {
        /// In which way.
        kind: Degeneracy,
    },
    /// The number of false alarms of the best model is not below a hundredth: as many matches would fit some model if all were wrong.
    #[error(
        "after {iterations} samples the best model fits {inliers} of {matches} matches, as some model would if all were wrong; at least {needed} are needed"
    )]
    NoConsensus {
        /// Matches that fit the best model.
        inliers: usize,
        /// Matches given.
        matches: usize,
        /// Matches that must fit: fewer would fit some model if all were wrong. More than there are where the threshold is so large that any do.
        needed: usize,
        /// Samples drawn.
        iterations: usize,
    },
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}
