//! Tracks: the keypoints of many views that are one point of the scene.

use cv_core::{DMatch, Keypoint, UnionFind};

/// A keypoint of a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Observation {
    /// Index of the view.
    pub view: u32,
    /// Index of the keypoint in it.
    pub keypoint: u32,
}

/// Matches between the keypoints of two views that agree with their geometry.
#[derive(Debug, Clone, PartialEq)]
pub struct PairMatches {
    /// The view of `DMatch::query`.
    pub a: usize,
    /// The view of `DMatch::train`.
    pub b: usize,
    /// The matches; a smaller distance is a surer one.
    pub matches: Vec<DMatch>,
    /// Those among features that were tried alike in all pairs: what is missing of them tells different things that look alike. None: of `matches` all were. Empty: of this pair they are not known.
    pub sample: Option<Vec<DMatch>>,
}

impl PairMatches {
    /// Matches among all features of both views, found alike in all pairs.
    pub fn new(a: usize, b: usize, matches: Vec<DMatch>) -> Self {
        Self { a, b, matches, sample: None }
    }

    /// The matches among features that were tried alike in all pairs.
    pub fn sample(&self) -> &[DMatch] {
        self.sample.as_ref().unwrap_or(&self.matches)
    }
}

/// Lists of observations, no two of one view in a list.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Tracks {
    /// Where each list starts, and the end.
    start: Vec<usize>,
    observations: Vec<Observation>,
}

impl Tracks {
    /// From lists.
    pub fn from_lists(lists: impl IntoIterator<Item = Vec<Observation>>) -> Self {
        let mut tracks = Self { start: vec![0], observations: Vec::new() };
        for list in lists {
            tracks.observations.extend(list);
            tracks.start.push(tracks.observations.len());
        }
        tracks
    }

    /// Joins matched keypoints to tracks of two and more views.
    ///
    /// The surest matches (by distance) come first, and one that would put two places of a view into one track is left out: that is how a wrong match between
    /// two right tracks costs itself alone. Features at one place (of several orientations or scales) count as one. Matches of views or keypoints that there are not are
    /// left out. O(m log m) of m matches.
    pub fn build<'p>(views: &[&[Keypoint]], pairs: impl IntoIterator<Item = &'p PairMatches>) -> Self {
        let mut joiner = TrackJoiner::new(views);
        let mut joins = Vec::new();
        for pair in pairs.into_iter().filter(|p| p.a != p.b) {
            let of = |view: usize, keypoint: u32| Observation { view: view as u32, keypoint };
            joins.extend(pair.matches.iter().map(|m| (m.distance, of(pair.a, m.query), of(pair.b, m.train))));
        }
        joiner.join(&joins);
        joiner.finish()
    }

    /// Number of tracks.
    pub fn len(&self) -> usize {
        self.start.len().saturating_sub(1)
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The observations of all tracks, track after track.
    pub fn observations(&self) -> &[Observation] {
        &self.observations
    }

    /// Where the observations of a track are among all.
    ///
    /// # Panics
    /// Where there is no such track.
    pub fn range(&self, track: usize) -> std::ops::Range<usize> {
        self.start[track]..self.start[track + 1]
    }
}

/// Two features of a view that are nearer than this are of one place, in pixels: of several orientations, or of neighboring scales.
const SAME_PLACE: f32 = 1.0;

/// Sets of observations that grow by joining.
pub(crate) struct TrackJoiner<'v> {
    views: &'v [&'v [Keypoint]],
    /// The number of the first keypoint of each view, where all are counted on.
    first: Vec<u32>,
    /// Of each keypoint the first of its view at exactly its place.
    place: Vec<u32>,
    sets: UnionFind,
    /// The keypoints of each set of two and more, ascending, and so by view: kept with the root.
    members: Vec<Vec<u32>>,
}

