//! Interpolation of an 8-bit gray image at eight positions at once: a loop over the positions for each step, so that all but the loads are
//! vectorized. For code that is compiled for an instruction set ([`fearless_simd::dispatch`]); the results are the same for each.

use crate::sample::{KEYS, integer_and_fraction};
use cv_core::GrayU8;

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
        let pair = |at: usize| samples.get(at..).and_then(|s| s.first_chunk()).copied().map_or(0, u16::from_le_bytes);
        (above[k], below[k]) = (pair(at).into(), pair(at + width).into());
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
