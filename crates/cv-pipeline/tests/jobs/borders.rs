//! Black borders of rectified images: pairs that were rotated, against ground truth.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, GrayF32, Image, Mask, Pose, RgbU8, Silent};
use cv_pipeline::{DepthOptions, depth};
use cv_stereo::{DisparityMap, PixelState, RectifiedView, Search, StereoMatcher, StereoOptions};
use cv_synth::{RenderOptions, Scene, StereoPair, render, stereo_pair};
use nalgebra::{Rotation3, Vector3};

const SIZE: (usize, usize) = (400, 300);

/// A pair that was rectified by a rotation of some degrees, with its masks.
struct Rotated {
    images: [RgbU8; 2],
    masks: [Mask; 2],
}

/// Renders a rectified pair for its ground truth, and twice the same views from rotated cameras, rectified: with the field of view of the
/// rectified ones, so that borders are black, and with a larger one.
fn scene(seed: u64) -> (StereoPair, Rotated, Rotated) {
    let scene = Scene::tabletop(seed);
    let camera = Camera::from_focal(SIZE.0, SIZE.1, 325.0);
    let left = scene.viewpoint();
    let baseline = 0.06;
    let right = Pose::new(left.rotation, left.translation - Vector3::new(baseline, 0.0, 0.0));
    let truth = stereo_pair(&scene, &camera, &left, baseline, &RenderOptions::default()).unwrap();
    let rotated = |source: Camera| {
        let turns = [[0.02, -0.05, 0.07], [-0.02, 0.04, -0.05]];
        let [one, two] = [(left, 0), (right, 1)].map(|(pose, i)| {
            let [a, b, c] = turns[i];
            // From the source to the rectified camera.
            let rotation = Rotation3::from_euler_angles(a, b, c);
            let pose = Pose::new(rotation.inverse() * pose.rotation, rotation.inverse() * pose.translation);
            let photo =
                render(&scene, &source, &pose, &RenderOptions::default().with_seed(9 + i as u64)).unwrap().image;
            RectifiedView { source, camera, rotation }.apply(photo.view(), &Silent).unwrap()
        });
        Rotated { images: [one.0, two.0], masks: [one.1, two.1] }
    };
    (truth, rotated(camera), rotated(Camera::from_focal(600, 450, 325.0)))
}

fn matched(images: &[RgbU8; 2], options: StereoOptions) -> DisparityMap {
    let options = StereoOptions { disparities: 64, ..options };
    StereoMatcher::new(options).unwrap().compute(images[0].view(), images[1].view(), &Silent).unwrap()
}

/// Returns the fraction of the pixels of `mask` without a disparity within 2 px of the truth, as errors in percent.
fn bad(map: &DisparityMap, truth: &GrayF32, is_in: impl Fn(usize, usize) -> bool) -> f64 {
    let pixels = (0..truth.height()).flat_map(|y| (0..truth.width()).map(move |x| (x, y)));
    let pixels: Vec<_> = pixels.filter(|&(x, y)| is_in(x, y)).collect();
    let right = pixels.iter().filter(|(x, y)| (map.disparity.at(*x, *y)[0] - truth.at(*x, *y)[0]).abs() <= 2.0);
    100.0 * (1.0 - right.count() as f64 / pixels.len() as f64)
}

fn crop<T: cv_core::Sample, const C: usize>(image: &Image<T, C>, margin: usize) -> Image<T, C> {
    Image::from_fn(SIZE.0 - 2 * margin, SIZE.1 - 2 * margin, |x, y| image.at(x + margin, y + margin))
}

