//! Sample types that can be interpolated.

use crate::remap_vertical::interpolate_rows;
use cv_core::{ImageView, Sample};

/// A sample type that can be interpolated.
pub trait Pixel: Sample {
    /// Converts to `f32` in the same unit.
    fn to_f32(self) -> f32;
    /// Converts to the nearest value of this type; integers saturate, and NaN becomes 0.
    fn from_f32(value: f32) -> Self;
    /// Interpolates by cubic convolution between rows 1 and 2 of four adjacent ones, at the fraction of each sample, 0 to 1. Not generic, so that
    /// it is compiled with the optimizations of this crate.
    fn interpolate_rows(rows: [&[Self]; 4], fractions: &[f32], out: &mut [Self]);
    /// Returns the view as 8-bit where that is its type, for integer arithmetic.
    #[inline(always)]
    fn as_bytes<const C: usize>(_: ImageView<'_, Self, C>) -> Option<ImageView<'_, u8, C>> {
        None
    }
    /// Returns the samples as 8-bit where that is their type.
    #[inline(always)]
    fn as_bytes_mut(_: &mut [Self]) -> Option<&mut [u8]> {
        None
    }
}

/// Rounds to the nearest integer of 0 to `last`, up to 2²²; halves up, and NaN to 0. For vectorized loops: avoids the saturating conversion, since at 2²³ the last bits
/// of a float are its integer part.
#[inline(always)]
fn rounded(value: f32, last: f32) -> u32 {
    const SHIFT: f32 = 8_388_608.0;
    // `max` first: it replaces NaN.
    let v = value.max(0.0).min(last) + 0.5;
    let nearest = v + SHIFT;
    (nearest.to_bits() & 0x7f_ffff) - u32::from(nearest - SHIFT > v)
}

impl Pixel for f32 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self
    }
    #[inline(always)]
    fn from_f32(value: f32) -> Self {
        value
    }
    fn interpolate_rows(rows: [&[Self]; 4], fractions: &[f32], out: &mut [Self]) {
        interpolate_rows(rows, fractions, out);
    }
}

impl Pixel for u8 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        f32::from(self)
    }
    #[inline(always)]
    fn from_f32(value: f32) -> Self {
        rounded(value, 255.0) as u8
    }
    fn interpolate_rows(rows: [&[Self]; 4], fractions: &[f32], out: &mut [Self]) {
        interpolate_rows(rows, fractions, out);
    }
    #[inline(always)]
    fn as_bytes<const C: usize>(view: ImageView<'_, Self, C>) -> Option<ImageView<'_, u8, C>> {
        Some(view)
    }
    #[inline(always)]
    fn as_bytes_mut(samples: &mut [Self]) -> Option<&mut [u8]> {
        Some(samples)
    }
}

impl Pixel for u16 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        f32::from(self)
    }
    #[inline(always)]
    fn from_f32(value: f32) -> Self {
        rounded(value, 65535.0) as u16
    }
    fn interpolate_rows(rows: [&[Self]; 4], fractions: &[f32], out: &mut [Self]) {
        interpolate_rows(rows, fractions, out);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn samples_are_rounded_to_the_nearest_and_saturate(bits in any::<u32>(), halves in -10..140_000_i32, level in -2.0_f32..258.0) {
            for v in [f32::from_bits(bits), halves as f32 / 2.0, level] {
                prop_assert_eq!(u8::from_f32(v), (v + 0.5) as u8, "{}", v);
                prop_assert_eq!(u16::from_f32(v), (v + 0.5) as u16, "{}", v);
            }
        }
    }
}
