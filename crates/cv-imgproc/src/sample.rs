//! Bilinear and bicubic interpolation: the only implementation in the workspace.

use crate::Pixel;
use cv_core::ImageView;

/// Tolerance in pixels for points outside the outermost pixel centers, which are clamped to them: the rounding of an `f32` map of
/// a few thousand pixels.
const BORDER_TOLERANCE_PX: f64 = 1e-3;

/// Splits a coordinate on a line of `n > 0` samples into base index and fraction; `None` outside `[0, n − 1]` (or NaN).
#[inline(always)]
pub(crate) fn split_coordinate(v: f64, n: usize) -> Option<(usize, f32)> {
    let last = (n - 1) as f64;
    if !(v >= -BORDER_TOLERANCE_PX && v <= last + BORDER_TOLERANCE_PX) {
        return None;
    }
    let v = v.clamp(0.0, last);
    // The base index is at most n − 2, so that base + 1 exists.
    let base = (v as usize).min(n.saturating_sub(2));
    Some((base, (v - base as f64) as f32))
}

/// Splits a number of 0 to 2²² into an integer and a fraction of 0 to 1 (an odd integer may give itself less one, and 1). For vectorized loops: avoids the
/// saturating conversion, since at 1.5 · 2²³ the last bits of a float are its integer part.
#[inline(always)]
pub fn integer_and_fraction(v: f32) -> (i32, f32) {
    const SHIFT: f32 = 12_582_912.0;
    let shifted = (v - 0.5) + SHIFT;
    ((shifted.to_bits() & 0x3f_ffff) as i32, v - (shifted - SHIFT))
}

/// Interpolates the value at `(x, y)` bilinearly, in the unit of the image.
///
/// `None` outside the rectangle of the outermost pixel centers, `[0, w − 1] × [0, h − 1]` (tolerance 0.001 px).
#[inline]
pub fn sample_bilinear<T: Pixel, const C: usize>(view: ImageView<'_, T, C>, x: f64, y: f64) -> Option<[f32; C]> {
    interpolate_with(view, x, y, bilinear_at)
}

