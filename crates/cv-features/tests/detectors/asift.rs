//! SIFT in simulated oblique views.

use cv_core::{GrayF32, Point2, Silent};
use cv_features::{FeatureError, MatchOptions, SiftOptions, match_descriptors, sift, sift_affine_view};

/// Blobs of various sizes at random positions of a 300 × 260 plane.
fn blobs() -> impl Fn(f32, f32) -> f32 {
    let mut state = 11u32;
    let mut random = move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    };
    let blobs: Vec<[f32; 4]> =
        (0..260).map(|_| [300.0 * random(), 260.0 * random(), 2.5 + 4.0 * random(), random() - 0.5]).collect();
    move |x, y| {
        let value = |s: &[f32; 4]| s[3] * (-((x - s[0]).powi(2) + (y - s[1]).powi(2)) / (2.0 * s[2] * s[2])).exp();
        0.5 + 0.3 * blobs.iter().map(value).sum::<f32>()
    }
}

/// Matches features of the plane with features of an oblique view; counts all and correct matches.
fn matches(tilt: f32, simulated: bool) -> (usize, usize) {
    let f = blobs();
    let rotation = 0.9f32;
    let (sin, cos) = rotation.sin_cos();
    let plane = GrayF32::from_fn(300, 260, |x, y| [f(x as f32, y as f32)]);
    // Maps the oblique view to the center of the plane.
    let to_plane = |x: f32, y: f32| {
        let (x, y) = ((x - 60.0) * tilt, y - 120.0);
        Point2::new(150.0 + cos * x + sin * y, 130.0 + cos * y - sin * x)
    };
    let oblique = GrayF32::from_fn(120, 240, |x, y| {
        let p = to_plane(x as f32, y as f32);
        [f(p.x, p.y)]
    });
    let options = SiftOptions::default();
    let a = if simulated {
        sift_affine_view(plane.view(), &options, tilt, rotation, &Silent)
    } else {
        sift(plane.view(), &options, &Silent)
    };
    let (a, b) = (a.unwrap(), sift(oblique.view(), &options, &Silent).unwrap());
    assert_eq!(a.keypoints.len(), a.descriptors.len());
    let options = MatchOptions { mutual: true, ..MatchOptions::default() };
    let found = match_descriptors(&a.descriptors, &b.descriptors, &options, &Silent).unwrap();
    let correct = found.iter().filter(|m| {
        let (p, q) = (a.keypoints[m.query as usize].position, b.keypoints[m.train as usize].position);
        // Half a pixel of the oblique image is half a tilt in the plane.
        (to_plane(q.x, q.y) - p).norm() < 0.5 * tilt
    });
    (found.len(), correct.count())
}

#[test]
fn an_oblique_view_matches_the_simulated_view_but_not_the_original() {
    let (found, correct) = matches(4.0, true);
    // The two differ by resampling, and the blobs are strongly compressed: most matches are correct.
    assert!(correct >= 20 && correct * 10 >= found * 8, "{correct} of {found}");
    let (_, plain) = matches(4.0, false);
    assert!(plain * 3 < correct, "{plain} and {correct}");
}

#[test]
fn without_tilt_the_result_is_that_of_sift() {
    let f = blobs();
    let image = GrayF32::from_fn(150, 140, |x, y| [f(x as f32, y as f32)]);
    let options = SiftOptions::default();
    let (tilted, plain) = (
        sift_affine_view(image.view(), &options, 1.0, 0.0, &Silent).unwrap(),
        sift(image.view(), &options, &Silent).unwrap(),
    );
    assert_eq!(tilted.descriptors, plain.descriptors);
    for (a, b) in tilted.keypoints.iter().zip(&plain.keypoints) {
        // The angle is computed from its sine and cosine.
        assert!(a.position == b.position && a.scale == b.scale && (a.angle - b.angle).abs() < 1e-5, "{a:?} {b:?}");
    }
    for (tilt, rotation) in [(0.5, 0.0), (f32::NAN, 0.0), (2.0, f32::INFINITY)] {
        let error = sift_affine_view(image.view(), &options, tilt, rotation, &Silent);
        assert!(matches!(error, Err(FeatureError::Option(_))));
    }
    let narrow = GrayF32::new(30, 30, [0.5]);
    let error = sift_affine_view(narrow.view(), &options, 8.0, 0.0, &Silent).unwrap_err();
    assert_eq!(error, FeatureError::ImageTooSmall { width: 4, height: 30, needed: 8 });
    assert!(sift_affine_view(GrayF32::new(0, 0, [0.0]).view(), &options, 2.0, 0.0, &Silent).is_err());
}
