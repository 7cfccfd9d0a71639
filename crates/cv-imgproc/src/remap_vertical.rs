//! Resampling along the columns of an image.

use crate::Pixel;
use crate::rows::for_rows_with;
use crate::sample::keys_weights;
use crate::simd;
use cv_core::{Image, ImageError, ImageView};
use fearless_simd::{Simd, dispatch};

/// Offsets in px are clamped to this, farther than any border: sums with rows do not overflow.
const MAX_OFFSET: f32 = 1e12;

/// Resamples an image along its columns by cubic convolution (Keys 1981, a = −1/2): the result at `(x, y)` is the source at
/// `(x, y + a + b x + c x²)` with `[a, b, c] = offset(y)` in px. Rows outside the image are those of its border. A NaN offset is none.
///
/// For small offsets that change slowly along a row, as between the images of a stereo pair: rows are processed in runs of one source row.
///
/// ```
/// use cv_core::GrayU8;
/// use cv_imgproc::remap_vertical;
///
/// let image = GrayU8::from_fn(16, 12, |_, y| [10 * y as u8]);
/// let half_a_row_up = remap_vertical(image.view(), |_| [0.5, 0.0, 0.0])?;
/// assert_eq!(half_a_row_up.at(3, 5), [55]);
/// # Ok::<(), cv_core::ImageError>(())
/// ```
///
/// # Errors
/// [`ImageError`] where memory for the result cannot be allocated.
pub fn remap_vertical<T: Pixel, const C: usize>(
    image: ImageView<'_, T, C>,
    offset: impl Fn(usize) -> [f32; 3] + Sync,
) -> Result<Image<T, C>, ImageError> {
    let (width, height) = image.size();
    let mut out = Image::try_new(width, height, [T::default(); C])?;
    for_rows_with(&mut out, Positions::default, |positions, y, out| {
        positions.set(y, (width, height), C, offset(y));
        for &(row, pixels) in &positions.runs {
            let samples = pixels[0] * C..pixels[1] * C;
            let rows = [0, 1, 2, 3].map(|i| &image.row((row + i).saturating_sub(1).min(height - 1))[samples.clone()]);
            T::interpolate_rows(rows, &positions.fractions[samples.clone()], &mut out[samples]);
        }
    });
    Ok(out)
}

/// The source positions of a row.
#[derive(Default)]
struct Positions {
    /// Of each sample, the distance in px below its source row.
    fractions: Vec<f32>,
    /// Source rows, each with its first pixel and the one after its last.
    runs: Vec<(usize, [usize; 2])>,
}

impl Positions {
    /// Sets the positions of row `y` of an image of this size and number of channels. Not generic, so that it is compiled with the
    /// optimizations of this crate.
    fn set(&mut self, y: usize, (width, height): (usize, usize), channels: usize, [a, b, c]: [f32; 3]) {
        self.fractions.resize(width * channels, 0.0);
        self.runs.clear();
        let last = height - 1;
        for x in 0..width {
            let at = x as f32;
            let offset = a + at * (b + at * c);
            let offset = if offset.is_nan() { 0.0 } else { offset.clamp(-MAX_OFFSET, MAX_OFFSET) };
            let whole = offset.floor();
            let row = y as i64 + whole as i64;
            let (row, fraction) = match usize::try_from(row) {
                Ok(row) if row < last => (row, offset - whole),
                Ok(_) => (last, 0.0),
                Err(_) => (0, 0.0),
            };
            self.fractions[x * channels..(x + 1) * channels].fill(fraction);
            match self.runs.last_mut() {
                Some((of_run, pixels)) if *of_run == row => pixels[1] = x + 1,
                _ => self.runs.push((row, [x, x + 1])),
            }
        }
    }
}

