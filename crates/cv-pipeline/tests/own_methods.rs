//! User-defined methods in the jobs: a descriptor, a loss and a disparity matcher from outside.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, GrayF32, ImageView, Keypoint, Progress};
use cv_features::{DescriptorKind, FeatureError, HarrisOptions, harris};
use cv_geometry::{Scorer, Scoring};
use cv_pipeline::{
    DepthError, FeatureExtractor, FeatureOptions, Features, Intrinsics, MatchingOptions, ModelKind, PanoramaOptions,
    PanoramaPhoto, ReconstructOptions, Silent, depth_with, estimate, match_photos, panorama, reconstruct,
};
use cv_stereo::{
    DisparityMap, DisparityMatcher, PixelState, StereoError, StereoGeometry, StereoMatcher, StereoOptions,
};
use cv_synth::{
    RenderOptions, Scene, direction_error, homography_corner_error, homography_pair, panorama_views, rotation_error,
    stereo_pair, two_view,
};
use std::sync::Arc;

/// Corners, described by the gray levels of every other of 21×21 pixels around each, normalized to zero mean and unit
/// length.
#[derive(Debug)]
struct GrayCorners;

const GRAY: DescriptorKind =
    DescriptorKind { name: "gray", dimension: 121, ratio: 0.7, max_ssd: 0.5, bytes: None, patch: Some(11) };

impl FeatureExtractor for GrayCorners {
    fn extract(&self, image: ImageView<'_, f32, 1>, progress: &dyn Progress) -> Result<Features, FeatureError> {
        let (width, height) = image.size();
        let mut features = Features::new(GRAY);
        for corner in harris(image, &HarrisOptions::default(), progress)?.into_iter().take(3000) {
            let (x, y) = (corner.position.x.round() as usize, corner.position.y.round() as usize);
            if x < 10 || y < 10 || x + 10 >= width || y + 10 >= height {
                features.beyond_limit += 1;
                continue;
            }
            let values: Vec<f32> =
                (0..121).map(|i| image.at(x + 2 * (i % 11) - 10, y + 2 * (i / 11) - 10)[0]).collect();
            let mean = values.iter().sum::<f32>() / 121.0;
            let length = values.iter().map(|v| (v - mean).powi(2)).sum::<f32>().sqrt().max(1e-6);
            let row: Vec<f32> = values.iter().map(|v| (v - mean) / length).collect();
            features.push(Keypoint { scale: 2.0, ..corner }, &row);
        }
        Ok(features)
    }

    fn kind(&self) -> DescriptorKind {
        GRAY
    }
}

fn with_gray_corners() -> MatchingOptions {
    MatchingOptions { features: FeatureOptions::Other(Arc::new(GrayCorners)), ..MatchingOptions::default() }
}

/// The Cauchy loss, truncated at three thresholds.
#[derive(Debug)]
struct Cauchy;

impl Scorer for Cauchy {
    fn loss(&self, u: f32) -> f32 {
        if u < 9.0 { u.ln_1p() / 10f32.ln() } else { 1.0 }
    }

    fn weight(&self, u: f64) -> f64 {
        if u < 9.0 { 1.0 / (1.0 + u) } else { 0.0 }
    }

    fn cutoff(&self) -> f64 {
        9.0
    }
}

#[test]
fn images_are_matched_by_a_custom_descriptor_and_loss() {
    let camera = Camera::from_focal(640, 480, 520.0);
    let pair = homography_pair(2, &camera, 0.15, &RenderOptions::draft()).unwrap();
    let found = match_photos(pair.a.image.view(), pair.b.image.view(), &with_gray_corners(), &Silent).unwrap();
    assert!(found.features.iter().all(|f| f.descriptors.kind() == GRAY));
    let kind = ModelKind::Homography;
    let mut options = kind.options();
    options.scoring = Scoring::Other(&Cauchy);
    let model = estimate(&found.pairs(), kind, &options, &Silent).unwrap().robust;
    let error = homography_corner_error(&model.model, &pair.homography, 640, 480);
    println!("{} matches, {} agree, {error:.3} px", found.matches.len(), model.inliers.len());
    // Corners are accurate to half a pixel; a hundred of them determine the image corners to that or better.
    assert!(model.inliers.len() > 60 && error < 0.7, "{} {error}", model.inliers.len());
}

