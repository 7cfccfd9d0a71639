//! Disparities of the frames of a film, one pair after the other.

use crate::depth::check_pair;
use crate::{DepthError, Progress};
use cv_core::ImageView;
use cv_stereo::{DisparityMap, Intensity, StereoError, StereoMatcher, StereoOptions};

/// Matches frame after frame of rectified pairs with the same memory.
#[derive(Debug)]
pub struct FrameDepth {
    matcher: StereoMatcher,
    map: DisparityMap,
}

impl FrameDepth {
    /// A matcher for frames.
    ///
    /// # Errors
    /// [`StereoError`] where an option is out of range.
    pub fn new(options: StereoOptions) -> Result<Self, StereoError> {
        Ok(Self { matcher: StereoMatcher::new(options)?, map: DisparityMap::empty() })
    }

    /// Disparities of the next frame's left image. The map stays until the frame after it.
    ///
    /// # Errors
    /// [`DepthError`] as of [`depth()`](crate::depth()).
    pub fn next<T: Intensity, const C: usize>(
        &mut self,
        left: ImageView<'_, T, C>,
        right: ImageView<'_, T, C>,
        progress: &dyn Progress,
    ) -> Result<&DisparityMap, DepthError> {
        self.matcher.compute_into(left, right, &mut self.map, progress)?;
        let StereoOptions { min_disparity, disparities, .. } = *self.matcher.options();
        check_pair(&self.map, left, right, (min_disparity, disparities), progress)?;
        Ok(&self.map)
    }
}
