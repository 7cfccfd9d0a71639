//! Multi-scale oriented patches.

use cv_core::{GrayF32, Keypoint, OptionError, Silent};
use cv_features::{
    DropReason, FeatureError, MatchOptions, MopsOptions, MultiScaleOptions, describe_oriented_patches, harris_laplace,
    match_descriptors, mops,
};

/// A texture of random gray squares of three sizes with soft edges.
fn squares(x: f32, y: f32) -> f32 {
    let cell = |size: f32| {
        let soft = |v: f32| {
            let (whole, part) = ((v / size).floor(), (v / size).fract());
            (whole, ((part - 1.0) * size + 1.0).clamp(0.0, 1.0))
        };
        let gray = |i: f32, j: f32| {
            let mut v =
                (i as i32 as u32).wrapping_mul(0x9E37_79B9) ^ (j as i32 as u32 + size as u32).wrapping_mul(0x85EB_CA6B);
            v = (v ^ (v >> 15)).wrapping_mul(0x2C1B_3C6D);
            v = (v ^ (v >> 12)).wrapping_mul(0x297A_2D39);
            ((v ^ (v >> 15)) >> 8) as f32 / (1 << 24) as f32
        };
        let ((i, fx), (j, fy)) = (soft(x + 1000.0 * size), soft(y + 1000.0 * size));
        let top = gray(i, j) * (1.0 - fx) + gray(i + 1.0, j) * fx;
        let bottom = gray(i, j + 1.0) * (1.0 - fx) + gray(i + 1.0, j + 1.0) * fx;
        top * (1.0 - fy) + bottom * fy
    };
    (cell(13.0) + cell(29.0) + cell(61.0)) / 3.0
}

#[test]
fn features_match_under_rotation_scale_and_contrast_change() {
    let (scale, angle) = (1.7f32, 0.8f32);
    let (sin, cos) = angle.sin_cos();
    let a = GrayF32::from_fn(400, 360, |x, y| [squares(x as f32, y as f32)]);
    // Maps a point of the second image to the first.
    let to_first = |x: f32, y: f32| {
        let (x, y) = ((x - 250.0) / scale, (y - 250.0) / scale);
        (200.0 + cos * x + sin * y, 180.0 + cos * y - sin * x)
    };
    // With a change of bias and gain.
    let b = GrayF32::from_fn(500, 500, |x, y| {
        let (x, y) = to_first(x as f32, y as f32);
        [0.1 + 0.6 * squares(x, y)]
    });
    for laplacian in [true, false] {
        let corners = MultiScaleOptions { laplacian, ..MultiScaleOptions::default() };
        let options = MopsOptions { corners, ..MopsOptions::default() };
        let (fa, fb) = (mops(a.view(), &options, &Silent).unwrap(), mops(b.view(), &options, &Silent).unwrap());
        let settings = MatchOptions { mutual: true, ..MatchOptions::default() };
        let found = match_descriptors(&fa.descriptors, &fb.descriptors, &settings, &Silent).unwrap();
        let mut correct = 0;
        for m in &found {
            let (p, q) = (fa.keypoints[m.query as usize], fb.keypoints[m.train as usize]);
            let (x, y) = to_first(q.position.x, q.position.y);
            let rotation = (q.angle - p.angle - angle).rem_euclid(std::f32::consts::TAU);
            // A scale step is 2^(1/3), and the adjacent scales are accepted; the orientation error by resampling is
            // a tenth of a radian.
            let same_scale = (q.scale / p.scale / scale).log2().abs() < 0.4;
            let same_rotation = rotation.min(std::f32::consts::TAU - rotation) < 0.1;
            correct += usize::from((x - p.position.x).hypot(y - p.position.y) < 2.0 && same_scale && same_rotation);
        }
        // By chance, one match in ten thousand would agree in position, scale and rotation; half of them allows for
        // corners that are visible in only one image.
        assert!(correct >= 50 && correct * 2 >= found.len(), "{correct} of {}", found.len());
    }
}

#[test]
fn all_corners_are_accounted_for() {
    let image = GrayF32::from_fn(220, 200, |x, y| [squares(x as f32, y as f32)]);
    let options = MopsOptions { max_features: 20, ..MopsOptions::default() };
    let found = harris_laplace(image.view(), &options.corners, &Silent).unwrap();
    let described = mops(image.view(), &options, &Silent).unwrap();
    assert_eq!(described.keypoints.len(), 20);
    assert_eq!(found.len(), 20 + described.dropped.len() + described.beyond_limit);
    assert!(found.windows(2).all(|k| k[0].response >= k[1].response));
    let margins = described.dropped.iter().filter(|d| matches!(d.reason, DropReason::OutsideImage { .. }));
    assert!(margins.count() > 0);
    for d in &described.dropped {
        let k = found[d.index];
        if let DropReason::OutsideImage { margin } = d.reason {
            let p = k.position;
            assert!(p.x < margin || p.y < margin || p.x + margin > 219.0 || p.y + margin > 199.0, "{k:?} {margin}");
        }
    }
}

#[test]
fn flat_images_have_no_features_and_invalid_input_is_rejected() {
    let options = MopsOptions::default();
    let flat = mops(GrayF32::new(64, 48, [0.7]).view(), &options, &Silent).unwrap();
    assert!(flat.keypoints.is_empty() && flat.dropped.is_empty());
    for (w, h) in [(0, 0), (1, 1), (15, 100)] {
        let error = mops(GrayF32::new(w, h, [0.7]).view(), &options, &Silent).unwrap_err();
        assert_eq!(error, FeatureError::ImageTooSmall { width: w, height: h, needed: 16 });
    }
    let mut image = GrayF32::new(64, 48, [0.7]);
    image.set(3, 4, [f32::NAN]);
    assert_eq!(mops(image.view(), &options, &Silent), Err(FeatureError::NotFinite { x: 3, y: 4 }));
    let bad = MopsOptions { window: f32::NAN, ..options.clone() };
    let image = GrayF32::new(64, 48, [0.7]);
    assert!(matches!(mops(image.view(), &bad, &Silent), Err(FeatureError::Option(OptionError { name: "window", .. }))));
    let unusable = [Keypoint { scale: f32::NAN, ..Keypoint::new(30.0, 30.0, 1.0) }, Keypoint::new(30.0, 20.0, 1.0)];
    let told = describe_oriented_patches(image.view(), &unusable, &options, &Silent).unwrap();
    let reasons: Vec<_> = told.dropped.iter().map(|d| d.reason).collect();
    assert!(matches!(reasons[..], [DropReason::NotFinite, DropReason::Flat { .. }]), "{reasons:?}");
}
