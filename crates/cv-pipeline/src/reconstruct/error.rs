//! Why two photographs could not be reconstructed.

use crate::MatchingError;
use cv_core::Cancelled;
use cv_geometry::TwoViewError;

/// Why two photographs could not be reconstructed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum ReconstructError {
    /// The photographs could not be matched.
    #[error(transparent)]
    Matching(MatchingError),
    /// The matches determine no motion or no points.
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
