//! The error of stereo matching.

use cv_core::{Cancelled, OptionError};

/// Why no disparities could be computed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum StereoError {
    /// The two images differ in size.
    #[error("left image is {}×{} px, right image {}×{} px: both must have the same size", left.0, left.1, right.0, right.1)]
    SizeMismatch {
        /// Width and height of the left image.
        left: (usize, usize),
        /// Width and height of the right image.
        right: (usize, usize),
    },
    /// The images are too small for the census window.
    #[error("images of {width}×{height} px are smaller than the {window_width}×{window_height} matching window")]
    TooSmall {
        /// Image width in pixels.
        width: usize,
        /// Image height in pixels.
        height: usize,
        /// Width of the window.
        window_width: usize,
        /// Height of the window.
        window_height: usize,
    },
    /// The number of disparities is 0, or above the maximum.
    #[error("{disparities} disparities were requested; 1 to {max} are possible")]
    Range {
        /// Requested number of disparities.
        disparities: usize,
        /// Maximum number of disparities.
        max: usize,
    },
    /// Every disparity puts every correspondence outside the right image.
    #[error(
        "disparities {min} to {max} px put every match outside images that are {width} px wide: the range must overlap −{width} to {width}"
    )]
    RangeOutsideImage {
        /// Smallest disparity.
        min: i64,
        /// Largest disparity.
        max: i64,
        /// Image width in pixels.
        width: usize,
    },
    /// A penalty or threshold is out of its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// A float image has NaN or infinite values.
    #[error("{count} samples of the {side} image are NaN or infinite")]
    NotFinite {
        /// `left` or `right`.
        side: &'static str,
        /// Number of such samples.
        count: usize,
    },
    /// Matching needs more memory than allowed.
    #[error("matching needs {:.1} MiB and {:.1} MiB are allowed", mib(*.needed), mib(*.allowed))]
    Memory {
        /// Bytes needed with the lowest strips.
        needed: usize,
        /// Bytes allowed by `max_memory`.
        allowed: usize,
    },
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

/// Converts bytes to MiB.
fn mib(bytes: usize) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}
