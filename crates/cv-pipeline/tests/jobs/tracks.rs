//! Tracks over more than two photographs: matches refer to keypoints by index, which is all that is needed.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, Point2, Pose, Rotation3, Vector3};
use cv_pipeline::{MatchingOptions, PanoramaOptions, PanoramaPhoto, Silent, match_photos, panorama};
use cv_synth::{RenderOptions, Rendered, Scene, panorama_views, render};

/// Renders three views of a room by a camera that moves sideways and rotates a little.
fn walk(scene: &Scene, camera: &Camera) -> Vec<Rendered> {
    let first = scene.viewpoint();
    let step = |i: u32| {
        let i = f64::from(i);
        let turn = Rotation3::new(Vector3::new(0.0, 0.03 * i, 0.0));
        Pose::new(turn, Vector3::new(-0.15 * i, 0.0, 0.0)).compose(&first)
    };
    (0..3).map(|i| render(scene, camera, &step(i), &RenderOptions::draft().with_seed(u64::from(i))).unwrap()).collect()
}

#[test]
fn tracks_over_three_photographs_join_two_results_by_index() {
    let camera = Camera::from_focal(640, 480, 560.0);
    let scene = Scene::room(3);
    let views = walk(&scene, &camera);
    let pair = |i: usize, j: usize| {
        let (a, b) = (views[i].image.view(), views[j].image.view());
        match_photos(a, b, &MatchingOptions::default(), &Silent).unwrap()
    };
    let (first, second) = (pair(0, 1), pair(1, 2));
    // A photograph has the same features in both results.
    assert_eq!(first.features[1], second.features[0]);
    let tracks: Vec<[u32; 3]> = first
        .matches
        .iter()
        .filter_map(|m| Some([m.query, m.train, second.matches.iter().find(|n| n.query == m.train)?.train]))
        .collect();
    // The projections of the surface at the first photograph's keypoint into the other two.
    let right = tracks.iter().filter(|track| {
        let at = |view: usize| match view {
            2 => second.features[1].keypoints[track[2] as usize],
            _ => first.features[view].keypoints[track[view] as usize],
        };
        let [a, b, c] = [0, 1, 2].map(|view| at(view).position.cast::<f64>());
        let Some(point) = scene.point_at(&camera, &views[0].pose, a) else { return false };
        let near = |view: usize, p: Point2<f64>| {
            let truth = camera.project(&views[view].pose.transform(&point));
            truth.is_some_and(|q| (q - p).norm() < 3.0)
        };
        near(1, b) && near(2, c)
    });
    let right = right.count();
    println!("{} tracks, {right} right", tracks.len());
    // At least nine in ten tentative matches are correct between neighboring views of a textured room; features at
    // object boundaries belong to two surfaces.
    assert!(tracks.len() > 150 && right * 10 >= tracks.len() * 8, "{right} of {}", tracks.len());
}

#[test]
fn matches_of_a_panorama_are_in_pixels_of_its_photographs() {
    let camera = Camera::from_focal(640, 480, 520.0);
    let options = cv_synth::PanoramaSetOptions { views: 3, ..cv_synth::PanoramaSetOptions::default() };
    let set = panorama_views(1, &camera, &options, &RenderOptions::draft()).unwrap();
    let photos: Vec<_> = set.views.iter().map(|v| PanoramaPhoto::new(v.image.view())).collect();
    // Features are extracted at half the resolution.
    let small = PanoramaOptions { registration_pixels: 320 * 240, ..PanoramaOptions::default() };
    let result = panorama(&photos, &small, &Silent).unwrap();
    let accepted: Vec<_> = result.pairs.iter().filter(|p| p.rejected.is_none()).collect();
    assert!(accepted.len() >= 2);
    for pair in accepted {
        let pixels = result.correspondences(pair);
        assert_eq!(pixels.len(), pair.matches.len());
        let mut off: Vec<f64> = pair
            .inliers
            .iter()
            .filter_map(|&i| Some((set.transfer(pair.a, pair.b, pixels[i].a)? - pixels[i].b).norm()))
            .collect();
        off.sort_by(f64::total_cmp);
        // A SIFT keypoint is accurate to a few tenths of a pixel, each of which is two of the photograph's.
        assert!(off.len() > 20 && off[off.len() / 2] < 1.5, "{} {}", off.len(), off[off.len() / 2]);
    }
}
