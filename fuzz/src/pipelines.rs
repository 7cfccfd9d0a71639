//! Fuzzes the jobs of `cv-pipeline` and the geometry below them with small structured inputs.

use crate::structured::{self as make, Input};
use arbitrary::Unstructured;
use cv_core::{DMatch, Keypoint, Mask, StereoRig};
use cv_geometry::{
    MatchedViews, TwoViewOptions, VerifyOptions, estimate_relative_pose, normalize_matches, reconstruct_two_views,
    verify_pair,
};
use cv_pipeline::{
    DepthOptions, DisparityRange, FeatureMethod, Intrinsics, MatchingOptions, ModelKind, PanoramaOptions,
    PanoramaPhoto, RobustOptions, Silent,
    panorama_types::{BlendMode, CompositingOptions, Projection},
    segmentation::{Labeled, TrainOptions},
    stereo::{Rectification, RectifyOptions, StereoGeometry, StereoOptions},
};
use libfuzzer_sys::Corpus;

/// Returns options with few enough iterations for about a millisecond per input.
fn robust_options(u: &mut Unstructured<'_>, defaults: RobustOptions) -> RobustOptions {
    let threshold = if make::whole(u, 0, 15) == 0 { make::number(u) } else { make::within(u, 0.1, 8.0) };
    RobustOptions { threshold, max_iterations: make::whole(u, 1, 200), seed: make::whole(u, 0, 255) as u64, ..defaults }
}

/// `cv estimate homography|fundamental`, and the essential matrix of known cameras.
pub fn estimate(bytes: &[u8]) -> Corpus {
    let u = &mut Unstructured::new(bytes);
    let Input { pairs, .. } = Input::of(u);
    for kind in [ModelKind::Homography, ModelKind::Fundamental] {
        let options = robust_options(u, kind.options());
        if let Ok(found) = cv_pipeline::estimate(&pairs, kind, &options, &Silent) {
            let robust = found.robust;
            assert!(robust.model.iter().all(|v| v.is_finite()), "{:?}", robust.model);
            assert!(robust.inliers.iter().all(|i| *i < pairs.len()) && robust.rms.is_finite());
            assert!(robust.inliers.windows(2).all(|two| two[0] < two[1]));
        }
    }
    Corpus::Keep
}

/// Verification of an image pair of a panorama.
pub fn homography_pair(bytes: &[u8]) -> Corpus {
    let u = &mut Unstructured::new(bytes);
    let Input { size, pairs, .. } = Input::of(u);
    let RobustOptions { threshold, seed, .. } = robust_options(u, RobustOptions::homography());
    let options = VerifyOptions { threshold, seed, ..VerifyOptions::default() };
    let _ = verify_pair((0, size), (1, size), &pairs, &options);
    Corpus::Keep
}

/// Relative pose from matches of calibrated cameras.
pub fn relative_pose(bytes: &[u8]) -> Corpus {
    let u = &mut Unstructured::new(bytes);
    let Input { size, pairs, .. } = Input::of(u);
    let cameras = [make::camera(u, size), make::camera(u, size)];
    let robust = robust_options(u, RobustOptions::fundamental());
    let _ = cv_pipeline::estimate_calibrated(&pairs, &cameras, &robust, &Silent);
    let (normalized, unit) = normalize_matches(&pairs, &cameras[0], &cameras[1]);
    let robust = RobustOptions { threshold: robust.threshold * unit, ..robust };
    let _ = estimate_relative_pose(&normalized, &robust, &Silent);
    Corpus::Keep
}

/// Two-view reconstruction from matches, with any knowledge of the intrinsics.
pub fn two_view(bytes: &[u8]) -> Corpus {
    let u = &mut Unstructured::new(bytes);
    let Input { size, focal, pairs } = Input::of(u);
    let intrinsics = match make::whole(u, 0, 4) {
        0 => Intrinsics::Unknown,
        1 => Intrinsics::Focal([focal; 2]),
        2 => Intrinsics::Focal([make::number(u), focal]),
        3 => Intrinsics::Matrix([make::camera(u, size), make::camera(u, size)]),
        _ => Intrinsics::Known([make::camera(u, size), make::camera(u, size)]),
    };
    let point = |x: f64, y: f64| Keypoint::new(x as f32, y as f32, 1.0);
    let a: Vec<Keypoint> = pairs.iter().map(|p| point(p.a.x, p.a.y)).collect();
    let b: Vec<Keypoint> = pairs.iter().map(|p| point(p.b.x, p.b.y)).collect();
    let index_offset = u32::from(make::whole(u, 0, 15) == 0);
    let matches: Vec<DMatch> = (0..pairs.len() as u32)
        .map(|i| DMatch { query: i, train: i + index_offset, distance: 0.5, ratio: 0.5 })
        .collect();
    let views = MatchedViews { sizes: [size; 2], keypoints: [&a, &b], matches: &matches };
    let defaults = TwoViewOptions::default();
    let options = TwoViewOptions {
        intrinsics,
        robust: robust_options(u, defaults.robust),
        min_inliers: make::whole(u, 0, 30),
        ..defaults
    };
    if let Ok(scene) = reconstruct_two_views(&views, &options, &Silent) {
        assert!(scene.points.iter().all(|p| p.position.coords.iter().all(|v| v.is_finite())));
        assert!(scene.reprojection_rms.is_finite() && !scene.points.is_empty());
    }
    Corpus::Keep
}

