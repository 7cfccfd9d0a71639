//! Gray patches at corners.

use cv_core::{GrayF32, Keypoint};
use cv_features::{DropReason, FeatureError, PatchOptions, describe_patches};

fn texture(x: f32, y: f32) -> f32 {
    0.5 + 0.2 * (0.31 * x + 0.1 * y).sin() + 0.2 * (0.23 * y - 0.07 * x).cos() + 0.05 * (0.011 * x * y).sin()
}

#[test]
fn patches_are_invariant_to_gain_and_bias_and_covariant_with_shifts() {
    let a = GrayF32::from_fn(100, 90, |x, y| [texture(x as f32, y as f32)]);
    // A change of bias and gain, and a shift by (2.5, 1.25) pixels.
    let b = GrayF32::from_fn(100, 90, |x, y| [0.1 + 0.6 * texture(x as f32 - 2.5, y as f32 - 1.25)]);
    let options = PatchOptions::default();
    let pa = describe_patches(a.view(), &[Keypoint::new(50.0, 45.0, 1.0)], &options).unwrap();
    let pb = describe_patches(b.view(), &[Keypoint::new(52.5, 46.25, 1.0)], &options).unwrap();
    let (mean, square) =
        pa.descriptors.row(0).iter().fold((0.0f64, 0.0f64), |(s, q), &v| (s + f64::from(v), q + f64::from(v).powi(2)));
    // 64 values of order one rounded to f32.
    assert!(mean.abs() < 1e-4 && (square - 64.0).abs() < 1e-3, "{mean} {square}");
    let ssd: f32 = pa.descriptors.row(0).iter().zip(pb.descriptors.row(0)).map(|(a, b)| (a - b) * (a - b)).sum();
    // Bilinear interpolation of the blurred waves (periods over 20 px) has an error below 2 % of their standard
    // deviation, per value: 64 · 0.02².
    assert!(ssd < 64.0 * 4e-4, "{ssd}");
}

#[test]
fn dropped_keypoints_have_a_reason() {
    let mut image = GrayF32::from_fn(120, 100, |x, y| [texture(x as f32, y as f32)]);
    for y in 40..100 {
        image.row_mut(y)[50..120].fill(0.25);
    }
    let points = [
        Keypoint::new(19.0, 50.0, 1.0),
        Keypoint::new(20.0, 50.0, 1.0),
        Keypoint::new(88.0, 72.0, 1.0),
        Keypoint::new(99.6, 50.0, 1.0),
        Keypoint::new(f32::NAN, 50.0, 1.0),
    ];
    let described = describe_patches(image.view(), &points, &PatchOptions::default()).unwrap();
    assert_eq!(described.keypoints, [points[1]]);
    assert_eq!(described.descriptors.len(), 1);
    let reasons: Vec<_> = described.dropped.iter().map(|d| (d.index, d.reason)).collect();
    assert_eq!(reasons[0], (0, DropReason::OutsideImage { margin: 20.0 }));
    assert!(matches!(reasons[1], (2, DropReason::Flat { deviation }) if deviation < 1e-3));
    assert_eq!(reasons[2], (3, DropReason::OutsideImage { margin: 20.0 }));
    assert_eq!(reasons[3], (4, DropReason::NotFinite));
}

#[test]
fn images_smaller_than_the_window_are_rejected() {
    let image = GrayF32::new(39, 100, [0.5]);
    assert_eq!(
        describe_patches(image.view(), &[], &PatchOptions::default()),
        Err(FeatureError::ImageTooSmall { width: 39, height: 100, needed: 40 })
    );
}