#[test]
fn two_views_and_a_panorama_use_a_custom_descriptor() {
    let camera = Camera::from_focal(640, 480, 520.0);
    let views = two_view(3, &camera, 0.25, &RenderOptions::draft()).unwrap();
    let mut options =
        ReconstructOptions { matching: with_gray_corners(), ..ReconstructOptions::new(Intrinsics::Known([camera; 2])) };
    options.two_view.robust.scoring = Scoring::Other(&Cauchy);
    let found = reconstruct(views.a.image.view(), views.b.image.view(), &options, &Silent).unwrap();
    let turn = rotation_error(&found.scene.pose.rotation, &views.relative.rotation).to_degrees();
    let way = direction_error(&found.scene.pose.translation, &views.relative.translation).to_degrees();
    println!("{} points, {turn:.3}° {way:.2}°", found.scene.points.len());
    // Twice the limits of SIFT: these corners are not scale-invariant.
    assert!(turn < 0.4 && way < 2.0 && found.scene.points.len() >= 60, "{turn} {way} {}", found.scene.points.len());

    let few = cv_synth::PanoramaSetOptions { views: 3, ..cv_synth::PanoramaSetOptions::default() };
    let set = panorama_views(1, &camera, &few, &RenderOptions::draft()).unwrap();
    let photos: Vec<_> = set.views.iter().map(|v| PanoramaPhoto::new(v.image.view())).collect();
    let options = PanoramaOptions { matching: with_gray_corners(), ..PanoramaOptions::default() };
    let joined = panorama(&photos, &options, &Silent).unwrap();
    assert!(joined.images.iter().all(|image| image.used));
}

/// A matcher that returns the true disparities.
struct Oracle(GrayF32);

impl DisparityMatcher<u8, 3> for Oracle {
    fn compute_into(
        &mut self,
        left: ImageView<'_, u8, 3>,
        _: ImageView<'_, u8, 3>,
        map: &mut DisparityMap,
        progress: &dyn Progress,
    ) -> Result<(), StereoError> {
        progress.report("oracle", 0, 1)?;
        let (width, height) = left.size();
        map.disparity = self.0.clone();
        let state = |x, y| if self.0.at(x, y)[0].is_finite() { PixelState::Matched } else { PixelState::Mismatched };
        map.state = cv_core::Image::from_fn(width, height, |x, y| [state(x, y)]);
        Ok(())
    }

    fn disparities(&self) -> (i32, usize) {
        (0, 64)
    }
}

#[test]
fn depth_uses_a_custom_matcher() {
    let scene = Scene::room(1);
    let camera = Camera::from_focal(320, 240, 280.0);
    let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::draft()).unwrap();
    let geometry = StereoGeometry::from_focal(320, 240, 280.0, 0.25).unwrap();
    let (left, right) = (pair.left.image.view(), pair.right.image.view());
    let all = (0.0, f32::INFINITY);
    let found = depth_with(&mut Oracle(pair.disparity.clone()), left, right, Some(&geometry), all, &Silent).unwrap();
    let depth = found.depth.unwrap();
    for (x, y) in (0..320).flat_map(|x| (0..240).map(move |y| (x, y))) {
        let truth = pair.left.depth.at(x, y)[0];
        // Rounding of f32.
        assert!(!truth.is_finite() || (depth.at(x, y)[0] / truth - 1.0).abs() < 1e-4, "{x} {y}: {truth}");
    }
    assert!(found.confidence.is_none() && found.disparities == (0, 64));
    // A matcher without matches is an error, which reports its range.
    let nothing = GrayF32::new(320, 240, [f32::NAN]);
    let error = depth_with(&mut Oracle(nothing), left, right, None, all, &Silent).map(|d| d.stages).unwrap_err();
    assert!(matches!(error, DepthError::NoPair { .. }), "{error}");
    // Ours, through the same call.
    let mut ours = StereoMatcher::new(StereoOptions { disparities: 64, ..StereoOptions::default() }).unwrap();
    let found = depth_with(&mut ours, left, right, Some(&geometry), all, &Silent).unwrap();
    assert!(found.map.matched_fraction() > 0.5);
}
