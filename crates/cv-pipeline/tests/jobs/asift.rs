//! Matches of a large slanted plane.

use cv_core::{RgbU8, Silent};
use cv_pipeline::{AffineSimulation, MatchingOptions, match_photos};

/// A large plane, frontal and at a slant of 75°: the views are selected at reduced resolution.
#[test]
fn a_large_slanted_plane_has_correct_matches() {
    let mut state = 5u32;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    };
    // Large enough to survive a compression by four.
    let spots: Vec<[f32; 4]> =
        (0..500).map(|_| [960.0 * random(), 540.0 * random(), 6.0 + 8.0 * random(), random() - 0.5]).collect();
    let plane = |x: f32, y: f32| {
        let near = |s: &&[f32; 4]| (x - s[0]).abs() < 4.0 * s[2] && (y - s[1]).abs() < 4.0 * s[2];
        let value = |s: &[f32; 4]| s[3] * (-((x - s[0]).powi(2) + (y - s[1]).powi(2)) / (2.0 * s[2] * s[2])).exp();
        [(128.0 + 100.0 * spots.iter().filter(near).map(value).sum::<f32>()).clamp(0.0, 255.0) as u8; 3]
    };
    let front = RgbU8::from_fn(960, 540, |x, y| plane(x as f32, y as f32));
    let slanted = RgbU8::from_fn(240, 540, |x, y| plane(4.0 * x as f32, y as f32));
    let correct_and_all = |affine_simulation| {
        let options = MatchingOptions { affine_simulation, ..MatchingOptions::default() };
        let pairs = match_photos(front.view(), slanted.view(), &options, &Silent).unwrap().pairs();
        // Two pixels in either image: the duplicate radius.
        let holds = |p: &&cv_core::Correspondence| (p.a.x - 4.0 * p.b.x).abs() < 8.0 && (p.a.y - p.b.y).abs() < 2.0;
        (pairs.iter().filter(holds).count(), pairs.len())
    };
    let (plain, with) = (correct_and_all(AffineSimulation::Never), correct_and_all(AffineSimulation::Always));
    // A hundred of the 500 blobs, with nearly all matches correct.
    assert!(with.0 >= 100 && 10 * with.0 >= 9 * with.1, "{with:?}, plain {plain:?}");
    assert!(with.0 > 3 * plain.0, "{with:?}, plain {plain:?}");
}
