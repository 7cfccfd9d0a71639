//! Depth from the images of a calibrated rig, with rectification in their bit depth.

use crate::{DepthError, DepthOptions, DepthResult, FrameDepth, Progress};
use cv_core::{ImageView, PointCloud, RgbU8};
use cv_imgproc::Pixel;
use cv_stereo::{Intensity, Rectification};

/// Result of [`depth_by_rig`] and [`FrameDepth`].
#[derive(Debug, Clone, PartialEq)]
pub struct RigDepthResult {
    /// The images (for a rig rectified), left or upper and right, as 8-bit RGB.
    pub images: [RgbU8; 2],
    /// Disparity and depth of the left image. For a rig, the `stages` begin with `rectify`.
    pub maps: DepthResult,
    /// The colored points in the frame of the unrectified left camera, in the unit of the rig.
    pub cloud: PointCloud,
}

/// Rectifies the images of a rig and computes disparity and depth, as [`depth()`](crate::depth()) does. Images are
/// resampled and matched in their bit depth.
///
/// # Errors
/// [`DepthError`]: as [`depth()`](crate::depth()), and [`DepthError::Rectify`] if an image does not have its camera's
/// size.
pub fn depth_by_rig<T: Intensity + Pixel, const C: usize>(
    left: ImageView<'_, T, C>,
    right: ImageView<'_, T, C>,
    rectification: &Rectification,
    options: &DepthOptions,
    progress: &dyn Progress,
) -> Result<RigDepthResult, DepthError> {
    FrameDepth::of_rig(options.clone(), rectification)?.next_depth(left, right, true, progress)
}
