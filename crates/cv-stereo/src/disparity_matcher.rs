//! What finds disparities: our matcher, and those of other crates.

use crate::{DisparityMap, Intensity, StereoError, StereoMatcher};
use cv_core::{GrayF32, ImageView, Progress};

/// Finds the disparities of rectified pairs of images with `C` channels of `T`.
///
/// `tests/own_matcher.rs` of this crate holds a small one.
pub trait DisparityMatcher<T: Intensity, const C: usize> {
    /// Disparities of `left`, into a map of any size (its memory may be used again). The images are rectified: a scene point has the same y in both.
    ///
    /// # Errors
    /// [`StereoError`] where the images do not fit together, or the matcher cannot work on them.
    fn compute_into(
        &mut self,
        left: ImageView<'_, T, C>,
        right: ImageView<'_, T, C>,
        map: &mut DisparityMap,
        progress: &dyn Progress,
    ) -> Result<(), StereoError>;

    /// Smallest disparity that is tried, in px, and how many.
    fn disparities(&self) -> (i32, usize);

    /// How sure each disparity of the last pair is, 0 to 1, 0 where it was filled in. `None`, the default, where that is not known.
    fn confidence(&self, map: &DisparityMap) -> Option<GrayF32> {
        let _ = map;
        None
    }

    /// Standard deviation in px of each disparity of the last pair, NaN where that is not known: by default everywhere.
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
