//! The view graph: relative poses of pairs of views, and whether they agree with each other.

use crate::rotation_averaging::average_rotations;
use crate::translation_direction::motion_of_rotation;
use crate::{SfmInput, SfmOptions, ViewPairModel};
use cv_core::{Camera, Cancelled, Correspondence, Pose, Progress, Stage, Vector3};
use cv_geometry::{
    EstimateError, PairEdge, PairGraph, RobustOptions, estimate_relative_pose, normalize_matches, refine_relative_pose,
};
use rayon::prelude::*;

/// Why a pair of views is not used although its matches agree with a geometry.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum PairRefusal {
    /// The rotations of none of its loops with two other pairs close.
    Triplets {
        /// Number of loops.
        loops: usize,
    },
    /// Both views show things that look alike: one has less of what the other shows than of what views from farther away show.
    Repeated {
        /// The share of the features of one view, known from other pairs, that the other view has.
        found: f64,
        /// The share that it has of a view from farther away.
        expected: f64,
    },
    /// It agrees with pairs that are refused as [`PairRefusal::Repeated`].
    RepeatedLoops {
        /// Loops that close with one right pair and a refused one.
        against: usize,
        /// These, and loops with two right pairs.
        of: usize,
    },
}

/// A pair of views that is not used.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RefusedPair {
    /// Its index among those that were given.
    pub pair: usize,
    /// Why.
    pub reason: PairRefusal,
}

/// A pair of views with its relative pose.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Link {
    /// Index of the pair.
    pub(crate) pair: usize,
    pub(crate) a: usize,
    pub(crate) b: usize,
    /// From the frame of `a` to that of `b`, the translation of length one.
    pub(crate) pose: Pose,
    /// Number of matches.
    pub(crate) matches: usize,
}

/// Views and the relative poses of their pairs.
#[derive(Debug, Clone, Default)]
pub(crate) struct ViewGraph {
    pub(crate) views: usize,
    pub(crate) links: Vec<Link>,
}

/// Largest angle of the rotation that is left after a loop of three pairs, in radians: 5 degrees. Of templeRing and a drive (kitti-2), all 78 pairs of 1,350 that are refused with it are wrong by 6
/// degrees and more in the end.
const LOOP: f64 = 0.087;
/// Most loops that are looked at: 1,000 views with 40 pairs each have 260,000.
const MOST_LOOPS: usize = 2_000_000;
/// Smallest share of a pair's matches that agree with the rotation that loops give it, for the pair to be kept.
const AGREES: f64 = 0.8;
/// Fewest loops of a pair that is refused: where there is one, another of its pairs may be the wrong one.
const LEAST_LOOPS: usize = 2;

