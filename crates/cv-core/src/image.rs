//! Owned images.

use crate::size::size_accessors;
use crate::{ImageView, ImageViewMut};

/// A sample type: the type of one channel value of an image.
///
/// Implemented for the common numeric types; callers may implement it for their own.
pub trait Sample: Copy + Default + PartialEq + Send + Sync + 'static {}
impl Sample for bool {}
impl Sample for u8 {}
impl Sample for u16 {}
impl Sample for i16 {}
impl Sample for u32 {}
impl Sample for i32 {}
impl Sample for f32 {}
impl Sample for f64 {}

/// Why an image could not be made from a buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum ImageError {
    /// The buffer's length is not `width × height × channels`.
    #[error("a {width}×{height} image with {channels} channel(s) does not have {len} samples")]
    WrongLength {
        /// Samples in the buffer.
        len: usize,
        /// Requested width in pixels.
        width: usize,
        /// Requested height in pixels.
        height: usize,
        /// Channels per pixel.
        channels: usize,
    },
    /// `width × height × channels` is more than memory can address.
    #[error("a {width}×{height} image with {channels} channel(s) is larger than memory can address")]
    TooLarge {
        /// Requested width in pixels.
        width: usize,
        /// Requested height in pixels.
        height: usize,
        /// Channels per pixel.
        channels: usize,
    },
}

/// A dense image: `height` rows of `width` pixels of `C` interleaved channels of type `T`.
///
/// An image may be empty (`width` or `height` zero).
#[derive(Debug, Clone, PartialEq)]
pub struct Image<T, const C: usize> {
    data: Vec<T>,
    width: usize,
    height: usize,
}

/// One channel of bytes, 0 to 255.
pub type GrayU8 = Image<u8, 1>;
/// One channel of `f32`, by convention 0 to 1.
pub type GrayF32 = Image<f32, 1>;
/// RGB bytes, 0 to 255, as stored in files (sRGB encoded).
pub type RgbU8 = Image<u8, 3>;
/// RGB of `f32`, by convention 0 to 1.
pub type RgbF32 = Image<f32, 3>;
/// A binary mask: true for foreground pixels.
pub type Mask = Image<bool, 1>;

impl<T: Sample, const C: usize> Image<T, C> {
    /// Makes an image with every pixel equal to `fill`.
    ///
    /// # Panics
    /// Where `width × height × C` overflows `usize`. Use [`Image::try_new`] for sizes from outside the process.
    pub fn new(width: usize, height: usize, fill: [T; C]) -> Self {
        match Self::try_new(width, height, fill) {
            Ok(image) => image,
            #[allow(clippy::panic)] // a documented precondition
            Err(error) => panic!("{error}"),
        }
    }

    /// As [`Image::new`], for untrusted sizes.
    ///
    /// # Errors
    /// [`ImageError::TooLarge`] where the number of samples overflows `isize`.
    pub fn try_new(width: usize, height: usize, fill: [T; C]) -> Result<Self, ImageError> {
        let len = checked_sample_count::<T, C>(width, height)?;
        let data = match fill.first() {
            Some(&first) if fill.iter().all(|&v| v == first) => vec![first; len],
            _ => {
                let mut data = Vec::with_capacity(len);
                for _ in 0..width * height {
                    data.extend_from_slice(&fill);
                }
                data
            }
        };
        Ok(Self { data, width, height })
    }

    /// Makes an image whose pixel at column `x` and row `y` is `f(x, y)`.
    pub fn from_fn(width: usize, height: usize, mut f: impl FnMut(usize, usize) -> [T; C]) -> Self {
        let mut image = Self::new(width, height, [T::default(); C]);
        for y in 0..height {
            for (x, pixel) in image.row_mut(y).chunks_exact_mut(C).enumerate() {
                pixel.copy_from_slice(&f(x, y));
            }
        }
        image
    }

    /// Makes an image of a buffer of `width × height × C` samples, row-major and interleaved, without a copy.
    ///
    /// # Errors
    /// [`ImageError::WrongLength`] where the buffer has another length.
    pub fn from_vec(width: usize, height: usize, data: Vec<T>) -> Result<Self, ImageError> {
        if data.len() != checked_sample_count::<T, C>(width, height)? {
            return Err(ImageError::WrongLength { len: data.len(), width, height, channels: C });
        }
        Ok(Self { data, width, height })
    }

    size_accessors!();

    /// Returns all samples, row-major.
    #[inline]
    pub fn as_slice(&self) -> &[T] {
        &self.data
    }

    /// Returns all samples, row-major, mutable.
    #[inline]
    pub fn as_mut_slice(&mut self) -> &mut [T] {
        &mut self.data
    }

