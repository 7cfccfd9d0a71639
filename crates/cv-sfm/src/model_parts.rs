//! Consistency of a registered model: removes components that are in a wrong position or scale.

use crate::scene::Scene;
use crate::tree_paths::TreePaths;
use cv_geometry::{PairEdge, PairGraph};
use cv_parallel::prelude::*;

/// Counts of the tracks that both views of a pair observe.
#[derive(Debug, Clone, Copy, Default)]
struct SharedTracks {
    /// Both observations are inliers.
    consistent: usize,
    /// One observation is an inlier, the other is an outlier.
    inconsistent: usize,
}

/// Removes the poses of all consistent components of at least `min_views` views but the largest. A component in a wrong
/// position or scale has points of its own, which are inliers in its views and outliers in the others.
///
/// Pairs with at least `min_shared` tracks that are inliers in both views make a maximum spanning forest. An edge of it
/// is cut if, over all `pairs` from one part to the other, more shared tracks are inliers in only one view than in both,
/// the most contradicted edge first: a few accidental matches do not hold parts together that thousands of others
/// contradict. Removed views can be registered again by the remaining points. Components in two scales that share a view
/// are not separated: pairs with that view do not depend on the scale. Returns whether views were removed.
/// O(observations of the views of all pairs + pairs · views) for each cut.
pub(crate) fn keep_largest_consistent_component(
    scene: &mut Scene<'_>,
    pairs: &[(usize, usize)],
    min_shared: usize,
    min_views: usize,
) -> bool {
    let is_registered = |v: usize| scene.poses[v].is_some();
    let pairs: Vec<(usize, usize)> =
        pairs.iter().filter(|(a, b)| is_registered(*a) && is_registered(*b)).copied().collect();
    let shared: Vec<SharedTracks> = pairs.par_iter().map(|(a, b)| count_shared_tracks(scene, *a, *b)).collect();
    let consistent = |(&(a, b), shared): (&(usize, usize), &SharedTracks)| {
        (shared.consistent >= min_shared).then_some(PairEdge { a, b, weight: shared.consistent as f64 })
    };
    let edges = pairs.iter().zip(&shared).filter_map(consistent).collect();
    let Ok(graph) = PairGraph::new(scene.views.len(), edges) else { return false };
    let mut forest = graph.maximum_spanning_forest();
    let mut kept = Vec::new();
    while let Some((edge, smaller_part)) = most_contradicted_edge(&graph, &forest, pairs.iter().zip(&shared)) {
        forest.retain(|e| *e != edge);
        if smaller_part < min_views {
            kept.push(edge);
        }
    }
    let kept = kept.iter().chain(&forest).map(|e| graph.edges()[*e]).collect();
    let Ok(parts) = PairGraph::new(scene.views.len(), kept) else { return false };
    let others = parts.connected_components().into_iter().skip(1).filter(|part| part.len() >= min_views);
    let mut has_removed = false;
    for view in others.flatten() {
        has_removed |= scene.poses[view].take().is_some();
    }
    has_removed
}

/// Returns the edge of a forest between two parts whose pairs have most inconsistent shared tracks in excess of the
/// consistent ones, and the number of nodes of the smaller part; `None` where none has more. O(pairs · nodes).
fn most_contradicted_edge<'p>(
    graph: &PairGraph,
    forest: &[usize],
    pairs: impl Iterator<Item = (&'p (usize, usize), &'p SharedTracks)>,
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
    // By node: the tracks across the edge to its parent, and the number of nodes from it on.
    let mut across = vec![SharedTracks::default(); nodes];
    for (&(a, b), shared) in pairs {
        for node in paths.between(a, b).into_iter().flatten() {
            across[node].consistent += shared.consistent;
            across[node].inconsistent += shared.inconsistent;
        }
    }
    let mut sizes = vec![1; nodes];
    steps.iter().rev().for_each(|step| sizes[step.parent] += sizes[step.node]);
    let excess = |node: usize| across[node].inconsistent.saturating_sub(across[node].consistent);
    let worst = steps.iter().max_by_key(|step| (excess(step.node), step.edge)).filter(|step| excess(step.node) > 0)?;
    let part = sizes[worst.node];
    Some((worst.edge, part.min(sizes[paths.root(worst.node)] - part)))
}

