//! Errors of training and prediction.

use crate::MixtureError;
use cv_core::Cancelled;
use cv_core::OptionError;

/// Why a model could not be trained, loaded, or scored.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum SegmentError {
    /// No training images were passed.
    #[error("there are no photos with masks to train on")]
    NoPhotos,
    /// The sizes of an image and its mask differ.
    #[error("photo {index} has {}×{} pixels, its mask {}×{}", photo.0, photo.1, mask.0, mask.1)]
    SizeMismatch {
        /// Index of the image, from 0.
        index: usize,
        /// Width and height of the image.
        photo: (usize, usize),
        /// Width and height of the mask.
        mask: (usize, usize),
    },
    /// No mask has a foreground pixel.
    #[error("none of the {photos} masks marks a pixel: the object's pixels must be white")]
    NoForeground {
        /// Number of masks.
        photos: usize,
    },
    /// The masks have no background pixel.
    #[error("the {photos} masks mark every pixel: there is no background to tell the object from")]
    NoBackground {
        /// Number of masks.
        photos: usize,
    },
    /// An option is out of its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// A mixture could not be fitted, or a loaded one is invalid.
    #[error(transparent)]
    Mixture(MixtureError),
    /// The model's schema is of another version.
    #[error("the model has {}; this program reads schema {known}: train it again", found.map_or("no schema".to_owned(), |s| format!("schema {s}")))]
    Schema {
        /// Schema of the model.
        found: Option<u64>,
        /// Schema that this version reads.
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