fn depth_options(u: &mut Unstructured<'_>) -> DepthOptions {
    let is_extreme = make::whole(u, 0, 15) == 0;
    let stereo = StereoOptions {
        min_disparity: make::whole(u, 0, 40) as i32 - 20,
        disparities: if is_extreme { make::whole(u, 0, 1 << 20) } else { 16 * make::whole(u, 1, 4) },
        p1: u.arbitrary().unwrap_or(4),
        p2: u.arbitrary().unwrap_or(20),
        uniqueness: u.arbitrary().unwrap_or(5),
        left_right: u.arbitrary().unwrap_or(None),
        speckle_size: make::whole(u, 0, 200),
        speckle_range: make::number(u) as f32,
        median: make::whole(u, 0, 4),
        fill: make::flag(u),
        confidence: make::flag(u),
        max_memory: Some(make::whole(u, 0, 1 << 26)),
        ..StereoOptions::default()
    };
    let disparities = match make::whole(u, 0, 7) {
        0 => DisparityRange::FromMatches { min: None },
        _ => DisparityRange::Given,
    };
    let range = if is_extreme { (make::number(u) as f32, make::number(u) as f32) } else { (0.0, f32::INFINITY) };
    DepthOptions { stereo, disparities, range, ..DepthOptions::default() }
}

pub fn depth(bytes: &[u8]) -> Corpus {
    let u = &mut Unstructured::new(bytes);
    let size = (make::whole(u, 0, 64), make::whole(u, 0, 40));
    let (shift, seed) = (make::whole(u, 0, 20), u.arbitrary::<u16>().unwrap_or(0).into());
    let left = make::photo(u, size, 0, 0, seed);
    let right = make::photo(u, size, shift, 0, seed);
    let [focal, baseline] = if make::whole(u, 0, 7) == 0 { [(); 2].map(|()| make::number(u)) } else { [60.0, 0.2] };
    let geometry = StereoGeometry::from_focal(size.0, size.1, focal, baseline).ok();
    let options = depth_options(u);
    if let Ok(found) = cv_pipeline::depth(left.view(), right.view(), geometry.as_ref(), &options, &Silent) {
        assert_eq!(found.map.disparity.size(), size);
        assert!((0.0..=1.0).contains(&found.map.valid_fraction()));
        assert_eq!(found.cloud(left.view()).is_some(), geometry.is_some());
    }
    Corpus::Keep
}

/// Rectification and depth by any rig.
pub fn rig_depth(bytes: &[u8]) -> Corpus {
    let u = &mut Unstructured::new(bytes);
    let size = (make::whole(u, 1, 48), make::whole(u, 1, 36));
    let (left, right) = (make::camera(u, size), make::camera(u, size));
    let rig = StereoRig { left, right, right_from_left: make::pose(u, 0.3) };
    let size_of_result = make::flag(u).then(|| (make::whole(u, 0, 80), make::whole(u, 0, 80)));
    let alpha = if make::whole(u, 0, 7) == 0 { make::number(u) } else { make::within(u, 0.0, 1.0) };
    let options = RectifyOptions { alpha, size: size_of_result };
    let Ok(rectification) = Rectification::new(&rig, &options) else { return Corpus::Keep };
    let seed = u.arbitrary::<u16>().unwrap_or(0).into();
    let photos = [make::photo(u, size, 0, 0, seed), make::photo(u, size, 3, 0, seed)];
    let options = depth_options(u);
    let _ = cv_pipeline::depth_by_rig(photos[0].view(), photos[1].view(), &rectification, &options, &Silent);
    Corpus::Keep
}

