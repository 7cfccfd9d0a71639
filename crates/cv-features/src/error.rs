//! Errors of detectors and descriptors.

use crate::simd;
use cv_core::{Cancelled, ImageView, OptionError};
use cv_parallel::prelude::*;

/// Why features could not be computed.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum FeatureError {
    /// The image is smaller than the smallest window of the method.
    #[error("a {width}×{height} image is smaller than the {needed}×{needed} pixels this method needs")]
    ImageTooSmall {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
        /// Minimum side in pixels.
        needed: usize,
    },
    /// A pixel is NaN or infinite.
    #[error("the pixel at column {x}, row {y} is not a finite number")]
    NotFinite {
        /// Column of the first such pixel.
        x: usize,
        /// Its row.
        y: usize,
    },
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

/// Rejects images with a side below `needed` or with a pixel that is not finite.
pub(crate) fn check_image(view: ImageView<'_, f32, 1>, needed: usize) -> Result<(), FeatureError> {
    let (width, height) = view.size();
    if width < needed || height < needed {
        return Err(FeatureError::ImageTooSmall { width, height, needed });
    }
    let level = simd::level();
    let rows = (0..height).into_par_iter().with_min_len(64);
    rows.try_for_each(|y| {
        if simd::all_finite(level, view.row(y)) {
            return Ok(());
        }
        let x = view.row(y).iter().position(|v| !v.is_finite());
        x.map_or(Ok(()), |x| Err(FeatureError::NotFinite { x, y }))
    })
}
