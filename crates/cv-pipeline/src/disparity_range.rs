//! The range of disparities of a pair: from matching it at a fraction of its size, or from feature matches.

use crate::depth::to_rgb8;
use crate::vertical_alignment::Alignment;
use crate::{MatchingError, MatchingOptions, Progress, match_photos};
use cv_core::{Cancelled, Correspondence, ImageView, quantile};
use cv_imgproc::Pixel;
use cv_stereo::{CoarseRange, Intensity, StereoError, StereoOptions};

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
    #[error("the images show disparities {} to {}: left and right are exchanged", .range.0, .range.1)]
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

/// Estimates the smallest disparity and the number of disparities of a rectified pair by matching it at a fraction of its size; where little of it is matched,
/// from feature matches in the same row. Either range is extended at both ends by an eighth of it and some px for what was missed. O(pixels).
///
/// # Errors
/// [`RangeError`] with too few matches in the same row, or negative disparities only.
pub fn disparity_range(
    left: ImageView<'_, u8, 3>,
    right: ImageView<'_, u8, 3>,
    progress: &dyn Progress,
) -> Result<(i32, usize), RangeError> {
    image_range([left, right], None, &StereoOptions::default(), &mut Alignment::off(), progress)
}

/// As [`disparity_range`], from `min` up where it is given, with these options but their range. Where less is matched than of most pairs, features are asked for a
/// vertical disparity first.
pub(crate) fn image_range<T: Intensity + Pixel, const C: usize>(
    [left, right]: [ImageView<'_, T, C>; 2],
    min: Option<i32>,
    options: &StereoOptions,
    alignment: &mut Alignment,
    progress: &dyn Progress,
) -> Result<(i32, usize), RangeError> {
    let coarse = |right| coarse_range([left, right], min, options, progress);
    let (mut found, mut matches) = (coarse(right)?, Vec::new());
    if found.is_none_or(|found| found.matched_fraction < USUAL_MATCHED_FRACTION) {
        match match_pair(to_rgb8(left).view(), to_rgb8(right).view(), progress) {
            Ok(pairs) => matches = pairs,
            Err(RangeError::Cancelled(stop)) => return Err(stop.into()),
            Err(error) if found.is_none() => return Err(error),
            Err(_) => {}
        }
        if left.size() == right.size() {
            alignment.update_from_features(&matches, left.size());
        }
        if let Some(offset) = alignment.offset {
            offset.correct_matches(&mut matches);
            // Without memory for it, the matcher has none either.
            if let Some(corrected) = alignment.correct(right).ok().flatten() {
                found = coarse(corrected.view())?.or(found);
            }
        }
    }
    let (first, count) = match found {
        Some(CoarseRange { range, scale, .. }) => with_margin(range, scale as f64),
        None => range_from_matches(&matches)?,
    };
    let last = i64::from(first) + count as i64 - 1;
    let range = (first, last as i32);
    if min.is_none() && is_exchanged(range) {
        return Err(RangeError::Exchanged { range });
    }
    let min_disparity = min.unwrap_or(first);
    Ok((min_disparity, (last - i64::from(min_disparity) + 1).max(1) as usize))
}

/// Minimum fraction of matched and confirmed pixels of a pair at a fraction of its size for its range: with a vertical disparity of 8 px public pairs have up to
/// 0.42.
const MIN_COARSE_MATCHED: f64 = 0.4;
/// That of most aligned pairs: public ones have 0.74 to 0.99, but for one with 0.63; with a vertical disparity of 4 px 0.29 to 0.69.
const USUAL_MATCHED_FRACTION: f64 = 0.7;

/// Estimates the range of a rectified pair by matching it at a fraction of its size; `None` where little is matched.
fn coarse_range<T: Intensity, const C: usize>(
    images: [ImageView<'_, T, C>; 2],
    min: Option<i32>,
    options: &StereoOptions,
    progress: &dyn Progress,
) -> Result<Option<CoarseRange>, Cancelled> {
    match CoarseRange::estimate(images, min, options, progress) {
        Ok(found) => Ok(found.filter(|found| found.matched_fraction >= MIN_COARSE_MATCHED)),
        Err(StereoError::Cancelled(stop)) => Err(stop),
        // The matcher reports what is wrong with the pair.
        Err(_) => Ok(None),
    }
}

/// Matches the features of a pair.
pub(crate) fn match_pair(
    left: ImageView<'_, u8, 3>,
    right: ImageView<'_, u8, 3>,
    progress: &dyn Progress,
) -> Result<Vec<Correspondence>, RangeError> {
    Ok(match_photos(left, right, &MatchingOptions::default(), progress)?.pairs())
}

/// Returns the range of feature matches in the same row.
fn range_from_matches(pairs: &[Correspondence]) -> Result<(i32, usize), RangeError> {
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
    with_margin((quantile_at(0.01), quantile_at(0.99)), 4.0)
}

/// Extends a range at both ends by an eighth of it and `least` px; returns the first and the number of disparities.
fn with_margin((low, high): (f64, f64), least: f64) -> (i32, usize) {
    let margin = (high - low) / 8.0 + least;
    let min = (low - margin).floor() as i32;
    // Disparities below zero are beyond infinity: a match or two are wrong or rounded.
    let min = if low > -1.0 { min.max(0) } else { min };
    (min, ((high + margin).ceil() as i32 - min + 1).max(1) as usize)
}