impl ViewGraph {
    /// Relative poses of all pairs: as they were given, or by the focal lengths of `cameras` where the pairs have a fundamental matrix or a homography. Pairs without one are left out.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub(crate) fn new(
        input: &SfmInput<'_>,
        cameras: &[Camera],
        options: &SfmOptions,
        progress: &dyn Progress,
    ) -> Result<Self, Cancelled> {
        let stage = Stage::new(progress, "graph", input.pairs.len())?;
        let link = |pair: usize| {
            let pose = relative_pose(input, cameras, pair, options, &stage)?;
            stage.add(1)?;
            let (a, b) = (input.pairs[pair].a, input.pairs[pair].b);
            let matches = input.pairs[pair].matches.len();
            Ok(pose.map(|pose| Link { pair, a, b, pose, matches }))
        };
        let links: Vec<Option<Link>> = (0..input.pairs.len()).into_par_iter().map(link).collect::<Result<_, _>>()?;
        Ok(Self { views: input.views.len(), links: links.into_iter().flatten().collect() })
    }

    /// The links that are kept, in a graph of their own.
    pub(crate) fn filtered(&self, keep: impl Fn(&Link) -> bool) -> Self {
        Self { views: self.views, links: self.links.iter().filter(|l| keep(l)).copied().collect() }
    }

    /// The links as edges, as many as links.
    pub(crate) fn edges(&self, weight: impl Fn(usize) -> f64) -> Option<PairGraph> {
        let edge = |(i, l): (usize, &Link)| PairEdge { a: l.a, b: l.b, weight: weight(i) };
        PairGraph::new(self.views, self.links.iter().enumerate().map(edge).collect()).ok()
    }

    /// The part of most views, with the links within it.
    pub(crate) fn largest_component(&self) -> Self {
        let component = self.edges(|i| self.links[i].matches as f64).map(|g| g.connected_components());
        let mut inside = vec![false; self.views];
        component.iter().flat_map(|c| c.first()).flatten().for_each(|v| inside[*v] = true);
        self.filtered(|l| inside[l.a])
    }

    /// Loops of three links, as indices of links; of very many, some evenly.
    fn triplets(&self) -> Vec<[usize; 3]> {
        let mut neighbors: Vec<Vec<(usize, usize)>> = vec![Vec::new(); self.views];
        for (i, l) in self.links.iter().enumerate() {
            neighbors[l.a.min(l.b)].push((l.a.max(l.b), i));
        }
        neighbors.iter_mut().for_each(|list| list.sort_unstable());
        let all = |found: &mut dyn FnMut([usize; 3])| {
            for list in &neighbors {
                for (n, &(b, ab)) in list.iter().enumerate() {
                    let (mut rest, mut others) = (&list[n + 1..], &neighbors[b][..]);
                    // Both ascend: views that are neighbors of the lowest of the three and of the middle one.
                    while let (Some(x), Some(y)) = (rest.first(), others.first()) {
                        if x.0 == y.0 {
                            found([ab, y.1, x.1]);
                        }
                        (rest, others) = (&rest[usize::from(x.0 <= y.0)..], &others[usize::from(y.0 <= x.0)..]);
                    }
                }
            }
        };
        let mut count = 0;
        all(&mut |_| count += 1);
        let step = usize::div_ceil(count, MOST_LOOPS).max(1);
        let (mut loops, mut n) = (Vec::with_capacity(count / step + 1), 0);
        all(&mut |triplet| {
            if n % step == 0 {
                loops.push(triplet);
            }
            n += 1;
        });
        loops
    }

    /// The rotation that is left after a loop, in radians.
    fn loop_angle(&self, [ab, bc, ac]: [usize; 3]) -> f64 {
        let forward = |i: usize| {
            let l = &self.links[i];
            if l.a < l.b { l.pose.rotation } else { l.pose.rotation.inverse() }
        };
        let left = forward(ac).inverse() * forward(bc) * forward(ab);
        Pose::new(left, Vector3::zeros()).rotation_angle()
    }

    /// Loops of three links whose rotations close.
    pub(crate) fn closed_triplets(&self) -> Vec<[usize; 3]> {
        self.triplets().into_par_iter().filter(|t| self.loop_angle(*t) <= LOOP).collect()
    }

    /// Refuses links that no loop confirms, but for those whose matches agree with what loops say of their rotation: of a flat scene two poses agree with the matches, and the wrong one may have
    /// been taken. Those get the other.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub(crate) fn refuse_by_triplets(
        &mut self,
        input: &SfmInput<'_>,
        cameras: &[Camera],
        options: &SfmOptions,
        stage: &Stage<'_>,
    ) -> Result<Vec<RefusedPair>, Cancelled> {
        let suspects = self.take_unconfirmed();
        if suspects.is_empty() {
            return Ok(Vec::new());
        }
        let rotations = average_rotations(&self.largest_component(), stage)?;
        let repaired = |(link, _): &(Link, usize)| {
            let rotation = rotations[link.b]? * rotations[link.a]?.inverse();
            let (rays, unit) = rays(input, cameras, link.pair);
            let threshold = options.growing_error() * unit;
            let (pose, share) = motion_of_rotation(&rotation, &rays, threshold)?;
            let enough = share >= AGREES && share * rays.len() as f64 >= options.min_pose_inliers as f64;
            enough.then(|| Link { pose: refine_relative_pose(&pose, &rays, threshold).0, ..*link })
        };
        let repaired: Vec<Option<Link>> = suspects.par_iter().map(repaired).collect();
        let mut refused = Vec::new();
        for ((link, loops), repaired) in suspects.iter().zip(repaired) {
            match repaired {
                Some(link) => self.links.push(link),
                None => refused.push(RefusedPair { pair: link.pair, reason: PairRefusal::Triplets { loops: *loops } }),
            }
        }
        self.links.sort_unstable_by_key(|l| l.pair);
        Ok(refused)
    }

    /// Takes out the links that no loop confirms, each with the number of its loops: where the rotations of three pairs do not close, one of them is wrong (Zach, Klopschitz & Pollefeys,
    /// "Disambiguating visual relations using loop constraints", CVPR 2010). The link with most open loops and no closed one goes first, since its loops tell nothing of the other links any
    /// more. O(loops · log).
    fn take_unconfirmed(&mut self) -> Vec<(Link, usize)> {
        let loops: Vec<([usize; 3], bool)> =
            self.triplets().into_par_iter().map(|t| (t, self.loop_angle(t) <= LOOP)).collect();
        let mut closed = vec![0usize; self.links.len()];
        let mut open = vec![0usize; self.links.len()];
        let mut of_link: Vec<Vec<usize>> = vec![Vec::new(); self.links.len()];
        for (l, (links, closes)) in loops.iter().enumerate() {
            for i in links {
                if *closes {
                    closed[*i] += 1;
                } else {
                    open[*i] += 1;
                    of_link[*i].push(l);
                }
            }
        }
        let mut dropped = vec![false; loops.len()];
        let mut taken = Vec::new();
        let mut gone = vec![false; self.links.len()];
        loop {
            let wrong = |i: &usize| !gone[*i] && closed[*i] == 0 && open[*i] >= LEAST_LOOPS;
            let Some(worst) = (0..self.links.len()).filter(wrong).max_by_key(|i| (open[*i], usize::MAX - i)) else {
                break;
            };
            gone[worst] = true;
            taken.push((self.links[worst], open[worst]));
            for l in std::mem::take(&mut of_link[worst]) {
                if !std::mem::replace(&mut dropped[l], true) {
                    loops[l].0.iter().for_each(|i| open[*i] -= 1);
                }
            }
        }
        let mut index = 0..;
        self.links.retain(|_| index.next().is_none_or(|i: usize| !gone[i]));
        taken.sort_unstable_by_key(|t| t.0.pair);
        taken
    }
}

