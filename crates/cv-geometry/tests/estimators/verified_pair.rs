//! Matches of an image pair are accepted or rejected by their homography.

use cv_core::{Camera, Correspondence, Distortion, Point2, Silent};
use cv_geometry::{PairRejection, RobustOptions, VerifyOptions, estimate_homography, verify_pair};
use nalgebra::Rotation3;

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

/// Matches between two views of a camera of 640 x 480 that turns by 25 degrees, with k1 = `k1` and a field of view of 60 degrees,
/// with an error of half a pixel, and a fifth of outliers.
fn turned(k1: f64) -> Vec<Correspondence> {
    let camera = Camera { distortion: Distortion::radial(k1, 0.0), ..Camera::from_focal(640, 480, 554.0) };
    let turn = Rotation3::from_euler_angles(0.03, -25.0_f64.to_radians(), 0.02);
    let mut state = 7_u64;
    let mut random = |n: f64| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / f64::from(1_u32 << 31) * n
    };
    let mut matches = Vec::new();
    while matches.len() < 300 {
        let a = Point2::new(random(639.0), random(479.0));
        let n = camera.normalize(a);
        let Some(b) = n.x.is_finite().then(|| camera.project(&(turn * n.to_homogeneous()).into())).flatten() else {
            continue;
        };
        let is_inside = (0.0..639.0).contains(&b.x) && (0.0..479.0).contains(&b.y);
        if is_inside {
            matches.push(Correspondence::new(a.x, a.y, b.x + random(1.0) - 0.5, b.y + random(1.0) - 0.5));
        }
    }
    matches.extend((0..75).map(|_| Correspondence::new(random(640.0), random(480.0), random(640.0), random(480.0))));
    matches
}

#[test]
fn matches_of_a_distorting_lens_are_found_in_the_whole_overlap() {
    let options = VerifyOptions::default();
    let plain = RobustOptions { threshold: options.threshold, ..RobustOptions::homography() };
    for k1 in [-0.3, -0.2, 0.25] {
        let matches = turned(k1);
        let pair = verify_pair((0, (640, 480)), (1, (640, 480)), &matches, &options).unwrap();
        let true_inliers = |inliers: &[usize]| inliers.iter().filter(|i| **i < 300).count();
        let (found, without) = (
            true_inliers(&pair.inliers),
            true_inliers(&estimate_homography(&matches, &plain, &Silent).unwrap().inliers),
        );
        println!("k1 = {k1}: {found} of 300, {without} without distortion; λ = {}", pair.distortion);
        // The division model is within the threshold of the polynomial one but for the corners, where that folds back.
        assert!(
            found >= 225 && 4 * without < 3 * found && pair.inliers.len() - found <= 5,
            "k1 = {k1}: {found}, {without}"
        );
        assert_eq!(pair.distortion.signum(), k1.signum());
    }
}

#[test]
fn matches_without_distortion_are_those_of_a_homography() {
    let pair = verify_pair((0, (640, 480)), (1, (640, 480)), &turned(0.0), &VerifyOptions::default()).unwrap();
    assert_eq!(pair.distortion, 0.0);
    assert_eq!(pair.inliers.iter().filter(|i| **i < 300).count(), 300);
}
