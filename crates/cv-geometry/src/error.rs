//! Errors of the estimators.

use cv_core::OptionError;

use cv_core::Cancelled;

/// A degenerate configuration of points, which does not determine a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum Degeneracy {
    /// Too few distinct points.
    Coincident,
    /// The points are collinear (all, or all but one).
    Collinear,
    /// The scene points are coplanar, or the motion is a pure rotation: one homography fits all matches.
    Planar,
}

impl std::fmt::Display for Degeneracy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Coincident => "too few distinct points",
            Self::Collinear => "the points lie on a line",
            Self::Planar => "one homography fits all points (a plane, or a camera that only turned)",
        })
    }
}

/// Why an estimate could not be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum EstimateError {
    /// There are fewer matches than the model needs.
    #[error("{got} matches are too few: {needed} are needed")]
    NotEnoughMatches {
        /// Number of matches.
        got: usize,
        /// Minimum number of matches.
        needed: usize,
    },
    /// A coordinate is NaN, infinite or beyond 1e12.
    #[error("match {index} has a coordinate that is NaN, infinite or beyond 1e12")]
    NotFinite {
        /// Index of the match.
        index: usize,
    },
    /// The points are in a degenerate configuration.
    #[error("{kind}")]
    Degenerate {
        /// The kind of degeneracy.
        kind: Degeneracy,
    },
    /// The number of false alarms of the best model is not below 0.01: as many matches would be inliers of some model
    /// by chance.
    #[error(
        "after {iterations} samples the best model has {inliers} inliers of {matches} matches, no more than expected by chance; at least {needed} are needed"
    )]
    NoConsensus {
        /// Number of inliers of the best model.
        inliers: usize,
        /// Number of matches.
        matches: usize,
        /// Minimum number of inliers that is significant. Larger than the number of matches if the threshold is so
        /// large that no number is.
        needed: usize,
        /// Number of minimal samples drawn.
        iterations: usize,
    },
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}