/// Interpolates between rows 1 and 2 of four adjacent ones, at the fraction of each sample.
pub(crate) fn interpolate_rows<T: Pixel>(rows: [&[T]; 4], fractions: &[f32], out: &mut [T]) {
    dispatch!(simd::level(), simd => simd_interpolate_rows(simd, rows, fractions, out));
}

#[inline(always)]
fn simd_interpolate_rows<S: Simd, T: Pixel>(_: S, rows: [&[T]; 4], fractions: &[f32], out: &mut [T]) {
    let n = out.len();
    let (rows, fractions) = (rows.map(|row| &row[..n]), &fractions[..n]);
    for i in 0..n {
        let weights = keys_weights(fractions[i]);
        out[i] = T::from_f32(
            weights[0] * rows[0][i].to_f32()
                + weights[1] * rows[1][i].to_f32()
                + weights[2] * rows[2][i].to_f32()
                + weights[3] * rows[3][i].to_f32(),
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sample_bicubic;
    use cv_core::GrayF32;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn equals_bicubic_samples(
            coefficients in prop::array::uniform3(-1.0f32..1.0),
            (width, height) in (1usize..40, 1usize..30),
            seed in any::<u32>(),
        ) {
            // Up to half of the height, so that some positions are outside.
            let [a, b, c] = coefficients;
            let offset = |y: usize| [a * 0.5 * height as f32 + 0.1 * y as f32, 0.3 * b, 0.01 * c];
            let value = |i: usize| ((i as u32).wrapping_mul(2_654_435_761) ^ seed) >> 16;
            let gray = Image::<u16, 1>::from_fn(width, height, |x, y| [value(y * 64 + x) as u16]);
            let color = Image::<u8, 3>::from_fn(width, height, |x, y| [0, 1, 2].map(|k| value((y * 64 + x) * 3 + k) as u8));
            let float = GrayF32::from_fn(width, height, |x, y| [f32::from(gray.at(x, y)[0])]);
            let moved_gray = remap_vertical(gray.view(), offset).unwrap();
            let moved_color = remap_vertical(color.view(), offset).unwrap();
            let moved = remap_vertical(float.view(), offset).unwrap();
            for y in 0..height {
                let [a, b, c] = offset(y).map(f64::from);
                for x in 0..width {
                    let at = x as f64;
                    let row = (y as f64 + a + b * at + c * at * at).clamp(0.0, (height - 1) as f64);
                    let expected = sample_bicubic(float.view(), at, row).unwrap()[0];
                    // Positions are rounded to f32: 2⁻²⁰ px of a range of 2¹⁶ levels.
                    prop_assert!((moved.at(x, y)[0] - expected).abs() < 0.5, "{x} {y}");
                    prop_assert!((f32::from(moved_gray.at(x, y)[0]) - expected.clamp(0.0, 65535.0)).abs() <= 1.0);
                    let expected = sample_bicubic(color.view(), at, row).unwrap();
                    for (moved, expected) in moved_color.at(x, y).into_iter().zip(expected) {
                        prop_assert!((f32::from(moved) - expected.clamp(0.0, 255.0)).abs() <= 0.51);
                    }
                }
            }
        }
    }

    #[test]
    fn borders_are_repeated_and_nan_is_no_offset() {
        let image = GrayF32::from_fn(4, 3, |x, y| [(10 * x + y) as f32]);
        let moved = |offset: f32| remap_vertical(image.view(), |_| [offset, 0.0, 0.0]).unwrap();
        assert_eq!(moved(f32::NAN), image);
        assert_eq!(moved(0.0), image);
        for (offset, row) in [(f32::INFINITY, 2), (1e30, 2), (2.5, 2), (-1e30, 0), (f32::NEG_INFINITY, 0)] {
            assert_eq!(moved(offset), GrayF32::from_fn(4, 3, |x, _| image.at(x, row)), "{offset}");
        }
        assert!(remap_vertical(GrayF32::new(0, 3, [0.0]).view(), |_| [1.0; 3]).unwrap().is_empty());
    }
}
