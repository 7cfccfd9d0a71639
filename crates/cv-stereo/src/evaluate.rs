//! Evaluation of a disparity map against ground truth, with the measures of Middlebury and KITTI.

use cv_core::{ImageView, Mask, quantile};

/// Error thresholds in px of the fractions of bad pixels.
pub const BAD_THRESHOLDS: [f32; 4] = [0.5, 1.0, 2.0, 4.0];

/// Errors over a set of pixels with ground truth.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct DisparityScores {
    /// Number of pixels with ground truth.
    pub pixels: usize,
    /// Fraction of those with an estimate.
    pub density: f64,
    /// Fraction of all pixels without an estimate or with an error above each of [`BAD_THRESHOLDS`].
    pub bad: [f64; 4],
    /// Fraction of the pixels with an estimate whose error is above each of [`BAD_THRESHOLDS`].
    pub bad_of_valid: [f64; 4],
    /// Mean absolute error in px of the pixels with an estimate; NaN without any, as the fields below.
    pub average: f64,
    /// Root mean squared error in px.
    pub rms: f64,
    /// Median absolute error in px.
    pub a50: f64,
    /// 90 % quantile of the absolute error in px.
    pub a90: f64,
    /// 95 % quantile of the absolute error in px.
    pub a95: f64,
}

/// Why two maps cannot be compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum EvaluateError {
    /// The maps differ in size.
    #[error("the estimate is {}×{} px, the {what} {}×{} px", estimate.0, estimate.1, other.0, other.1)]
    SizeMismatch {
        /// Size of the estimate.
        estimate: (usize, usize),
        /// `truth` or `mask`.
        what: &'static str,
        /// Its size.
        other: (usize, usize),
    },
    /// No pixel can be compared.
    #[error("none of the {total} pixels has ground truth inside the mask")]
    NoTruth {
        /// Pixels of the map.
        total: usize,
    },
}

/// Compares an estimate with the ground truth over the pixels of `mask` (all without one) whose truth is finite.
///
/// # Errors
/// [`EvaluateError`] for maps of different sizes, and if no pixel can be compared.
pub fn evaluate_disparity(
    estimate: ImageView<'_, f32, 1>,
    truth: ImageView<'_, f32, 1>,
    mask: Option<ImageView<'_, bool, 1>>,
) -> Result<DisparityScores, EvaluateError> {
    let size = estimate.size();
    let mismatch = |what, other| EvaluateError::SizeMismatch { estimate: size, what, other };
    if truth.size() != size {
        return Err(mismatch("truth", truth.size()));
    }
    if let Some(mask) = mask
        && mask.size() != size
    {
        return Err(mismatch("mask", mask.size()));
    }
    let mut errors = Vec::new();
    let mut pixels = 0usize;
    for y in 0..size.1 {
        let inside = mask.map(|m| m.row(y));
        for (x, (&d, &t)) in estimate.row(y).iter().zip(truth.row(y)).enumerate() {
            if t.is_finite() && inside.is_none_or(|row| row[x]) {
                pixels += 1;
                if d.is_finite() {
                    errors.push((d - t).abs());
                }
            }
        }
    }
    if pixels == 0 {
        return Err(EvaluateError::NoTruth { total: size.0 * size.1 });
    }
    let n = errors.len() as f64;
    let wrong = BAD_THRESHOLDS.map(|limit| errors.iter().filter(|&&e| e > limit).count() as f64);
    let average = errors.iter().map(|&e| f64::from(e)).sum::<f64>() / n;
    let rms = (errors.iter().map(|&e| f64::from(e).powi(2)).sum::<f64>() / n).sqrt();
    let missing = (pixels - errors.len()) as f64;
    let mut at = |fraction: f64| quantile(&mut errors, fraction).map_or(f64::NAN, f64::from);
    let [a50, a90, a95] = [0.5, 0.9, 0.95].map(&mut at);
    Ok(DisparityScores {
        pixels,
        density: n / pixels as f64,
        bad: wrong.map(|w| (w + missing) / pixels as f64),
        bad_of_valid: wrong.map(|w| w / n),
        average,
        rms,
        a50,
        a90,
        a95,
    })
}

