//! The confusion matrix of a mask against the truth, and the scores made of it.

use crate::SegmentError;
use cv_core::ImageView;
use std::iter::Sum;

/// Pixel counts by predicted and true label. Matrices of several images add up.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct ConfusionMatrix {
    /// Foreground pixels predicted as foreground.
    pub true_positives: u64,
    /// Background pixels predicted as foreground.
    pub false_positives: u64,
    /// Foreground pixels predicted as background.
    pub false_negatives: u64,
    /// Background pixels predicted as background.
    pub true_negatives: u64,
}

impl ConfusionMatrix {
    /// Compares a predicted mask with the ground truth.
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

    /// Returns TP / (TP + FP); 1 where nothing is predicted as foreground.
    pub fn precision(&self) -> f64 {
        ratio(self.true_positives, self.true_positives + self.false_positives)
    }

    /// Returns TP / (TP + FN); 1 where there is no foreground.
    pub fn recall(&self) -> f64 {
        ratio(self.true_positives, self.true_positives + self.false_negatives)
    }

    /// Returns the F1 score, the harmonic mean of precision and recall, `2 TP / (2 TP + FP + FN)`; 1 where both masks
    /// are empty.
    pub fn f1(&self) -> f64 {
        ratio(2 * self.true_positives, 2 * self.true_positives + self.false_positives + self.false_negatives)
    }

    /// Returns the intersection over union (Jaccard index), `TP / (TP + FP + FN)`; 1 where both masks are empty.
    pub fn iou(&self) -> f64 {
        ratio(self.true_positives, self.true_positives + self.false_positives + self.false_negatives)
    }
}

fn ratio(part: u64, whole: u64) -> f64 {
    if whole == 0 { 1.0 } else { part as f64 / whole as f64 }
}

/// Adds the counts of several images: micro-averaging, each pixel has the same weight.
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
    fn counts_and_scores_of_a_small_mask() {
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
