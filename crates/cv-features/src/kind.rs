//! What the numbers of a descriptor mean.

use crate::simd::round;

/// What the numbers of a descriptor mean, and what belongs to that. Sets of different kinds are never compared; those of one kind are by the sum of their squared
/// differences (SSD).
///
/// A method declares its kind beside itself, as a constant:
///
/// ```
/// use cv_features::DescriptorKind;
///
/// /// The gray values of 5×5 pixels less their mean, in images of 0 to 1.
/// const SAMPLES: DescriptorKind = DescriptorKind { name: "samples", dimension: 25, max_ssd: 0.5, ..DescriptorKind::PATCH };
/// assert_ne!(SAMPLES, DescriptorKind::PATCH);
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DescriptorKind {
    /// In messages and names of files: lower case, no spaces.
    pub name: &'static str,
    /// Numbers in one descriptor. 1 or more.
    pub dimension: usize,
    /// Where [`RatioTest::Kind`](crate::RatioTest::Kind) cuts: largest ratio of the SSD of the best candidate to that of the second. 0 to 1.
    pub ratio: f32,
    /// Largest SSD of two descriptors of one point, for matching along a known geometry. Infinite where it is not known.
    pub max_ssd: f32,
    /// How numbers are rounded to bytes; `None` where their range is not known.
    pub bytes: Option<ByteScale>,
    /// Side of the square of gray values that the numbers are, row after row; `None` where they are something else.
    pub patch: Option<usize>,
}

/// Numbers as bytes: a byte is `(number + offset) · factor`, rounded, 0 to 255.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ByteScale {
    /// Added first.
    pub offset: f32,
    /// Bytes in a unit.
    pub factor: f32,
}

impl ByteScale {
    /// The nearest byte.
    #[inline]
    pub fn to_byte(self, number: f32) -> u8 {
        let v = (number + self.offset) * self.factor;
        // As comparisons, which vectorize; NaN becomes 0.
        let v = if v > 0.0 { v } else { 0.0 };
        round(if v < 255.0 { v } else { 255.0 }) as u8
    }

    /// The number in the middle of those that become this byte.
    pub fn to_number(self, byte: u8) -> f32 {
        f32::from(byte) / self.factor - self.offset
    }
}

/// Brown & Lowe's 0.8 on distances, squared and rounded.
pub(crate) const RATIO: f32 = 0.66;
/// Of descriptors of unit length: COLMAP's distance of 0.7.
pub(crate) const MAX_SSD: f32 = 0.49;

impl DescriptorKind {
    /// The kinds of this crate's own methods.
    pub const OWN: [Self; 4] = [Self::ROOT_SIFT, Self::SIFT, Self::MOPS, Self::PATCH];

    /// Rows of another program of which nothing but their length is known.
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
    fn kinds_are_told_apart_by_name_and_every_number() {
        for (i, a) in DescriptorKind::OWN.iter().enumerate() {
            assert!(
                DescriptorKind::OWN
                    .iter()
                    .enumerate()
                    .all(|(j, b)| (a == b) == (i == j) && (a.name == b.name) == (i == j))
            );
            // A tenth of a kind's largest difference is many steps of a byte.
            let (bytes, step) = (a.bytes.unwrap(), (a.max_ssd / a.dimension as f32).sqrt());
            assert!(bytes.factor * step > 10.0, "{a}");
        }
        assert_ne!(DescriptorKind::foreign(3), DescriptorKind::foreign(4));
        assert_eq!(DescriptorKind::foreign(3).to_string(), "3-number foreign");
    }
}
