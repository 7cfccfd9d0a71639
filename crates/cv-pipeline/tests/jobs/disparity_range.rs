//! The range of disparities of a pair.

use cv_core::{Camera, RgbU8, Silent};
use cv_pipeline::disparity_range;
use cv_synth::{RenderOptions, Scene, stereo_pair};

#[test]
fn the_range_of_a_generated_room_is_tight() {
    let camera = Camera::from_focal(320, 240, 280.0);
    // Disparities of 3 to 14 px, and of 8 to 35.
    for (seed, baseline) in (4..7).flat_map(|seed| [(seed, 0.1), (seed, 0.25)]) {
        let scene = Scene::room(seed);
        let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), baseline, &RenderOptions::draft()).unwrap();
        let (min, n) = disparity_range(pair.left.image.view(), pair.right.image.view(), &Silent).unwrap();
        let d = pair.disparity.as_slice();
        let inside = d.iter().filter(|&&d| d >= min as f32 && d <= (min + n as i32 - 1) as f32).count();
        let [smallest, largest] = [f32::min, f32::max].map(|f| d.iter().copied().reduce(f).unwrap());
        println!("room {seed}, {baseline}: {min} and {n}, {smallest} to {largest}: {inside} of {}", d.len());
        // What is seen at the border of the left image only may be nearer than all that is matched.
        assert!(inside as f64 >= 0.99 * d.len() as f64, "{min} {n}: {inside} of {}", d.len());
        // A margin of an eighth and of a pixel of the reduced images at both ends.
        assert!((n as f32) < 1.25 * (largest - smallest) + 12.0, "{min} {n} for {smallest} to {largest}");
    }
}

#[test]
fn the_range_includes_surfaces_without_features() {
    // A slanted floor of weak texture below a wall with corners: features are on the wall only, at a disparity of 10 px.
    let hash = |x: usize, y: usize| {
        let mixed = (x as u32).wrapping_mul(0x9e37_79b9) ^ (y as u32).wrapping_mul(0x85eb_ca6b);
        (mixed ^ (mixed >> 15)).wrapping_mul(0x2c1b_3c6d) >> 24
    };
    let wall = |x: f64, y: usize| 40.0 + f64::from(hash((x / 14.0) as usize, y / 14)) * 0.7;
    // Interpolated along the rows: waves of irregular width, without corners.
    let floor = |x: f64, y: usize| {
        let [cell, part] = [(x / 17.0).floor(), (x / 17.0).fract()];
        let at = |cell: f64| f64::from(hash(cell as usize, y / 40));
        120.0 + 0.1 * (at(cell) * (1.0 - part) + at(cell + 1.0) * part)
    };
    let disparity = |y: usize| if y < 120 { 10.0 } else { 10.0 + (y - 120) as f64 * 0.4 };
    let view = |is_right: bool| {
        RgbU8::from_fn(480, 240, |x, y| {
            let x = x as f64 + if is_right { disparity(y) } else { 0.0 };
            [if y < 120 { wall(x, y) } else { floor(x, y) } as u8; 3]
        })
    };
    let (min, n) = disparity_range(view(false).view(), view(true).view(), &Silent).unwrap();
    // The floor ends at 57.6 px.
    assert!(min <= 10 && (58..90).contains(&(min + n as i32)), "{min} {n}");
}

#[test]
fn images_without_features_are_errors() {
    let flat = RgbU8::new(80, 60, [90; 3]);
    assert!(disparity_range(flat.view(), flat.view(), &Silent).is_err());
}