#[test]
fn black_borders_have_no_disparity_and_do_not_harm_the_pixels_beside_them() {
    // Errors of all pixels within 12 px of a border, with it and without.
    let (mut beside, mut without) = (0.0, 0.0);
    for seed in 0..3 {
        let (truth, pair, whole) = scene(seed);
        let mask = &pair.masks[0];
        let map = matched(&pair.images, StereoOptions::default());
        // Detected pixel by pixel: nothing of the scene is exactly black.
        for (x, y) in (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| (x, y))) {
            assert_eq!(map.state.at(x, y)[0] == PixelState::NoData, !mask.at(x, y)[0], "{x}, {y}");
            assert_eq!(map.disparity.at(x, y)[0].is_nan(), !mask.at(x, y)[0], "{x}, {y}");
        }
        let black = mask.as_slice().iter().filter(|valid| !**valid).count() as f64 / (SIZE.0 * SIZE.1) as f64;
        assert!(black > 0.05 && (map.no_data_fraction() - black).abs() < 1e-9 && map.valid_fraction() == 1.0);
        let before = matched(&pair.images, StereoOptions { ignore_black_borders: false, ..Default::default() });
        assert!(before.valid_fraction() == 1.0 && before.no_data_fraction() == 0.0);
        // Visible in both images, within 12 px of the border.
        let is_black = |x: i64, y: i64| {
            (0..SIZE.0 as i64).contains(&x) && (0..SIZE.1 as i64).contains(&y) && !mask.at(x as usize, y as usize)[0]
        };
        let is_near = |x: usize, y: usize| {
            [(-12, 0), (12, 0), (0, -12), (0, 12)].iter().any(|(dx, dy)| is_black(x as i64 + dx, y as i64 + dy))
        };
        let is_seen = |x: usize, y: usize| {
            let column = x as f32 - truth.disparity.at(x, y)[0];
            let has_data = column >= 0.0 && pair.masks[1].at(column as usize, y)[0];
            mask.at(x, y)[0] && truth.visible.at(x, y)[0] && has_data
        };
        let is_beside = |x: usize, y: usize| is_near(x, y) && is_seen(x, y);
        let whole = matched(&whole.images, StereoOptions::default());
        beside += bad(&map, &truth.disparity, is_beside);
        without += bad(&whole, &truth.disparity, is_beside);
        // With the borders cropped away.
        let is_inside = |margin: usize| {
            let inside = |mask: &Mask| crop(mask, margin).as_slice().iter().all(|valid| *valid);
            pair.masks.iter().all(inside)
        };
        let margin = (0..100).find(|margin| is_inside(*margin)).unwrap();
        let cropped = matched(&pair.images.each_ref().map(|image| crop(image, margin)), StereoOptions::default());
        let part = DisparityMap { disparity: crop(&map.disparity, margin), state: crop(&map.state, margin) };
        let (truth, visible) = (crop(&truth.disparity, margin), crop(&truth.visible, margin));
        let is_seen = |x: usize, y: usize| visible.at(x, y)[0] && x as f32 >= truth.at(x, y)[0] + 4.0;
        let (alone, part) = (bad(&cropped, &truth, is_seen), bad(&part, &truth, is_seen));
        println!("seed {seed}: {black:.3} black; inside {part:.2} %, cropped {alone:.2} %");
        assert!((part - alone).abs() < 0.3, "{part} {alone}");
    }
    println!("beside the border {:.2} %, without one {:.2} %", beside / 3.0, without / 3.0);
    assert!(beside < without + 3.0, "{beside} {without}");
}

#[test]
fn masks_of_a_rectification_are_those_of_its_black_pixels_in_every_mode() {
    let (_, pair, _) = scene(1);
    let none = StereoOptions { ignore_black_borders: false, disparities: 64, ..Default::default() };
    let modes = [
        StereoOptions { search: Search::Full, ..none.clone() },
        StereoOptions { search: Search::Hierarchical, disparities: 300, ..none.clone() },
        StereoOptions { fill: false, ..none.clone() },
        StereoOptions { max_memory: Some(14 << 20), ..none.clone() },
        StereoOptions { quality: true, ..none },
    ];
    for options in modes {
        let fill = options.fill || options.quality;
        let mut matcher = StereoMatcher::new(options).unwrap();
        matcher.set_masks(Some([&pair.masks[0], &pair.masks[1]]));
        let map = matcher.compute(pair.images[0].view(), pair.images[1].view(), &Silent).unwrap();
        for (i, valid) in pair.masks[0].as_slice().iter().enumerate() {
            assert_eq!(map.state.as_slice()[i] == PixelState::NoData, !valid);
            assert!(!map.disparity.as_slice()[i].is_finite() || *valid);
            assert!(!fill || map.disparity.as_slice()[i].is_finite() == *valid);
        }
        // No match is in the border of the right image: of those that smoothing moved, by some pixels.
        let into_border = |i: &usize| {
            let column = (i % SIZE.0) as f32 - map.disparity.as_slice()[*i];
            map.state.as_slice()[*i] == PixelState::Matched
                && (0..9).all(|dx| {
                    let column = (column.round().max(0.0) as usize + dx).clamp(4, SIZE.0 + 3) - 4;
                    !pair.masks[1].at(column, i / SIZE.0)[0]
                })
        };
        let count = (0..SIZE.0 * SIZE.1).filter(into_border).count();
        println!(
            "{:?} fill {fill}: {count} matches in the border, {:.3} matched",
            matcher.options().search,
            map.matched_fraction()
        );
        assert!(count < 20, "{count}");
        assert!(map.matched_fraction() > 0.7, "{}", map.matched_fraction());
    }
}

#[test]
fn a_dark_scene_loses_no_pixel() {
    let camera = Camera::from_focal(SIZE.0, SIZE.1, 325.0);
    for seed in 0..2 {
        let (scene, options) = (Scene::room(seed), RenderOptions::default());
        let bright = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.2, &options).unwrap();
        for stops in [-4.0, -6.0] {
            let pair = bright.retake(stops, &options);
            let options = DepthOptions { few_matches: cv_pipeline::FewMatches::Keep, ..Default::default() };
            let map = depth(pair.left.image.view(), pair.right.image.view(), None, &options, &Silent).unwrap().map;
            assert_eq!(map.no_data_fraction(), 0.0);
        }
    }
}
