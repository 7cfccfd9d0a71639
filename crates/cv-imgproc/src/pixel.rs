//! Sample types that can be interpolated.

use cv_core::{ImageView, Sample};

/// A sample type that can be interpolated.
pub trait Pixel: Sample {
    /// Converts to `f32` in the same unit.
    fn to_f32(self) -> f32;
    /// Converts to the nearest value of this type; integers saturate, and NaN becomes 0.
    fn from_f32(value: f32) -> Self;
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

impl Pixel for f32 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self
    }
    #[inline(always)]
    fn from_f32(value: f32) -> Self {
        value
    }
}

impl Pixel for u8 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        f32::from(self)
    }
    #[inline(always)]
    fn from_f32(value: f32) -> Self {
        (value + 0.5) as u8
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
        (value + 0.5) as u16
    }
}
