//! Disparity maps and the state of their pixels.

use cv_core::{GrayF32, Image, Sample};

/// How a pixel came by its disparity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum PixelState {
    /// Matched, and accepted by every check.
    #[default]
    Matched,
    /// Occluded: visible in the left image only, behind something nearer in the right one. Filled from the background.
    Occluded,
    /// The match failed a check, or smoothing moved a depth discontinuity across the pixel. Filled from the surrounding surfaces.
    Mismatched,
    /// Out of view: the correspondence would be outside the right image, or in its black border. Filled from the surrounding surfaces.
    OutOfView,
    /// The left image has no data: the black border of a rectified image. Never filled.
    NoData,
}

impl Sample for PixelState {}

/// Disparities of a left image.
#[derive(Debug, Clone, PartialEq)]
pub struct DisparityMap {
    /// `x_left − x_right` in px, NaN where unknown.
    pub disparity: GrayF32,
    /// Where each disparity comes from; all but [`PixelState::Matched`] are filled, or NaN without filling, and NaN for
    /// [`PixelState::NoData`].
    pub state: Image<PixelState, 1>,
}

impl DisparityMap {
    /// An empty map, to be passed to [`crate::StereoMatcher::compute_into`].
    pub fn empty() -> Self {
        Self { disparity: GrayF32::new(0, 0, [0.0]), state: Image::new(0, 0, [PixelState::Matched]) }
    }

    /// Resizes the map, with unspecified contents, in its memory if that suffices.
    pub(crate) fn resize(&mut self, width: usize, height: usize) {
        if self.disparity.size() != (width, height) {
            resize(&mut self.disparity, (width, height), f32::NAN);
            resize(&mut self.state, (width, height), PixelState::Matched);
        }
    }

    /// Fraction of the pixels with data that have a disparity, filled ones included.
    pub fn valid_fraction(&self) -> f64 {
        let count = self.disparity.as_slice().iter().filter(|v| v.is_finite()).count();
        count as f64 / self.data_pixels().max(1) as f64
    }

    /// Fraction of the pixels with data that were matched and accepted by every check.
    pub fn matched_fraction(&self) -> f64 {
        self.count(PixelState::Matched) as f64 / self.data_pixels().max(1) as f64
    }

    /// Fraction of all pixels that have no data ([`PixelState::NoData`]).
    pub fn no_data_fraction(&self) -> f64 {
        self.count(PixelState::NoData) as f64 / self.state.as_slice().len().max(1) as f64
    }

    fn data_pixels(&self) -> usize {
        self.state.as_slice().len() - self.count(PixelState::NoData)
    }

    fn count(&self, state: PixelState) -> usize {
        self.state.as_slice().iter().filter(|&&v| v == state).count()
    }
}

/// Resizes an image in its memory if that suffices.
fn resize<T: Sample>(image: &mut Image<T, 1>, (width, height): (usize, usize), fill: T) {
    let mut values = std::mem::replace(image, Image::new(0, 0, [fill])).into_vec();
    values.clear();
    values.resize(width * height, fill);
    *image = Image::from_vec(width, height, values).unwrap_or_else(|_| Image::new(width, height, [fill]));
}
