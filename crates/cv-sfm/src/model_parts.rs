//! Consistency of a registered model: removes components that are in a wrong position or scale.

use crate::scene::Scene;
use crate::tree_paths::TreePaths;
use cv_core::{Cancelled, Keypoint, Point2, Stage, Vector3, quantile};
use cv_geometry::{PairEdge, PairGraph};
use cv_parallel::prelude::*;

/// By which observations the views of a pair are judged.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Consistency {
    /// Of the tracks that both views observe and that are inliers in one, those that are inliers in both. A component in
    /// a wrong position or scale has points of its own, which are outliers in the others. At least half must be.
    Inliers,
    /// Of the points of one view that the other one sees under nearly the same angle and at nearly the same distance, and
    /// as features of the larger half of the scales it observes (a blurred photograph has no small ones), those it
    /// observes. Views of another place that looks alike observe few: a thirtieth to an eighth on a rendered street, where
    /// right ones of five public sets observe half, and with a wrong focal length a quarter. At least a sixth must be. Of
    /// completed tracks only.
    VisiblePoints,
}

impl Consistency {
    /// Returns the largest number of observations for each one that agrees.
    fn max_for_one(self) -> usize {
        match self {
            Self::Inliers => 2,
            Self::VisiblePoints => 6,
        }
    }
}

/// Largest angle at a visible point between the directions to the two views, in radians.
const MAX_VISIBLE_ANGLE: f64 = 0.2;
/// Largest ratio of the distances of a visible point from the two views.
const MAX_VISIBLE_RATIO: f64 = 4.0 / 3.0;
/// Distance of a visible point from the image border, in pixels.
const VISIBLE_BORDER: f64 = 5.0;

/// Counts of observations of a pair of views, or of pairs.
#[derive(Debug, Clone, Copy, Default)]
struct Agreement {
    /// Those that agree.
    agree: usize,
    /// All.
    of: usize,
    /// Tracks that are inliers in both views.
    shared: usize,
}

impl Agreement {
    fn add(&mut self, other: &Self) {
        self.agree += other.agree;
        self.of += other.of;
        self.shared += other.shared;
    }

    /// Returns the number of observations that contradict in excess of those that [`Consistency`] allows; 0 where there
    /// are fewer than shared tracks, too few to judge by: views at large angles see no points alike.
    fn lacking(&self, consistency: Consistency) -> usize {
        let is_judged = self.of >= self.shared;
        if is_judged { self.of.saturating_sub(consistency.max_for_one() * self.agree) } else { 0 }
    }
}

/// A view that was removed from a model, with the agreement of its part with the others.
#[derive(Debug, Clone, Copy)]
pub(crate) struct RemovedView {
    pub(crate) view: usize,
    pub(crate) agree: usize,
    pub(crate) of: usize,
}