/// Calls `at` with the base pixel of `(x, y)` and the fractions; `None` outside.
#[inline(always)]
fn interpolate_with<T: Pixel, const C: usize>(
    view: ImageView<'_, T, C>,
    x: f64,
    y: f64,
    at: impl Fn(ImageView<'_, T, C>, usize, usize, f32, f32) -> [f32; C],
) -> Option<[f32; C]> {
    if view.is_empty() {
        return None;
    }
    let (ix, fx) = split_coordinate(x, view.width())?;
    let (iy, fy) = split_coordinate(y, view.height())?;
    Some(at(view, ix, iy, fx, fy))
}

/// Interpolates bilinearly from the base pixel `(ix, iy)`, which must be in the image, by the fractions `fx`, `fy` in 0 to 1; see
/// [`sample_bilinear`]. For loops that compute base pixels and fractions themselves.
#[inline(always)]
pub fn bilinear_at<T: Pixel, const C: usize>(
    view: ImageView<'_, T, C>,
    ix: usize,
    iy: usize,
    fx: f32,
    fy: f32,
) -> [f32; C] {
    let above = view.row(iy);
    let below = view.row((iy + 1).min(view.height() - 1));
    let right = (ix + 1).min(view.width() - 1) * C;
    let left = ix * C;
    let (a, b) = (&above[left..left + C], &above[right..right + C]);
    let (c, d) = (&below[left..left + C], &below[right..right + C]);
    // A loop, since a closure would not be inlined into code compiled for the instruction set.
    let mut value = [0.0; C];
    for (i, value) in value.iter_mut().enumerate() {
        let top = a[i].to_f32() + fx * (b[i].to_f32() - a[i].to_f32());
        let bottom = c[i].to_f32() + fx * (d[i].to_f32() - c[i].to_f32());
        *value = top + fy * (bottom - top);
    }
    value
}

/// Interpolates the value at `(x, y)` by cubic convolution with Keys's kernel, `a = −½` (Keys 1981: exact for quadratics), in the unit of the
/// image.
///
/// `None` outside `[0, w − 1] × [0, h − 1]`, as in [`sample_bilinear`]; the border mode within the kernel's support is replicate. May
/// overshoot at edges.
#[inline]
pub fn sample_bicubic<T: Pixel, const C: usize>(view: ImageView<'_, T, C>, x: f64, y: f64) -> Option<[f32; C]> {
    interpolate_with(view, x, y, bicubic_at)
}

/// Coefficients of the polynomials of the four weights of Keys's kernel, from the cubic term to the constant.
pub(crate) const KEYS: [[f32; 4]; 4] =
    [[-0.5, 1.5, -1.5, 0.5], [1.0, -2.5, 2.0, -0.5], [-0.5, 0.0, 0.5, 0.0], [0.0, 1.0, 0.0, 0.0]];

/// Computes the four weights of Keys's kernel for a fraction in 0 to 1.
#[inline(always)]
pub(crate) fn keys_weights(t: f32) -> [f32; 4] {
    let mut weights = KEYS[0];
    for coefficients in &KEYS[1..] {
        for (weight, c) in weights.iter_mut().zip(coefficients) {
            *weight = *weight * t + c;
        }
    }
    weights
}

/// Interpolates bicubically from the base pixel `(ix, iy)`, which must be in the image, by the fractions `fx`, `fy` in 0 to 1; see
/// [`sample_bicubic`]. For loops that compute base pixels and fractions themselves. Vertical first, so that rows of samples vectorize.
#[inline(always)]
pub fn bicubic_at<T: Pixel, const C: usize>(
    view: ImageView<'_, T, C>,
    ix: usize,
    iy: usize,
    fx: f32,
    fy: f32,
) -> [f32; C] {
    let (w, h) = view.size();
    let (wx, wy) = (keys_weights(fx), keys_weights(fy));
    let mut sums = [[0f32; C]; 4];
    for (j, wy) in wy.into_iter().enumerate() {
        let row = view.row((iy + j).saturating_sub(1).min(h - 1));
        if ix >= 1 && ix + 2 < w {
            for (sum, v) in sums.as_flattened_mut().iter_mut().zip(&row[(ix - 1) * C..(ix + 3) * C]) {
                *sum += wy * v.to_f32();
            }
        } else {
            for (i, sum) in sums.iter_mut().enumerate() {
                let x = (ix + i).saturating_sub(1).min(w - 1) * C;
                for (sum, v) in sum.iter_mut().zip(&row[x..x + C]) {
                    *sum += wy * v.to_f32();
                }
            }
        }
    }
    // A loop, since a closure would not be inlined into code compiled for the instruction set.
    let mut value = [0.0; C];
    for (c, value) in value.iter_mut().enumerate() {
        *value = wx[0] * sums[0][c] + wx[1] * sums[1][c] + wx[2] * sums[2][c] + wx[3] * sums[3][c];
    }
    value
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{GrayF32, GrayU8, Image};
    use proptest::prelude::*;

    #[test]
    fn a_number_is_its_integer_and_its_fraction() {
        for k in 0..=8184 {
            let v = k as f32 / 8.0;
            let (i, fraction) = integer_and_fraction(v);
            assert!((0.0..=1.0).contains(&fraction) && i as f32 + fraction == v, "{v}: {i} {fraction}");
        }
    }

    proptest! {
        #[test]
        fn a_plane_is_reproduced(x in 0.0f64..8.0, y in 0.0f64..5.0) {
            let image = Image::<f32, 2>::from_fn(9, 6, |x, y| [3.0 * x as f32 - 2.0 * y as f32 + 1.0, (x * y) as f32]);
            let expected = 3.0 * x - 2.0 * y + 1.0;
            let got = sample_bilinear(image.view(), x, y).unwrap();
            // Values up to 40: a few roundings of 2e-6.
            prop_assert!((f64::from(got[0]) - expected).abs() < 1e-5 && (f64::from(got[1]) - x * y).abs() < 1e-5);
            // Away from the border, where samples are replicated, cubic convolution reproduces planes and products too.
            if (1.0..7.0).contains(&x) && (1.0..4.0).contains(&y) {
                let got = sample_bicubic(image.view(), x, y).unwrap();
                prop_assert!((f64::from(got[0]) - expected).abs() < 2e-5 && (f64::from(got[1]) - x * y).abs() < 2e-5);
            }
        }

        #[test]
        fn bicubic_reproduces_parabolas(x in 1.0f64..7.0) {
            let image = GrayF32::from_fn(9, 3, |x, _| [(x * x) as f32]);
            prop_assert!((f64::from(sample_bicubic(image.view(), x, 1.0).unwrap()[0]) - x * x).abs() < 3e-5);
        }
    }

    #[test]
    fn pixel_centers_are_exact_and_the_outside_is_none() {
        let image = GrayU8::from_fn(4, 3, |x, y| [(10 * x + y) as u8]);
        for y in 0..3 {
            for x in 0..4 {
                let expected = Some([(10 * x + y) as f32]);
                assert_eq!(sample_bilinear(image.view(), x as f64, y as f64), expected);
                assert_eq!(sample_bicubic(image.view(), x as f64, y as f64), expected);
            }
        }
        for (x, y) in [(-0.01, 0.0), (3.01, 0.0), (0.0, 2.01), (f64::NAN, 0.0), (0.0, f64::INFINITY), (1e300, 0.0)] {
            assert_eq!(sample_bilinear(image.view(), x, y), None);
            assert_eq!(sample_bicubic(image.view(), x, y), None);
        }
    }

    #[test]
    fn a_single_pixel_has_one_value() {
        let image = GrayU8::new(1, 1, [7]);
        assert_eq!(sample_bilinear(image.view(), 0.0, 0.0), Some([7.0]));
        assert_eq!(sample_bicubic(image.view(), 0.0, 0.0), Some([7.0]));
        assert_eq!(sample_bilinear(GrayU8::new(0, 0, [0]).view(), 0.0, 0.0), None);
    }
}
