//! Why a picture could not be made.

use cv_core::CameraError;

/// Why a picture could not be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum SynthError {
    /// The camera's parameters make no sense.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// The picture has no pixels, or more than `u32` can count.
    #[error("cannot render a picture of {width}×{height} pixels")]
    Size {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// A pose has an entry that is NaN or infinite.
    #[error("the pose is not finite")]
    Pose,
    /// A rectified pair needs a camera without distortion and a positive baseline.
    #[error("a rectified pair needs a pinhole and a positive baseline, not {baseline} m")]
    Stereo {
        /// The baseline in meters.
        baseline: f64,
    },
}
