//! Covariances against the errors of models with ground truth.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Keypoint, Pose, Silent, Vector3};
use cv_geometry::Similarity;
use cv_sfm::{
    CameraKnowledge, PairMatches, SfmInput, SfmModel, SfmOptions, SfmView, ViewPairOptions, model_covariance,
    reconstruct_views_from, verify_view_pair,
};
use cv_synth::{FeatureViews, FeatureViewsOptions};

/// Transforms a model to the true frame in the gauge of the covariances: the pose of the first view is true, and so is
/// the constant coordinate of the translation of the other view.
fn anchor(model: &mut SfmModel, truth: &[Pose], [first, farthest]: [usize; 2]) {
    let pose = model.poses[first].unwrap();
    let rotation = truth[first].rotation.inverse() * pose.rotation;
    let move_to = |scale: f64| Similarity {
        scale,
        rotation,
        translation: truth[first].center().coords - rotation * pose.center().coords * scale,
    };
    let along = truth[farthest].rotation * (truth[farthest].center() - truth[first].center());
    let k = along.iamax();
    // t = −R c is linear in the scale.
    let t = |scale: f64| {
        let mut moved = SfmModel { points: Vec::new(), ..model.clone() };
        moved.transform(&move_to(scale));
        moved.poses[farthest].unwrap().translation[k]
    };
    let (at_one, at_two) = (t(1.0), t(2.0));
    let scale = 1.0 + (truth[farthest].translation[k] - at_one) / (at_two - at_one);
    model.transform(&move_to(scale));
}

#[test]
fn errors_agree_with_the_covariances() {
    let (mut centers, mut turns, mut points) = (Vec::new(), Vec::new(), Vec::new());
    for seed in 0..4 {
        let options =
            FeatureViewsOptions { views: 60, points: 6000, outlier_ratio: 0.0, seed, ..FeatureViewsOptions::default() };
        let truth = FeatureViews::new(&options);
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
        let knowledge = [CameraKnowledge::Known];
        let input = SfmInput {
            views: &views,
            cameras: &[truth.camera],
            knowledge: &knowledge,
            pairs: &pairs,
            geometry: &geometry,
            feature_distance: None,
        };
        let known: Vec<Option<Pose>> = truth.poses.iter().copied().map(Some).collect();
        let found = reconstruct_views_from(&input, &known, &SfmOptions::default(), &Silent).unwrap();
        let mut model = found.models.into_iter().next().unwrap();
        let reference = model_covariance(&views, &knowledge, &model).unwrap().reference;
        anchor(&mut model, &truth.poses, reference);
        let covariance = model_covariance(&views, &knowledge, &model).unwrap();
        assert_eq!(covariance.reference, reference);
        // Keypoints have a standard deviation of 0.3 px in each coordinate. The estimate is by a robust loss: its
        // residuals are some per cent larger than those of least squares, which the degrees of freedom are for.
        assert!((0.29..0.35).contains(&covariance.noise), "{}", covariance.noise);
        for (v, (pose, covariance)) in model.poses.iter().zip(&covariance.poses).enumerate() {
            let (Some(pose), Some(of)) = (pose, covariance) else { continue };
            if v == reference[0] {
                assert!(of.center.norm() < 1e-12 && of.rotation.norm() < 1e-12, "{of:?}");
                continue;
            }
            let off = pose.center() - truth.poses[v].center();
            centers.push(off.dot(&(of.center.try_inverse().unwrap() * off)));
            let turn = (pose.rotation * truth.poses[v].rotation.inverse()).scaled_axis();
            turns.push(turn.dot(&(of.rotation.try_inverse().unwrap() * turn)));
        }
        for (point, of) in model.points.iter().zip(&covariance.points) {
            let o = point.observations[0];
            let off: Vector3<f64> =
                point.position - truth.points[truth.point_indices[o.view as usize][o.keypoint as usize] as usize];
            points.push(off.dot(&(of.unwrap().try_inverse().unwrap() * off)));
        }
    }
    // The mean of χ² with three degrees of freedom is 3. Errors of one walk are correlated: four walks are some twenty
    // independent values, whose mean is within a half of it.
    for (name, list) in [("centers", centers), ("turns", turns), ("points", points)] {
        let mean = list.iter().sum::<f64>() / list.len() as f64;
        assert!((2.0..4.5).contains(&mean), "{name}: {mean}");
    }
}
