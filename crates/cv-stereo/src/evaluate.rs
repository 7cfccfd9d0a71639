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
