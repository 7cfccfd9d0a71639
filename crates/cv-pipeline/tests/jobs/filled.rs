//! Accuracy of filled pixels by the fraction of matched ones: [`DepthResult::is_mostly_filled`] against ground truth.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, Silent};
use cv_pipeline::{DepthOptions, DepthResult, depth};
use cv_stereo::{PixelState, StereoOptions};
use cv_synth::{RenderOptions, Scene, StereoPair, stereo_pair};

/// Returns the fractions of matched and of filled pixels with an error of more than 2 px.
fn outlier_fractions(found: &DepthResult, pair: &StereoPair) -> [f64; 2] {
    let mut counts = [[0u32; 2]; 2];
    let pixels = found.map.disparity.as_slice().iter().zip(pair.disparity.as_slice());
    for ((d, truth), state) in pixels.zip(found.map.state.as_slice()) {
        let of = &mut counts[usize::from(*state != PixelState::Matched)];
        of[0] += 1;
        of[1] += u32::from((d - truth).abs() > 2.0);
    }
    counts.map(|[all, bad]| f64::from(bad) / f64::from(all.max(1)))
}

#[test]
fn the_warning_is_given_where_filled_pixels_are_often_wrong() {
    let camera = Camera::from_focal(400, 300, 325.0);
    let light = RenderOptions::default();
    let mut warned = 0;
    for seed in [501, 503] {
        for (scene, baseline) in [(Scene::room(seed), 0.2), (Scene::tabletop(seed), 0.06)] {
            let bright = stereo_pair(&scene, &camera, &scene.viewpoint(), baseline, &light).unwrap();
            let noisy = RenderOptions { full_well: 40.0, ..light.clone() };
            // As usual, underexposed by four stops, and with a sensor of 40 electrons.
            for pair in [bright.clone(), bright.retake(-4.0, &light), bright.retake(0.0, &noisy)] {
                let stereo = StereoOptions { disparities: 64, ..StereoOptions::default() };
                let options = DepthOptions { stereo, ..DepthOptions::default() };
                let found = depth(pair.left.image.view(), pair.right.image.view(), None, &options, &Silent).unwrap();
                let [matched, filled] = outlier_fractions(&found, &pair);
                println!(
                    "{:.3} matched, {matched:.3} of those wrong, {filled:.3} of the others",
                    found.map.matched_fraction()
                );
                // Matched pixels are correct however few there are: the checks ensure it.
                assert!(matched < 0.06, "{matched}");
                // The worst pair without a warning has 0.15 of its filled pixels wrong; those with a warning have 0.48
                // to 0.80.
                if found.is_mostly_filled() {
                    warned += 1;
                    assert!(filled > 0.2, "{filled}");
                } else {
                    assert!(filled < 0.4, "{filled}");
                }
            }
        }
    }
    assert!((3..=6).contains(&warned), "{warned}");
    // Nothing filled: no warning.
    let pair = stereo_pair(
        &Scene::room(1),
        &camera,
        &Scene::room(1).viewpoint(),
        0.2,
        &RenderOptions { full_well: 40.0, ..light },
    )
    .unwrap();
    let stereo = StereoOptions { disparities: 64, fill: false, ..StereoOptions::default() };
    let options = DepthOptions { stereo, ..DepthOptions::default() };
    let found = depth(pair.left.image.view(), pair.right.image.view(), None, &options, &Silent).unwrap();
    assert!(!found.is_mostly_filled());
}
