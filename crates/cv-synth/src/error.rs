//! Why an image could not be rendered.

use cv_core::CameraError;

/// Why an image could not be rendered.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum SynthError {
    /// The camera is not valid.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// The image has no pixels, or more than `u32` can count.
    #[error("cannot render an image of {width}×{height} pixels")]
    Size {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// The pose is not finite.
    #[error("the pose is not finite")]
    Pose,
    /// A rectified pair needs a camera without distortion and a positive baseline.
    #[error("a rectified pair needs a pinhole and a positive baseline, not {baseline} m")]
    Stereo {
        /// The baseline in meters.
        baseline: f64,
    },
}
