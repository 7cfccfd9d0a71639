//! Color conversion.

use crate::{Pixel, rows::for_rows};
use cv_core::{GrayF32, GrayU8, Image, ImageView, RgbF32, RgbU8, Sample, luma_f32, luma_u8};
use std::{f32::consts::TAU, sync::LazyLock};

/// Applies `f` to every pixel, rows in parallel.
fn convert<T: Sample, const C: usize, U: Sample, const D: usize>(
    view: ImageView<'_, T, C>,
    f: impl Fn([T; C]) -> [U; D] + Sync,
) -> Image<U, D> {
    let mut out = Image::new(view.width(), view.height(), [U::default(); D]);
    for_rows(&mut out, |y, row| {
        let (from, _) = view.row(y).as_chunks::<C>();
        let (to, _) = row.as_chunks_mut::<D>();
        for (to, from) in to.iter_mut().zip(from) {
            *to = f(*from);
        }
    });
    out
}

/// Converts RGB to gray by Rec. 601 luma ([`luma_u8`]), with the same results as OpenCV's `cvtColor`, `RGB2GRAY`.
pub fn rgb_to_gray(view: ImageView<'_, u8, 3>) -> GrayU8 {
    convert(view, |rgb| [luma_u8(rgb)])
}

/// Converts gray to RGB with three equal channels.
pub fn gray_to_rgb<T: Sample>(view: ImageView<'_, T, 1>) -> Image<T, 3> {
    convert(view, |[v]| [v; 3])
}

/// Converts 8-bit RGB to gray levels 0 to 1 by Rec. 601 luma ([`luma_f32`]), without rounding to 8 bits.
pub fn rgb_to_gray_f32(view: ImageView<'_, u8, 3>) -> GrayF32 {
    convert(view, |rgb| [luma_f32(rgb.map(f32::from)) * (1.0 / 255.0)])
}

/// Converts 8-bit gray levels to 0 to 1.
pub fn gray_to_f32(view: ImageView<'_, u8, 1>) -> GrayF32 {
    u8_to_f32(view)
}

/// Converts 8-bit RGB to 0 to 1; the values stay sRGB encoded.
pub fn rgb_to_f32(view: ImageView<'_, u8, 3>) -> RgbF32 {
    u8_to_f32(view)
}

/// Converts 8-bit samples to 0 to 1, for any number of channels.
pub fn u8_to_f32<const C: usize>(view: ImageView<'_, u8, C>) -> Image<f32, C> {
    convert(view, |p| p.map(|v| f32::from(v) * (1.0 / 255.0)))
}

/// Converts samples 0 to 1 to 8 bits, rounded to nearest; values outside saturate, NaN becomes 0.
pub fn f32_to_u8<const C: usize>(view: ImageView<'_, f32, C>) -> Image<u8, C> {
    convert(view, |p| p.map(|v| u8::from_f32(v * 255.0)))
}

/// Converts 8-bit RGB to hue in radians `[0, 2π)`, saturation and value 0 to 1 (Smith, SIGGRAPH 1978).
///
/// The undefined hue of gray pixels is 0, as is the saturation of black ones.
pub fn rgb_to_hsv(view: ImageView<'_, u8, 3>) -> Image<f32, 3> {
    convert(view, rgb_pixel_to_hsv)
}

/// Converts one pixel as [`rgb_to_hsv`].
#[inline]
pub fn rgb_pixel_to_hsv(rgb: [u8; 3]) -> [f32; 3] {
    let [r, g, b] = rgb.map(i32::from);
    let max = r.max(g).max(b);
    let min = r.min(g).min(b);
    let range = max - min;
    if range == 0 {
        return [0.0, 0.0, max as f32 / 255.0];
    }
    let (offset, difference) = if max == r {
        (if g < b { 6.0 } else { 0.0 }, g - b)
    } else if max == g {
        (2.0, b - r)
    } else {
        (4.0, r - g)
    };
    let hue = (offset + difference as f32 / range as f32) * (TAU / 6.0);
    [hue, range as f32 / max as f32, max as f32 / 255.0]
}

