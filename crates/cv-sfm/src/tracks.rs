//! Tracks: sets of keypoints of different views that are the same scene point.

use cv_core::{DMatch, Keypoint, UnionFind};

/// An observation: a keypoint of a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Observation {
    /// Index of the view.
    pub view: u32,
    /// Index of the keypoint in it.
    pub keypoint: u32,
}

/// Inlier matches of a pair of views.
#[derive(Debug, Clone, PartialEq)]
pub struct PairMatches {
    /// The view of `DMatch::query`.
    pub a: usize,
    /// The view of `DMatch::train`.
    pub b: usize,
    /// The matches; those with a smaller distance are merged first.
    pub matches: Vec<DMatch>,
    /// The matches among a subset of features that is matched in all pairs alike, by which missing correspondences
    /// reveal repeated structure. `None`: all of `matches`. Empty: unknown for this pair.
    pub sample: Option<Vec<DMatch>>,
}

impl PairMatches {
    /// Creates the matches of a pair whose features were all matched, as in all other pairs.
    pub fn new(a: usize, b: usize, matches: Vec<DMatch>) -> Self {
        Self { a, b, matches, sample: None }
    }

    /// Returns the matches among the features that are matched in all pairs alike.
    pub fn sample(&self) -> &[DMatch] {
        self.sample.as_ref().unwrap_or(&self.matches)
    }
}

/// Tracks as lists of observations, with at most one observation of a view.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Tracks {
    /// Start of each track, and the total length.
    start: Vec<usize>,
    observations: Vec<Observation>,
}

impl Tracks {
    /// Creates tracks from lists of observations.
    pub fn from_lists(lists: impl IntoIterator<Item = Vec<Observation>>) -> Self {
        let mut tracks = Self { start: vec![0], observations: Vec::new() };
        for list in lists {
            tracks.observations.extend(list);
            tracks.start.push(tracks.observations.len());
        }
        tracks
    }

    /// Merges matched keypoints into tracks of at least two views.
    ///
    /// Matches are merged in the order of their distance. A match that would put two positions of a view into one track
    /// is skipped, so that a wrong match between two right tracks does no harm. Features at the same position (with
    /// several orientations or scales) count as one. Matches of missing views or keypoints are ignored. O(m log m) for
    /// m matches.
    pub fn build<'p>(views: &[&[Keypoint]], pairs: impl IntoIterator<Item = &'p PairMatches>) -> Self {
        let mut merger = TrackMerger::new(views);
        let mut edges = Vec::new();
        for pair in pairs.into_iter().filter(|p| p.a != p.b) {
            let of = |view: usize, keypoint: u32| Observation { view: view as u32, keypoint };
            edges.extend(pair.matches.iter().map(|m| (m.distance, of(pair.a, m.query), of(pair.b, m.train))));
        }
        merger.merge(&edges);
        merger.into_tracks()
    }

    /// Returns the number of tracks.
    pub fn len(&self) -> usize {
        self.start.len().saturating_sub(1)
    }

    /// Returns whether there are no tracks.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the observations of all tracks, track after track.
    pub fn observations(&self) -> &[Observation] {
        &self.observations
    }

    /// Returns the range of a track in [`observations`](Self::observations).
    ///
    /// # Panics
    /// If there is no such track.
    pub fn range(&self, track: usize) -> std::ops::Range<usize> {
        self.start[track]..self.start[track + 1]
    }
}

/// Largest distance of two features of a view at the same position, in pixels: of several orientations or of
/// neighboring scales.
const SAME_POSITION_PX: f32 = 1.0;

/// Union of observations into tracks, with at most one position of a view in a track.
pub(crate) struct TrackMerger<'v> {
    views: &'v [&'v [Keypoint]],
    /// Global index of the first keypoint of each view.
    offsets: Vec<u32>,
    /// By keypoint: the first keypoint of its view at exactly its position.
    representative: Vec<u32>,
    sets: UnionFind,
    /// Sorted keypoints of each set of at least two, stored at its root.
    members: Vec<Vec<u32>>,
}

impl<'v> TrackMerger<'v> {
    /// Creates a set for each keypoint.
    pub(crate) fn new(views: &'v [&'v [Keypoint]]) -> Self {
        let mut offsets = Vec::with_capacity(views.len());
        let mut total = 0u32;
        for view in views {
            offsets.push(total);
            total += view.len() as u32;
        }
        let representative = representatives(views, &offsets);
        let sets = UnionFind::new(total as usize);
        Self { views, offsets, representative, sets, members: vec![Vec::new(); total as usize] }
    }

    /// Merges the sets of pairs of observations, in ascending order of the first value, unless a view would get two
    /// positions in a set. Missing observations are ignored.
    pub(crate) fn merge(&mut self, edges: &[(f32, Observation, Observation)]) {
        let item = |o: Observation| {
            let exists = self.views.get(o.view as usize).is_some_and(|view| (o.keypoint as usize) < view.len());
            exists.then(|| self.representative[(self.offsets[o.view as usize] + o.keypoint) as usize])
        };
        let existing = edges.iter().filter_map(|(distance, a, b)| Some((*distance, item(*a)?, item(*b)?)));
        let mut edges: Vec<(f32, u32, u32)> = existing.map(|(d, a, b)| (d, a.min(b), a.max(b))).collect();
        edges.sort_unstable_by(|x, y| x.0.total_cmp(&y.0).then((x.1, x.2).cmp(&(y.1, y.2))));
        for (_, i, j) in edges {
            let (i, j) = (self.sets.find(i), self.sets.find(j));
            if i == j {
                continue;
            }
            let take = |list: &mut Vec<u32>, item: u32| if list.is_empty() { vec![item] } else { std::mem::take(list) };
            let (one, two) = (take(&mut self.members[i as usize], i), take(&mut self.members[j as usize], j));
            match merge_members(&one, &two, |item| self.view_of(item), |i, j| self.is_same_position(i, j)) {
                Some(all) => {
                    self.sets.union(i, j);
                    self.members[i.min(j) as usize] = all;
                }
                None => (self.members[i as usize], self.members[j as usize]) = (one, two),
            }
        }
    }

    /// Returns the sets of at least two observations.
    pub(crate) fn into_tracks(self) -> Tracks {
        let observation = |item: u32| {
            let view = self.view_of(item);
            Observation { view: view as u32, keypoint: item - self.offsets[view] }
        };
        let lists = self.members.iter().filter(|list| list.len() > 1);
        Tracks::from_lists(lists.map(|list| list.iter().map(|item| observation(*item)).collect()))
    }

    fn view_of(&self, item: u32) -> usize {
        self.offsets.partition_point(|f| *f <= item) - 1
    }

    fn is_same_position(&self, i: u32, j: u32) -> bool {
        let position = |item: u32| {
            let view = self.view_of(item);
            self.views[view][(item - self.offsets[view]) as usize].position
        };
        (position(i) - position(j)).norm() <= SAME_POSITION_PX
    }
}

