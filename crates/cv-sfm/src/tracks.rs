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
    /// two right tracks costs itself alone. Features at one place (of several orientations) count as one. Matches of views or keypoints that there are not are
    /// left out. O(m log m) of m matches.
    pub fn build(views: &[&[Keypoint]], pairs: &[PairMatches]) -> Self {
        let mut first = Vec::with_capacity(views.len() + 1);
        let mut total = 0u32;
        for view in views {
            first.push(total);
            total += view.len() as u32;
        }
        let place = places(views, &first);
        let mut edges: Vec<(f32, u32, u32)> = Vec::with_capacity(pairs.iter().map(|p| p.matches.len()).sum());
        for pair in pairs {
            let known = pair.a < views.len() && pair.b < views.len() && pair.a != pair.b;
            for m in pair.matches.iter().filter(|_| known) {
                if (m.query as usize) < views[pair.a].len() && (m.train as usize) < views[pair.b].len() {
                    let of = |view: usize, keypoint: u32| place[(first[view] + keypoint) as usize];
                    let (i, j) = (of(pair.a, m.query), of(pair.b, m.train));
                    edges.push((m.distance, i.min(j), i.max(j)));
                }
            }
        }
        edges.sort_unstable_by(|x, y| x.0.total_cmp(&y.0).then((x.1, x.2).cmp(&(y.1, y.2))));

        let view_of = |item: u32| first.partition_point(|f| *f <= item) - 1;
        let mut sets = UnionFind::new(total as usize);
        // The items of each set of two and more, ascending, and so by view: kept with the root.
        let mut members: Vec<Vec<u32>> = vec![Vec::new(); total as usize];
        for (_, i, j) in edges {
            let (i, j) = (sets.find(i), sets.find(j));
            if i == j {
                continue;
            }
            let (one, two) = (std::mem::take(&mut members[i as usize]), std::mem::take(&mut members[j as usize]));
            let own = |list: Vec<u32>, item: u32| if list.is_empty() { vec![item] } else { list };
            let (one, two) = (own(one, i), own(two, j));
            match merged(&one, &two, view_of) {
                Some(all) => {
                    sets.union(i, j);
                    members[i.min(j) as usize] = all;
                }
                None => (members[i as usize], members[j as usize]) = (one, two),
            }
        }
        let observation = |item: u32| {
            let view = view_of(item);
            Observation { view: view as u32, keypoint: item - first[view] }
        };
        let lists = members.into_iter().filter(|list| list.len() > 1);
        Self::from_lists(lists.map(|list| list.into_iter().map(observation).collect()))
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

/// Two ascending lists as one, unless a view is in both.
fn merged(one: &[u32], two: &[u32], view_of: impl Fn(u32) -> usize) -> Option<Vec<u32>> {
    let mut all = Vec::with_capacity(one.len() + two.len());
    let (mut i, mut j) = (0, 0);
    while i < one.len() && j < two.len() {
        if one[i] < two[j] {
            all.push(one[i]);
            i += 1;
        } else {
            all.push(two[j]);
            j += 1;
        }
    }
    all.extend_from_slice(&one[i..]);
    all.extend_from_slice(&two[j..]);
    all.windows(2).all(|w| view_of(w[0]) != view_of(w[1])).then_some(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(n: usize) -> Vec<Keypoint> {
        (0..n).map(|i| Keypoint::new(i as f32, 0.0, 1.0)).collect()
    }

    fn matches(a: usize, b: usize, list: &[(u32, u32, f32)]) -> PairMatches {
        let of = |&(query, train, distance): &(u32, u32, f32)| DMatch { query, train, distance, ratio: 0.5 };
        PairMatches { a, b, matches: list.iter().map(of).collect() }
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
