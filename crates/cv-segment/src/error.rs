//! What can go wrong.

use crate::MixtureError;
use cv_core::Cancelled;
use cv_core::OptionError;

/// Why a model could not be trained, loaded, or scored.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum SegmentError {
    /// There is nothing to train on.
    #[error("there are no photos with masks to train on")]
    NoPhotos,
    /// A mask does not fit its photo.
    #[error("photo {index} has {}×{} pixels, its mask {}×{}", photo.0, photo.1, mask.0, mask.1)]
    SizeMismatch {
        /// Which, from 0.
        index: usize,
        /// Width and height of the photo.
        photo: (usize, usize),
        /// Width and height of the mask.
        mask: (usize, usize),
    },
    /// No mask marks any pixel.
    #[error("none of the {photos} masks marks a pixel: the object's pixels must be white")]
    NoForeground {
        /// How many there are.
        photos: usize,
    },
    /// The masks mark every pixel.
    #[error("the {photos} masks mark every pixel: there is no background to tell the object from")]
    NoBackground {
        /// How many there are.
        photos: usize,
    },
    /// An option is out of its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// A mixture could not be fitted, or a loaded one is not one.
    #[error(transparent)]
    Mixture(MixtureError),
    /// A model was written by another version.
    #[error("the model has {}; this program reads schema {known}: train it again", found.map_or("no schema".to_owned(), |s| format!("schema {s}")))]
    Schema {
        /// What it says.
        found: Option<u64>,
        /// What is read here.
        known: u32,
    },
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

impl From<MixtureError> for SegmentError {
    fn from(error: MixtureError) -> Self {
        match error {
            MixtureError::Cancelled(stop) => Self::Cancelled(stop),
            other => Self::Mixture(other),
        }
    }
}