/// Removes the poses of all consistent components of at least `min_views` views but the largest.
///
/// Pairs with at least `min_shared` tracks that are inliers in both views make a maximum spanning forest. An edge of it
/// is cut if, over all `pairs` from one part to the other, too few observations agree ([`Consistency`]), the most
/// contradicted edge first: a few accidental matches do not hold parts together that thousands of others contradict.
/// Removed views can be registered again by the remaining points. Components in two scales that share a view are not
/// separated: pairs with that view do not depend on the scale. Returns the removed views.
/// O(observations of the views of all pairs + pairs · views for each cut).
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn keep_largest_consistent_component(
    scene: &mut Scene<'_>,
    pairs: &[(usize, usize)],
    consistency: Consistency,
    (min_shared, min_views): (usize, usize),
    stage: &Stage<'_>,
) -> Result<Vec<RemovedView>, Cancelled> {
    let is_registered = |v: usize| scene.poses[v].is_some();
    let pairs: Vec<(usize, usize)> =
        pairs.iter().filter(|(a, b)| is_registered(*a) && is_registered(*b)).copied().collect();
    let min_scales: Vec<f32> = match consistency {
        Consistency::Inliers => Vec::new(),
        Consistency::VisiblePoints => (0..scene.views.len()).into_par_iter().map(|v| median_scale(scene, v)).collect(),
    };
    let count = |&(a, b): &(usize, usize)| {
        stage.check()?;
        let shared = count_shared_tracks(scene, a, b);
        let [Some(of_a), Some(of_b)] = [a, b].map(|v| min_scales.get(v)) else { return Ok(shared) };
        let mut visible = Agreement { shared: shared.shared, ..count_visible_points(scene, b, a, *of_a) };
        visible.add(&count_visible_points(scene, a, b, *of_b));
        Ok(visible)
    };
    let agreement: Vec<Agreement> = pairs.par_iter().map(count).try_collect()?;
    let edge = |(&(a, b), of_pair): (&(usize, usize), &Agreement)| {
        (of_pair.shared >= min_shared).then_some(PairEdge { a, b, weight: of_pair.shared as f64 })
    };
    let edges = pairs.iter().zip(&agreement).filter_map(edge).collect();
    let Ok(graph) = PairGraph::new(scene.views.len(), edges) else { return Ok(Vec::new()) };
    let mut forest = graph.maximum_spanning_forest();
    let mut kept = Vec::new();
    while let Some((edge, smaller_part)) = most_contradicted_edge(&graph, &forest, &pairs, &agreement, consistency) {
        forest.retain(|e| *e != edge);
        if smaller_part < min_views {
            kept.push(edge);
        }
    }
    let kept = kept.iter().chain(&forest).map(|e| graph.edges()[*e]).collect();
    let Ok(parts) = PairGraph::new(scene.views.len(), kept) else { return Ok(Vec::new()) };
    let mut removed = Vec::new();
    for part in parts.connected_components().into_iter().skip(1).filter(|part| part.len() >= min_views) {
        // Nodes are ascending.
        let is_across = |(a, b): &(usize, usize)| part.binary_search(a).is_ok() != part.binary_search(b).is_ok();
        let mut across = Agreement::default();
        pairs.iter().zip(&agreement).filter(|(pair, _)| is_across(pair)).for_each(|(_, of_pair)| across.add(of_pair));
        // Parts may be unconnected without a contradiction.
        if consistency == Consistency::VisiblePoints && across.lacking(consistency) == 0 {
            continue;
        }
        let registered = part.iter().filter(|v| scene.poses[**v].take().is_some());
        removed.extend(registered.map(|view| RemovedView { view: *view, agree: across.agree, of: across.of }));
    }
    Ok(removed)
}

/// Returns the pairs of views that share inlier tracks, ordered: also those that are no verified pairs, but whose matches
/// with further views make common tracks. O(inliers · track length).
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn covisible_pairs(scene: &Scene<'_>, stage: &Stage<'_>) -> Result<Vec<(usize, usize)>, Cancelled> {
    let views = scene.views.len();
    let with_later = |a: usize| {
        stage.check()?;
        let shared = scene.shared_inliers(a);
        Ok((a + 1..views).filter(|b| shared[*b] > 0).map(|b| (a, b)).collect())
    };
    let pairs: Vec<Vec<(usize, usize)>> = (0..views).into_par_iter().map(with_later).try_collect()?;
    Ok(pairs.concat())
}