    /// Returns the buffer of samples.
    pub fn into_vec(self) -> Vec<T> {
        self.data
    }

    /// Iterates over all pixels, row-major.
    pub fn pixels(&self) -> impl ExactSizeIterator<Item = [T; C]> + '_ {
        let (pixels, _) = self.data.as_chunks::<C>();
        pixels.iter().copied()
    }

    /// Returns the samples of row `y`.
    ///
    /// # Panics
    /// Where `y` is not below the height.
    #[inline]
    pub fn row(&self, y: usize) -> &[T] {
        &self.data[y * self.width * C..(y + 1) * self.width * C]
    }

    /// Returns the samples of row `y`, mutable.
    ///
    /// # Panics
    /// Where `y` is not below the height.
    #[inline]
    pub fn row_mut(&mut self, y: usize) -> &mut [T] {
        &mut self.data[y * self.width * C..(y + 1) * self.width * C]
    }

    /// Returns the pixel at column `x`, row `y`.
    ///
    /// # Panics
    /// Outside the image.
    #[inline]
    pub fn at(&self, x: usize, y: usize) -> [T; C] {
        assert!(x < self.width, "column {x} of {}", self.width);
        let start = (y * self.width + x) * C;
        std::array::from_fn(|c| self.data[start + c])
    }

    /// Returns the pixel at column `x`, row `y`, or `None` outside.
    #[inline]
    pub fn get(&self, x: usize, y: usize) -> Option<[T; C]> {
        (x < self.width && y < self.height).then(|| self.at(x, y))
    }

    /// Overwrites the pixel at column `x`, row `y`.
    ///
    /// # Panics
    /// Outside the image.
    #[inline]
    pub fn set(&mut self, x: usize, y: usize, pixel: [T; C]) {
        assert!(x < self.width, "column {x} of {}", self.width);
        let start = (y * self.width + x) * C;
        self.data[start..start + C].copy_from_slice(&pixel);
    }

    /// Applies `f` to every pixel and returns the new image.
    pub fn map<U: Sample, const D: usize>(&self, mut f: impl FnMut([T; C]) -> [U; D]) -> Image<U, D> {
        let mut data = Vec::with_capacity(self.width * self.height * D);
        for pixel in self.pixels() {
            data.extend_from_slice(&f(pixel));
        }
        Image { data, width: self.width, height: self.height }
    }

    /// Returns a view of the whole image.
    #[inline]
    pub fn view(&self) -> ImageView<'_, T, C> {
        ImageView::from_parts(&self.data, self.width, self.height, self.width * C)
    }

    /// Returns a mutable view of the whole image.
    #[inline]
    pub fn view_mut(&mut self) -> ImageViewMut<'_, T, C> {
        ImageViewMut::from_parts(&mut self.data, self.width, self.height, self.width * C)
    }
}

impl<'a, T: Sample, const C: usize> From<&'a Image<T, C>> for ImageView<'a, T, C> {
    fn from(image: &'a Image<T, C>) -> Self {
        image.view()
    }
}

/// Computes the number of samples of an image, or an error where they cannot be allocated.
fn checked_sample_count<T, const C: usize>(width: usize, height: usize) -> Result<usize, ImageError> {
    width
        .checked_mul(height)
        .and_then(|n| n.checked_mul(C))
        .filter(|n| n.checked_mul(size_of::<T>().max(1)).is_some_and(|bytes| isize::try_from(bytes).is_ok()))
        .ok_or(ImageError::TooLarge { width, height, channels: C })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_buffer_of_the_wrong_length_is_refused_with_the_numbers() {
        let error = Image::<u8, 3>::from_vec(2, 2, vec![0; 11]).unwrap_err();
        assert_eq!(error, ImageError::WrongLength { len: 11, width: 2, height: 2, channels: 3 });
    }

    #[test]
    fn sizes_that_overflow_are_refused() {
        for (w, h) in [(usize::MAX, 2), (usize::MAX / 2, 1), (1 << 40, 1 << 40)] {
            assert!(matches!(Image::<f32, 3>::try_new(w, h, [0.0; 3]), Err(ImageError::TooLarge { .. })));
        }
    }

    #[test]
    fn a_fill_of_unequal_channels_sets_every_pixel() {
        let image = Image::<u8, 3>::new(3, 2, [1, 2, 3]);
        assert!(image.pixels().all(|p| p == [1, 2, 3]) && image.pixels().len() == 6);
    }

    #[test]
    fn empty_images_have_empty_rows() {
        let image = Image::<u8, 1>::new(0, 5, [0]);
        assert!(image.is_empty() && image.row(4).is_empty() && image.get(0, 0).is_none());
    }
}
