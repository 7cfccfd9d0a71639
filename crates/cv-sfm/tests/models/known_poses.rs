//! Reconstruction from known poses.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Keypoint, Pose, Rotation3, Silent, Vector3};
use cv_sfm::{
    CameraKnowledge, PairMatches, SfmInput, SfmOptions, SfmView, ViewOutcome, ViewPairOptions, align_to_poses,
    reconstruct_views_from, verify_view_pair,
};
use cv_synth::{FeatureViews, FeatureViewsOptions};

#[test]
fn a_model_extends_known_poses_and_replaces_wrong_ones() {
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
        feature_distance: None,
    };
    // Twenty-two of the poses, each off by a pixel or two; two of them are those of other views.
    let rotation_error = Rotation3::from_euler_angles(0.0008, -0.0012, 0.0005);
    let perturbed = |i: usize| {
        Pose::new(
            rotation_error * truth.poses[i].rotation,
            truth.poses[i].translation + Vector3::new(0.004, -0.003, 0.005),
        )
    };
    let mut known: Vec<Option<Pose>> = (0..36).map(|i| (i < 22).then(|| perturbed(i))).collect();
    (known[3], known[8]) = (Some(perturbed(25)), Some(perturbed(29)));
    let found = reconstruct_views_from(&input, &known, &SfmOptions::default(), &Silent).unwrap();
    assert_eq!(found.models.len(), 1, "{:?}", found.views);
    assert!(found.views.iter().all(|v| *v == ViewOutcome::Registered { model: 0 }), "{:?}", found.views);
    let mut model = found.models.into_iter().next().unwrap();
    let max_center_error = |model: &cv_sfm::SfmModel| {
        let each = model.poses.iter().flatten().zip(&truth.poses);
        each.map(|(p, t)| (p.center() - t.center()).norm()).fold(0.0, f64::max)
    };
    // The frame is kept within the errors of the poses: 1.5 mrad over the 30 m of the walk, and that of the first pose.
    assert!(max_center_error(&model) < 0.1, "{}", max_center_error(&model));
    // In the frame of the true poses only the keypoint noise is left: a thousandth of the walk.
    let true_poses: Vec<Option<Pose>> = truth.poses.iter().copied().map(Some).collect();
    model.transform(&align_to_poses(&model, &true_poses).unwrap());
    assert!(max_center_error(&model) < 0.03, "{}", max_center_error(&model));
}