/// Matching and stitching.
pub fn panorama(bytes: &[u8]) -> Corpus {
    let u = &mut Unstructured::new(bytes);
    let size = (make::whole(u, 0, 96), make::whole(u, 0, 80));
    let seed = u.arbitrary::<u16>().unwrap_or(0).into();
    let photos: Vec<_> = (0..make::whole(u, 0, 3))
        .map(|i| {
            let (dx, dy) = (i * make::whole(u, 0, 40), make::whole(u, 0, 6));
            make::photo(u, size, dx, dy, seed)
        })
        .collect();
    let known = make::whole(u, 0, 3);
    let inputs: Vec<PanoramaPhoto<'_>> = photos
        .iter()
        .map(|photo| PanoramaPhoto {
            focal: (known == 1).then(|| make::number(u)),
            camera: (known == 2).then(|| make::camera(u, size)),
            ..PanoramaPhoto::new(photo.view())
        })
        .collect();
    let projections = [Projection::Auto, Projection::Plane, Projection::Cylindrical, Projection::Spherical];
    let blends = [BlendMode::Multiband, BlendMode::Feather, BlendMode::None];
    let defaults = PanoramaOptions::default();
    let render = CompositingOptions {
        projection: projections[make::whole(u, 0, 3)],
        blend: blends[make::whole(u, 0, 2)],
        crop: make::flag(u),
        max_pixels: make::whole(u, 0, 1 << 18),
        ..defaults.render.clone()
    };
    let methods = [FeatureMethod::Sift, FeatureMethod::Mops];
    let matching = MatchingOptions { features: methods[make::whole(u, 0, 1)].into(), ..defaults.matching.clone() };
    let options = PanoramaOptions { matching, render, ..defaults };
    if let Ok(found) = cv_pipeline::panorama(&inputs, &options, &Silent) {
        assert!(found.images.len() == inputs.len() && found.image.size() == found.mask.size());
    }
    Corpus::Keep
}

pub fn segment(bytes: &[u8]) -> Corpus {
    let u = &mut Unstructured::new(bytes);
    let photos: Vec<_> = (0..make::whole(u, 0, 3))
        .map(|_| {
            let size = (make::whole(u, 0, 24), make::whole(u, 0, 20));
            let seed = u.arbitrary::<u16>().unwrap_or(0).into();
            let photo = make::photo(u, size, 0, 0, seed);
            let cut = make::whole(u, 0, 255) as u8;
            // Sometimes of another size than the photograph.
            let wider = usize::from(make::whole(u, 0, 31) == 0);
            let mask =
                Mask::from_fn(size.0 + wider, size.1, |x, y| [size.0 > x && photo.at(x.min(size.0 - 1), y)[0] > cut]);
            (photo, mask)
        })
        .collect();
    let labeled: Vec<Labeled<'_>> = photos.iter().map(|(photo, mask)| (photo.view(), mask.view())).collect();
    let options = TrainOptions {
        components: make::whole(u, 0, 6),
        background_components: make::whole(u, 0, 6),
        smoothing: if make::whole(u, 0, 7) == 0 { make::number(u) as f32 } else { 1.0 },
        regularization: if make::whole(u, 0, 7) == 0 { make::number(u) } else { 1e-6 },
        open_radius: make::whole(u, 0, 40),
        close_radius: make::whole(u, 0, 40),
        ..TrainOptions::default()
    };
    if let Ok(training) = cv_pipeline::train_segment(&labeled, &options, &Silent) {
        let model = training.trained.model;
        for (photo, _) in &photos {
            let found = cv_pipeline::segment(photo.view(), &model, &Silent).expect("there is no cancellation");
            assert_eq!(found.mask.size(), photo.size());
        }
        let text = serde_json::to_string(&model).expect("a model can be serialized");
        let again: Result<cv_pipeline::segmentation::ColorModel, _> = serde_json::from_str(&text);
        assert!(again.is_ok(), "a trained model must be readable: {again:?}\n{text}");
    }
    Corpus::Keep
}

/// Features and matches of two small images.
pub fn match_photos(bytes: &[u8]) -> Corpus {
    let u = &mut Unstructured::new(bytes);
    let size = (make::whole(u, 0, 80), make::whole(u, 0, 64));
    let seed = u.arbitrary::<u16>().unwrap_or(0).into();
    let a = make::photo(u, size, 0, 0, seed);
    let (dx, dy) = (make::whole(u, 0, 20), make::whole(u, 0, 20));
    let b = make::photo(u, size, dx, dy, seed);
    let guided = [None, Some(ModelKind::Homography), Some(ModelKind::Fundamental)][make::whole(u, 0, 2)];
    let methods = [FeatureMethod::Sift, FeatureMethod::Mops];
    let options = MatchingOptions {
        features: methods[make::whole(u, 0, 1)].into(),
        guided,
        mutual: make::flag(u),
        ..MatchingOptions::default()
    };
    if let Ok(found) = cv_pipeline::match_photos(a.view(), b.view(), &options, &Silent) {
        assert_eq!(found.pairs().len(), found.matches.len());
    }
    Corpus::Keep
}
