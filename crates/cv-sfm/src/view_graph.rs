//! The view graph: relative poses of pairs of views, and their triplet consistency.

use crate::rotation_averaging::average_rotations;
use crate::translation_direction::pose_given_rotation;
use crate::{SfmInput, SfmOptions, ViewPairModel};
use cv_core::{Camera, Cancelled, Correspondence, Pose, Progress, Stage, Vector3};
use cv_geometry::{
    EstimateError, PairEdge, PairGraph, RobustOptions, estimate_relative_pose, normalize_matches, refine_relative_pose,
};
use cv_parallel::prelude::*;

/// Why a verified pair of views is rejected.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum PairRefusal {
    /// None of its triplets of pairs has consistent rotations.
    Triplets {
        /// Number of triplets.
        loops: usize,
    },
    /// Repeated structure: one view matches less of the other view than of views farther away.
    Repeated {
        /// Ratio of the features of one view, confirmed by other pairs, that are matched in the other view.
        found: f64,
        /// Largest such ratio with a view at the same or a larger viewpoint change.
        expected: f64,
    },
    /// Triplet consistency with pairs that are rejected as [`PairRefusal::Repeated`].
    RepeatedLoops {
        /// Consistent triplets with one accepted and one rejected pair.
        against: usize,
        /// These, and consistent triplets with two accepted pairs.
        of: usize,
    },
}

/// A rejected pair of views.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RefusedPair {
    /// Its index among the input pairs.
    pub pair: usize,
    /// The reason.
    pub reason: PairRefusal,
}

/// An edge of the view graph: a pair of views with its relative pose.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Link {
    /// Index of the pair.
    pub(crate) pair: usize,
    pub(crate) a: usize,
    pub(crate) b: usize,
    /// From the frame of `a` to that of `b`, with a unit translation.
    pub(crate) pose: Pose,
    /// Number of matches.
    pub(crate) matches: usize,
}

/// The view graph: views and the relative poses of their pairs.
#[derive(Debug, Clone, Default)]
pub(crate) struct ViewGraph {
    pub(crate) views: usize,
    pub(crate) links: Vec<Link>,
}

/// Largest angle of the composed rotation of a consistent triplet, in radians: 5 degrees. All 78 pairs of 1,350 that it
/// rejects on templeRing and a drive (kitti-2) are in the end wrong by 6 degrees and more.
const MAX_TRIPLET_ANGLE: f64 = 0.087;
/// Maximum number of triplets that are tested: 1,000 views with 40 pairs each have 260,000.
const MAX_TRIPLETS: usize = 2_000_000;
/// Minimum inlier ratio of a pair with the rotation that its triplets predict, for the pair to be kept.
const MIN_INLIER_RATIO: f64 = 0.8;
/// Minimum number of triplets of a rejected pair: with one, another of its pairs may be the wrong one.
const MIN_TRIPLETS: usize = 2;

