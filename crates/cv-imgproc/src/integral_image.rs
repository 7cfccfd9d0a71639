//! Integral images and the box filter.

use crate::mirror::mirror_index;
use crate::rows::for_rows_with;
use cv_core::{Image, ImageView};

/// An integral image (summed-area table): sums over rectangles in constant time.
///
/// Sums are `f64`: exact for 24-bit values in images up to 2²⁹ pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct IntegralImage<const C: usize> {
    sums: Image<f64, C>,
}

impl<const C: usize> IntegralImage<C> {
    /// Computes the integral image.
    pub fn new(view: ImageView<'_, f32, C>) -> Self {
        let (w, h) = view.size();
        let mut sums = Image::new(w + 1, h + 1, [0.0; C]);
        let stride = (w + 1) * C;
        for y in 0..h {
            let (above, row) = sums.as_mut_slice()[y * stride..(y + 2) * stride].split_at_mut(stride);
            let mut along = [0.0f64; C];
            for (x, pixel) in view.row(y).chunks_exact(C).enumerate() {
                for c in 0..C {
                    along[c] += f64::from(pixel[c]);
                    row[(x + 1) * C + c] = above[(x + 1) * C + c] + along[c];
                }
            }
        }
        Self { sums }
    }

    /// Returns the sum over the columns `x0..x1` and rows `y0..y1`, clipped to the image.
    #[inline]
    pub fn sum(&self, x0: usize, y0: usize, x1: usize, y1: usize) -> [f64; C] {
        let (w, h) = (self.sums.width() - 1, self.sums.height() - 1);
        let (x1, y1) = (x1.min(w), y1.min(h));
        let (x0, y0) = (x0.min(x1), y0.min(y1));
        let (a, b, c, d) = (self.sums.at(x0, y0), self.sums.at(x1, y0), self.sums.at(x0, y1), self.sums.at(x1, y1));
        std::array::from_fn(|i| d[i] - b[i] - c[i] + a[i])
    }
}

/// Computes the mean over windows of `2 rx + 1` by `2 ry + 1` pixels, border mode reflect-101 (OpenCV's `blur`).
///
/// O(pixels), independent of the window size. Uses running sums, so that a NaN spreads beyond the windows that contain it.
pub fn box_filter<const C: usize>(view: ImageView<'_, f32, C>, rx: usize, ry: usize) -> Image<f32, C> {
    let (w, h) = view.size();
    let mut out = Image::new(w, h, [0.0; C]);
    if view.is_empty() {
        return out;
    }
    let norm = 1.0 / ((2 * rx + 1) as f64 * (2 * ry + 1) as f64);
    // Column sums of the previous row of the band, updated by the entering and the leaving row.
    let buffers = || (Vec::<f64>::new(), 0usize);
    for_rows_with(&mut out, buffers, |(columns, last), y, row| {
        let source = |d: isize| view.row(mirror_index(y as isize + d, h));
        let ry = ry as isize;
        if columns.len() == w * C && *last + 1 == y {
            let (enters, leaves) = (source(ry), source(-ry - 1));
            for (sum, (a, b)) in columns.iter_mut().zip(enters.iter().zip(leaves)) {
                *sum += f64::from(*a) - f64::from(*b);
            }
        } else {
            columns.clear();
            columns.resize(w * C, 0.0);
            for d in -ry..=ry {
                columns.iter_mut().zip(source(d)).for_each(|(sum, v)| *sum += f64::from(*v));
            }
        }
        *last = y;
        let at = |x: isize, c: usize| columns[mirror_index(x, w) * C + c];
        let r = rx as isize;
        for c in 0..C {
            let mut sum: f64 = (-r..=r).map(|x| at(x, c)).sum();
            for x in 0..w {
                row[x * C + c] = (sum * norm) as f32;
                sum += at(x as isize + r + 1, c) - at(x as isize - r, c);
            }
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn sums_and_means_equal_direct_summation(w in 1usize..30, h in 1usize..60, rx in 0usize..40, ry in 0usize..9, p in proptest::array::uniform4(0usize..40)) {
            let image = Image::<f32, 2>::from_fn(w, h, |x, y| [((x * 31 + y * 17) % 23) as f32, (x + y) as f32]);
            let integral = IntegralImage::new(image.view());
            let smooth = box_filter(image.view(), rx, ry);
            let sum = |x0: usize, y0: usize, x1: usize, y1: usize, c: usize| -> f64 {
                (y0..y1.min(h)).flat_map(|y| (x0..x1.min(w)).map(move |x| (x, y))).map(|(x, y)| f64::from(image.at(x, y)[c])).sum()
            };
            for c in 0..2 {
                prop_assert_eq!(integral.sum(p[0], p[1], p[2], p[3])[c], sum(p[0], p[1], p[2], p[3], c));
            }
            let (rx, ry) = (rx as isize, ry as isize);
            let (x, y) = (p[0] % w, p[1] % h);
            let mut mean = 0.0;
            for j in -ry..=ry {
                for i in -rx..=rx {
                    mean += f64::from(image.at(mirror_index(x as isize + i, w), mirror_index(y as isize + j, h))[0]);
                }
            }
            mean /= ((2 * rx + 1) * (2 * ry + 1)) as f64;
            // The f64 sums are exact for these integers; one rounding to f32 of values below 23.
            prop_assert!((f64::from(smooth.at(x, y)[0]) - mean).abs() < 2e-6);
        }
    }

    #[test]
    fn empty_images_sum_to_zero() {
        let empty = Image::<f32, 1>::new(0, 0, [0.0]);
        assert_eq!(IntegralImage::new(empty.view()).sum(0, 0, 9, 9), [0.0]);
        assert!(box_filter(empty.view(), 3, 3).is_empty());
    }
}