/// Returns the edge of a forest between two parts whose pairs lack most observations that agree, and the number of nodes
/// of the smaller part; `None` where none lacks any. O(pairs · nodes).
fn most_contradicted_edge(
    graph: &PairGraph,
    forest: &[usize],
    pairs: &[(usize, usize)],
    agreement: &[Agreement],
    consistency: Consistency,
) -> Option<(usize, usize)> {
    let nodes = graph.nodes();
    let mut paths = TreePaths::new(nodes);
    let mut steps = Vec::new();
    let mut is_visited = vec![false; nodes];
    for root in forest.iter().map(|e| graph.edges()[*e].a) {
        if !is_visited[root] {
            let of_tree = graph.breadth_first(forest, root);
            of_tree.iter().for_each(|step| paths.add(step));
            of_tree.iter().for_each(|step| is_visited[step.node] = true);
            is_visited[root] = true;
            steps.extend(of_tree);
        }
    }
    // By node: the agreement across the edge to its parent, and the number of nodes from it on.
    let mut across = vec![Agreement::default(); nodes];
    for (&(a, b), of_pair) in pairs.iter().zip(agreement) {
        for node in paths.between(a, b).into_iter().flatten() {
            across[node].add(of_pair);
        }
    }
    let mut sizes = vec![1; nodes];
    steps.iter().rev().for_each(|step| sizes[step.parent] += sizes[step.node]);
    let lacking = |node: usize| across[node].lacking(consistency);
    let worst =
        steps.iter().max_by_key(|step| (lacking(step.node), step.edge)).filter(|step| lacking(step.node) > 0)?;
    let part = sizes[worst.node];
    Some((worst.edge, part.min(sizes[paths.root(worst.node)] - part)))
}

/// Counts the tracks that both views observe and that are inliers in one, and those that are inliers in both.
fn count_shared_tracks(scene: &Scene<'_>, a: usize, b: usize) -> Agreement {
    // The observations of a view are sorted by track.
    let (mut first, mut second) = (scene.view_observations(a).peekable(), scene.view_observations(b).peekable());
    let mut counts = Agreement::default();
    while let (Some(&i), Some(&j)) = (first.peek(), second.peek()) {
        let (s, t) = (scene.track_of(i), scene.track_of(j));
        if s == t {
            counts.agree += usize::from(scene.active[i] && scene.active[j]);
            counts.of += usize::from(scene.active[i] || scene.active[j]);
            counts.shared = counts.agree;
        }
        if s <= t {
            first.next();
        }
        if t <= s {
            second.next();
        }
    }
    counts
}

/// Returns the median scale of the keypoints of a view that are inliers; 0 without any.
fn median_scale(scene: &Scene<'_>, view: usize) -> f32 {
    let inliers = scene.view_observations(view).filter(|i| scene.active[*i]);
    let mut scales: Vec<f64> = inliers.map(|i| f64::from(scene.keypoint(i).scale)).collect();
    quantile(&mut scales, 0.5).unwrap_or(0.0) as f32
}

