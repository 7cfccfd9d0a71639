//! A custom feature extractor: points on a grid with gray patches.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{GrayF32, ImageView, Keypoint, Progress, Silent};
use cv_features::{
    ByteDescriptors, ByteScale, DescriptorKind, FeatureError, FeatureExtractor, FeatureMethod, FeatureOptions,
    Features, MatchError, MatchOptions, RatioTest, match_descriptors,
};

/// The gray levels of 7×7 pixels minus their mean.
const GRAY: DescriptorKind = DescriptorKind {
    name: "gray",
    dimension: 49,
    ratio: 0.5,
    max_ssd: 1.0,
    bytes: Some(ByteScale { offset: 1.0, factor: 127.0 }),
    patch: Some(7),
};

#[derive(Debug)]
struct GrayValues {
    /// Spacing of the points in pixels.
    step: usize,
}

impl FeatureExtractor for GrayValues {
    fn extract(&self, image: ImageView<'_, f32, 1>, _: &dyn Progress) -> Result<Features, FeatureError> {
        let (width, height) = image.size();
        if width < 7 || height < 7 {
            return Err(FeatureError::ImageTooSmall { width, height, needed: 7 });
        }
        let mut features = Features::new(GRAY);
        for (y, x) in
            (3..height - 3).step_by(self.step).flat_map(|y| (3..width - 3).step_by(self.step).map(move |x| (y, x)))
        {
            let values: Vec<f32> = (0..49).map(|i| image.at(x + i % 7 - 3, y + i / 7 - 3)[0]).collect();
            let mean = values.iter().sum::<f32>() / 49.0;
            let row: Vec<f32> = values.iter().map(|v| v - mean).collect();
            assert!(features.push(Keypoint::new(x as f32, y as f32, 1.0), &row));
        }
        Ok(features)
    }

    fn kind(&self) -> DescriptorKind {
        GRAY
    }
}

/// Deterministic noise, shifted by `shift` pixels to the left.
fn noise(shift: usize) -> GrayF32 {
    GrayF32::from_fn(120, 90, |x, y| {
        let mut v = ((x + shift) as u32).wrapping_mul(0x9E37_79B9) ^ (y as u32).wrapping_mul(0x85EB_CA6B);
        v = (v ^ (v >> 15)).wrapping_mul(0x2C1B_3C6D);
        [((v ^ (v >> 13)) >> 8) as f32 / (1 << 24) as f32]
    })
}

#[test]
fn custom_features_are_matched_with_the_thresholds_of_their_kind() {
    let method = FeatureOptions::Other(std::sync::Arc::new(GrayValues { step: 1 }));
    let extract = |image: &GrayF32| method.extractor().extract(image.view(), &Silent).unwrap();
    let (a, b) = (extract(&noise(0)), extract(&noise(4)));
    assert_eq!((method.extractor().kind(), a.descriptors.kind(), a.detected_count()), (GRAY, GRAY, 114 * 84));
    let matches = match_descriptors(&a.descriptors, &b.descriptors, &MatchOptions::default(), &Silent).unwrap();
    let correct = matches.iter().filter(|m| {
        let (p, q) = (a.keypoints[m.query as usize].position, b.keypoints[m.train as usize].position);
        p - q == cv_core::nalgebra::Vector2::new(4.0, 0.0)
    });
    // Patches in both images are identical; patches in only one image fail the ratio test.
    assert_eq!(correct.count(), 110 * 84);
    assert!(matches.iter().all(|m| m.ratio < GRAY.ratio));
    let all = MatchOptions { ratio: RatioTest::Off, ..MatchOptions::default() };
    assert_eq!(match_descriptors(&a.descriptors, &b.descriptors, &all, &Silent).unwrap().len(), 114 * 84);
    // Half a quantization step, and f32 rounding.
    let bytes = ByteDescriptors::new(&a.descriptors).unwrap().to_descriptors();
    for (v, w) in a.descriptors.as_slice().iter().zip(bytes.as_slice()) {
        assert!((v - w).abs() < 0.5 / 127.0 + 1e-6, "{v} {w}");
    }
}

#[test]
fn custom_descriptors_are_not_compared_with_other_kinds() {
    let own = GrayValues { step: 5 }.extract(noise(0).view(), &Silent).unwrap();
    let mut patches = Features::new(DescriptorKind::PATCH);
    assert!(
        patches.push(Keypoint::new(1.0, 1.0, 1.0), &[0.5; 64])
            && !patches.push(Keypoint::new(1.0, 1.0, 1.0), &[0.5; 63])
    );
    assert_eq!((patches.keypoints.len(), patches.add(&own, 0)), (1, None));
    let error = match_descriptors(&own.descriptors, &patches.descriptors, &MatchOptions::default(), &Silent);
    assert_eq!(error, Err(MatchError::KindsDiffer { query: ("gray", 49), train: ("patch", 64) }));
}

#[test]
fn built_in_methods_implement_the_same_trait() {
    // Blobs, in which every method detects features.
    let image = GrayF32::from_fn(200, 160, |x, y| {
        let blob = |cx: f32, cy: f32| (-((x as f32 - cx).powi(2) + (y as f32 - cy).powi(2)) / 30.0).exp();
        [0.1 + 0.8 * (blob(60.0, 50.0) + blob(120.0, 90.0) + 0.7 * blob(90.0, 110.0)).min(1.0)]
    });
    for method in [FeatureMethod::Harris, FeatureMethod::Mops, FeatureMethod::Sift] {
        let options = FeatureOptions::from(method);
        let features = options.extractor().extract(image.view(), &Silent).unwrap();
        assert_eq!(features.descriptors.kind(), options.extractor().kind());
        assert!(!features.keypoints.is_empty() && features.descriptors.len() == features.keypoints.len(), "{method}");
        let one = options.at_most(1).extractor().extract(image.view(), &Silent).unwrap();
        assert!(one.keypoints.len() <= 1 && one.detected_count() >= features.keypoints.len().min(2), "{method}");
        let tiny = FeatureOptions::from(method);
        let error = tiny.extractor().extract(GrayF32::new(2, 2, [0.5]).view(), &Silent);
        assert!(matches!(error, Err(FeatureError::ImageTooSmall { width: 2, height: 2, .. })), "{method}");
    }
}
