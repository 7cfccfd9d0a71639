//! Whether all views of a model hold together, or it is several that only lie beside each other.

use crate::scene::Scene;
use crate::view_graph::{Link, ViewGraph};
use rayon::prelude::*;

/// How two views of a link agree on the tracks that both see.
#[derive(Debug, Clone, Copy, Default)]
struct Agreement {
    /// Tracks whose point agrees with both.
    both: usize,
    /// Tracks whose point agrees with one of them only.
    one: usize,
}

/// Takes the poses from all views but the largest set of them that links hold together: links of which at least `least` points agree with both views, and no more with one of them only. A part
/// that is placed wrongly beside another, or in another scale, has points of its own that agree with all of its views; across to the other part they do not. What is taken out can be placed by
/// the points of the rest. Parts in two scales that share a view are not told apart: pairs with it say nothing of a scale. Gives back whether there was any. O(observations of the views of all links).
pub(crate) fn keep_largest_part(scene: &mut Scene<'_>, graph: &ViewGraph, least: usize) -> bool {
    let holds = |l: &Link| {
        if scene.poses[l.a].is_none() || scene.poses[l.b].is_none() {
            return false;
        }
        let Agreement { both, one } = agreement(scene, l.a, l.b);
        both >= least && both >= one
    };
    let links = graph.links.par_iter().filter(|l| holds(l)).copied().collect();
    let firm = ViewGraph { views: graph.views, links }.largest_component();
    let mut inside = vec![false; scene.views.len()];
    firm.links.iter().for_each(|l| (inside[l.a], inside[l.b]) = (true, true));
    let loose: Vec<usize> = scene.registered().into_iter().filter(|v| !inside[*v]).collect();
    loose.iter().for_each(|v| scene.poses[*v] = None);
    !loose.is_empty()
}

/// Of the tracks that two views see and that have a point.
fn agreement(scene: &Scene<'_>, a: usize, b: usize) -> Agreement {
    // The observations of a view are by track.
    let (mut first, mut second) = (scene.of_view(a).peekable(), scene.of_view(b).peekable());
    let mut found = Agreement::default();
    while let (Some(&i), Some(&j)) = (first.peek(), second.peek()) {
        let (s, t) = (scene.track_of(i), scene.track_of(j));
        if s == t {
            match (scene.active[i], scene.active[j]) {
                (true, true) => found.both += 1,
                (false, false) => {}
                _ => found.one += 1,
            }
        }
        if s <= t {
            first.next();
        }
        if t <= s {
            second.next();
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::triangulate_track::{PointLimits, update_tracks};
    use crate::{CameraKnowledge, Observation, SfmView, Tracks};
    use cv_core::{Keypoint, Pose};
    use cv_synth::{FeatureViews, FeatureViewsOptions};

    #[test]
    fn a_part_in_another_scale_is_taken_out_and_one_piece_stays_whole() {
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
            // The limits of a run: three standard deviations of the noise are a pixel.
            update_tracks(&mut scene, PointLimits { error: 2.5, angle: 0.026 }, &all);
            let cut = keep_largest_part(&mut scene, &graph, 20);
            (cut, scene.registered())
        };
        assert_eq!(placed(truth.poses.clone()), (false, (0..24).collect()));
        // From the fifteenth view on everything is twice as large, about the middle of the round: of no view, since two parts that share one agree by pairs in any scale.
        let larger = |v: usize| {
            let pose = truth.poses[v];
            let by = if v < 15 { 1.0 } else { 2.0 };
            Pose::new(pose.rotation, pose.translation * by)
        };
        assert_eq!(placed((0..24).map(larger).collect()), (true, (0..15).collect()));
    }
}
