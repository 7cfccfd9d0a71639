//! Borrowed, strided views of images.

use crate::size::size_accessors;
use crate::{Image, Sample};

/// A borrowed view of an image: rows of `width × C` samples, `stride` samples apart.
#[derive(Debug, Clone, Copy)]
pub struct ImageView<'a, T, const C: usize> {
    data: &'a [T],
    width: usize,
    height: usize,
    stride: usize,
}

impl<'a, T: Sample, const C: usize> ImageView<'a, T, C> {
    pub(crate) fn from_parts(data: &'a [T], width: usize, height: usize, stride: usize) -> Self {
        Self { data, width, height, stride }
    }

    /// Makes a view of a buffer whose rows are `stride` samples apart.
    ///
    /// `None` where the buffer is too short for the last row, or `stride < width × C`.
    pub fn from_slice(data: &'a [T], width: usize, height: usize, stride: usize) -> Option<Self> {
        let row = width.checked_mul(C)?;
        let needed = match height {
            0 => 0,
            _ => (height - 1).checked_mul(stride)?.checked_add(row)?,
        };
        (stride >= row && data.len() >= needed).then_some(Self { data, width, height, stride })
    }

    size_accessors!();

    /// Returns this view as one of `D` channels, or `None` unless `D` is `C`: generic code can thus call code for a fixed number of channels.
    #[inline]
    pub fn with_channels<const D: usize>(self) -> Option<ImageView<'a, T, D>> {
        let Self { data, width, height, stride } = self;
        (C == D).then_some(ImageView { data, width, height, stride })
    }

    /// Returns the samples of row `y`.
    ///
    /// # Panics
    /// Where `y` is not below the height.
    #[inline]
    pub fn row(&self, y: usize) -> &'a [T] {
        assert!(y < self.height, "row {y} of {}", self.height);
        &self.data[y * self.stride..y * self.stride + self.width * C]
    }

    /// Returns the samples from the first of the first row to at least the last of the last row, and the stride. For loops that compute positions themselves.
    #[inline]
    pub fn strided_samples(&self) -> (&'a [T], usize) {
        (self.data, self.stride)
    }

    /// Returns the pixel at column `x`, row `y`.
    ///
    /// # Panics
    /// Outside the view.
    #[inline]
    pub fn at(&self, x: usize, y: usize) -> [T; C] {
        let row = self.row(y);
        std::array::from_fn(|c| row[x * C + c])
    }

    /// Returns the pixel at column `x`, row `y`, or `None` outside.
    #[inline]
    pub fn get(&self, x: usize, y: usize) -> Option<[T; C]> {
        (x < self.width && y < self.height).then(|| self.at(x, y))
    }

    /// Returns the sub-view with top-left corner `(x, y)`, or `None` where it does not fit.
    pub fn crop(&self, x: usize, y: usize, width: usize, height: usize) -> Option<Self> {
        if x.checked_add(width)? > self.width || y.checked_add(height)? > self.height {
            return None;
        }
        let start = (y * self.stride + x * C).min(self.data.len());
        Some(Self { data: &self.data[start..], width, height, stride: self.stride })
    }

    /// Copies the view to a dense image.
    pub fn to_image(&self) -> Image<T, C> {
        let mut image = Image::new(self.width, self.height, [T::default(); C]);
        for y in 0..self.height {
            image.row_mut(y).copy_from_slice(self.row(y));
        }
        image
    }
}

/// A mutable view of an image: rows of `width × C` samples, `stride` samples apart.
#[derive(Debug)]
pub struct ImageViewMut<'a, T, const C: usize> {
    data: &'a mut [T],
    width: usize,
    height: usize,
    stride: usize,
}

impl<'a, T: Sample, const C: usize> ImageViewMut<'a, T, C> {
    pub(crate) fn from_parts(data: &'a mut [T], width: usize, height: usize, stride: usize) -> Self {
        Self { data, width, height, stride }
    }

    size_accessors!();

    /// Returns the samples of row `y`, mutable.
    ///
    /// # Panics
    /// Where `y` is not below the height.
    #[inline]
    pub fn row_mut(&mut self, y: usize) -> &mut [T] {
        assert!(y < self.height, "row {y} of {}", self.height);
        &mut self.data[y * self.stride..y * self.stride + self.width * C]
    }

    /// Iterates over all rows from top to bottom, mutable.
    pub fn rows_mut(&mut self) -> impl Iterator<Item = &mut [T]> {
        let row = self.width * C;
        self.data.chunks_mut(self.stride.max(1)).take(self.height).map(move |r| &mut r[..row])
    }

    /// Returns the sub-view with top-left corner `(x, y)`, or `None` where it does not fit.
    pub fn crop(self, x: usize, y: usize, width: usize, height: usize) -> Option<Self> {
        if x.checked_add(width)? > self.width || y.checked_add(height)? > self.height {
            return None;
        }
        let start = (y * self.stride + x * C).min(self.data.len());
        Some(Self { data: &mut self.data[start..], width, height, stride: self.stride })
    }

    /// Reborrows as a read-only view.
    pub fn as_view(&self) -> ImageView<'_, T, C> {
        ImageView::from_parts(self.data, self.width, self.height, self.stride)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_crop_shows_the_same_pixels(w in 1usize..9, h in 1usize..9, x in 0usize..9, y in 0usize..9, cw in 0usize..9, ch in 0usize..9) {
            let image = Image::<u16, 2>::from_fn(w, h, |x, y| [x as u16, y as u16]);
            match image.view().crop(x, y, cw, ch) {
                None => prop_assert!(x + cw > w || y + ch > h),
                Some(view) => {
                    prop_assert!(x + cw <= w && y + ch <= h);
                    for j in 0..ch {
                        for i in 0..cw {
                            prop_assert_eq!(view.at(i, j), [(x + i) as u16, (y + j) as u16]);
                        }
                    }
                    prop_assert_eq!(view.to_image().size(), (cw, ch));
                }
            }
        }
    }

    #[test]
    fn only_the_own_number_of_channels_is_accepted() {
        let image = Image::<u8, 3>::from_fn(4, 2, |x, y| [x as u8, y as u8, 7]);
        let crop = image.view().crop(1, 0, 2, 2).unwrap();
        assert_eq!(crop.with_channels::<3>().unwrap().to_image(), crop.to_image());
        assert!(crop.with_channels::<1>().is_none());
    }

    #[test]
    fn writing_through_a_crop_leaves_other_pixels_unchanged() {
        let mut image = Image::<u8, 1>::new(4, 3, [0]);
        let mut window = image.view_mut().crop(1, 1, 2, 2).unwrap();
        for row in window.rows_mut() {
            row.fill(7);
        }
        assert_eq!(image.as_slice(), [0, 0, 0, 0, 0, 7, 7, 0, 0, 7, 7, 0]);
    }

    #[test]
    fn slices_that_are_too_short_are_refused() {
        assert!(ImageView::<u8, 1>::from_slice(&[0; 7], 3, 2, 5).is_none());
        assert!(ImageView::<u8, 1>::from_slice(&[0; 8], 3, 2, 5).is_some());
        assert!(ImageView::<u8, 1>::from_slice(&[0; 8], 3, 2, 2).is_none());
    }
}