/// The matches of a pair in normalized coordinates, those that the lenses reach, and a pixel in that unit.
fn rays(input: &SfmInput<'_>, cameras: &[Camera], pair: usize) -> (Vec<Correspondence>, f64) {
    let pair = &input.pairs[pair];
    let [a, b] = [&input.views[pair.a], &input.views[pair.b]];
    let pixels: Vec<Correspondence> =
        pair.matches.iter().filter_map(|m| m.correspondence(a.keypoints, b.keypoints)).collect();
    let (mut rays, unit) = normalize_matches(&pixels, &cameras[a.camera], &cameras[b.camera]);
    rays.retain(Correspondence::is_finite);
    (rays, unit)
}

/// Matches that a relative pose is looked for with, evenly from all of a pair, before all of them refine it: they agree with a geometry already.
const ENOUGH: usize = 400;

/// From the matches anew where the pair's geometry is no pose: a fundamental matrix of a nearly flat scene says little of the rotation, and five matches are enough where focal lengths are known.
fn relative_pose(
    input: &SfmInput<'_>,
    cameras: &[Camera],
    pair: usize,
    options: &SfmOptions,
    progress: &dyn Progress,
) -> Result<Option<Pose>, Cancelled> {
    if let ViewPairModel::Pose(pose) = input.geometry[pair] {
        return Ok(Some(pose));
    }
    let (rays, unit) = rays(input, cameras, pair);
    let threshold = options.growing_error() * unit;
    let step = rays.len().div_ceil(ENOUGH).max(1);
    let some: Vec<Correspondence> = rays.iter().step_by(step).copied().collect();
    let robust = RobustOptions { threshold, seed: options.seed, max_iterations: 1000, ..RobustOptions::essential() };
    match estimate_relative_pose(&some, &robust, progress) {
        Ok(found) => Ok(Some(refine_relative_pose(&found.model, &rays, threshold).0)),
        Err(EstimateError::Cancelled(stop)) => Err(stop),
        Err(_) => Ok(None),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Rotation3;

    /// All pairs of `views` views with random rotations; those of `wrong` turned by `by` radians.
    fn graph(views: usize, wrong: &[(usize, usize)], by: f64) -> ViewGraph {
        let rotation = |i: usize| Rotation3::from_euler_angles(0.3 * i as f64, 1.0 / (1.0 + i as f64), -0.2 * i as f64);
        let pairs = (0..views).flat_map(|a| (a + 1..views).map(move |b| (a, b)));
        let link = |(pair, (a, b)): (usize, (usize, usize))| {
            let turn = Rotation3::new(Vector3::new(0.0, if wrong.contains(&(a, b)) { by } else { 0.0 }, 0.0));
            let pose = Pose::new(turn * rotation(b) * rotation(a).inverse(), Vector3::x());
            // Every other pair is given from the later view to the earlier.
            match pair % 2 {
                0 => Link { pair, a, b, pose, matches: 100 },
                _ => Link { pair, a: b, b: a, pose: pose.inverse(), matches: 100 },
            }
        };
        ViewGraph { views, links: pairs.enumerate().map(link).collect() }
    }

    #[test]
    fn pairs_that_no_loop_confirms_are_refused_and_no_others() {
        let wrong = [(0, 1), (2, 5), (3, 4)];
        let mut graph = graph(7, &wrong, 0.5);
        assert_eq!(graph.triplets().len(), 35);
        let of = |pair: usize| {
            let all: Vec<(usize, usize)> = (0..7).flat_map(|a| (a + 1..7).map(move |b| (a, b))).collect();
            all[pair]
        };
        let taken = graph.take_unconfirmed();
        assert_eq!(taken.iter().map(|t| of(t.0.pair)).collect::<Vec<_>>(), wrong);
        // Five other views close a loop with each pair.
        assert!(taken.iter().all(|t| t.1 == 5), "{taken:?}");
        assert_eq!(graph.links.len(), 18);
        // Everything that is left closes: none is refused.
        assert!(graph.closed_triplets().len() == graph.triplets().len() && graph.take_unconfirmed().is_empty());
    }

    #[test]
    fn one_open_loop_does_not_say_which_of_its_pairs_is_wrong() {
        assert!(graph(3, &[(0, 1)], 0.5).take_unconfirmed().is_empty());
        // And 3 degrees are what a wrong focal length does.
        assert!(graph(6, &[(0, 1)], 0.05).take_unconfirmed().is_empty());
    }

    #[test]
    fn the_largest_part_is_kept_with_its_links() {
        let mut parted = graph(7, &[], 0.0);
        parted.links.retain(|l| (l.a < 3) == (l.b < 3));
        let largest = parted.largest_component();
        assert!(largest.links.len() == 6 && largest.links.iter().all(|l| l.a >= 3 && l.b >= 3));
    }
}
