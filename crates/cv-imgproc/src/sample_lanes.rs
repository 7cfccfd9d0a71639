//! Interpolation of an 8-bit image at eight positions at once: a loop over the positions for each step, so that all but the loads are
//! vectorized. For code that is compiled for an instruction set ([`fearless_simd::dispatch`]); the results are the same for each.

use crate::sample::{KEYS, integer_and_fraction};
use cv_core::{GrayU8, ImageView};
use fearless_simd::{f32x4, f32x16, i32x16, prelude::*, u8x16};

/// Number of positions.
pub const SAMPLE_LANES: usize = 8;

/// Interpolates bilinearly at `(us[k], vs[k])` in pixels; positions are clamped to the outermost pixel centers. Equal to [`crate::bilinear_at`] within
/// the image. An image of fewer than two rows or columns is 0 everywhere.
#[inline(always)]
pub fn bilinear_lanes(image: &GrayU8, us: &[f32; SAMPLE_LANES], vs: &[f32; SAMPLE_LANES]) -> [f32; SAMPLE_LANES] {
    let ((width, height), samples) = (image.size(), image.as_slice());
    if width < 2 || height < 2 {
        return [0.0; SAMPLE_LANES];
    }
    let (xs, fx) = split(0, width - 1, us);
    let (ys, fy) = split(0, height - 1, vs);
    // Two pixels in the low bytes.
    let (mut above, mut below) = ([0_u32; SAMPLE_LANES], [0_u32; SAMPLE_LANES]);
    for k in 0..SAMPLE_LANES {
        let at = ys[k] as usize * width + xs[k] as usize;
        // One check of the length.
        if let Some(four) = samples.get(at..at + width + 2) {
            let pair = |i: usize| u16::from_le_bytes([four[i], four[i + 1]]).into();
            (above[k], below[k]) = (pair(0), pair(width));
        }
    }
    let mut values = [0.0; SAMPLE_LANES];
    for k in 0..SAMPLE_LANES {
        let (a, b, c, d) = (byte(above[k], 0), byte(above[k], 1), byte(below[k], 0), byte(below[k], 1));
        let (top, bottom) = (a + fx[k] * (b - a), c + fx[k] * (d - c));
        values[k] = top + fy[k] * (bottom - top);
    }
    values
}

/// Interpolates by cubic convolution at `(us[k], vs[k])` in pixels; positions are clamped to `[1, w − 2] × [1, h − 2]`, where the kernel's support is
/// in the image. Equal to [`crate::bicubic_at`] there. An image of fewer than four rows or columns is 0 everywhere.
#[inline(always)]
pub fn bicubic_lanes(image: &GrayU8, us: &[f32; SAMPLE_LANES], vs: &[f32; SAMPLE_LANES]) -> [f32; SAMPLE_LANES] {
    let ((width, height), samples) = (image.size(), image.as_slice());
    if width < 4 || height < 4 {
        return [0.0; SAMPLE_LANES];
    }
    let (xs, fx) = split(1, width - 2, us);
    let (ys, fy) = split(1, height - 2, vs);
    // Four pixels of each row.
    let mut rows = [[0_u32; SAMPLE_LANES]; 4];
    for k in 0..SAMPLE_LANES {
        let mut at = (ys[k] as usize - 1) * width + xs[k] as usize - 1;
        for row in &mut rows {
            row[k] = samples.get(at..).and_then(|s| s.first_chunk()).copied().map_or(0, u32::from_le_bytes);
            at += width;
        }
    }
    let (wx, wy) = (keys_lanes(&fx), keys_lanes(&fy));
    let mut sums = [[0.0_f32; SAMPLE_LANES]; 4];
    for (row, wy) in rows.iter().zip(&wy) {
        for (column, sums) in sums.iter_mut().enumerate() {
            for k in 0..SAMPLE_LANES {
                sums[k] += wy[k] * byte(row[k], column);
            }
        }
    }
    let mut values = [0.0; SAMPLE_LANES];
    for k in 0..SAMPLE_LANES {
        values[k] = wx[0][k] * sums[0][k] + wx[1][k] * sums[1][k] + wx[2][k] * sums[2][k] + wx[3][k] * sums[3][k];
    }
    values
}

