//! Channel types that can be interpolated.

use cv_core::Sample;

/// A channel value that interpolation can compute with.
pub trait Pixel: Sample {
    /// The value as a number, in the same unit.
    fn to_f32(self) -> f32;
    /// The nearest value of this type; integers saturate, and take NaN to 0.
    fn from_f32(value: f32) -> Self;
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
