//! Depth of generated rooms, and images without one.

use cv_core::{Camera, Image, Silent};
use cv_pipeline::{DepthError, DepthOptions, DisparityRange, FewMatches, NoPairCause, RangeError, depth};
use cv_stereo::{GeometryError, StereoError, StereoGeometry, StereoOptions};
use cv_synth::{RenderOptions, Scene, stereo_pair};

#[test]
fn depth_of_a_generated_room() {
    let scene = Scene::room(1);
    let camera = Camera::from_focal(400, 300, 350.0);
    let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::default()).unwrap();
    let geometry = StereoGeometry::from_focal(400, 300, 350.0, 0.25).unwrap();
    let options =
        DepthOptions { stereo: StereoOptions { disparities: 64, ..Default::default() }, ..Default::default() };
    let result = depth(pair.left.image.view(), pair.right.image.view(), Some(&geometry), &options, &Silent).unwrap();
    let depth = result.depth.unwrap();
    let (mut good, mut all) = (0u32, 0u32);
    for y in 0..300 {
        for x in 0..400 {
            let truth = pair.left.depth.at(x, y)[0];
            if pair.visible.at(x, y)[0] && truth < 10.0 {
                all += 1;
                good += u32::from((depth.at(x, y)[0] - truth).abs() <= 0.05 * truth);
            }
        }
    }
    // The requirement of the project: 95 % of the visible pixels within 5 %.
    assert!(f64::from(good) >= 0.95 * f64::from(all), "{good} of {all}");
}

#[test]
fn images_that_are_no_rectified_pair_are_errors() {
    let scene = Scene::room(1);
    let camera = Camera::from_focal(320, 240, 280.0);
    let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::default()).unwrap();
    let other = stereo_pair(&Scene::tabletop(2), &camera, &scene.viewpoint(), 0.25, &RenderOptions::default()).unwrap();
    let options =
        DepthOptions { stereo: StereoOptions { disparities: 64, ..Default::default() }, ..Default::default() };
    let gray = Image::<u8, 3>::new(320, 240, [90; 3]);
    let (left, right) = (pair.left.image.view(), pair.right.image.view());
    // Uniform images, a uniform image and a photograph, exchanged images, another scene.
    let pairs = [(gray.view(), gray.view()), (gray.view(), right), (right, left), (left, other.right.image.view())];
    for (i, (a, b)) in pairs.into_iter().enumerate() {
        let error = depth(a, b, None, &options, &Silent).map(|found| found.map.matched_fraction()).unwrap_err();
        let DepthError::NoPair { cause, .. } = error else { panic!("{i}: {error}") };
        match i {
            2 => assert!(matches!(cause, NoPairCause::Exchanged { range: (..0, ..9) }), "{cause:?}"),
            _ => assert!(matches!(cause, NoPairCause::Unrelated { .. }), "{i}: {cause:?}"),
        }
    }
    // Exchanged, with the range of the images: negative disparities have no depth.
    let auto = DepthOptions { disparities: DisparityRange::Auto { min: None }, ..Default::default() };
    let error = depth(right, left, None, &auto, &Silent).map(|_| ()).unwrap_err();
    assert!(matches!(error, DepthError::NoRange(RangeError::Exchanged { range: (..-8, ..9) })), "{error}");
    // A given negative minimum is accepted.
    let min = exchanged_min(depth(left, right, None, &auto, &Silent).unwrap().disparities);
    let below = DepthOptions { disparities: DisparityRange::Auto { min: Some(min) }, ..Default::default() };
    assert!(depth(right, left, None, &below, &Silent).unwrap().map.matched_fraction() > 0.5);
    // Ten rows lower; then a range beyond the nearest wall.
    let lower = pair.right.image.view().crop(0, 10, 320, 230).unwrap();
    let error =
        depth(pair.left.image.view().crop(0, 0, 320, 230).unwrap(), lower, None, &options, &Silent).unwrap_err();
    let DepthError::NoPair { cause: NoPairCause::VerticalDisparity { px: apart }, .. } = error else {
        panic!("{error}")
    };
    assert!((apart - 10.0).abs() < 1.0, "{apart}");
    let far = StereoOptions { min_disparity: 200, disparities: 64, ..Default::default() };
    let error = depth(left, right, None, &DepthOptions { stereo: far, ..Default::default() }, &Silent).unwrap_err();
    assert!(matches!(error, DepthError::NoPair { cause: NoPairCause::Range { .. }, .. }), "{error}");
    assert!(depth(left, right, None, &options, &Silent).unwrap().map.matched_fraction() > 0.5);
}

