//! Matches of an image pair are accepted or rejected by their homography.

use cv_core::Correspondence;
use cv_geometry::{PairRejection, VerifyOptions, verify_pair};

/// `inliers` matches of a shift by (80, 10) and `outliers` uniform ones, in images of 200 x 150.
fn matches(inliers: usize, outliers: usize) -> Vec<Correspondence> {
    let mut state = 12345_u64;
    let mut random = |n: f64| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / f64::from(1_u32 << 31) * n
    };
    let mut all: Vec<_> = (0..inliers)
        .map(|_| {
            let (x, y) = (80.0 + random(118.0), 10.0 + random(138.0));
            Correspondence::new(x, y, x - 80.0, y - 10.0)
        })
        .collect();
    all.extend((0..outliers).map(|_| Correspondence::new(random(200.0), random(150.0), random(200.0), random(150.0))));
    all
}

const SIZE: (usize, usize) = (200, 150);

#[test]
fn a_true_overlap_is_accepted_with_its_homography() {
    let matches = matches(60, 60);
    let pair = verify_pair((4, SIZE), (2, SIZE), &matches, &VerifyOptions::default()).unwrap();
    assert_eq!((pair.a, pair.b), (4, 2));
    assert!(pair.inliers.len() >= 60 && pair.inliers.is_sorted());
    assert_eq!(pair.inliers.iter().map(|&i| matches[i]).collect::<Vec<_>>(), pair.matches);
    // Exact matches; an outlier within 3 px by chance may bias the estimate by a fraction of that.
    assert!((pair.homography[(0, 2)] + 80.0).abs() < 0.5 && (pair.homography[(1, 2)] + 10.0).abs() < 0.5);
}

#[test]
fn insignificant_support_is_rejected() {
    for matches in [matches(0, 100), matches(8, 0), matches(0, 3), matches(9, 80)] {
        assert!(verify_pair((0, SIZE), (1, SIZE), &matches, &VerifyOptions::default()).is_err());
    }
}

#[test]
fn a_mirror_image_is_rejected() {
    let mirrored: Vec<_> =
        matches(80, 0).into_iter().map(|c| Correspondence::new(c.a.x, c.a.y, 200.0 - c.a.x, c.a.y)).collect();
    assert_eq!(
        verify_pair((0, SIZE), (1, SIZE), &mirrored, &VerifyOptions::default()),
        Err(PairRejection::ImplausibleHomography)
    );
}