/// Interpolates an RGB image by cubic convolution at `(us[k], vs[k])` in pixels; returns the channels, equal to [`crate::bicubic_at`] of each position. `None`
/// unless all positions are inside `(1, w − 4) × (1, h − 2)`, in an image of up to 2²² rows and columns.
///
/// The four pixels of a row are loaded as one vector of 16 bytes, of which four are unused.
#[inline(always)]
pub fn bicubic_rgb_lanes<S: Simd>(
    simd: S,
    view: ImageView<'_, u8, 3>,
    us: &[f32; SAMPLE_LANES],
    vs: &[f32; SAMPLE_LANES],
) -> Option<[[f32; SAMPLE_LANES]; 3]> {
    let (right, bottom) = (view.width() as f32 - 4.0, view.height() as f32 - 2.0);
    let mut inside = right.max(bottom) <= (1 << 22) as f32;
    let (mut xs, mut ys) = ([0; SAMPLE_LANES], [0; SAMPLE_LANES]);
    let (mut fx, mut fy) = ([0.0; SAMPLE_LANES], [0.0; SAMPLE_LANES]);
    for k in 0..SAMPLE_LANES {
        inside &= (us[k] > 1.0) & (us[k] < right) & (vs[k] > 1.0) & (vs[k] < bottom);
        (xs[k], fx[k]) = integer_and_fraction(us[k]);
        (ys[k], fy[k]) = integer_and_fraction(vs[k]);
    }
    if !inside {
        return None;
    }
    let (wx, wy) = (keys_lanes(&fx), keys_lanes(&fy));
    let (samples, stride) = view.strided_samples();
    let mut values = [[0.0; SAMPLE_LANES]; 3];
    for k in 0..SAMPLE_LANES {
        let mut rows = samples.get((ys[k] as usize - 1) * stride + 3 * (xs[k] as usize - 1)..)?;
        let mut sums = f32x16::splat(simd, 0.0);
        // No closures: they would not be inlined, nor would the vector operations in them.
        for (j, wy) in wy.iter().enumerate() {
            if j > 0 {
                rows = rows.get(stride..)?;
            }
            let (low, high) = u8x16::from_slice(simd, rows.first_chunk::<16>()?).widen();
            let (low, high) = low.combine(high).widen();
            // As signed integers, which unlike unsigned ones every instruction set converts.
            let samples = low.combine(high).bitcast::<i32x16<S>>();
            sums += samples.to_float::<f32x16<S>>() * f32x16::splat(simd, wy[k]);
        }
        // Each pixel's three samples moved to the first lanes. (A load from an array of all of them would wait for its stores.)
        let (low, high) = sums.split();
        let ((a, b), (c, d)) = (low.split(), high.split());
        let sum = a * f32x4::splat(simd, wx[0][k])
            + a.slide::<3>(b) * f32x4::splat(simd, wx[1][k])
            + b.slide::<2>(c) * f32x4::splat(simd, wx[2][k])
            + c.slide::<1>(d) * f32x4::splat(simd, wx[3][k]);
        for (c, values) in values.iter_mut().enumerate() {
            values[k] = sum[c];
        }
    }
    Some(values)
}

/// Splits coordinates, clamped to `first..=last`, into base index, `first` to `last - 1`, and fraction of 0 to 1.
#[inline(always)]
fn split(first: usize, last: usize, values: &[f32; SAMPLE_LANES]) -> ([i32; SAMPLE_LANES], [f32; SAMPLE_LANES]) {
    let (mut bases, mut fractions) = ([0; SAMPLE_LANES], [0.0; SAMPLE_LANES]);
    for k in 0..SAMPLE_LANES {
        // `max` first: it replaces NaN.
        let v = values[k].max(first as f32).min(last as f32);
        let (base, _) = integer_and_fraction(v);
        bases[k] = base.max(first as i32).min(last as i32 - 1);
        fractions[k] = v - bases[k] as f32;
    }
    (bases, fractions)
}

/// Returns a byte of a little-endian word.
#[inline(always)]
fn byte(word: u32, index: usize) -> f32 {
    // As signed integers, which unlike unsigned ones every instruction set converts.
    (word >> (8 * index) & 255) as i32 as f32
}