impl ViewGraph {
    /// Computes the relative poses of all pairs: as given, or by the focal lengths of `cameras` where the geometry is a
    /// fundamental matrix or a homography. Pairs without a pose are left out.
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
        let links: Vec<Option<Link>> = (0..input.pairs.len()).into_par_iter().map(link).try_collect()?;
        Ok(Self { views: input.views.len(), links: links.into_iter().flatten().collect() })
    }

    /// Returns the graph of the links that `keep` accepts.
    pub(crate) fn filtered(&self, keep: impl Fn(&Link) -> bool) -> Self {
        Self { views: self.views, links: self.links.iter().filter(|l| keep(l)).copied().collect() }
    }

    /// Returns the weighted graph of the links, with one edge for each link.
    pub(crate) fn edges(&self, weight: impl Fn(usize) -> f64) -> Option<PairGraph> {
        let edge = |(i, l): (usize, &Link)| PairEdge { a: l.a, b: l.b, weight: weight(i) };
        PairGraph::new(self.views, self.links.iter().enumerate().map(edge).collect()).ok()
    }

    /// Returns the connected component with most views.
    pub(crate) fn largest_component(&self) -> Self {
        let component = self.edges(|i| self.links[i].matches as f64).map(|g| g.connected_components());
        let mut inside = vec![false; self.views];
        component.iter().flat_map(|c| c.first()).flatten().for_each(|v| inside[*v] = true);
        self.filtered(|l| inside[l.a])
    }

    /// Returns the triplets of mutually linked views, as link indices; evenly sampled if there are too many.
    fn triplets(&self) -> Vec<[usize; 3]> {
        let mut neighbors: Vec<Vec<(usize, usize)>> = vec![Vec::new(); self.views];
        for (i, l) in self.links.iter().enumerate() {
            neighbors[l.a.min(l.b)].push((l.a.max(l.b), i));
        }
        neighbors.iter_mut().for_each(|list| list.sort_unstable());
        let for_each_triplet = |visit: &mut dyn FnMut([usize; 3])| {
            for list in &neighbors {
                for (n, &(b, ab)) in list.iter().enumerate() {
                    let (mut rest, mut others) = (&list[n + 1..], &neighbors[b][..]);
                    // Both lists are sorted: common neighbors of the lowest and the middle view of the triplet.
                    while let (Some(x), Some(y)) = (rest.first(), others.first()) {
                        if x.0 == y.0 {
                            visit([ab, y.1, x.1]);
                        }
                        (rest, others) = (&rest[usize::from(x.0 <= y.0)..], &others[usize::from(y.0 <= x.0)..]);
                    }
                }
            }
        };
        let mut count = 0;
        for_each_triplet(&mut |_| count += 1);
        let step = usize::div_ceil(count, MAX_TRIPLETS).max(1);
        let (mut triplets, mut n) = (Vec::with_capacity(count / step + 1), 0);
        for_each_triplet(&mut |triplet| {
            if n % step == 0 {
                triplets.push(triplet);
            }
            n += 1;
        });
        triplets
    }

    /// Returns the angle of the composed rotation of a triplet, in radians.
    fn triplet_angle(&self, [ab, bc, ac]: [usize; 3]) -> f64 {
        let forward = |i: usize| {
            let l = &self.links[i];
            if l.a < l.b { l.pose.rotation } else { l.pose.rotation.inverse() }
        };
        let composed = forward(ac).inverse() * forward(bc) * forward(ab);
        Pose::new(composed, Vector3::zeros()).rotation_angle()
    }

    /// Returns the triplets with consistent rotations.
    pub(crate) fn consistent_triplets(&self) -> Vec<[usize; 3]> {
        let is_consistent = |t: [usize; 3]| (self.triplet_angle(t) <= MAX_TRIPLET_ANGLE).then_some(t);
        self.triplets().into_par_iter().map(is_consistent).collect().into_iter().flatten().collect()
    }

    /// Rejects the links without a consistent triplet, unless their matches agree with the rotation that triplets
    /// predict: two poses explain the matches of a planar scene, and the wrong one may have been selected. Such links
    /// get the other pose.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub(crate) fn reject_by_triplets(
        &mut self,
        input: &SfmInput<'_>,
        cameras: &[Camera],
        options: &SfmOptions,
        stage: &Stage<'_>,
    ) -> Result<Vec<RefusedPair>, Cancelled> {
        let suspects = self.remove_inconsistent();
        if suspects.is_empty() {
            return Ok(Vec::new());
        }
        let rotations = average_rotations(&self.largest_component(), stage)?;
        let repaired = |(link, _): &(Link, usize)| {
            let rotation = rotations[link.b]? * rotations[link.a]?.inverse();
            let (rays, unit) = normalized_matches(input, cameras, link.pair);
            let threshold = options.initial_error() * unit;
            let (pose, inlier_ratio) = pose_given_rotation(&rotation, &rays, threshold)?;
            let has_enough =
                inlier_ratio >= MIN_INLIER_RATIO && inlier_ratio * rays.len() as f64 >= options.min_pose_inliers as f64;
            has_enough.then(|| Link { pose: refine_relative_pose(&pose, &rays, threshold).0, ..*link })
        };
        let repaired: Vec<Option<Link>> = suspects.par_iter().map(repaired).collect();
        let mut refused = Vec::new();
        for ((link, triplets), repaired) in suspects.iter().zip(repaired) {
            match repaired {
                Some(link) => self.links.push(link),
                None => {
                    refused.push(RefusedPair { pair: link.pair, reason: PairRefusal::Triplets { loops: *triplets } })
                }
            }
        }
        self.links.sort_unstable_by_key(|l| l.pair);
        Ok(refused)
    }

    /// Removes the links without a consistent triplet and returns each with its number of triplets: if the rotations of
    /// three pairs are not consistent, one of them is wrong (Zach, Klopschitz & Pollefeys, "Disambiguating visual
    /// relations using loop constraints", CVPR 2010). Greedy: the link with most inconsistent triplets goes first, and
    /// its triplets no longer count against the other links. O(triplets · log).
    fn remove_inconsistent(&mut self) -> Vec<(Link, usize)> {
        let triplets: Vec<([usize; 3], bool)> =
            self.triplets().into_par_iter().map(|t| (t, self.triplet_angle(t) <= MAX_TRIPLET_ANGLE)).collect();
        let mut consistent = vec![0usize; self.links.len()];
        let mut inconsistent = vec![0usize; self.links.len()];
        let mut inconsistent_of_link: Vec<Vec<usize>> = vec![Vec::new(); self.links.len()];
        for (l, (links, is_consistent)) in triplets.iter().enumerate() {
            for i in links {
                if *is_consistent {
                    consistent[*i] += 1;
                } else {
                    inconsistent[*i] += 1;
                    inconsistent_of_link[*i].push(l);
                }
            }
        }
        let mut is_dropped = vec![false; triplets.len()];
        let mut removed = Vec::new();
        let mut is_removed = vec![false; self.links.len()];
        loop {
            let is_inconsistent =
                |i: &usize| !is_removed[*i] && consistent[*i] == 0 && inconsistent[*i] >= MIN_TRIPLETS;
            let Some(worst) =
                (0..self.links.len()).filter(is_inconsistent).max_by_key(|i| (inconsistent[*i], usize::MAX - i))
            else {
                break;
            };
            is_removed[worst] = true;
            removed.push((self.links[worst], inconsistent[worst]));
            for l in std::mem::take(&mut inconsistent_of_link[worst]) {
                if !std::mem::replace(&mut is_dropped[l], true) {
                    triplets[l].0.iter().for_each(|i| inconsistent[*i] -= 1);
                }
            }
        }
        let mut index = 0..;
        self.links.retain(|_| index.next().is_none_or(|i: usize| !is_removed[i]));
        removed.sort_unstable_by_key(|t| t.0.pair);
        removed
    }
}

