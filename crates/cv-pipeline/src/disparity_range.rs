//! Which disparities a pair shows, from sparse matches.

use crate::{MatchingError, MatchingOptions, Progress, match_photos};
use cv_core::{Cancelled, Correspondence, ImageView, quantile};

/// Why no range was found.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum RangeError {
    /// No features to match.
    #[error(transparent)]
    Matching(MatchingError),
    /// Too few matches lie in the same row of both photographs.
    #[error("only {found} of {matches} matches lie in the same row of both photographs, {needed} are needed")]
    TooFew {
        /// Matches in common rows.
        found: usize,
        /// All matches.
        matches: usize,
        /// How many are needed.
        needed: usize,
    },
    /// The disparities are negative: the first photograph is the right one.
    #[error("features show disparities {} to {}: left and right are exchanged", .range.0, .range.1)]
    Exchanged {
        /// Smallest and largest disparity of the matches in px.
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

/// Fewer matches than this do not tell a range.
pub(crate) const NEEDED: usize = 16;

/// Whether features that differ by so many px in y lie in a common row.
pub(crate) fn is_common_row(apart: f64) -> bool {
    const COMMON_ROW: f64 = 1.5;
    apart.abs() <= COMMON_ROW
}

/// Disparities of those matches that lie in a common row.
pub(crate) fn in_common_rows(matches: &[Correspondence]) -> Vec<f64> {
    matches.iter().filter(|m| is_common_row(m.a.y - m.b.y)).map(|m| m.a.x - m.b.x).collect()
}

/// Smallest disparity and number of disparities that a rectified pair shows: those of feature matches in common rows
/// between their 1 % and 99 % quantiles, and an eighth of that and 4 px more at both ends for what features miss.
///
/// # Errors
/// [`RangeError`] where too few matches lie in common rows.
pub fn disparity_range(
    left: ImageView<'_, u8, 3>,
    right: ImageView<'_, u8, 3>,
    progress: &dyn Progress,
) -> Result<(i32, usize), RangeError> {
    range_from(&matches_of(left, right, progress)?)
}

/// Feature matches of a pair.
pub(crate) fn matches_of(
    left: ImageView<'_, u8, 3>,
    right: ImageView<'_, u8, 3>,
    progress: &dyn Progress,
) -> Result<Vec<Correspondence>, RangeError> {
    Ok(match_photos(left, right, &MatchingOptions::default(), progress)?.pairs())
}

/// As [`disparity_range`], of matches.
pub(crate) fn range_from(pairs: &[Correspondence]) -> Result<(i32, usize), RangeError> {
    let disparities = in_common_rows(pairs);
    if disparities.len() < NEEDED {
        return Err(RangeError::TooFew { found: disparities.len(), matches: pairs.len(), needed: NEEDED });
    }
    Ok(range_of(disparities))
}

/// Whether disparities from the smallest to the largest are those of a pair whose photographs are exchanged: none but a few pixels
/// above zero, as far things have them where the rows are aligned and the principal points are not, and some far below.
pub(crate) fn is_exchanged((low, high): (i32, i32)) -> bool {
    high <= 8 && low < -8
}

/// The range of some disparities, of which there is at least one.
pub(crate) fn range_of(mut disparities: Vec<f64>) -> (i32, usize) {
    let mut at = |share: f64| quantile(&mut disparities, share).unwrap_or(0.0);
    let (low, high) = (at(0.01), at(0.99));
    let more = (high - low) / 8.0 + 4.0;
    let min = (low - more).floor() as i32;
    // A rectified pair shows nothing beyond infinity; a point or two below zero are wrong matches or rounding.
    let min = if low > -1.0 { min.max(0) } else { min };
    (min, ((high + more).ceil() as i32 - min + 1).max(1) as usize)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Silent;
    use cv_core::{Camera, RgbU8};
    use cv_synth::{RenderOptions, Scene, stereo_pair};

    #[test]
    fn the_range_covers_a_generated_room_and_little_more() {
        let scene = Scene::room(4);
        let camera = Camera::from_focal(320, 240, 280.0);
        let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::default()).unwrap();
        let (min, n) = disparity_range(pair.left.image.view(), pair.right.image.view(), &Silent).unwrap();
        let d = pair.disparity.as_slice();
        let inside = d.iter().filter(|&&d| d >= min as f32 && d <= (min + n as i32 - 1) as f32).count();
        let largest = d.iter().copied().fold(0.0, f32::max);
        // Quantiles of features leave out a few pixels of the nearest things.
        assert!(inside as f64 >= 0.97 * d.len() as f64, "{min} {n}: {inside} of {}", d.len());
        assert!((n as f32) < 1.6 * largest + 10.0, "{min} {n} for {largest}");
    }

    #[test]
    fn photographs_without_common_rows_are_refused() {
        let flat = RgbU8::new(80, 60, [90; 3]);
        assert!(disparity_range(flat.view(), flat.view(), &Silent).is_err());
    }
}
