//! Why hardly any pixel of one photograph has a partner in the other, as far as feature matches tell.

use crate::depth::color_bytes;
use crate::disparity_range::{NEEDED, in_common_rows, is_common_row, is_exchanged, range_of};
use crate::{MatchingError, MatchingOptions, Progress, match_photos};
use cv_core::{Cancelled, Correspondence, ImageView, quantile};
use cv_stereo::{DisparityMap, Intensity, PixelState};

/// What becomes of a pair of which fewer pixels are matched and confirmed than nearly all rectified pairs show.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum FewMatches {
    /// It is refused where features, which are matched by themselves, say what is wrong: photographs of different things, exchanged ones, rows that are not common,
    /// another range of disparities. Where they lie as those of a rectified pair do, it is kept, and [`FeatureAgreement`] tells what they say of it: a calibration
    /// board, whose squares are plain and repeat, shows 10 % and less of what is right.
    #[default]
    Check,
    /// It is kept as long as any pixel is matched.
    Keep,
}

cv_core::named!(FewMatches {
    Check = "check": "refused where features say what is wrong",
    Keep = "keep": "kept as long as any pixel is matched",
});

/// How many features say of confirmed pixels what the matcher says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct FeatureAgreement {
    /// Feature matches in common rows whose disparity is that of their pixel, to 2 px.
    pub agree: usize,
    /// Feature matches in common rows on pixels that were matched and confirmed.
    pub seen: usize,
}

/// A feature is placed to about a pixel, and so is a pixel at an outline.
const AGREES: f64 = 2.0;

impl FeatureAgreement {
    /// Whether that is no chance: eight, and three of four. Of thirteen pairs of a board 91 to 100 % agree; features that are matched by chance agree with one of some tens of
    /// disparities as often as there are pixels around it, one in ten.
    pub fn is_enough(&self) -> bool {
        self.agree >= 8 && 4 * self.agree >= 3 * self.seen
    }

    fn new(map: &DisparityMap, matches: &[Correspondence]) -> Self {
        let (width, height) = map.disparity.size();
        let mut out = Self { agree: 0, seen: 0 };
        for m in matches.iter().filter(|m| is_common_row(m.a.y - m.b.y)) {
            let (x, y) = (m.a.x.round() as usize, m.a.y.round() as usize);
            if x < width && y < height && map.state.at(x, y)[0] == PixelState::Matched {
                out.seen += 1;
                out.agree += usize::from((f64::from(map.disparity.at(x, y)[0]) - (m.a.x - m.b.x)).abs() <= AGREES);
            }
        }
        out
    }
}

/// What feature matches of a refused pair show.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum NoPairCause {
    /// Too few features of one are found in the other: another scene, or hardly anything in common.
    Unrelated {
        /// Matches that could be right.
        matches: usize,
    },
    /// Matches do not lie in common rows: the pair is not rectified.
    Rows {
        /// Median of the vertical distance in px.
        apart: f64,
    },
    /// Disparities are negative: the first photograph is the right one.
    Exchanged {
        /// Smallest and largest disparity of the matches in px.
        range: (i32, i32),
    },
    /// Disparities lie outside the range that was tried.
    Range {
        /// Smallest and largest disparity of the matches in px.
        range: (i32, i32),
    },
    /// Matches lie where they should: the photographs show too little texture or a pattern that repeats, or things moved.
    Unknown,
}

impl std::fmt::Display for NoPairCause {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Unrelated { matches } => {
                write!(
                    f,
                    "only {matches} features of one are found in the other: they show different things, or none with texture"
                )
            }
            Self::Rows { apart } => write!(f, "features lie {apart:.1} px apart vertically: the pair is not rectified"),
            Self::Exchanged { range: (low, high) } => {
                write!(f, "features show disparities {low} to {high}: left and right are exchanged")
            }
            Self::Range { range: (low, high) } => {
                write!(f, "features show disparities {low} to {high}, outside the range that was tried")
            }
            Self::Unknown => f.write_str(
                "features lie in common rows: too little texture, a pattern that repeats, or things that moved",
            ),
        }
    }
}

/// Between the quartiles of chance matches' vertical distances lies about a third of the height; a pair whose rows are askew by ten
/// degrees stays below this share of it.
const SPREAD: f64 = 0.1;