/// Counts the points of view `from` that lie in the image of view `to` under nearly the same angle and at nearly the same
/// distance, with features of at least `min_scale`, and those of them that `to` observes; no more points than `to`
/// has such keypoints in that part of its image.
fn count_visible_points(scene: &Scene<'_>, from: usize, to: usize, min_scale: f32) -> Agreement {
    let mut counts = Agreement::default();
    let [Some(pose_from), Some(pose)] = [from, to].map(|v| scene.poses[v]) else { return counts };
    let (center_from, center) = (pose_from.center(), pose.center());
    let camera = scene.camera_of(to);
    let (right, bottom) = (camera.width as f64 - 1.0 - VISIBLE_BORDER, camera.height as f64 - 1.0 - VISIBLE_BORDER);
    let (mut low, mut high) = (Point2::new(right, bottom), Point2::new(VISIBLE_BORDER, VISIBLE_BORDER));
    for observation in scene.view_observations(from).filter(|i| scene.active[*i]) {
        let track = scene.track_of(observation);
        let Some(point) = scene.points[track] else { continue };
        let [one, other]: [Vector3<f64>; 2] = [point - center_from, point - center];
        let ratio = one.norm() / other.norm();
        let is_similar = (1.0 / MAX_VISIBLE_RATIO..=MAX_VISIBLE_RATIO).contains(&ratio);
        let is_large = scene.keypoint(observation).scale >= min_scale;
        if !is_similar || !is_large || one.angle(&other) > MAX_VISIBLE_ANGLE {
            continue;
        }
        let Some(at) = camera.project(&pose.transform(&point)) else { continue };
        if !(VISIBLE_BORDER..=right).contains(&at.x) || !(VISIBLE_BORDER..=bottom).contains(&at.y) {
            continue;
        }
        (low, high) = (low.inf(&at), high.sup(&at));
        counts.of += 1;
        counts.agree += usize::from(scene.tracks.range(track).any(|i| scene.view_of(i) == to && scene.active[i]));
    }
    // A photograph of low contrast has few keypoints.
    let is_inside = |k: &Keypoint| {
        let at: Point2<f64> = k.position.cast();
        k.scale >= min_scale && (low.x..=high.x).contains(&at.x) && (low.y..=high.y).contains(&at.y)
    };
    if counts.agree * Consistency::VisiblePoints.max_for_one() < counts.of {
        let keypoints = scene.views[to].keypoints.iter().filter(|k| is_inside(k)).count();
        counts.of = counts.of.min(keypoints.max(counts.agree));
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::triangulate_track::{PointLimits, update_tracks};
    use crate::{CameraKnowledge, Observation, SfmView, Tracks};
    use cv_core::{Point3, Pose, Silent};
    use cv_synth::{FeatureViews, FeatureViewsOptions};

    /// Keypoints, tracks and pairs of the views of a walk.
    struct Matched {
        walk: FeatureViews,
        keypoints: Vec<Vec<Point2<f64>>>,
        tracks: Vec<Vec<Observation>>,
        pairs: Vec<(usize, usize)>,
    }

    impl Matched {
        fn new(points: usize) -> Self {
            let walk = FeatureViews::new(&FeatureViewsOptions { views: 24, points, ..Default::default() });
            let mut tracks: Vec<Vec<Observation>> = vec![Vec::new(); walk.points.len()];
            for (shown, view) in walk.point_indices.iter().zip(0..) {
                shown
                    .iter()
                    .zip(0..)
                    .for_each(|(p, keypoint)| tracks[*p as usize].push(Observation { view, keypoint }));
            }
            let pairs = walk.pairs(30).into_iter().map(|(a, b, _)| (a, b)).collect();
            Self { keypoints: walk.keypoints.clone(), walk, tracks, pairs }
        }

        /// Adds a keypoint to a view.
        fn observe(&mut self, view: usize, at: Point2<f64>) -> Observation {
            self.keypoints[view].push(at);
            Observation { view: view as u32, keypoint: self.keypoints[view].len() as u32 - 1 }
        }

        /// Registers all views with `poses`, keeps the largest consistent component, and returns its views.
        fn kept(&self, poses: &[Pose], consistency: Consistency, min_shared: usize, min_views: usize) -> Vec<usize> {
            let keypoints: Vec<Vec<Keypoint>> = (self.keypoints.iter())
                .map(|view| view.iter().map(|p| Keypoint::new(p.x as f32, p.y as f32, 1.0)).collect())
                .collect();
            let views: Vec<SfmView<'_>> = keypoints.iter().map(|k| SfmView { camera: 0, keypoints: k }).collect();
            let (cameras, knowledge) = ([self.walk.camera], [CameraKnowledge::Known]);
            let tracks = self.tracks.iter().filter(|list| list.len() >= 2).cloned();
            let mut scene = Scene::new(&views, &cameras, &knowledge, Tracks::from_lists(tracks));
            scene.poses = poses.iter().copied().map(Some).collect();
            let all: Vec<usize> = (0..scene.tracks.len()).collect();
            // As in a reconstruction: three standard deviations of the noise are a pixel.
            update_tracks(&mut scene, PointLimits { error: 2.5, angle: 0.026 }, &all);
            let (limits, stage) = ((min_shared, min_views), Stage::new(&Silent, "test", 1).unwrap());
            let pairs = match consistency {
                Consistency::Inliers => self.pairs.clone(),
                Consistency::VisiblePoints => covisible_pairs(&scene, &stage).unwrap(),
            };
            let removed = keep_largest_consistent_component(&mut scene, &pairs, consistency, limits, &stage).unwrap();
            assert_eq!(removed.len() + scene.registered().len(), poses.len());
            assert!(removed.iter().all(|r| r.agree * consistency.max_for_one() < r.of), "{removed:?}");
            scene.registered()
        }
    }

    fn views(range: std::ops::Range<usize>) -> Vec<usize> {
        range.collect()
    }

    #[test]
    fn a_component_in_another_scale_is_removed_and_a_consistent_model_stays_whole() {
        let mut matched = Matched::new(4000);
        // From the fifteenth view on, the model is scaled by 2 about the center of the walk, which is the center of no
        // view: two components that share a view are consistent pairwise in any scale.
        let scaled = |v: usize| {
            let pose = matched.walk.poses[v];
            let factor = if v < 15 { 1.0 } else { 2.0 };
            Pose::new(pose.rotation, pose.translation * factor)
        };
        let (right, scaled): (Vec<Pose>, Vec<Pose>) = (matched.walk.poses.clone(), (0..24).map(scaled).collect());
        let judged = Consistency::Inliers;
        for (min_shared, min_views) in [(20, 1), (1, 3)] {
            assert_eq!(matched.kept(&right, judged, min_shared, min_views), views(0..24));
            assert_eq!(matched.kept(&scaled, judged, min_shared, min_views), views(0..15));
        }
        // Parts of fewer views than the minimum stay.
        assert_eq!(matched.kept(&scaled, judged, 1, 10), views(0..24));
        // Accidental matches that agree with the wrong scale do not hold the components together: points on rays of one
        // view, in front of another.
        let ends = [2, 21];
        let [a, b] = ends.map(|v| scaled[v]);
        let camera = matched.walk.camera;
        for k in 0..60 {
            let [x, y] = [k % 10, k / 10].map(|n| 80.0 * f64::from(n));
            let ray = camera.normalize(Point2::new(x, y)).to_homogeneous();
            // In the image or not: neither is checked.
            let in_front = |depth: u32| {
                let point = a.inverse().transform(&Point3::from(ray * f64::from(depth)));
                camera.project(&b.transform(&point))
            };
            let pixels = [Point2::new(x, y), (1..60).find_map(in_front).unwrap()];
            let track = [0, 1].map(|end| matched.observe(ends[end], pixels[end]));
            matched.tracks.push(track.to_vec());
        }
        matched.pairs.push((ends[0], ends[1]));
        for (min_shared, min_views) in [(20, 1), (1, 3)] {
            assert_eq!(matched.kept(&scaled, judged, min_shared, min_views), views(0..15));
        }
    }

    #[test]
    fn a_view_of_another_place_that_looks_alike_is_removed() {
        let mut matched = Matched::new(12_000);
        let mut poses = matched.walk.poses.clone();
        assert_eq!(matched.kept(&poses, Consistency::VisiblePoints, 1, 1), views(0..24));
        // The last view is thought to be beside another one, by 20 of the points there; it lacks the views around it.
        let beside = 8;
        poses[23] = Pose::new(poses[beside].rotation, poses[beside].translation + Vector3::new(0.2, 0.0, 0.0));
        matched.tracks.iter_mut().for_each(|track| track.retain(|o| o.view != 23));
        matched.pairs.retain(|pair| pair.1 != 23);
        matched.pairs.push((beside, 23));
        let camera = matched.walk.camera;
        let seen = |track: &usize| matched.tracks[*track].iter().any(|o| o.view as usize == beside);
        let shown: Vec<usize> = (0..matched.tracks.len()).filter(seen).take(20).collect();
        assert_eq!(shown.len(), 20);
        for point in shown {
            let at = camera.project(&poses[23].transform(&matched.walk.points[point])).unwrap();
            let observation = matched.observe(23, at);
            matched.tracks[point].push(observation);
        }
        // All its matches are inliers.
        assert_eq!(matched.kept(&poses, Consistency::Inliers, 1, 1), views(0..24));
        assert_eq!(matched.kept(&poses, Consistency::VisiblePoints, 1, 1), views(0..23));
    }
}