/// Computes the four weights of Keys's kernel for each fraction.
#[inline(always)]
fn keys_lanes(fractions: &[f32; SAMPLE_LANES]) -> [[f32; SAMPLE_LANES]; 4] {
    let mut weights = [[0.0; SAMPLE_LANES]; 4];
    for (c, weights) in weights.iter_mut().enumerate() {
        for (weight, t) in weights.iter_mut().zip(fractions) {
            *weight = ((KEYS[0][c] * t + KEYS[1][c]) * t + KEYS[2][c]) * t + KEYS[3][c];
        }
    }
    weights
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{bicubic_at, bilinear_at};
    use cv_core::RgbU8;
    use fearless_simd::{Level, dispatch};
    use proptest::prelude::*;

    fn image() -> GrayU8 {
        GrayU8::from_fn(11, 7, |x, y| [((x * x * 7 + y * 29 + x * y * 13) % 256) as u8])
    }

    /// Base and fraction by the definition.
    fn parts(v: f32) -> (usize, f32) {
        (v as usize, v - v.floor())
    }

    fn at(v: f32, noise: [f32; SAMPLE_LANES]) -> [f32; SAMPLE_LANES] {
        noise.map(|n| v + n)
    }

    proptest! {
        #[test]
        fn lanes_equal_single_pixels(u in 1.0_f32..8.0, v in 1.0_f32..4.0, du in proptest::array::uniform8(0.0_f32..1.0), dv in proptest::array::uniform8(0.0_f32..1.0)) {
            let image = image();
            let (us, vs) = (at(u, du), at(v, dv));
            let (linear, cubic) = dispatch!(Level::new(), _simd => (bilinear_lanes(&image, &us, &vs), bicubic_lanes(&image, &us, &vs)));
            for k in 0..SAMPLE_LANES {
                let ((x, fx), (y, fy)) = (parts(us[k]), parts(vs[k]));
                prop_assert_eq!(linear[k], bilinear_at(image.view(), x, y, fx, fy)[0]);
                prop_assert_eq!(cubic[k], bicubic_at(image.view(), x, y, fx, fy)[0]);
            }
        }
    }

    proptest! {
        #[test]
        fn colors_equal_single_pixels(u in -1.0_f32..9.0, v in -1.0_f32..5.0, du in proptest::array::uniform8(0.0_f32..1.0), dv in proptest::array::uniform8(0.0_f32..1.0), integers in any::<bool>()) {
            let whole = RgbU8::from_fn(13, 9, |x, y| [0, 1, 2].map(|c| ((37 * x + 59 * y + 83 * c) * (x + 3 * c + 1) % 256) as u8));
            // A part of an image, whose rows are not contiguous.
            let view = whole.view().crop(2, 1, 10, 7).unwrap();
            let (mut us, mut vs) = (at(u, du), at(v, dv));
            if integers {
                (us, vs) = (us.map(f32::round), vs.map(f32::round));
            }
            let inside = us.iter().all(|u| (1.0..6.0).contains(u) && *u > 1.0) && vs.iter().all(|v| (1.0..5.0).contains(v) && *v > 1.0);
            let found = dispatch!(Level::new(), simd => bicubic_rgb_lanes(simd, view, &us, &vs));
            prop_assert_eq!(found.is_some(), inside);
            for k in 0..SAMPLE_LANES {
                let Some(found) = found else { break };
                let ((x, fx), (y, fy)) = (parts(us[k]), parts(vs[k]));
                prop_assert_eq!(found.map(|channel| channel[k]), bicubic_at(view, x, y, fx, fy));
            }
        }
    }

    #[test]
    fn positions_near_the_border_or_nowhere_are_not_interpolated() {
        let image = RgbU8::new(20, 20, [7, 80, 255]);
        let inside = [5.0; SAMPLE_LANES];
        let all = |us: &[f32; SAMPLE_LANES]| dispatch!(Level::new(), simd => bicubic_rgb_lanes(simd, image.view(), us, &inside));
        assert_eq!(all(&inside), Some([[7.0; SAMPLE_LANES], [80.0; SAMPLE_LANES], [255.0; SAMPLE_LANES]]));
        for u in [f32::NAN, f32::INFINITY, -1e9, 0.0, 1.0, 16.0, 19.0, 1e9] {
            let mut us = inside;
            us[3] = u;
            assert_eq!(all(&us), None, "{u}");
        }
        for (width, height) in [(0, 0), (4, 20), (20, 3)] {
            let small = RgbU8::new(width, height, [1; 3]);
            let found = dispatch!(Level::new(), simd => bicubic_rgb_lanes(simd, small.view(), &inside, &inside));
            assert_eq!(found, None);
        }
    }

    #[test]
    fn pixel_centers_have_their_values_and_positions_beyond_are_clamped() {
        let image = image();
        let us: [f32; SAMPLE_LANES] = [0.0, 1.0, 9.0, 10.0, -3.0, 12.5, f32::NAN, 5.0];
        let vs: [f32; SAMPLE_LANES] = [0.0, 5.0, 1.0, 6.0, 2.0, 3.0, 4.0, f32::INFINITY];
        let clamped = |v: f32, low: f32, high: f32| v.max(low).min(high) as usize;
        let (linear, cubic) = (bilinear_lanes(&image, &us, &vs), bicubic_lanes(&image, &us, &vs));
        for k in 0..SAMPLE_LANES {
            let value =
                |low: f32| f32::from(image.at(clamped(us[k], low, 10.0 - low), clamped(vs[k], low, 6.0 - low))[0]);
            assert_eq!((linear[k], cubic[k]), (value(0.0), value(1.0)), "{k}");
        }
    }

    #[test]
    fn images_that_are_too_small_are_zero() {
        let positions = [0.3; SAMPLE_LANES];
        for (width, height) in [(0, 0), (1, 1), (1, 9), (9, 1)] {
            assert_eq!(bilinear_lanes(&GrayU8::new(width, height, [9]), &positions, &positions), [0.0; SAMPLE_LANES]);
        }
        assert_eq!(bilinear_lanes(&GrayU8::new(2, 2, [9]), &positions, &positions), [9.0; SAMPLE_LANES]);
        for (width, height) in [(0, 0), (3, 9), (9, 3)] {
            assert_eq!(bicubic_lanes(&GrayU8::new(width, height, [9]), &positions, &positions), [0.0; SAMPLE_LANES]);
        }
    }
}