/// Returns the matches of a pair in normalized coordinates, within the range of the distortion model, and the size of a
/// pixel in that unit.
fn normalized_matches(input: &SfmInput<'_>, cameras: &[Camera], pair: usize) -> (Vec<Correspondence>, f64) {
    let pair = &input.pairs[pair];
    let [a, b] = [&input.views[pair.a], &input.views[pair.b]];
    let pixels: Vec<Correspondence> =
        pair.matches.iter().filter_map(|m| m.correspondence(a.keypoints, b.keypoints)).collect();
    let (mut rays, unit) = normalize_matches(&pixels, &cameras[a.camera], &cameras[b.camera]);
    rays.retain(Correspondence::is_finite);
    (rays, unit)
}

/// Maximum number of matches, evenly sampled, that RANSAC estimates a relative pose from; all matches then refine it.
/// They are inliers of a geometry already.
const MAX_RANSAC_MATCHES: usize = 400;

/// Returns the relative pose of a pair, estimated from the matches again if its geometry is not a pose: the fundamental
/// matrix of a nearly planar scene hardly determines the rotation, and the five-point method with known focal lengths
/// does.
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
    let (rays, unit) = normalized_matches(input, cameras, pair);
    let threshold = options.initial_error() * unit;
    let step = rays.len().div_ceil(MAX_RANSAC_MATCHES).max(1);
    let sampled: Vec<Correspondence> = rays.iter().step_by(step).copied().collect();
    let robust = RobustOptions { threshold, seed: options.seed, max_iterations: 1000, ..RobustOptions::essential() };
    match estimate_relative_pose(&sampled, &robust, progress) {
        Ok(estimate) => Ok(Some(refine_relative_pose(&estimate.model, &rays, threshold).0)),
        Err(EstimateError::Cancelled(stop)) => Err(stop),
        Err(_) => Ok(None),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Rotation3;

    /// All pairs of `views` views with different rotations; those of `wrong` have an error of `by` radians.
    fn graph(views: usize, wrong: &[(usize, usize)], angle: f64) -> ViewGraph {
        let rotation = |i: usize| Rotation3::from_euler_angles(0.3 * i as f64, 1.0 / (1.0 + i as f64), -0.2 * i as f64);
        let pairs = (0..views).flat_map(|a| (a + 1..views).map(move |b| (a, b)));
        let link = |(pair, (a, b)): (usize, (usize, usize))| {
            let error = Rotation3::new(Vector3::new(0.0, if wrong.contains(&(a, b)) { angle } else { 0.0 }, 0.0));
            let pose = Pose::new(error * rotation(b) * rotation(a).inverse(), Vector3::x());
            // Every other pair is given in reverse order.
            match pair % 2 {
                0 => Link { pair, a, b, pose, matches: 100 },
                _ => Link { pair, a: b, b: a, pose: pose.inverse(), matches: 100 },
            }
        };
        ViewGraph { views, links: pairs.enumerate().map(link).collect() }
    }

    #[test]
    fn exactly_the_pairs_without_a_consistent_triplet_are_removed() {
        let wrong = [(0, 1), (2, 5), (3, 4)];
        let mut graph = graph(7, &wrong, 0.5);
        assert_eq!(graph.triplets().len(), 35);
        let of = |pair: usize| {
            let all: Vec<(usize, usize)> = (0..7).flat_map(|a| (a + 1..7).map(move |b| (a, b))).collect();
            all[pair]
        };
        let removed = graph.remove_inconsistent();
        assert_eq!(removed.iter().map(|t| of(t.0.pair)).collect::<Vec<_>>(), wrong);
        // Each pair is in a triplet with five other views.
        assert!(removed.iter().all(|t| t.1 == 5), "{removed:?}");
        assert_eq!(graph.links.len(), 18);
        // All remaining triplets are consistent: no pair is removed.
        assert!(graph.consistent_triplets().len() == graph.triplets().len() && graph.remove_inconsistent().is_empty());
    }

    #[test]
    fn a_single_inconsistent_triplet_removes_no_pair() {
        assert!(graph(3, &[(0, 1)], 0.5).remove_inconsistent().is_empty());
        // Errors of 3 degrees are within the tolerance: a wrong focal length causes them.
        assert!(graph(6, &[(0, 1)], 0.05).remove_inconsistent().is_empty());
    }

    #[test]
    fn the_largest_component_has_all_its_links() {
        let mut split = graph(7, &[], 0.0);
        split.links.retain(|l| (l.a < 3) == (l.b < 3));
        let largest = split.largest_component();
        assert!(largest.links.len() == 6 && largest.links.iter().all(|l| l.a >= 3 && l.b >= 3));
    }
}
