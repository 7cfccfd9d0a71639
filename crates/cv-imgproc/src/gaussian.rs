//! Separable filters: Gaussian blur and Sobel derivatives.

use crate::mirror::{mirror_ends, mirror_index};
use crate::rows::for_rows_with;
use crate::simd;
use cv_core::{GrayF32, Image, ImageView};

/// Blurs with a Gaussian of `sigma` pixels; border mode reflect-101 ([`mirror_index`]).
///
/// The kernel is the sampled Gaussian, truncated as in OpenCV's `GaussianBlur` for float images (at 4σ: an odd width of about `8σ + 1`)
/// and normalized to sum one. A `sigma` of zero or less (or NaN) returns a copy. A NaN pixel spreads over the kernel's
/// support. O(pixels · sigma).
pub fn gaussian_blur<const C: usize>(view: ImageView<'_, f32, C>, sigma: f32) -> Image<f32, C> {
    // The mirrored image is periodic, so that a few times its size all larger sigmas give its mean.
    let max_sigma = 4.0 * view.width().max(view.height()).max(1) as f32;
    if sigma > 0.0 && !view.is_empty() {
        separable_symmetric(view, &gaussian_half_kernel(sigma.min(max_sigma)))
    } else {
        view.to_image()
    }
}

/// Computes the half kernel of [`gaussian_blur`]: the sampled Gaussian from its center outwards, normalized so that the whole kernel sums to
/// one. A `sigma` that is not positive gives `[1]`.
pub fn gaussian_half_kernel(sigma: f32) -> Vec<f32> {
    if sigma.is_nan() || sigma <= 0.0 {
        return vec![1.0];
    }
    // OpenCV: ksize = round(8σ + 1) | 1.
    let radius = ((8.0 * sigma + 1.0).round_ties_even() as usize | 1) / 2;
    let weight = |i: usize| (-0.5 * (i as f64 / f64::from(sigma)).powi(2)).exp();
    let sum = weight(0) + 2.0 * (1..=radius).map(weight).sum::<f64>();
    (0..=radius).map(|i| (weight(i) / sum) as f32).collect()
}

/// Convolves rows and columns with the symmetric kernel given by its half, center `half[0]` first; border mode reflect-101.
///
/// An empty kernel returns a copy. Each output row is filtered vertically into a row buffer and then along it, so that no intermediate image
/// is stored.
pub fn separable_symmetric<const C: usize>(view: ImageView<'_, f32, C>, half: &[f32]) -> Image<f32, C> {
    let (w, h) = view.size();
    if half.is_empty() || view.is_empty() {
        return view.to_image();
    }
    let r = half.len() - 1;
    let mut out = Image::new(w, h, [0.0; C]);
    let level = simd::level();
    let buffers = || (vec![0.0f32; (w + 2 * r) * C], Vec::with_capacity(2 * r + 1));
    for_rows_with(&mut out, buffers, |(padded, sources), y, row| {
        sources.clear();
        sources.extend((0..=2 * r).map(|i| view.row(mirror_index((y + i) as isize - r as isize, h))));
        simd::filter_columns(level, &mut padded[r * C..(r + w) * C], sources, half);
        mirror_ends::<C>(padded, r, r);
        simd::filter_rows(level, row, padded, half, C);
    });
    out
}