#[test]
fn a_map_with_few_matches_is_kept_if_features_agree() {
    let scene = Scene::room(1);
    let camera = Camera::from_focal(480, 360, 420.0);
    let striped_pair = |scene: &Scene| {
        let pair = stereo_pair(scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::default()).unwrap();
        // A tenth of the rows; around them independent noise.
        let keep_strip = |image: &cv_core::RgbU8, seed: u32| {
            let noise = |x: usize, y: usize| {
                let mixed = ((x * 480 + y) as u32 ^ seed).wrapping_mul(0x9E37_79B1);
                80 + ((mixed ^ (mixed >> 15)).wrapping_mul(0x85EB_CA77) >> 28) as u8
            };
            let kept = 160..196;
            cv_core::RgbU8::from_fn(480, 360, |x, y| if kept.contains(&y) { image.at(x, y) } else { [noise(x, y); 3] })
        };
        ([keep_strip(&pair.left.image, 1), keep_strip(&pair.right.image, 0xABCD_EF01)], pair.disparity)
    };
    let ([left, right], truth) = striped_pair(&scene);
    let ([_, other], _) = striped_pair(&Scene::tabletop(2));
    let options = |disparities, few_matches| DepthOptions {
        stereo: StereoOptions { disparities, fill: false, ..Default::default() },
        few_matches,
        ..Default::default()
    };
    let run = |right: &cv_core::RgbU8, options: &DepthOptions| depth(left.view(), right.view(), None, options, &Silent);
    let result = run(&right, &options(96, FewMatches::Check)).unwrap();
    let agreement = result.feature_agreement.unwrap();
    assert!(agreement.is_enough(), "{agreement:?}");
    let valid = (0..480 * 36).map(|i| (i % 480, 160 + i / 480));
    let valid = valid.filter(|(x, y)| result.map.disparity.at(*x, *y)[0].is_finite());
    let errors = valid.map(|(x, y)| (result.map.disparity.at(x, y)[0] - truth.at(x, y)[0]).abs());
    let errors: Vec<f32> = errors.collect();
    // As for a whole pair, for which nine of ten are within a pixel; windows next to the noise are mostly noise.
    assert!(
        errors.len() > 480 * 18 && errors.iter().filter(|d| **d < 1.0).count() * 10 > errors.len() * 8,
        "{}",
        errors.len()
    );
    // Another scene, and a range below the disparities of the features.
    let error = run(&other, &options(96, FewMatches::Check)).map(|d| d.feature_agreement).unwrap_err();
    let DepthError::NoPair { needed, .. } = error else { panic!("{error}") };
    assert!(result.map.matched_fraction() < needed);
    let nearest = truth.as_slice().iter().copied().fold(0.0, f32::max) as usize;
    let error = run(&right, &options(nearest / 2, FewMatches::Check)).map(|d| d.feature_agreement).unwrap_err();
    assert!(matches!(error, DepthError::NoPair { cause: NoPairCause::Range { .. }, .. }), "{error}");
    // The policy keeps it, if speckles of chance matches are not removed.
    let keep = options(96, FewMatches::Keep);
    let keep = DepthOptions { stereo: StereoOptions { speckle_size: 10, ..keep.stereo }, ..keep };
    assert!(run(&other, &keep).unwrap().feature_agreement.is_some());
}

/// Returns the smallest disparity of the exchanged pair.
fn exchanged_min((first, count): (i32, usize)) -> i32 {
    -(first + count as i32 - 1)
}

#[test]
fn a_map_without_a_depth_is_an_error() {
    let scene = Scene::room(1);
    let camera = Camera::from_focal(320, 240, 280.0);
    let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::default()).unwrap();
    let run = |offset: f64, range: (f32, f32)| {
        let geometry = StereoGeometry { offset, ..StereoGeometry::from_focal(320, 240, 280.0, 0.25).unwrap() };
        let options = DepthOptions {
            stereo: StereoOptions { disparities: 64, ..Default::default() },
            range,
            ..Default::default()
        };
        depth(pair.left.image.view(), pair.right.image.view(), Some(&geometry), &options, &Silent)
    };
    assert!(run(0.0, (0.0, f32::INFINITY)).is_ok());
    // The room is a few meters deep.
    let error = run(0.0, (1000.0, 2000.0)).unwrap_err();
    let DepthError::NoDepth { kept: (1000.0, 2000.0), found: Some((near, far)) } = error else { panic!("{error}") };
    let truth = pair.left.depth.as_slice();
    let farthest = truth.iter().copied().fold(0.0, f32::max);
    assert!(near > 0.0 && near < far && far < 3.0 * farthest, "{near} {far} {farthest}");
    // Principal points so far apart that everything is behind the cameras.
    let error = run(-200.0, (0.0, f32::INFINITY)).unwrap_err();
    assert!(matches!(error, DepthError::NoDepth { found: None, .. }), "{error}");
}

#[test]
fn invalid_input_is_an_error_with_the_numbers() {
    let (a, b) = (Image::<u8, 1>::new(40, 30, [7]), Image::<u8, 1>::new(40, 31, [7]));
    let run = |options: &DepthOptions| depth(a.view(), b.view(), None, options, &Silent).unwrap_err();
    assert_eq!(
        run(&DepthOptions::default()),
        DepthError::Stereo(StereoError::SizeMismatch { left: (40, 30), right: (40, 31) })
    );
    let range = (3.0, 2.0);
    assert_eq!(run(&DepthOptions { range, ..Default::default() }), DepthError::Range { near: 3.0, far: 2.0 });
    let geometry = StereoGeometry { focal: -1.0, cx: 0.0, cy: 0.0, baseline: 1.0, offset: 0.0 };
    assert!(matches!(
        depth(a.view(), a.view(), Some(&geometry), &DepthOptions::default(), &Silent),
        Err(DepthError::Geometry(GeometryError::NotPositive { .. }))
    ));
}
