//! Nearest-neighbor matching of descriptors.

use crate::nearest_neighbors::{TwoNearest, nearest};
use crate::simd;
use crate::{DescriptorKind, Descriptors};
use cv_core::{Cancelled, DMatch, OptionError, Progress};

/// Why two sets could not be matched.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum MatchError {
    /// The sets hold different kinds of descriptors.
    #[error("{} {} descriptors cannot be compared with {} {} ones", query.1, query.0, train.1, train.0)]
    KindsDiffer {
        /// Name and dimension of the first set's kind.
        query: (&'static str, usize),
        /// Name and dimension of the second set's kind.
        train: (&'static str, usize),
    },
    /// A set is empty.
    #[error("there is nothing to match: {query} descriptors against {train}")]
    Empty {
        /// Descriptors in the first set.
        query: usize,
        /// Descriptors in the second set.
        train: usize,
    },
    /// A set holds more descriptors than an index can count.
    #[error("{got} descriptors are more than can be indexed (2³² − 1)")]
    TooMany {
        /// Descriptors in the set.
        got: usize,
    },
    /// An option is outside its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

/// In which measure the ratio of best to second-best is taken, and distances are reported.
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

/// How ambiguous a match may be: the ratio of the best candidate's distance to that of the second.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum RatioTest {
    /// Below [`DescriptorKind::ratio`](crate::DescriptorKind::ratio).
    #[default]
    Kind,
    /// Below this, in the measure of the options. 0 to 1.
    Below(f32),
    /// Every nearest neighbor stays.
    Off,
}

/// Settings of [`match_descriptors`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct MatchOptions {
    /// Which matches stay by how ambiguous they are. Default as of the kind of the descriptors.
    pub ratio: RatioTest,
    /// The measure of `ratio`, and of the distances returned. Default SSD.
    pub measure: RatioMeasure,
    /// Keep a match only where each is the other's nearest. Default off.
    pub mutual: bool,
    /// Of several matches with the same descriptor of the second set, keep only the one with the smallest distance (the first of equals). Default off;
    /// mutual matches are one-to-one already.
    pub one_to_one: bool,
}

impl Default for MatchOptions {
    fn default() -> Self {
        Self { ratio: RatioTest::Kind, measure: RatioMeasure::Ssd, mutual: false, one_to_one: false }
    }
}

/// The nearest descriptor in `train` for each one in `query`, kept where the ratio test (and mutual check) passes, in the order of `query`.
///
/// Exact: every pair is compared. Of equally near descriptors the first counts as the best, so that a duplicate gives ratio 1. Where `train`
/// has a single descriptor nothing can be said about ambiguity: the ratio is 1, and only [`RatioTest::Off`] keeps such a match. O(query · train · dimension).
///
/// [`match_byte_descriptors`](crate::match_byte_descriptors) does the same in a third of the time for kinds that are as good in bytes.
///
/// There is no approximate index: at 20,000 descriptors of 128 numbers on each side OpenCV's forest of k-d trees is faster by a half at most (see
/// `docs/benchmarks.md`) and does not always find the nearest.
///
/// # Errors
/// [`MatchError`] for kinds that differ, an empty set, a ratio out of range.
pub fn match_descriptors(
    query: &Descriptors,
    train: &Descriptors,
    options: &MatchOptions,
    progress: &dyn Progress,
) -> Result<Vec<DMatch>, MatchError> {
    select(query.kind(), train.kind(), [query.len(), train.len()], options, || {
        nearest(simd::level(), query, train, options.mutual, progress)
    })
}

