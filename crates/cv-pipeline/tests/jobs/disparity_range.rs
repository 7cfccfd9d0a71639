//! The range of disparities of feature matches.

use cv_core::{Camera, RgbU8, Silent};
use cv_pipeline::disparity_range;
use cv_synth::{RenderOptions, Scene, stereo_pair};

#[test]
fn the_range_of_a_generated_room_is_tight() {
    let scene = Scene::room(4);
    let camera = Camera::from_focal(320, 240, 280.0);
    let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::draft()).unwrap();
    let (min, n) = disparity_range(pair.left.image.view(), pair.right.image.view(), &Silent).unwrap();
    let d = pair.disparity.as_slice();
    let inside = d.iter().filter(|&&d| d >= min as f32 && d <= (min + n as i32 - 1) as f32).count();
    let largest = d.iter().copied().fold(0.0, f32::max);
    // Quantiles of features miss a few pixels of the nearest objects.
    assert!(inside as f64 >= 0.97 * d.len() as f64, "{min} {n}: {inside} of {}", d.len());
    assert!((n as f32) < 1.6 * largest + 10.0, "{min} {n} for {largest}");
}

#[test]
fn images_without_features_are_errors() {
    let flat = RgbU8::new(80, 60, [90; 3]);
    assert!(disparity_range(flat.view(), flat.view(), &Silent).is_err());
}
