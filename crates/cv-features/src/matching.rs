//! Nearest-neighbor matching of descriptors.

use crate::nearest_neighbors::{TwoNearest, nearest};
use crate::simd;
use crate::{DescriptorKind, Descriptors};
use cv_core::{Cancelled, DMatch, OptionError, Progress};

/// Why two sets could not be matched.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum MatchError {
    /// The descriptors are of different kinds.
    #[error("{}-dimensional {} descriptors cannot be compared with {}-dimensional {} descriptors", query.1, query.0, train.1, train.0)]
    KindsDiffer {
        /// Name and dimension of the kind of the first set.
        query: (&'static str, usize),
        /// Name and dimension of the kind of the second set.
        train: (&'static str, usize),
    },
    /// A set is empty.
    #[error("there is nothing to match: {query} descriptors against {train}")]
    Empty {
        /// Number of descriptors of the first set.
        query: usize,
        /// Number of descriptors of the second set.
        train: usize,
    },
    /// A set has more descriptors than 32-bit indices allow.
    #[error("{got} descriptors are more than can be indexed (2³² − 1)")]
    TooMany {
        /// Number of descriptors.
        got: usize,
    },
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

/// The distance measure of the ratio test and of the reported distances.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum RatioMeasure {
    /// Sum of squared differences. 0.66 here is 0.81 on distances.
    #[default]
    Ssd,
    /// Euclidean distance, as in Lowe's paper and OpenCV's usual code.
    Distance,
}

/// The ratio test (Lowe 2004): the threshold on the ratio of the distances of the nearest and second nearest neighbor.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum RatioTest {
    /// The threshold of the kind, [`DescriptorKind::ratio`](crate::DescriptorKind::ratio).
    #[default]
    Kind,
    /// This threshold, in the measure of the options. 0 to 1.
    Below(f32),
    /// No ratio test.
    Off,
}

/// Options of [`match_descriptors`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct MatchOptions {
    /// The ratio test. Default the threshold of the descriptor kind.
    pub ratio: RatioTest,
    /// The measure of the ratio test and of the returned distances. Default SSD.
    pub measure: RatioMeasure,
    /// Cross-check: keep only mutual nearest neighbors. Default off.
    pub mutual: bool,
    /// Keep only the match with the smallest distance for each descriptor of the second set (ties by index). Default
    /// off; mutual matches are one-to-one.
    pub one_to_one: bool,
}

impl Default for MatchOptions {
    fn default() -> Self {
        Self { ratio: RatioTest::Kind, measure: RatioMeasure::Ssd, mutual: false, one_to_one: false }
    }
}

/// Matches each descriptor in `query` with its nearest neighbor in `train`, subject to the ratio test and the
/// cross-check; in the order of `query`.
///
/// Exhaustive search with exact results. Ties are resolved by index, and duplicates have ratio 1. If `train` has a
/// single descriptor, the ratio is 1, and only [`RatioTest::Off`] accepts the match. O(query × train × dimension).
///
/// [`match_byte_descriptors`](crate::match_byte_descriptors) takes a third of the time for kinds that can be quantized.
///
/// There is no approximate search: with 20,000 descriptors of 128 dimensions in each set, OpenCV's forest of k-d trees
/// is at most faster by a half (see `docs/benchmarks.md`) and not exact.
///
/// # Errors
/// [`MatchError`] for different kinds, an empty set, a ratio out of range.
pub fn match_descriptors(
    query: &Descriptors,
    train: &Descriptors,
    options: &MatchOptions,
    progress: &dyn Progress,
) -> Result<Vec<DMatch>, MatchError> {
    select_matches(query.kind(), train.kind(), [query.len(), train.len()], options, || {
        nearest(simd::level(), query, train, options.mutual, progress)
    })
}

/// Selects the matches that pass the tests of `options`. `search` returns the two nearest neighbors of each query and,
/// for the cross-check, the nearest query of each candidate.
pub(crate) fn select_matches(
    query: DescriptorKind,
    train: DescriptorKind,
    [queries, candidates]: [usize; 2],
    options: &MatchOptions,
    search: impl FnOnce() -> Result<(Vec<TwoNearest>, Vec<u32>), Cancelled>,
) -> Result<Vec<DMatch>, MatchError> {
    check_same_kind(query, train)?;
    if queries == 0 || candidates == 0 {
        return Err(MatchError::Empty { query: queries, train: candidates });
    }
    if let Some(got) = [queries, candidates].into_iter().find(|&n| u32::try_from(n).is_err()) {
        return Err(MatchError::TooMany { got });
    }
    let limit = match (options.ratio, options.measure) {
        (RatioTest::Kind, RatioMeasure::Ssd) => Some(query.ratio),
        (RatioTest::Kind, RatioMeasure::Distance) => Some(query.ratio.sqrt()),
        (RatioTest::Below(limit), _) => Some(limit),
        (RatioTest::Off, _) => None,
    };
    if let Some(limit) = limit {
        OptionError::check("ratio", limit.into(), "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
    }
    let (forward, backward) = search()?;
    let mut matches = Vec::new();
    for (i, two) in forward.iter().enumerate() {
        if options.mutual && backward[two.best as usize] as usize != i {
            continue;
        }
        let of_ssd = |v: f32| if options.measure == RatioMeasure::Ssd { v } else { v.sqrt() };
        let (distance, second) = (of_ssd(two.ssd), of_ssd(two.second_ssd));
        // Duplicates have ratio 1, not 0/0.
        let ratio = if second > 0.0 && second.is_finite() { distance / second } else { 1.0 };
        if limit.is_none_or(|limit| ratio < limit) {
            matches.push(DMatch { query: i as u32, train: two.best, distance, ratio });
        }
    }
    if options.one_to_one {
        keep_nearest_of_each(&mut matches, candidates);
    }
    Ok(matches)
}

/// Rejects descriptors of different kinds.
pub(crate) fn check_same_kind(a: DescriptorKind, b: DescriptorKind) -> Result<(), MatchError> {
    if a == b {
        return Ok(());
    }
    Err(MatchError::KindsDiffer { query: (a.name, a.dimension), train: (b.name, b.dimension) })
}

/// Retains one match for each descriptor of the second set: that with the smallest distance, ties by index.
pub(crate) fn keep_nearest_of_each(matches: &mut Vec<DMatch>, train: usize) {
    let mut best = vec![f32::INFINITY; train];
    for m in matches.iter() {
        let b = &mut best[m.train as usize];
        *b = b.min(m.distance);
    }
    let mut is_matched = vec![false; train];
    matches.retain(|m| {
        let t = m.train as usize;
        m.distance <= best[t] && !std::mem::replace(&mut is_matched[t], true)
    });
}
