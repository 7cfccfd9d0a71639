//! The trait of dense stereo matchers: the one of this crate, and those of others.

use crate::{DisparityMap, Intensity, StereoError, StereoMatcher};
use cv_core::{GrayF32, ImageView, Progress};

/// Computes the disparities of rectified pairs of images with `C` channels of `T`.
///
/// `tests/own_matcher.rs` of this crate has a small implementation.
pub trait DisparityMatcher<T: Intensity, const C: usize> {
    /// Computes the disparities of `left`, into a map of any size (its memory may be reused). The images are rectified: a scene point
    /// has the same y in both.
    ///
    /// # Errors
    /// [`StereoError`] if the images differ in size, or are not supported by the matcher.
    fn compute_into(
        &mut self,
        left: ImageView<'_, T, C>,
        right: ImageView<'_, T, C>,
        map: &mut DisparityMap,
        progress: &dyn Progress,
    ) -> Result<(), StereoError>;

    /// Returns the smallest disparity of the search range, in px, and the number of disparities.
    fn disparities(&self) -> (i32, usize);

    /// Returns the confidence of each disparity of the last pair, 0 to 1, 0 for filled pixels. `None`, the default, if unknown.
    fn confidence(&self, map: &DisparityMap) -> Option<GrayF32> {
        let _ = map;
        None
    }

    /// Returns the standard deviation in px of each disparity of the last pair, NaN where unknown: by default everywhere.
    fn uncertainty(&self, map: &DisparityMap) -> GrayF32 {
        let (width, height) = map.disparity.size();
        GrayF32::new(width, height, [f32::NAN])
    }
}

impl<T: Intensity, const C: usize> DisparityMatcher<T, C> for StereoMatcher {
    fn compute_into(
        &mut self,
        left: ImageView<'_, T, C>,
        right: ImageView<'_, T, C>,
        map: &mut DisparityMap,
        progress: &dyn Progress,
    ) -> Result<(), StereoError> {
        Self::compute_into(self, left, right, map, progress)
    }

    fn disparities(&self) -> (i32, usize) {
        (self.options().min_disparity, self.options().disparities)
    }

    fn confidence(&self, map: &DisparityMap) -> Option<GrayF32> {
        Self::confidence(self, map)
    }

    fn uncertainty(&self, map: &DisparityMap) -> GrayF32 {
        Self::uncertainty(self, map)
    }
}
