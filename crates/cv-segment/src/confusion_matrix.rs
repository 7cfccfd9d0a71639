//! The confusion matrix of a mask against the truth, and the scores made of it.

use crate::SegmentError;
use cv_core::ImageView;
use std::iter::Sum;

/// Pixels counted by what was said about them and what they are; sums over photographs add up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct ConfusionMatrix {
    /// Marked, rightly.
    pub true_positives: u64,
    /// Marked, wrongly.
    pub false_positives: u64,
    /// Not marked, wrongly.
    pub false_negatives: u64,
    /// Not marked, rightly.
    pub true_negatives: u64,
}

impl ConfusionMatrix {
    /// Counts a mask against the true one.
    ///
    /// # Errors
    /// [`SegmentError::SizeMismatch`] with index 0.
    pub fn new(mask: ImageView<'_, bool, 1>, truth: ImageView<'_, bool, 1>) -> Result<Self, SegmentError> {
        if mask.size() != truth.size() {
            return Err(SegmentError::SizeMismatch { index: 0, photo: mask.size(), mask: truth.size() });
        }
        let mut counts = [0u64; 4];
        for y in 0..mask.height() {
            for (&m, &t) in mask.row(y).iter().zip(truth.row(y)) {
                counts[usize::from(m) * 2 + usize::from(t)] += 1;
            }
        }
        let [true_negatives, false_negatives, false_positives, true_positives] = counts;
        Ok(Self { true_positives, false_positives, false_negatives, true_negatives })
    }

    /// The share of the marked pixels that are right; 1 where none is marked.
    pub fn precision(&self) -> f64 {
        share(self.true_positives, self.true_positives + self.false_positives)
    }

    /// The share of the true pixels that are marked; 1 where there are none.
    pub fn recall(&self) -> f64 {
        share(self.true_positives, self.true_positives + self.false_negatives)
    }

    /// The harmonic mean of precision and recall, `2 TP / (2 TP + FP + FN)`; 1 where nothing is marked and nothing is there.
    pub fn f1(&self) -> f64 {
        share(2 * self.true_positives, 2 * self.true_positives + self.false_positives + self.false_negatives)
    }

    /// Intersection over union; 1 where nothing is marked and nothing is there.
    pub fn iou(&self) -> f64 {
        share(self.true_positives, self.true_positives + self.false_positives + self.false_negatives)
    }
}

fn share(part: u64, whole: u64) -> f64 {
    if whole == 0 { 1.0 } else { part as f64 / whole as f64 }
}

/// Counts of several photos together, so that each pixel weighs the same.
impl Sum for ConfusionMatrix {
    fn sum<I: Iterator<Item = Self>>(scores: I) -> Self {
        scores.fold(Self::default(), |a, b| Self {
            true_positives: a.true_positives + b.true_positives,
            false_positives: a.false_positives + b.false_positives,
            false_negatives: a.false_negatives + b.false_negatives,
            true_negatives: a.true_negatives + b.true_negatives,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Mask;

    #[test]
    fn counted_by_hand() {
        let mask = Mask::from_fn(4, 2, |x, y| [[[true, true, true, false], [false, false, true, false]][y][x]]);
        let truth = Mask::from_fn(4, 2, |x, y| [[[true, true, false, false], [true, false, true, false]][y][x]]);
        let s = ConfusionMatrix::new(mask.view(), truth.view()).unwrap();
        assert_eq!(s, ConfusionMatrix { true_positives: 3, false_positives: 1, false_negatives: 1, true_negatives: 3 });
        assert_eq!((s.precision(), s.recall(), s.f1(), s.iou()), (0.75, 0.75, 0.75, 0.6));
        let twice: ConfusionMatrix = [s, s].into_iter().sum();
        assert_eq!((twice.true_negatives, twice.f1()), (6, 0.75));
        assert_eq!(ConfusionMatrix::default().f1(), 1.0);
        assert!(ConfusionMatrix::new(mask.view(), Mask::new(2, 4, [true]).view()).is_err());
    }
}
