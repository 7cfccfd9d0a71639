//! Descriptor kinds: dimension, thresholds and quantization.

use crate::simd::round;

/// A descriptor kind and its matching parameters. Descriptors of different kinds are never compared; those of the same
/// kind are compared by the sum of squared differences (SSD).
///
/// A method declares its kind as a constant:
///
/// ```
/// use cv_features::DescriptorKind;
///
/// /// The gray levels of 5×5 pixels minus their mean, in images of 0 to 1.
/// const SAMPLES: DescriptorKind = DescriptorKind { name: "samples", dimension: 25, max_ssd: 0.5, ..DescriptorKind::PATCH };
/// assert_ne!(SAMPLES, DescriptorKind::PATCH);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DescriptorKind {
    /// Name for messages and file names: lower case, no spaces.
    pub name: &'static str,
    /// Number of dimensions, 1 or more.
    pub dimension: usize,
    /// Threshold of [`RatioTest::Kind`](crate::RatioTest::Kind): maximum ratio of the SSDs of the nearest and second
    /// nearest neighbor. 0 to 1.
    pub ratio: f32,
    /// Maximum SSD of corresponding descriptors, for guided matching. Infinite if unknown.
    pub max_ssd: f32,
    /// Quantization to bytes; `None` if the range of values is unknown.
    pub bytes: Option<ByteScale>,
    /// Side of the patch, if the values are the gray levels of a square patch in row-major order; `None` otherwise.
    pub patch: Option<usize>,
}

/// Uniform quantization: a byte is `(value + offset) · factor`, rounded, 0 to 255.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ByteScale {
    /// Added before scaling.
    pub offset: f32,
    /// Quantization steps per unit.
    pub factor: f32,
}

impl ByteScale {
    /// Quantizes a value.
    #[inline]
    pub fn to_byte(self, value: f32) -> u8 {
        let v = (value + self.offset) * self.factor;
        // Comparisons vectorize; NaN becomes 0.
        let v = if v > 0.0 { v } else { 0.0 };
        round(if v < 255.0 { v } else { 255.0 }) as u8
    }

    /// Dequantizes a byte to the center of its interval.
    pub fn to_number(self, byte: u8) -> f32 {
        f32::from(byte) / self.factor - self.offset
    }
}

/// Ratio threshold on SSDs: Lowe's 0.8 on distances, squared and rounded.
pub(crate) const RATIO: f32 = 0.66;
/// Maximum SSD of corresponding descriptors of unit length: COLMAP's distance of 0.7.
pub(crate) const MAX_SSD: f32 = 0.49;

impl DescriptorKind {
    /// The kinds of the built-in methods.
    pub const BUILT_IN: [Self; 4] = [Self::ROOT_SIFT, Self::SIFT, Self::MOPS, Self::PATCH];

    /// Creates a kind for external descriptors of which only the dimension is known.
    pub const fn foreign(dimension: usize) -> Self {
        Self { name: "foreign", dimension, ratio: RATIO, max_ssd: f32::INFINITY, bytes: None, patch: None }
    }
}

impl std::fmt::Display for DescriptorKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}-number {}", self.dimension, self.name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kinds_differ_by_name_and_every_parameter() {
        for (i, a) in DescriptorKind::BUILT_IN.iter().enumerate() {
            assert!(
                DescriptorKind::BUILT_IN
                    .iter()
                    .enumerate()
                    .all(|(j, b)| (a == b) == (i == j) && (a.name == b.name) == (i == j))
            );
            // The maximum difference per dimension is more than ten quantization steps.
            let (bytes, step) = (a.bytes.unwrap(), (a.max_ssd / a.dimension as f32).sqrt());
            assert!(bytes.factor * step > 10.0, "{a}");
        }
        assert_ne!(DescriptorKind::foreign(3), DescriptorKind::foreign(4));
        assert_eq!(DescriptorKind::foreign(3).to_string(), "3-number foreign");
    }
}