/// Converts hue in radians (modulo 2π), saturation and value 0 to 1, to 8-bit RGB.
pub fn hsv_to_rgb(view: ImageView<'_, f32, 3>) -> RgbU8 {
    convert(view, |[h, s, v]| {
        // f(n) = V − V S max(0, min(k, 4 − k, 1)), k = (n + H/60°) mod 6.
        [5.0, 3.0, 1.0].map(|n: f32| {
            let k = (n + h * (6.0 / TAU)).rem_euclid(6.0);
            u8::from_f32(255.0 * (v - v * s * k.min(4.0 - k).clamp(0.0, 1.0)))
        })
    })
}

/// Table of linear intensities, 0 to 1, of 8-bit sRGB values (IEC 61966-2-1).
static LINEAR_OF_SRGB: LazyLock<[f32; 256]> = LazyLock::new(|| {
    std::array::from_fn(|i| {
        let v = i as f64 / 255.0;
        (if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }) as f32
    })
});

/// Decodes an sRGB value, 0 to 1, to linear intensity (IEC 61966-2-1).
pub fn decode_srgb(v: f32) -> f32 {
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

/// Decodes 8-bit sRGB to linear intensity, 0 to 1 (IEC 61966-2-1).
pub fn srgb_to_linear<const C: usize>(view: ImageView<'_, u8, C>) -> Image<f32, C> {
    let table = &*LINEAR_OF_SRGB;
    convert(view, |p| p.map(|v| table[usize::from(v)]))
}

/// Encodes linear intensity as 8-bit sRGB (IEC 61966-2-1); values outside 0 to 1 saturate, NaN becomes 0.
pub fn linear_to_srgb<const C: usize>(view: ImageView<'_, f32, C>) -> Image<u8, C> {
    let encode = |v: f32| if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    convert(view, |p| p.map(|v| u8::from_f32(255.0 * encode(v))))
}

/// Computes the cube root of a number in about 1e-3 to 1 by two steps of Halley's method from a bit-level guess.
#[inline(always)]
fn cube_root(v: f32) -> f32 {
    let mut y = f32::from_bits(v.to_bits() / 3 + 0x2a51_4067);
    for _ in 0..2 {
        let y3 = y * y * y;
        y *= (y3 + 2.0 * v) / (2.0 * y3 + v);
    }
    y
}

/// Converts 8-bit sRGB to CIE 1976 L*a*b* with the D65 white point: L 0 to 100, a and b about −110 to 110.
pub fn rgb_to_lab(view: ImageView<'_, u8, 3>) -> Image<f32, 3> {
    let table = &*LINEAR_OF_SRGB;
    convert(view, |rgb| linear_rgb_to_lab(rgb.map(|v| table[usize::from(v)])))
}

/// Converts one pixel as [`rgb_to_lab`].
#[inline]
pub fn rgb_pixel_to_lab(rgb: [u8; 3]) -> [f32; 3] {
    linear_rgb_to_lab(rgb.map(|v| LINEAR_OF_SRGB[usize::from(v)]))
}

/// Converts linear RGB with sRGB primaries, 0 to 1, to L*a*b*, as [`rgb_to_lab`] after [`srgb_to_linear`]. Branchless, so that loops over
/// it vectorize.
#[inline(always)]
pub fn linear_rgb_to_lab([r, g, b]: [f32; 3]) -> [f32; 3] {
    // Linear sRGB to XYZ over the white point (0.950456, 1, 1.088754): each row sums to one, so that grays have a = b = 0.
    let x = 0.433_953 * r + 0.376_219 * g + 0.189_828 * b;
    let y = 0.212_671 * r + 0.715_160 * g + 0.072_169 * b;
    let z = 0.017_758 * r + 0.109_477 * g + 0.872_765 * b;
    let f = |t: f32| {
        let root = cube_root(t.max(0.008));
        if t > 0.008_856_452 { root } else { 7.787_037 * t + 16.0 / 116.0 }
    };
    let (fx, fy, fz) = (f(x), f(y), f(z));
    [116.0 * fy - 16.0, 500.0 * (fx - fy), 200.0 * (fy - fz)]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn one(rgb: [u8; 3]) -> RgbU8 {
        RgbU8::new(1, 1, rgb)
    }

    #[test]
    fn hues_of_the_primary_and_secondary_colors() {
        let corners = [[255, 0, 0], [255, 255, 0], [0, 255, 0], [0, 255, 255], [0, 0, 255], [255, 0, 255]];
        for (i, rgb) in corners.into_iter().enumerate() {
            let [h, s, v] = rgb_to_hsv(one(rgb).view()).at(0, 0);
            // One rounding of i·60° in f32.
            assert!((h - (i as f32) * TAU / 6.0).abs() < 1e-6 && s == 1.0 && v == 1.0);
        }
        assert_eq!(rgb_to_hsv(one([0; 3]).view()).at(0, 0), [0.0; 3]);
        assert_eq!(rgb_to_hsv(one([51; 3]).view()).at(0, 0), [0.0, 0.0, 0.2]);
    }

    #[test]
    fn lab_of_tabulated_colors() {
        // CIE formulas for sRGB, D65, from color calculators to two digits; matrices with four or six digits differ by 0.02.
        for (rgb, expected) in [
            ([255, 255, 255], [100.0, 0.0, 0.0]),
            ([0, 0, 0], [0.0, 0.0, 0.0]),
            ([255, 0, 0], [53.24, 80.09, 67.20]),
            ([0, 255, 0], [87.73, -86.18, 83.18]),
            ([0, 0, 255], [32.30, 79.19, -107.86]),
            ([128, 128, 128], [53.59, 0.0, 0.0]),
        ] {
            let got = rgb_to_lab(one(rgb).view()).at(0, 0);
            assert!(got.iter().zip(expected).all(|(a, b)| (a - b).abs() < 0.03), "{rgb:?}: {got:?}");
            assert_eq!(rgb_pixel_to_lab(rgb), got);
        }
    }

    #[test]
    fn the_cube_root_is_accurate_to_f32_rounding() {
        for i in 8..=1000 {
            let v = i as f32 / 1000.0;
            // Halley converges cubically: the second step reaches the rounding of f32.
            assert!((cube_root(v) - v.cbrt()).abs() < 3e-7);
        }
    }

    proptest! {
        #[test]
        fn conversions_round_trip(rgb in any::<[u8; 3]>()) {
            let image = one(rgb);
            prop_assert_eq!(f32_to_u8(rgb_to_f32(image.view()).view()), image.clone());
            prop_assert_eq!(hsv_to_rgb(rgb_to_hsv(image.view()).view()), image.clone());
            prop_assert_eq!(linear_to_srgb(srgb_to_linear(image.view()).view()), image.clone());
            // The 8-bit value is the exact one rounded: half a level, 1/510.
            let gray = rgb_to_gray(image.view()).at(0, 0)[0];
            prop_assert!((f32::from(gray) / 255.0 - rgb_to_gray_f32(image.view()).at(0, 0)[0]).abs() < 0.5 / 255.0 + 1e-4);
        }
    }

    #[test]
    fn non_finite_values_saturate_or_become_zero() {
        let image = RgbF32::new(1, 1, [f32::NAN, f32::INFINITY, -3.0]);
        assert_eq!(f32_to_u8(image.view()).at(0, 0), [0, 255, 0]);
        assert_eq!(linear_to_srgb(image.view()).at(0, 0), [0, 255, 0]);
        assert!(rgb_to_hsv(RgbU8::new(0, 4, [0; 3]).view()).is_empty());
    }
}