/// Counts the tracks with a point that both views observe.
fn count_shared_tracks(scene: &Scene<'_>, a: usize, b: usize) -> SharedTracks {
    // The observations of a view are sorted by track.
    let (mut first, mut second) = (scene.view_observations(a).peekable(), scene.view_observations(b).peekable());
    let mut counts = SharedTracks::default();
    while let (Some(&i), Some(&j)) = (first.peek(), second.peek()) {
        let (s, t) = (scene.track_of(i), scene.track_of(j));
        if s == t {
            match (scene.active[i], scene.active[j]) {
                (true, true) => counts.consistent += 1,
                (false, false) => {}
                _ => counts.inconsistent += 1,
            }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::triangulate_track::{PointLimits, update_tracks};
    use crate::{CameraKnowledge, Observation, SfmView, Tracks};
    use cv_core::{Keypoint, Point2, Point3, Pose};
    use cv_synth::{FeatureViews, FeatureViewsOptions};

    /// Registers all views with `poses`, keeps the largest consistent component, and returns its views.
    fn kept(
        truth: &FeatureViews,
        poses: &[Pose],
        accidental: &[[Point2<f64>; 2]],
        limits: (usize, usize),
    ) -> Vec<usize> {
        let mut keypoints = truth.keypoints.clone();
        let mut lists: Vec<Vec<Observation>> = vec![Vec::new(); truth.points.len()];
        for (shown, view) in truth.point_indices.iter().zip(0..) {
            shown.iter().zip(0..).for_each(|(p, keypoint)| lists[*p as usize].push(Observation { view, keypoint }));
        }
        lists.retain(|list| list.len() >= 2);
        for pixels in accidental {
            let observe = |(view, at): (usize, &Point2<f64>)| {
                keypoints[view].push(*at);
                Observation { view: view as u32, keypoint: keypoints[view].len() as u32 - 1 }
            };
            lists.push(ENDS.into_iter().zip(pixels).map(observe).collect());
        }
        let keypoints: Vec<Vec<Keypoint>> = (keypoints.iter())
            .map(|view| view.iter().map(|p| Keypoint::new(p.x as f32, p.y as f32, 1.0)).collect())
            .collect();
        let views: Vec<SfmView<'_>> = keypoints.iter().map(|k| SfmView { camera: 0, keypoints: k }).collect();
        let (cameras, knowledge) = ([truth.camera], [CameraKnowledge::Known]);
        let mut scene = Scene::new(&views, &cameras, &knowledge, Tracks::from_lists(lists));
        scene.poses = poses.iter().copied().map(Some).collect();
        let all: Vec<usize> = (0..scene.tracks.len()).collect();
        // As in a reconstruction: three standard deviations of the noise are a pixel.
        update_tracks(&mut scene, PointLimits { error: 2.5, angle: 0.026 }, &all);
        let mut pairs: Vec<(usize, usize)> = truth.pairs(30).into_iter().map(|(a, b, _)| (a, b)).collect();
        pairs.push((ENDS[0], ENDS[1]));
        let has_removed = keep_largest_consistent_component(&mut scene, &pairs, limits.0, limits.1);
        assert_eq!(has_removed, scene.registered().len() < poses.len());
        scene.registered()
    }

    /// The views with accidental matches.
    const ENDS: [usize; 2] = [2, 21];

    #[test]
    fn a_component_in_another_scale_is_removed_and_a_consistent_model_stays_whole() {
        let truth = FeatureViews::new(&FeatureViewsOptions { views: 24, points: 4000, ..Default::default() });
        // From the fifteenth view on, the model is scaled by 2 about the center of the walk, which is the center of no
        // view: two components that share a view are consistent pairwise in any scale.
        let scaled = |v: usize| {
            let pose = truth.poses[v];
            let factor = if v < 15 { 1.0 } else { 2.0 };
            Pose::new(pose.rotation, pose.translation * factor)
        };
        let scaled: Vec<Pose> = (0..24).map(scaled).collect();
        // Points on rays of the one view, in front of the other.
        let [a, b] = ENDS.map(|v| scaled[v]);
        let pixels = |k: usize| {
            let [x, y] = [k % 40, k / 40].map(|n| 20.0 * n as f64);
            let ray = truth.camera.normalize(Point2::new(x, y)).to_homogeneous();
            // In the image or not: the adjustment does not care.
            let at = (1..60).find_map(|depth| {
                let point = a.inverse().transform(&Point3::from(ray * f64::from(depth)));
                truth.camera.project(&b.transform(&point))
            })?;
            Some([Point2::new(x, y), at])
        };
        let accidental: Vec<[Point2<f64>; 2]> = (0..1200).filter_map(pixels).take(60).collect();
        assert_eq!(accidental.len(), 60);
        for limits in [(20, 1), (1, 3)] {
            assert_eq!(kept(&truth, &truth.poses, &[], limits), (0..24).collect::<Vec<_>>());
            assert_eq!(kept(&truth, &scaled, &[], limits), (0..15).collect::<Vec<_>>());
            // Accidental matches that agree with the wrong scale do not hold the components together.
            assert_eq!(kept(&truth, &scaled, &accidental, limits), (0..15).collect::<Vec<_>>());
        }
        // Parts of fewer views than the minimum stay.
        assert_eq!(kept(&truth, &scaled, &[], (1, 10)), (0..24).collect::<Vec<_>>());
    }
}
