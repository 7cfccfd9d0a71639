//! Image resizing.

use crate::{Interpolation, Pixel, RemapOptions, WarpError, rows::for_rows_with, warp_with};
use cv_core::{Image, ImageError, ImageView, Point2, Scaling};

/// Resamples to `width × height` with image edges aligned: pixel center `x` is sampled at `(x + ½) w / width − ½` (as OpenCV's `resize`).
///
/// No anti-aliasing: to shrink an image use [`resize_area`].
///
/// # Errors
/// [`ImageError::TooLarge`]. An empty source gives zeros.
pub fn resize<T: Pixel, const C: usize>(
    view: ImageView<'_, T, C>,
    width: usize,
    height: usize,
    interpolation: Interpolation,
) -> Result<Image<T, C>, ImageError> {
    let to_source = Scaling::between((width.max(1), height.max(1)), view.size());
    let last = |n: usize| n.saturating_sub(1) as f64;
    let (last_x, last_y) = (last(view.width()), last(view.height()));
    let options = RemapOptions { interpolation, ..Default::default() };
    let result = warp_with(view, (width, height), &options, |x, y| {
        let source = to_source.point(Point2::new(x as f64, y as f64));
        Some(Point2::new(source.x.clamp(0.0, last_x), source.y.clamp(0.0, last_y)))
    });
    match result {
        Ok((image, _)) => Ok(image),
        Err(WarpError::Size(error)) => Err(error),
        // Other errors need a homography or a camera.
        Err(_) => Err(ImageError::TooLarge { width, height, channels: C }),
    }
}

/// Computes the area weights for resampling a line of `from` samples to `to`: per result the first source sample, and the weights of it and its
/// successors, which sum to one.
fn area_weights(from: usize, to: usize) -> Vec<(usize, Vec<f32>)> {
    let scale = from as f64 / to as f64;
    (0..to)
        .map(|i| {
            let (start, end) = (i as f64 * scale, (i as f64 + 1.0) * scale);
            let first = (start as usize).min(from - 1);
            let last = ((end.ceil() as usize).max(first + 1)).min(from);
            let weight = |k: usize| (end.min(k as f64 + 1.0) - start.max(k as f64)).max(0.0);
            let sum: f64 = (first..last).map(weight).sum();
            (first, (first..last).map(|k| (weight(k) / sum) as f32).collect())
        })
        .collect()
}

/// Resamples to `width × height` by the area-weighted mean of the source under each result pixel (OpenCV's `INTER_AREA` when shrinking).
///
/// For shrinking; when enlarging it repeats pixels.
///
/// # Errors
/// [`ImageError::TooLarge`]. An empty source gives zeros.
pub fn resize_area<T: Pixel, const C: usize>(
    view: ImageView<'_, T, C>,
    width: usize,
    height: usize,
) -> Result<Image<T, C>, ImageError> {
    let mut out = Image::try_new(width, height, [T::default(); C])?;
    if view.is_empty() || out.is_empty() {
        return Ok(out);
    }
    let columns = area_weights(view.width(), width);
    let lines = area_weights(view.height(), height);
    for_rows_with(
        &mut out,
        || vec![0.0f32; view.width() * C],
        |sums, y, row| {
            let (first, weights) = &lines[y];
            sums.fill(0.0);
            for (j, &weight) in weights.iter().enumerate() {
                for (sum, v) in sums.iter_mut().zip(view.row(first + j)) {
                    *sum += weight * v.to_f32();
                }
            }
            for (out, (first, weights)) in row.chunks_exact_mut(C).zip(&columns) {
                let mut pixel = [0.0f32; C];
                for (weight, v) in weights.iter().zip(sums[first * C..].chunks_exact(C)) {
                    for (p, v) in pixel.iter_mut().zip(v) {
                        *p += weight * v;
                    }
                }
                for (out, p) in out.iter_mut().zip(pixel) {
                    *out = T::from_f32(p);
                }
            }
        },
    );
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{GrayF32, GrayU8};
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn area_resizing_preserves_the_mean(w in 1usize..30, h in 1usize..20, a in 1usize..30, b in 1usize..20) {
            let image = GrayF32::from_fn(w, h, |x, y| [((x * 31 + y * 17) % 23) as f32 / 23.0]);
            let mean = |i: &GrayF32| i.as_slice().iter().sum::<f32>() / i.as_slice().len() as f32;
            let small = resize_area(image.view(), a, b).unwrap();
            // Sums of up to 600 values below 1 in f32.
            prop_assert!((mean(&small) - mean(&image)).abs() < 3e-5);
        }

        #[test]
        fn resizing_preserves_a_ramp(w in 2usize..40, to in 1usize..60) {
            let image = GrayF32::from_fn(w, 2, |x, _| [x as f32]);
            let out = resize(image.view(), to, 3, Interpolation::Bilinear).unwrap();
            for x in 0..to {
                let expected = ((x as f32 + 0.5) * w as f32 / to as f32 - 0.5).clamp(0.0, w as f32 - 1.0);
                // Values up to 40 in f32.
                prop_assert!((out.at(x, 1)[0] - expected).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn integer_factors_give_block_means() {
        let image = GrayU8::from_fn(6, 4, |x, y| [(x + 10 * y) as u8]);
        let small = resize_area(image.view(), 3, 2).unwrap();
        // Mean of x, x + 1, x + 10, x + 11 is x + 5.5, rounded up.
        assert_eq!(small.as_slice(), [6, 8, 10, 26, 28, 30]);
    }

    #[test]
    fn empty_and_huge_sizes() {
        let empty = GrayU8::new(0, 0, [0]);
        assert_eq!(resize_area(empty.view(), 2, 2).unwrap().as_slice(), [0; 4]);
        assert_eq!(resize(empty.view(), 2, 2, Interpolation::Nearest).unwrap().as_slice(), [0; 4]);
        let one = GrayU8::new(1, 1, [9]);
        assert!(resize(one.view(), 0, 0, Interpolation::Bicubic).unwrap().is_empty());
        assert_eq!(resize(one.view(), 3, 1, Interpolation::Bicubic).unwrap().as_slice(), [9; 3]);
        assert_eq!(resize_area(one.view(), 3, 1).unwrap().as_slice(), [9; 3]);
        assert!(resize(one.view(), usize::MAX, 9, Interpolation::Nearest).is_err());
        assert!(resize_area(one.view(), usize::MAX, 9).is_err());
    }
}
