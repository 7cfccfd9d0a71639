//! SIFT keypoints of blobs, and refused images.

use cv_core::{GrayF32, Keypoint, OptionError, Silent};
use cv_features::{FeatureError, SiftOptions, sift};

fn image_of(w: usize, h: usize, f: impl Fn(f32, f32) -> f32) -> GrayF32 {
    GrayF32::from_fn(w, h, |x, y| [f(x as f32, y as f32)])
}

#[test]
fn position_and_scale_of_a_gaussian_blob_are_detected() {
    // The scale-normalized Laplacian of a Gaussian blob of σ0 has its maximum at σ = σ0. That of the difference of
    // Gaussians with k = 2^(1/3) is where its two scales bracket σ0, and a keypoint has the smaller of the two: σ0
    // = σ·2^(1/6) to first order. The input blur of 0.5 is included in the image.
    for (x0, y0, s0) in [(60.3f32, 50.7f32, 4.0f32), (70.0, 60.5, 6.0), (64.25, 61.0, 2.5)] {
        let blob =
            image_of(130, 120, |x, y| 0.1 + 0.8 * (-((x - x0).powi(2) + (y - y0).powi(2)) / (2.0 * s0 * s0)).exp());
        let found = sift(blob.view(), &SiftOptions::default(), &Silent).unwrap();
        let best = found.keypoints.iter().min_by(|a, b| {
            let off = |k: &Keypoint| (k.scale / s0).ln().abs();
            off(a).total_cmp(&off(b))
        });
        let k = best.unwrap();
        assert!((k.position.x - x0).abs() < 0.05 && (k.position.y - y0).abs() < 0.05, "{k:?} not ({x0}, {y0})");
        // Quadratic interpolation over three scales has an error of a tenth of a scale step, 3 %, and the factor
        // 2^(1/6) is a first-order approximation.
        assert!((k.scale * 2f32.powf(1.0 / 6.0) / s0 - 1.0).abs() < 0.06, "{k:?} not σ {s0}");
    }
}

#[test]
fn flat_images_have_no_features_and_invalid_images_are_rejected() {
    let options = SiftOptions::default();
    let flat = sift(GrayF32::new(64, 48, [0.7]).view(), &options, &Silent).unwrap();
    assert!(flat.keypoints.is_empty() && flat.dropped.is_empty() && flat.beyond_limit == 0);
    for (w, h) in [(0, 0), (1, 1), (7, 100)] {
        let error = sift(GrayF32::new(w, h, [0.7]).view(), &options, &Silent).unwrap_err();
        assert_eq!(error, FeatureError::ImageTooSmall { width: w, height: h, needed: 8 });
    }
    let mut image = GrayF32::new(64, 48, [0.7]);
    image.set(3, 4, [f32::NAN]);
    assert_eq!(sift(image.view(), &options, &Silent), Err(FeatureError::NotFinite { x: 3, y: 4 }));
    let bad = SiftOptions { layers: 0, ..options };
    assert!(matches!(sift(image.view(), &bad, &Silent), Err(FeatureError::Option(OptionError { name: "layers", .. }))));
}
