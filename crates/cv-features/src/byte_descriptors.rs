//! Descriptors in bytes: a quarter of the memory.

use crate::matching::{MatchError, MatchOptions, match_descriptors};
use crate::{ByteScale, DescriptorKind, Descriptors};
use cv_core::{DMatch, Progress};

/// Descriptors whose numbers are rounded to bytes, by a scale that belongs to their kind: sets made apart compare.
///
/// Of 2000 rootSIFT features of a photograph, the nearest in a neighboring one is the same as without rounding for 99 % (`cargo xtask peers features` measures it).
#[derive(Debug, Clone, PartialEq)]
pub struct ByteDescriptors {
    kind: DescriptorKind,
    scale: ByteScale,
    data: Vec<u8>,
}

impl ByteDescriptors {
    /// Rounds; `None` for a kind without [`DescriptorKind::bytes`].
    pub fn new(descriptors: &Descriptors) -> Option<Self> {
        let kind = descriptors.kind();
        let scale = kind.bytes?;
        Some(Self { kind, scale, data: descriptors.as_slice().iter().map(|v| scale.to_byte(*v)).collect() })
    }

    /// What the numbers mean.
    pub fn kind(&self) -> DescriptorKind {
        self.kind
    }

    /// Number of descriptors.
    pub fn len(&self) -> usize {
        self.data.len() / self.kind.dimension
    }

    /// True where there are none.
    pub fn is_empty(&self) -> bool {
        self.data.is_empty()
    }

    /// All bytes, row after row.
    pub fn as_slice(&self) -> &[u8] {
        &self.data
    }

    /// The numbers, as far as the bytes tell.
    pub fn to_descriptors(&self) -> Descriptors {
        let data = self.data.iter().map(|&b| self.scale.to_number(b)).collect();
        Descriptors::from_vec(self.kind, data).unwrap_or(Descriptors::new(self.kind))
    }
}

/// As [`match_descriptors`], on rounded descriptors; they are unpacked for the products.
///
/// # Errors
/// As [`match_descriptors`].
pub fn match_byte_descriptors(
    query: &ByteDescriptors,
    train: &ByteDescriptors,
    options: &MatchOptions,
    progress: &dyn Progress,
) -> Result<Vec<DMatch>, MatchError> {
    match_descriptors(&query.to_descriptors(), &train.to_descriptors(), options, progress)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::RatioTest;
    use cv_core::Silent;

    #[test]
    fn rounding_loses_half_a_step() {
        let unit = |k: usize| ((k * 7919 % 101) as f32 / 101.0) * 0.25;
        let patch = |k: usize| ((k * 7919 % 101) as f32 / 101.0) * 7.0 - 3.5;
        for (kind, data, step) in [
            (DescriptorKind::ROOT_SIFT, (0..128 * 9).map(unit).collect::<Vec<f32>>(), 1.0 / 512.0),
            (DescriptorKind::MOPS, (0..64 * 9).map(patch).collect(), 8.0 / 255.0),
        ] {
            let exact = Descriptors::from_vec(kind, data).unwrap();
            let bytes = ByteDescriptors::new(&exact).unwrap();
            assert_eq!((bytes.len(), bytes.kind(), bytes.is_empty()), (9, kind, false));
            for (a, b) in exact.as_slice().iter().zip(bytes.to_descriptors().as_slice()) {
                // Half a step, and f32 rounding.
                assert!((a - b).abs() < 0.5 * step + 1e-6, "{a} {b}");
            }
            let all = MatchOptions { ratio: RatioTest::Off, ..MatchOptions::default() };
            let found = match_byte_descriptors(&bytes, &bytes, &all, &Silent).unwrap();
            assert!(found.iter().all(|m| m.distance == 0.0) && found.len() == 9);
        }
        let foreign = Descriptors::new(DescriptorKind::foreign(3));
        assert_eq!(ByteDescriptors::new(&foreign), None);
        let (a, b) = ([DescriptorKind::SIFT, DescriptorKind::PATCH])
            .map(|kind| ByteDescriptors::new(&Descriptors::from_vec(kind, vec![0.1; 128]).unwrap()).unwrap())
            .into();
        assert!(matches!(
            match_byte_descriptors(&a, &b, &MatchOptions::default(), &Silent),
            Err(MatchError::KindsDiffer { .. })
        ));
    }
}