/// Returns for each keypoint the first one of its view at the same position.
fn representatives(views: &[&[Keypoint]], offsets: &[u32]) -> Vec<u32> {
    let mut representative = Vec::with_capacity(views.iter().map(|v| v.len()).sum());
    for (view, offset) in views.iter().zip(offsets) {
        let bits = |k: &Keypoint| (k.position.x.to_bits(), k.position.y.to_bits());
        let mut order: Vec<u32> = (0..view.len() as u32).collect();
        order.sort_unstable_by_key(|&i| (bits(&view[i as usize]), i));
        let base = representative.len();
        representative.resize(base + view.len(), 0);
        let mut head = 0;
        for (n, &i) in order.iter().enumerate() {
            if n == 0 || bits(&view[i as usize]) != bits(&view[head as usize]) {
                head = i;
            }
            representative[base + i as usize] = offset + head;
        }
    }
    representative
}

/// Merges two keypoint lists that are sorted by view; `None` if a view has two different positions. For nearby
/// positions the keypoint of the longer list is kept.
fn merge_members(
    one: &[u32],
    two: &[u32],
    view_of: impl Fn(u32) -> usize,
    is_same_position: impl Fn(u32, u32) -> bool,
) -> Option<Vec<u32>> {
    let (long, short) = if one.len() >= two.len() { (one, two) } else { (two, one) };
    let mut all = Vec::with_capacity(long.len() + short.len());
    let (mut i, mut j) = (0, 0);
    while i < long.len() && j < short.len() {
        let (a, b) = (view_of(long[i]), view_of(short[j]));
        if a == b && !is_same_position(long[i], short[j]) {
            return None;
        }
        all.push(if a <= b { long[i] } else { short[j] });
        i += usize::from(a <= b);
        j += usize::from(b <= a);
    }
    all.extend_from_slice(&long[i..]);
    all.extend_from_slice(&short[j..]);
    Some(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(n: usize) -> Vec<Keypoint> {
        (0..n).map(|i| Keypoint::new(10.0 * i as f32, 0.0, 1.0)).collect()
    }

    fn matches(a: usize, b: usize, list: &[(u32, u32, f32)]) -> PairMatches {
        let of = |&(query, train, distance): &(u32, u32, f32)| DMatch { query, train, distance, ratio: 0.5 };
        PairMatches::new(a, b, list.iter().map(of).collect())
    }

    fn lists(tracks: &Tracks) -> Vec<Vec<(u32, u32)>> {
        let list = |t| tracks.observations()[tracks.range(t)].iter().map(|o| (o.view, o.keypoint)).collect();
        (0..tracks.len()).map(list).collect()
    }

    #[test]
    fn matches_are_merged_into_tracks_in_order_of_distance() {
        let views = [view(4), view(4), view(4)];
        let views: Vec<&[Keypoint]> = views.iter().map(Vec::as_slice).collect();
        let pairs = [
            matches(0, 1, &[(0, 1, 0.1), (2, 3, 0.1)]),
            // Keypoint 3 of view 1 is in a track with keypoint 2 of view 0 already: the match of larger distance to
            // keypoint 0 is skipped.
            matches(1, 2, &[(1, 0, 0.1), (3, 2, 0.2)]),
            matches(0, 2, &[(0, 2, 0.9), (3, 3, 0.5), (9, 0, 0.0)]),
            matches(0, 7, &[(0, 0, 0.0)]),
        ];
        let tracks = Tracks::build(&views, &pairs);
        let expected = [vec![(0, 0), (1, 1), (2, 0)], vec![(0, 2), (1, 3), (2, 2)], vec![(0, 3), (2, 3)]];
        assert_eq!(lists(&tracks), expected);
        assert!(Tracks::build(&[], &[]).is_empty() && Tracks::default().is_empty());
    }

    #[test]
    fn features_at_the_same_position_count_as_one() {
        let mut duplicated = view(3);
        duplicated[2].position = duplicated[0].position;
        let other = view(2);
        let pairs = [matches(0, 1, &[(2, 1, 0.1), (0, 1, 0.2), (1, 0, 0.3)])];
        let tracks = Tracks::build(&[&duplicated, &other], &pairs);
        assert_eq!(lists(&tracks), [vec![(0, 0), (1, 1)], vec![(0, 1), (1, 0)]]);
    }
}