/// The matches that pass the tests of `options`, of the two nearest neighbors that `search` finds of each query and, for mutual matches, the nearest query of
/// each candidate.
pub(crate) fn select(
    query: DescriptorKind,
    train: DescriptorKind,
    [queries, candidates]: [usize; 2],
    options: &MatchOptions,
    search: impl FnOnce() -> Result<(Vec<TwoNearest>, Vec<u32>), Cancelled>,
) -> Result<Vec<DMatch>, MatchError> {
    same_kind(query, train)?;
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
        // Two exact copies are ambiguous, not 0/0.
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

/// Refuses sets of different kinds.
pub(crate) fn same_kind(a: DescriptorKind, b: DescriptorKind) -> Result<(), MatchError> {
    if a == b {
        return Ok(());
    }
    Err(MatchError::KindsDiffer { query: (a.name, a.dimension), train: (b.name, b.dimension) })
}

/// Leaves one match for each descriptor of the second set: that with the smallest distance, of equals the first.
pub(crate) fn keep_nearest_of_each(matches: &mut Vec<DMatch>, train: usize) {
    let mut best = vec![f32::INFINITY; train];
    for m in matches.iter() {
        let b = &mut best[m.train as usize];
        *b = b.min(m.distance);
    }
    let mut taken = vec![false; train];
    matches.retain(|m| {
        let t = m.train as usize;
        m.distance <= best[t] && !std::mem::replace(&mut taken[t], true)
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Silent;

    fn set(rows: &[&[f32]]) -> Descriptors {
        let mut data = Vec::new();
        for row in rows {
            let mut padded = [0.0; 64];
            padded[..row.len()].copy_from_slice(row);
            data.extend_from_slice(&padded);
        }
        Descriptors::from_vec(DescriptorKind::PATCH, data).unwrap()
    }

    #[test]
    fn ratio_and_mutual_tests_do_what_they_say() {
        let a = set(&[&[0.0, 0.0], &[10.0, 0.0], &[0.2, 0.0]]);
        let b = set(&[&[0.0, 1.0], &[0.0, 3.0], &[10.0, 1.0]]);
        let all = MatchOptions { ratio: RatioTest::Off, ..MatchOptions::default() };
        let found = match_descriptors(&a, &b, &all, &Silent).unwrap();
        assert_eq!(found.iter().map(|m| (m.query, m.train)).collect::<Vec<_>>(), [(0, 0), (1, 2), (2, 0)]);
        assert_eq!((found[0].distance, found[0].ratio), (1.0, 1.0 / 9.0));
        let by_distance = MatchOptions { measure: RatioMeasure::Distance, ..all.clone() };
        let found = match_descriptors(&a, &b, &by_distance, &Silent).unwrap();
        assert_eq!((found[0].distance, found[0].ratio), (1.0, 1.0 / 3.0));
        let mutual = MatchOptions { mutual: true, ..all.clone() };
        let found = match_descriptors(&a, &b, &mutual, &Silent).unwrap();
        assert_eq!(found.iter().map(|m| (m.query, m.train)).collect::<Vec<_>>(), [(0, 0), (1, 2)]);
        let single = MatchOptions { one_to_one: true, ..all.clone() };
        assert_eq!(match_descriptors(&a, &b, &single, &Silent).unwrap(), found);
        let strict = MatchOptions { ratio: RatioTest::Below(0.05), ..MatchOptions::default() };
        assert_eq!(match_descriptors(&a, &b, &strict, &Silent).unwrap().len(), 1);
    }

    #[test]
    fn duplicates_and_single_candidates_are_ambiguous() {
        let a = set(&[&[1.0]]);
        let twice = set(&[&[1.0], &[1.0]]);
        assert_eq!(match_descriptors(&a, &twice, &MatchOptions::default(), &Silent), Ok(vec![]));
        assert_eq!(match_descriptors(&a, &a, &MatchOptions::default(), &Silent), Ok(vec![]));
        let all = MatchOptions { ratio: RatioTest::Off, ..MatchOptions::default() };
        let expected = DMatch { query: 0, train: 0, distance: 0.0, ratio: 1.0 };
        assert_eq!(match_descriptors(&a, &twice, &all, &Silent), Ok(vec![expected]));
        assert_eq!(match_descriptors(&a, &a, &all, &Silent), Ok(vec![expected]));
    }

    #[test]
    fn what_cannot_be_matched_is_refused() {
        let (a, none) = (set(&[&[1.0]]), set(&[]));
        let options = MatchOptions::default();
        assert_eq!(match_descriptors(&none, &a, &options, &Silent), Err(MatchError::Empty { query: 0, train: 1 }));
        assert_eq!(match_descriptors(&a, &none, &options, &Silent), Err(MatchError::Empty { query: 1, train: 0 }));
        let bad = MatchOptions { ratio: RatioTest::Below(f32::NAN), ..options };
        assert!(matches!(match_descriptors(&a, &a, &bad, &Silent), Err(MatchError::Option(_))));
    }
}
