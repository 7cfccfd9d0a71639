//! Diagnosis of a pair with few matched pixels, from feature matches.

use crate::depth::to_rgb8;
use crate::disparity_range::{MIN_MATCHES, is_exchanged, is_same_row, range_with_margin, same_row_disparities};
use crate::{MatchingError, MatchingOptions, Progress, match_photos};
use cv_core::{Cancelled, Correspondence, ImageView, quantile};
use cv_stereo::{DisparityMap, Intensity, PixelState};

/// Policy for a pair with fewer matched and confirmed pixels than nearly all rectified pairs have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum FewMatches {
    /// Rejected if feature matches show a fault: different scenes, exchanged images, vertical disparity, another range
    /// of disparities. If they are those of a rectified pair, it is kept with its [`FeatureAgreement`]: on a
    /// calibration board, whose squares are uniform and repeat, 10 % and less of the pixels are matched, correctly.
    #[default]
    Check,
    /// Kept if any pixel is matched.
    Keep,
}

cv_core::named!(FewMatches {
    Check = "check": "refused where features say what is wrong",
    Keep = "keep": "kept as long as any pixel is matched",
});

/// Number of feature matches that agree with the disparity map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct FeatureAgreement {
    /// Feature matches in the same row that agree with the disparity of their pixel within 2 px.
    pub agree: usize,
    /// Feature matches in the same row on matched and confirmed pixels.
    pub seen: usize,
}

/// Tolerance in px: features are accurate to about a pixel, and so are disparities at depth discontinuities.
const MAX_DIFFERENCE_PX: f64 = 2.0;

impl FeatureAgreement {
    /// Returns whether the agreement is significant: at least eight features, and three of four. On thirteen pairs of a
    /// board 91 to 100 % agree; chance matches agree within 2 px of one of some tens of disparities in one of ten
    /// cases.
    pub fn is_enough(&self) -> bool {
        self.agree >= 8 && 4 * self.agree >= 3 * self.seen
    }

    /// Counts the feature matches that agree with a map.
    fn new(map: &DisparityMap, matches: &[Correspondence]) -> Self {
        let (width, height) = map.disparity.size();
        let mut out = Self { agree: 0, seen: 0 };
        for m in matches.iter().filter(|m| is_same_row(m.a.y - m.b.y)) {
            let (x, y) = (m.a.x.round() as usize, m.a.y.round() as usize);
            if x < width && y < height && map.state.at(x, y)[0] == PixelState::Matched {
                out.seen += 1;
                out.agree +=
                    usize::from((f64::from(map.disparity.at(x, y)[0]) - (m.a.x - m.b.x)).abs() <= MAX_DIFFERENCE_PX);
            }
        }
        out
    }
}

/// Fault of a pair, as far as feature matches show it.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum NoPairCause {
    /// Too few matches: another scene, or hardly any overlap.
    Unrelated {
        /// Matches that may be correct.
        matches: usize,
    },
    /// Vertical disparity: the pair is not rectified.
    #[cfg_attr(feature = "serde", serde(rename = "Rows"))]
    VerticalDisparity {
        /// Median of its absolute value, in px.
        #[cfg_attr(feature = "serde", serde(rename = "apart"))]
        px: f64,
    },
    /// Negative disparities: left and right are exchanged.
    Exchanged {
        /// Smallest and largest disparity of the matches, in px.
        range: (i32, i32),
    },
    /// The disparities are outside the range that was searched.
    Range {
        /// Smallest and largest disparity of the matches, in px.
        range: (i32, i32),
    },
    /// No fault: low texture, repetitive texture, or a scene that moved.
    Unknown,
}

impl std::fmt::Display for NoPairCause {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Unrelated { matches } => {
                write!(
                    f,
                    "only {matches} features of one image are matched in the other: different scenes, or too little texture"
                )
            }
            Self::VerticalDisparity { px } => {
                write!(f, "the vertical disparity of features is {px:.1} px: the pair is not rectified")
            }
            Self::Exchanged { range: (low, high) } => {
                write!(f, "features show disparities {low} to {high}: left and right are exchanged")
            }
            Self::Range { range: (low, high) } => {
                write!(f, "features show disparities {low} to {high}, outside the range that was searched")
            }
            Self::Unknown => f.write_str(
                "features have no vertical disparity: too little texture, a repetitive pattern, or a scene that moved",
            ),
        }
    }
}

/// Largest interquartile range of the vertical disparity for a coherent misalignment, as a ratio of the image height.
/// Chance matches have about a third; rows tilted by ten degrees stay below.
const MAX_SPREAD_RATIO: f64 = 0.1;