/// Computes the Sobel derivatives by x and by y (3×3: smoothing `[1 2 1]`, derivative `[−1 0 1]`), not normalized, as OpenCV's `Sobel`: a
/// ramp of slope 1 gives 8. Border mode reflect-101.
pub fn sobel(view: ImageView<'_, f32, 1>) -> (GrayF32, GrayF32) {
    let (w, h) = view.size();
    let mut dx = GrayF32::new(w, h, [0.0]);
    let mut dy = GrayF32::new(w, h, [0.0]);
    if view.is_empty() {
        return (dx, dy);
    }
    let level = simd::level();
    crate::rows::for_rows2(&mut dx, &mut dy, |y, dx, dy| {
        let above = view.row(mirror_index(y as isize - 1, h));
        let below = view.row(mirror_index(y as isize + 1, h));
        simd::sobel(level, [above, view.row(y), below], dx, dy);
    });
    (dx, dy)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Reference implementation: direct 2D convolution in f64.
    fn reference(view: ImageView<'_, f32, 2>, half: &[f32]) -> Image<f32, 2> {
        let r = half.len() as isize - 1;
        let (w, h) = view.size();
        Image::from_fn(w, h, |x, y| {
            std::array::from_fn(|c| {
                let mut sum = 0.0;
                for j in -r..=r {
                    for i in -r..=r {
                        let v = view.at(mirror_index(x as isize + i, w), mirror_index(y as isize + j, h))[c];
                        sum += f64::from(half[i.unsigned_abs()]) * f64::from(half[j.unsigned_abs()]) * f64::from(v);
                    }
                }
                sum as f32
            })
        })
    }

    fn noise<const C: usize>(w: usize, h: usize, seed: u32) -> Image<f32, C> {
        let mut state = seed | 1;
        Image::from_fn(w, h, |_, _| {
            std::array::from_fn(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 8) as f32 / (1 << 24) as f32
            })
        })
    }

    proptest! {
        #[test]
        fn the_blur_equals_direct_convolution(w in 1usize..40, h in 1usize..12, sigma in 0.2f32..2.0, seed in any::<u32>()) {
            let image = noise::<2>(w, h, seed);
            let fast = gaussian_blur(image.view(), sigma);
            let slow = reference(image.view(), &gaussian_half_kernel(sigma));
            for (a, b) in fast.as_slice().iter().zip(slow.as_slice()) {
                // Sums of up to 2·17 terms of at most 1: 34 roundings of 6e-8.
                prop_assert!((a - b).abs() < 2e-6, "{} {}", a, b);
            }
        }

        #[test]
        fn sobel_equals_direct_convolution(w in 1usize..40, h in 1usize..8, seed in any::<u32>()) {
            let image = noise::<1>(w, h, seed);
            let (dx, dy) = sobel(image.view());
            for y in 0..h {
                for x in 0..w {
                    let at = |i: isize, j: isize| image.at(mirror_index(x as isize + i, w), mirror_index(y as isize + j, h))[0];
                    let gx = at(1, -1) - at(-1, -1) + 2.0 * (at(1, 0) - at(-1, 0)) + at(1, 1) - at(-1, 1);
                    let gy = at(-1, 1) - at(-1, -1) + 2.0 * (at(0, 1) - at(0, -1)) + at(1, 1) - at(1, -1);
                    // Six terms of at most 2 in another order.
                    prop_assert!((dx.at(x, y)[0] - gx).abs() < 2e-6 && (dy.at(x, y)[0] - gy).abs() < 2e-6);
                }
            }
        }
    }

    #[test]
    fn a_kernel_larger_than_the_image_averages_it() {
        let image = noise::<1>(3, 2, 5);
        let mean = image.as_slice().iter().sum::<f32>() / 6.0;
        let smooth = gaussian_blur(image.view(), 1e9);
        // Under reflect-101, inner samples count twice: 3×2 has the weights (1 2 1)/4 along x and (1 1)/2 along y.
        let weighted: f32 =
            (0..2).map(|y| [0.25, 0.5, 0.25].iter().zip(image.row(y)).map(|(k, v)| k * v).sum::<f32>() / 2.0).sum();
        assert!(smooth.as_slice().iter().all(|v| (v - weighted).abs() < 1e-4), "{smooth:?} {mean} {weighted}");
    }

    #[test]
    fn empty_images_and_invalid_sigmas_return_a_copy() {
        assert!(gaussian_blur(GrayF32::new(0, 3, [0.0]).view(), 1.0).is_empty());
        let image = noise::<1>(4, 4, 9);
        for sigma in [0.0, -1.0, f32::NAN] {
            assert_eq!(gaussian_blur(image.view(), sigma), image);
        }
        assert_eq!(gaussian_half_kernel(f32::NAN), [1.0]);
        let mut with_nan = noise::<1>(64, 64, 9);
        with_nan.set(2, 2, [f32::NAN]);
        let smooth = gaussian_blur(with_nan.view(), 1.0);
        assert!(smooth.at(2, 2)[0].is_nan() && smooth.at(2, 20)[0].is_finite());
    }
}
