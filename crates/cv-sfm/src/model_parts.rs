//! Consistency of a registered model: removes components that are in a wrong position or scale.

use crate::scene::Scene;
use crate::view_graph::{Link, ViewGraph};
use cv_parallel::prelude::*;

/// Counts of the tracks that both views of a link observe.
#[derive(Debug, Clone, Copy, Default)]
struct SharedTracks {
    /// Both observations are inliers.
    consistent: usize,
    /// One observation is an inlier, the other is an outlier.
    inconsistent: usize,
}

/// Removes the poses of all views but the largest component of consistent links: links with at least `min_shared`
/// shared tracks that are inliers in both views, and no more that are inliers in only one. A component in a wrong
/// position or scale has points of its own, which are inliers in its views and outliers in the others. Removed views
/// can be registered again by the remaining points. Components in two scales that share a view are not separated: pairs
/// with that view do not depend on the scale. Returns whether views were removed. O(observations of the views of all
/// links).
pub(crate) fn keep_largest_consistent_component(scene: &mut Scene<'_>, graph: &ViewGraph, min_shared: usize) -> bool {
    let is_consistent = |l: &Link| {
        if scene.poses[l.a].is_none() || scene.poses[l.b].is_none() {
            return false;
        }
        let SharedTracks { consistent, inconsistent } = count_shared_tracks(scene, l.a, l.b);
        consistent >= min_shared && consistent >= inconsistent
    };
    let links =
        graph.links.par_iter().map(|l| is_consistent(l).then_some(*l)).collect().into_iter().flatten().collect();
    let largest = ViewGraph { views: graph.views, links }.largest_component();
    let mut inside = vec![false; scene.views.len()];
    largest.links.iter().for_each(|l| (inside[l.a], inside[l.b]) = (true, true));
    let removed: Vec<usize> = scene.registered().into_iter().filter(|v| !inside[*v]).collect();
    removed.iter().for_each(|v| scene.poses[*v] = None);
    !removed.is_empty()
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
    use cv_core::{Keypoint, Pose};
    use cv_synth::{FeatureViews, FeatureViewsOptions};

    #[test]
    fn a_component_in_another_scale_is_removed_and_a_consistent_model_stays_whole() {
        let truth = FeatureViews::new(&FeatureViewsOptions { views: 24, points: 4000, ..Default::default() });
        let keypoints: Vec<Vec<Keypoint>> = (truth.keypoints.iter())
            .map(|view| view.iter().map(|p| Keypoint::new(p.x as f32, p.y as f32, 1.0)).collect())
            .collect();
        let views: Vec<SfmView<'_>> = keypoints.iter().map(|k| SfmView { camera: 0, keypoints: k }).collect();
        let mut lists: Vec<Vec<Observation>> = vec![Vec::new(); truth.points.len()];
        for (shown, view) in truth.point_indices.iter().zip(0..) {
            shown.iter().zip(0..).for_each(|(p, keypoint)| lists[*p as usize].push(Observation { view, keypoint }));
        }
        lists.retain(|list| list.len() >= 2);
        let link = |(pair, (a, b, matches)): (usize, (usize, usize, usize))| Link {
            pair,
            a,
            b,
            pose: Pose::relative(&truth.poses[a], &truth.poses[b]),
            matches,
        };
        let graph = ViewGraph { views: 24, links: truth.pairs(30).into_iter().enumerate().map(link).collect() };
        let placed = |poses: Vec<Pose>| {
            let mut scene = Scene::new(
                &views,
                &[truth.camera],
                &[CameraKnowledge::Known],
                Tracks::from_lists(lists.iter().cloned()),
            );
            scene.poses = poses.into_iter().map(Some).collect();
            let all: Vec<usize> = (0..scene.tracks.len()).collect();
            // As in a reconstruction: three standard deviations of the noise are a pixel.
            update_tracks(&mut scene, PointLimits { error: 2.5, angle: 0.026 }, &all);
            let has_removed = keep_largest_consistent_component(&mut scene, &graph, 20);
            (has_removed, scene.registered())
        };
        assert_eq!(placed(truth.poses.clone()), (false, (0..24).collect()));
        // From the fifteenth view on, the model is scaled by 2 about the center of the walk, which is the center of no
        // view: two components that share a view are consistent pairwise in any scale.
        let scaled = |v: usize| {
            let pose = truth.poses[v];
            let factor = if v < 15 { 1.0 } else { 2.0 };
            Pose::new(pose.rotation, pose.translation * factor)
        };
        assert_eq!(placed((0..24).map(scaled).collect()), (true, (0..15).collect()));
    }
}