/// Returns the pixels of the left view that are visible in the right one: those whose ground truth the right ground truth confirms to
/// 1 px.
///
/// # Errors
/// [`EvaluateError::SizeMismatch`].
pub fn non_occluded(
    left_truth: ImageView<'_, f32, 1>,
    right_truth: ImageView<'_, f32, 1>,
) -> Result<Mask, EvaluateError> {
    let size = left_truth.size();
    if right_truth.size() != size {
        return Err(EvaluateError::SizeMismatch { estimate: size, what: "right truth", other: right_truth.size() });
    }
    Ok(Mask::from_fn(size.0, size.1, |x, y| {
        let d = left_truth.row(y)[x];
        let column = (x as f32 - d).round_ties_even();
        let seen = column >= 0.0 && (column as usize) < size.0;
        // NaN, of an unknown truth, compares false.
        [d.is_finite() && seen && (right_truth.row(y)[column as usize] - d).abs() <= 1.0]
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::GrayF32;

    #[test]
    fn the_scores_of_a_map_worked_out_by_hand() {
        let truth =
            GrayF32::from_vec(5, 2, vec![1.0, 2.0, 3.0, 4.0, f32::NAN, 6.0, 7.0, 8.0, f32::INFINITY, 9.0]).unwrap();
        // Errors 0, 0.75, 1.5, 3 and 5; two missing; one of known truth missing by infinity.
        let estimate =
            GrayF32::from_vec(5, 2, vec![1.0, 2.75, 1.5, 7.0, 5.0, 1.0, f32::NAN, f32::INFINITY, 8.0, f32::NAN])
                .unwrap();
        let s = evaluate_disparity(estimate.view(), truth.view(), None).unwrap();
        assert_eq!(s.pixels, 8);
        assert_eq!(s.density, 5.0 / 8.0);
        assert_eq!(s.bad, [7.0 / 8.0, 6.0 / 8.0, 5.0 / 8.0, 4.0 / 8.0]);
        assert_eq!(s.bad_of_valid, [4.0 / 5.0, 3.0 / 5.0, 2.0 / 5.0, 1.0 / 5.0]);
        // Exact in binary.
        assert_eq!((s.average, s.a50, s.a90, s.a95), (10.25 / 5.0, 1.5, 5.0, 5.0));
        assert!((s.rms - ((0.5625f64 + 2.25 + 9.0 + 25.0) / 5.0).sqrt()).abs() < 1e-12);
        let mask = Mask::from_fn(5, 2, |x, _| [x == 0]);
        assert_eq!(evaluate_disparity(estimate.view(), truth.view(), Some(mask.view())).unwrap().pixels, 2);
    }

    #[test]
    fn maps_that_cannot_be_compared_are_errors() {
        let a = GrayF32::new(3, 2, [1.0]);
        let b = GrayF32::new(2, 2, [1.0]);
        assert!(matches!(
            evaluate_disparity(a.view(), b.view(), None),
            Err(EvaluateError::SizeMismatch { estimate: (3, 2), what: "truth", other: (2, 2) })
        ));
        let unknown = GrayF32::new(3, 2, [f32::NAN]);
        assert_eq!(evaluate_disparity(a.view(), unknown.view(), None), Err(EvaluateError::NoTruth { total: 6 }));
        let none = evaluate_disparity(unknown.view(), a.view(), None).unwrap();
        assert!(none.bad == [1.0; 4] && none.average.is_nan() && none.density == 0.0);
    }

    #[test]
    fn a_pixel_occluded_in_the_right_view_is_excluded() {
        // Background at 1, one near pixel at 3 in column 5 of the left view, in column 2 of the right one.
        let left = GrayF32::from_fn(8, 1, |x, _| [if x == 5 { 3.0 } else { 1.0 }]);
        let right = GrayF32::from_fn(8, 1, |x, _| [if x == 2 { 3.0 } else { 1.0 }]);
        let mask = non_occluded(left.view(), right.view()).unwrap();
        // Column 0 is out of view, column 3 is occluded by the near pixel.
        assert_eq!(mask.as_slice(), [false, true, true, false, true, true, true, true]);
    }
}
