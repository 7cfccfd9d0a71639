//! Models that go on from poses that are known.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Keypoint, Pose, Rotation3, Silent, Vector3};
use cv_sfm::{
    CameraKnowledge, PairMatches, SfmInput, SfmOptions, SfmView, ViewOutcome, ViewPairOptions, align_to_poses,
    reconstruct_views_from, verify_view_pair,
};
use cv_synth::{FeatureViews, FeatureViewsOptions};

#[test]
fn a_model_goes_on_from_poses_and_finds_wrong_ones_anew() {
    let truth = FeatureViews::new(&FeatureViewsOptions { views: 36, points: 7000, ..FeatureViewsOptions::default() });
    let keypoint = |p: &cv_core::Point2<f64>| Keypoint::new(p.x as f32, p.y as f32, 1.0);
    let keypoints: Vec<Vec<Keypoint>> =
        truth.keypoints.iter().map(|view| view.iter().map(keypoint).collect()).collect();
    let views: Vec<SfmView<'_>> = keypoints.iter().map(|k| SfmView { camera: 0, keypoints: k }).collect();
    let (mut pairs, mut geometry) = (Vec::new(), Vec::new());
    for (a, b, _) in truth.pairs(30) {
        let (matches, camera) = (truth.matches(a, b), (&truth.camera, &CameraKnowledge::Known));
        let both = [&keypoints[a][..], &keypoints[b]];
        if let Ok(pair) = verify_view_pair([camera; 2], both, &matches, &ViewPairOptions::default(), &Silent) {
            pairs.push(PairMatches::new(a, b, pair.inliers.iter().map(|i| matches[*i]).collect()));
            geometry.push(pair.model);
        }
    }
    let input = SfmInput {
        views: &views,
        cameras: &[truth.camera],
        knowledge: &[CameraKnowledge::Known],
        pairs: &pairs,
        geometry: &geometry,
        alike: None,
    };
    // Twenty-two of the poses, each off by a pixel or two; two of them are those of others.
    let turn = Rotation3::from_euler_angles(0.0008, -0.0012, 0.0005);
    let off = |i: usize| {
        Pose::new(turn * truth.poses[i].rotation, truth.poses[i].translation + Vector3::new(0.004, -0.003, 0.005))
    };
    let mut known: Vec<Option<Pose>> = (0..36).map(|i| (i < 22).then(|| off(i))).collect();
    (known[3], known[8]) = (Some(off(25)), Some(off(29)));
    let found = reconstruct_views_from(&input, &known, &SfmOptions::default(), &Silent).unwrap();
    assert_eq!(found.models.len(), 1, "{:?}", found.views);
    assert!(found.views.iter().all(|v| *v == ViewOutcome::Registered { model: 0 }), "{:?}", found.views);
    let mut model = found.models.into_iter().next().unwrap();
    let farthest = |model: &cv_sfm::SfmModel| {
        let each = model.poses.iter().flatten().zip(&truth.poses);
        each.map(|(p, t)| (p.center() - t.center()).norm()).fold(0.0, f64::max)
    };
    // The frame stays, to what the poses were off by: 1.5 mrad over the walk's 30 m, and the first of them.
    assert!(farthest(&model) < 0.1, "{}", farthest(&model));
    // In the frame of the true poses nothing but the keypoints' noise is left: a thousandth of the walk.
    let right: Vec<Option<Pose>> = truth.poses.iter().copied().map(Some).collect();
    model.transform(&align_to_poses(&model, &right).unwrap());
    assert!(farthest(&model) < 0.03, "{}", farthest(&model));
}