/// Looks at the matches of a pair of which few pixels were matched: what is wrong with it, and how many of them agree with the map.
pub(crate) fn cause<T: Intensity, const C: usize>(
    map: &DisparityMap,
    left: ImageView<'_, T, C>,
    right: ImageView<'_, T, C>,
    (first, count): (i32, usize),
    progress: &dyn Progress,
) -> Result<(NoPairCause, FeatureAgreement), Cancelled> {
    let [a, b] = [left, right].map(color_bytes);
    let found = match match_photos(a.view(), b.view(), &MatchingOptions::default(), progress) {
        Ok(found) => found.pairs(),
        Err(MatchingError::Cancelled(stop)) => return Err(stop),
        Err(_) => return Ok((NoPairCause::Unrelated { matches: 0 }, FeatureAgreement { agree: 0, seen: 0 })),
    };
    let tried = (first, first.saturating_add(count as i32 - 1));
    let mut cause = judge(&found, left.height(), Some(tried));
    // With few matches it matters more that nothing lies outside: what does is matched to where its pattern repeats.
    let mut common = in_common_rows(&found);
    let mut at = |share| quantile(&mut common, share).unwrap_or(0.0);
    if cause == NoPairCause::Unknown && (at(0.01) < f64::from(tried.0) - 1.0 || at(0.99) > f64::from(tried.1) + 1.0) {
        let (min, n) = range_of(common);
        cause = NoPairCause::Range { range: (min, min + n as i32 - 1) };
    }
    Ok((cause, FeatureAgreement::new(map, &found)))
}

/// What matches of two photographs of a height show, of which the disparities `tried` gave hardly any; [`NoPairCause::Unknown`] where
/// they lie as those of a rectified pair do.
pub(crate) fn judge(matches: &[Correspondence], height: usize, tried: Option<(i32, i32)>) -> NoPairCause {
    let mut apart: Vec<f64> = matches.iter().map(|p| p.a.y - p.b.y).collect();
    let n = apart.len();
    if n < NEEDED {
        return NoPairCause::Unrelated { matches: n };
    }
    apart.sort_unstable_by(f64::total_cmp);
    let common = in_common_rows(matches);
    // Wrong matches are few: most lie in common rows where the pair is rectified.
    if common.len() < NEEDED.max(n / 2) {
        // Cameras that are not aligned shift neighbors alike; chance matches are anywhere.
        let spread = apart[3 * n / 4] - apart[n / 4];
        if n < 2 * NEEDED || spread > SPREAD * height as f64 {
            return NoPairCause::Unrelated { matches: common.len() };
        }
        let middle = apart[n / 2];
        // Where wrong matches lie as often above as below, a pattern repeats.
        return if is_common_row(middle) { NoPairCause::Unknown } else { NoPairCause::Rows { apart: middle.abs() } };
    }
    let (min, n) = range_of(common);
    let (low, high) = (min, min + n as i32 - 1);
    if is_exchanged((low, high)) && tried.is_none_or(|tried| tried.0 >= 0) {
        return NoPairCause::Exchanged { range: (low, high) };
    }
    let Some(tried) = tried else { return NoPairCause::Unknown };
    // Most of what there is must have been tried.
    let overlap = tried.1.min(high) - tried.0.max(low) + 1;
    if 2 * overlap < high - low + 1 { NoPairCause::Range { range: (low, high) } } else { NoPairCause::Unknown }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Point2;

    /// Matches with these differences in y, and a disparity of 20 px.
    fn matches(apart: impl Iterator<Item = f64>) -> Vec<Correspondence> {
        apart
            .enumerate()
            .map(|(i, dy)| {
                let (x, y) = ((i * 37 % 600) as f64, (i * 53 % 400) as f64);
                Correspondence { a: Point2::new(x + 20.0, y + dy), b: Point2::new(x, y) }
            })
            .collect()
    }

    #[test]
    fn a_board_that_repeats_is_not_askew() {
        // Two fifths are right, the others a square of 20 px too high or too low.
        let board = |shift: f64| {
            matches(
                (0..200).map(move |i| shift + [0.0, 0.0, -20.0, 20.0, 20.0 - 40.0 * f64::from(i % 2)][i as usize % 5]),
            )
        };
        assert_eq!(judge(&board(0.1), 480, None), NoPairCause::Unknown);
        assert_eq!(judge(&board(12.0), 480, None), NoPairCause::Rows { apart: 12.0 });
    }
}
