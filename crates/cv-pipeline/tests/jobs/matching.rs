//! Matches of shifted blobs, and images without features.

use cv_core::{RgbU8, Silent};
use cv_features::FeatureError;
use cv_pipeline::{FeatureMethod, MatchingError, MatchingOptions, match_photos};

/// Renders blobs of many sizes at pseudo-random positions.
fn blobs(shift: (f32, f32)) -> RgbU8 {
    let mut state = 7u32;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    };
    let spots: Vec<[f32; 4]> =
        (0..400).map(|_| [random() * 240.0, random() * 180.0, 0.8 + 4.0 * random(), random() - 0.5]).collect();
    RgbU8::from_fn(240, 180, |x, y| {
        let (x, y) = (x as f32 - shift.0, y as f32 - shift.1);
        let sum: f32 =
            spots.iter().map(|s| s[3] * (-((x - s[0]).powi(2) + (y - s[1]).powi(2)) / (2.0 * s[2] * s[2])).exp()).sum();
        [(128.0 + 120.0 * sum) as u8; 3]
    })
}

#[test]
fn all_methods_find_a_shift() {
    let (a, b) = (blobs((0.0, 0.0)), blobs((6.5, -4.0)));
    for method in [FeatureMethod::Harris, FeatureMethod::Mops, FeatureMethod::Sift] {
        let options = MatchingOptions { features: method.into(), ..MatchingOptions::default() };
        let result = match_photos(a.view(), b.view(), &options, &Silent).unwrap();
        let pairs = result.pairs();
        let correct =
            pairs.iter().filter(|p| (p.b.x - p.a.x - 6.5).abs() < 1.0 && (p.b.y - p.a.y + 4.0).abs() < 1.0).count();
        // The images differ by the shift and by rounding to 8 bits, which moves the maximum of a blob by up to a
        // pixel.
        // Oriented patches at all scales need a wide margin: few fit into this small image.
        let min_correct = if method == FeatureMethod::Mops { 15 } else { 30 };
        assert!(correct >= min_correct && correct * 10 >= pairs.len() * 9, "{method:?}: {correct} of {}", pairs.len());
        assert_eq!(result.matches.len(), pairs.len());
    }
}

#[test]
fn images_without_features_are_errors_with_their_index() {
    let flat = RgbU8::new(100, 80, [9; 3]);
    let good = blobs((0.0, 0.0));
    for method in [FeatureMethod::Harris, FeatureMethod::Mops, FeatureMethod::Sift] {
        let options = MatchingOptions { features: method.into(), ..MatchingOptions::default() };
        let error = match_photos(good.view(), flat.view(), &options, &Silent).unwrap_err();
        assert_eq!(error, MatchingError::NoFeatures { index: 2, found: 0, dropped: 0 });
        let tiny = RgbU8::new(1, 1, [9; 3]);
        let error = match_photos(tiny.view(), good.view(), &options, &Silent).unwrap_err();
        assert!(matches!(
            error,
            MatchingError::Features { index: 1, source: FeatureError::ImageTooSmall { width: 1, height: 1, .. } }
        ));
    }
}