impl<'v> TrackJoiner<'v> {
    /// Every keypoint in a set of its own.
    pub(crate) fn new(views: &'v [&'v [Keypoint]]) -> Self {
        let mut first = Vec::with_capacity(views.len());
        let mut total = 0u32;
        for view in views {
            first.push(total);
            total += view.len() as u32;
        }
        let place = places(views, &first);
        let sets = UnionFind::new(total as usize);
        Self { views, first, place, sets, members: vec![Vec::new(); total as usize] }
    }

    /// Joins the sets of two observations each, the surest (least number) first, where no view comes to have two places in a set. Observations that there are not are left out.
    pub(crate) fn join(&mut self, joins: &[(f32, Observation, Observation)]) {
        let item = |o: Observation| {
            let known = self.views.get(o.view as usize).is_some_and(|view| (o.keypoint as usize) < view.len());
            known.then(|| self.place[(self.first[o.view as usize] + o.keypoint) as usize])
        };
        let known = joins.iter().filter_map(|(distance, a, b)| Some((*distance, item(*a)?, item(*b)?)));
        let mut edges: Vec<(f32, u32, u32)> = known.map(|(d, a, b)| (d, a.min(b), a.max(b))).collect();
        edges.sort_unstable_by(|x, y| x.0.total_cmp(&y.0).then((x.1, x.2).cmp(&(y.1, y.2))));
        for (_, i, j) in edges {
            let (i, j) = (self.sets.find(i), self.sets.find(j));
            if i == j {
                continue;
            }
            let take = |list: &mut Vec<u32>, item: u32| if list.is_empty() { vec![item] } else { std::mem::take(list) };
            let (one, two) = (take(&mut self.members[i as usize], i), take(&mut self.members[j as usize], j));
            match merged(&one, &two, |item| self.view_of(item), |i, j| self.near(i, j)) {
                Some(all) => {
                    self.sets.union(i, j);
                    self.members[i.min(j) as usize] = all;
                }
                None => (self.members[i as usize], self.members[j as usize]) = (one, two),
            }
        }
    }

    /// The sets of two observations and more.
    pub(crate) fn finish(self) -> Tracks {
        let observation = |item: u32| {
            let view = self.view_of(item);
            Observation { view: view as u32, keypoint: item - self.first[view] }
        };
        let lists = self.members.iter().filter(|list| list.len() > 1);
        Tracks::from_lists(lists.map(|list| list.iter().map(|item| observation(*item)).collect()))
    }

    fn view_of(&self, item: u32) -> usize {
        self.first.partition_point(|f| *f <= item) - 1
    }

    fn near(&self, i: u32, j: u32) -> bool {
        let at = |item: u32| {
            let view = self.view_of(item);
            self.views[view][(item - self.first[view]) as usize].position
        };
        (at(i) - at(j)).norm() <= SAME_PLACE
    }
}

/// Of each keypoint the first of its view at the same place.
fn places(views: &[&[Keypoint]], first: &[u32]) -> Vec<u32> {
    let mut place = Vec::with_capacity(views.iter().map(|v| v.len()).sum());
    for (view, first) in views.iter().zip(first) {
        let bits = |k: &Keypoint| (k.position.x.to_bits(), k.position.y.to_bits());
        let mut order: Vec<u32> = (0..view.len() as u32).collect();
        order.sort_unstable_by_key(|&i| (bits(&view[i as usize]), i));
        let base = place.len();
        place.resize(base + view.len(), 0);
        let mut head = 0;
        for (n, &i) in order.iter().enumerate() {
            if n == 0 || bits(&view[i as usize]) != bits(&view[head as usize]) {
                head = i;
            }
            place[base + i as usize] = first + head;
        }
    }
    place
}

/// Two lists, ascending by view, as one; `None` where a view is in both at two places. Where its places are near each other, that of the longer list stays.
fn merged(
    one: &[u32],
    two: &[u32],
    view_of: impl Fn(u32) -> usize,
    near: impl Fn(u32, u32) -> bool,
) -> Option<Vec<u32>> {
    let (long, short) = if one.len() >= two.len() { (one, two) } else { (two, one) };
    let mut all = Vec::with_capacity(long.len() + short.len());
    let (mut i, mut j) = (0, 0);
    while i < long.len() && j < short.len() {
        let (a, b) = (view_of(long[i]), view_of(short[j]));
        if a == b && !near(long[i], short[j]) {
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
    fn matches_become_tracks_and_the_surest_win() {
        let views = [view(4), view(4), view(4)];
        let views: Vec<&[Keypoint]> = views.iter().map(Vec::as_slice).collect();
        let pairs = [
            matches(0, 1, &[(0, 1, 0.1), (2, 3, 0.1)]),
            // Keypoint 3 of view 1 is in a track with keypoint 2 of view 0 already: the less sure way back to keypoint 0 is left out.
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
    fn features_at_one_place_are_one() {
        let mut twice = view(3);
        twice[2].position = twice[0].position;
        let other = view(2);
        let pairs = [matches(0, 1, &[(2, 1, 0.1), (0, 1, 0.2), (1, 0, 0.3)])];
        let tracks = Tracks::build(&[&twice, &other], &pairs);
        assert_eq!(lists(&tracks), [vec![(0, 0), (1, 1)], vec![(0, 1), (1, 0)]]);
    }
}
