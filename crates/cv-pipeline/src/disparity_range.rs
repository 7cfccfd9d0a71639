//! The range of disparities of a pair, from feature matches.

use crate::{MatchingError, MatchingOptions, Progress, match_photos};
use cv_core::{Cancelled, Correspondence, ImageView, quantile};

/// Why the range of disparities could not be estimated.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum RangeError {
    /// The features cannot be matched.
    #[error(transparent)]
    Matching(MatchingError),
    /// Too few matches without vertical disparity.
    #[error("only {found} of {matches} matches are in the same row of both photographs, {needed} are needed")]
    TooFew {
        /// Matches in the same row.
        found: usize,
        /// Number of matches.
        matches: usize,
        /// Number that is needed.
        needed: usize,
    },
    /// The disparities are negative: left and right are exchanged.
    #[error("features show disparities {} to {}: left and right are exchanged", .range.0, .range.1)]
    Exchanged {
        /// Smallest and largest disparity of the matches, in px.
        range: (i32, i32),
    },
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

impl From<MatchingError> for RangeError {
    fn from(error: MatchingError) -> Self {
        match error {
            MatchingError::Cancelled(stop) => Self::Cancelled(stop),
            other => Self::Matching(other),
        }
    }
}

/// Minimum number of matches for a range.
pub(crate) const MIN_MATCHES: usize = 16;

/// Returns whether a vertical disparity in px is small enough for the same row.
pub(crate) fn is_same_row(vertical_disparity: f64) -> bool {
    const MAX_VERTICAL_DISPARITY: f64 = 1.5;
    vertical_disparity.abs() <= MAX_VERTICAL_DISPARITY
}

/// Returns the disparities of the matches in the same row.
pub(crate) fn same_row_disparities(matches: &[Correspondence]) -> Vec<f64> {
    matches.iter().filter(|m| is_same_row(m.a.y - m.b.y)).map(|m| m.a.x - m.b.x).collect()
}

/// Estimates the smallest disparity and the number of disparities of a rectified pair from feature matches in the same
/// row: their 1 % and 99 % quantiles, extended at both ends by an eighth of the range and 4 px for what features miss.
///
/// # Errors
/// [`RangeError`] with too few matches in the same row, or negative disparities only.
pub fn disparity_range(
    left: ImageView<'_, u8, 3>,
    right: ImageView<'_, u8, 3>,
    progress: &dyn Progress,
) -> Result<(i32, usize), RangeError> {
    range_from_matches(&match_pair(left, right, progress)?)
}

/// Matches the features of a pair.
pub(crate) fn match_pair(
    left: ImageView<'_, u8, 3>,
    right: ImageView<'_, u8, 3>,
    progress: &dyn Progress,
) -> Result<Vec<Correspondence>, RangeError> {
    Ok(match_photos(left, right, &MatchingOptions::default(), progress)?.pairs())
}

/// As [`disparity_range`], from matches.
pub(crate) fn range_from_matches(pairs: &[Correspondence]) -> Result<(i32, usize), RangeError> {
    let disparities = same_row_disparities(pairs);
    if disparities.len() < MIN_MATCHES {
        return Err(RangeError::TooFew { found: disparities.len(), matches: pairs.len(), needed: MIN_MATCHES });
    }
    Ok(range_with_margin(disparities))
}

/// Returns whether a range of disparities is that of exchanged images: nothing but distant points a few pixels above
/// zero (by an offset of the principal points), and some far below.
pub(crate) fn is_exchanged((low, high): (i32, i32)) -> bool {
    high <= 8 && low < -8
}

/// Returns the extended range of a non-empty list of disparities.
pub(crate) fn range_with_margin(mut disparities: Vec<f64>) -> (i32, usize) {
    let mut quantile_at = |fraction: f64| quantile(&mut disparities, fraction).unwrap_or(0.0);
    let (low, high) = (quantile_at(0.01), quantile_at(0.99));
    let margin = (high - low) / 8.0 + 4.0;
    let min = (low - margin).floor() as i32;
    // Disparities below zero are beyond infinity: a match or two are wrong or rounded.
    let min = if low > -1.0 { min.max(0) } else { min };
    (min, ((high + margin).ceil() as i32 - min + 1).max(1) as usize)
}