/// Diagnoses a pair with few matched pixels from its feature matches, and counts those that agree with the map.
pub(crate) fn diagnose<T: Intensity, const C: usize>(
    map: &DisparityMap,
    left: ImageView<'_, T, C>,
    right: ImageView<'_, T, C>,
    (first, count): (i32, usize),
    progress: &dyn Progress,
) -> Result<(NoPairCause, FeatureAgreement), Cancelled> {
    let [a, b] = [left, right].map(to_rgb8);
    let matches = match match_photos(a.view(), b.view(), &MatchingOptions::default(), progress) {
        Ok(matches) => matches.pairs(),
        Err(MatchingError::Cancelled(stop)) => return Err(stop),
        Err(_) => return Ok((NoPairCause::Unrelated { matches: 0 }, FeatureAgreement { agree: 0, seen: 0 })),
    };
    let searched = (first, first.saturating_add(count as i32 - 1));
    let mut cause = diagnose_matches(&matches, left.height(), Some(searched));
    // With few matched pixels, hardly any disparity may be outside: those pixels are matched to repetitions.
    let mut disparities = same_row_disparities(&matches);
    let mut quantile_at = |share| quantile(&mut disparities, share).unwrap_or(0.0);
    if cause == NoPairCause::Unknown
        && (quantile_at(0.01) < f64::from(searched.0) - 1.0 || quantile_at(0.99) > f64::from(searched.1) + 1.0)
    {
        let (min, n) = range_with_margin(disparities);
        cause = NoPairCause::Range { range: (min, min + n as i32 - 1) };
    }
    Ok((cause, FeatureAgreement::new(map, &matches)))
}

/// Diagnoses matches of two images with the given height. `searched` is the range of disparities that few pixels were
/// matched in. [`NoPairCause::Unknown`] if they are those of a rectified pair.
pub(crate) fn diagnose_matches(matches: &[Correspondence], height: usize, searched: Option<(i32, i32)>) -> NoPairCause {
    let mut vertical: Vec<f64> = matches.iter().map(|p| p.a.y - p.b.y).collect();
    let n = vertical.len();
    if n < MIN_MATCHES {
        return NoPairCause::Unrelated { matches: n };
    }
    vertical.sort_unstable_by(f64::total_cmp);
    let disparities = same_row_disparities(matches);
    // In a rectified pair, outliers are the minority.
    if disparities.len() < MIN_MATCHES.max(n / 2) {
        // A misalignment shifts neighboring points alike; chance matches are scattered.
        let spread = vertical[3 * n / 4] - vertical[n / 4];
        if n < 2 * MIN_MATCHES || spread > MAX_SPREAD_RATIO * height as f64 {
            return NoPairCause::Unrelated { matches: disparities.len() };
        }
        let median = vertical[n / 2];
        // Outliers as often above as below: a repetitive pattern.
        return if is_same_row(median) {
            NoPairCause::Unknown
        } else {
            NoPairCause::VerticalDisparity { px: median.abs() }
        };
    }
    let (min, n) = range_with_margin(disparities);
    let (low, high) = (min, min + n as i32 - 1);
    if is_exchanged((low, high)) && searched.is_none_or(|searched| searched.0 >= 0) {
        return NoPairCause::Exchanged { range: (low, high) };
    }
    let Some(searched) = searched else { return NoPairCause::Unknown };
    // At least half of the range must have been searched.
    let overlap = searched.1.min(high) - searched.0.max(low) + 1;
    if 2 * overlap < high - low + 1 { NoPairCause::Range { range: (low, high) } } else { NoPairCause::Unknown }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Point2;

    /// Creates matches with these vertical disparities and a disparity of 20 px.
    fn matches(vertical: impl Iterator<Item = f64>) -> Vec<Correspondence> {
        vertical
            .enumerate()
            .map(|(i, dy)| {
                let (x, y) = ((i * 37 % 600) as f64, (i * 53 % 400) as f64);
                Correspondence { a: Point2::new(x + 20.0, y + dy), b: Point2::new(x, y) }
            })
            .collect()
    }

    #[test]
    fn a_repetitive_board_is_no_misalignment() {
        // Two fifths are correct, the others are off by a square of 20 px, up or down.
        let board = |shift: f64| {
            matches(
                (0..200).map(move |i| shift + [0.0, 0.0, -20.0, 20.0, 20.0 - 40.0 * f64::from(i % 2)][i as usize % 5]),
            )
        };
        assert_eq!(diagnose_matches(&board(0.1), 480, None), NoPairCause::Unknown);
        assert_eq!(diagnose_matches(&board(12.0), 480, None), NoPairCause::VerticalDisparity { px: 12.0 });
    }
}
