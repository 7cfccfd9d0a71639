//! Fundamental matrices.

use crate::testing::{TwoViews, cosine};
use cv_core::{Correspondence, Matrix3, Point2, Silent, Vector3};
use cv_geometry::{
    Degeneracy, EstimateError, RobustOptions, estimate_fundamental, fundamental_eight_point, fundamental_seven_point,
    sampson,
};
use proptest::prelude::*;

/// Draws inlier matches of points on one slanted plane.
fn planar_matches(views: &TwoViews, n: usize, noise: f64) -> Vec<Correspondence> {
    let plane = Vector3::new(0.03, -0.02, 0.125);
    (0..n).map(|_| views.noisy(views.point(Some(plane)).1, noise)).collect()
}

/// Computes the RMS Sampson distance of new exact matches from `f`, in pixels.
fn exact_rms(views: &TwoViews, f: &Matrix3<f64>) -> f64 {
    let m = views.matches(100, 0.0);
    (m.iter().map(|m| sampson(f, m).powi(2)).sum::<f64>() / 100.0).sqrt()
}

/// Scales a matrix to Frobenius norm 1 and makes its entry of largest magnitude positive.
fn normalize_scale_and_sign(f: &Matrix3<f64>) -> Matrix3<f64> {
    f * (1.0 / f.norm()).copysign(f[f.iamax_full()])
}

fn points<const N: usize>(m: &[Correspondence]) -> ([Point2<f64>; N], [Point2<f64>; N]) {
    (std::array::from_fn(|i| m[i].a), std::array::from_fn(|i| m[i].b))
}

proptest! {
    #[test]
    fn eight_point_algorithm_recovers_every_entry_from_exact_points(seed: u64, n in 8usize..30) {
        let views = TwoViews::random(seed);
        let f = fundamental_eight_point(&views.matches(n, 0.0)).unwrap();
        let truth = normalize_scale_and_sign(&views.fundamental());
        // Some random configurations are nearly degenerate and lose digits; entries are of order 1e-6 to 1.
        prop_assert!(1.0 - cosine(&f, &truth) < 1e-9, "{f} {truth}");
        prop_assert!((f.norm() - 1.0).abs() < 1e-12 && f.determinant().abs() < 1e-12);
        prop_assert!((f - truth).norm() < 1e-4);
    }

    #[test]
    fn one_of_the_seven_point_solutions_is_the_truth(seed: u64) {
        let views = TwoViews::random(seed);
        let m = views.normalized_matches(7, 0.0);
        let (a, b) = points(&m);
        let mut best = 0.0f64;
        let mut count = 0;
        fundamental_seven_point(&a, &b, |f| {
            count += 1;
            best = best.max(cosine(&f, &views.essential()));
            assert!((f.norm() - 1.0).abs() < 1e-12);
            // All solutions satisfy the constraints.
            for m in &m {
                assert!(m.b.to_homogeneous().dot(&(f * m.a.to_homogeneous())).abs() < 1e-8);
            }
            assert!(f.determinant().abs() < 1e-9, "{}", f.determinant());
        });
        prop_assert!((1..=3).contains(&count));
        prop_assert!(1.0 - best < 1e-6, "{best}");
    }
}

#[test]
fn accuracy_with_outliers_is_close_to_least_squares_on_inliers() {
    let mut errors = Vec::new();
    let mut linear = Vec::new();
    for seed in 0..40 {
        let views = TwoViews::random(seed);
        let mut m = views.matches(150, 0.3);
        m.extend(views.outliers(100));
        let found = estimate_fundamental(&m, &RobustOptions { seed, ..RobustOptions::fundamental() }, &Silent).unwrap();
        // The error on exact points that were not used in the estimation.
        errors.push(exact_rms(&views, &found.model));
        linear.push(exact_rms(&views, &fundamental_eight_point(&m[..150]).unwrap()));
        let true_positives = found.inliers.iter().filter(|i| **i < 150).count();
        // 1 px is 3.3 standard deviations; an outlier is that close to an epipolar line with a probability of about
        // 2/480.
        assert!(
            true_positives >= 140 && found.inliers.len() - true_positives <= 12,
            "{true_positives} {}",
            found.inliers.len()
        );
    }
    errors.sort_by(f64::total_cmp);
    linear.sort_by(f64::total_cmp);
    // Nearly as accurate as the linear method on the true inliers; never worse than the threshold.
    assert!(errors[20] < 1.5 * linear[20] && errors[39] < 1.0, "{errors:?} {linear:?}");
}

#[test]
fn a_dominant_plane_is_not_degenerate() {
    let mut errors = Vec::new();
    for seed in 0..20 {
        let views = TwoViews::random(seed);
        // Nine in ten inliers are on one plane.
        let mut m = planar_matches(&views, 180, 0.3);
        m.extend(views.matches(20, 0.3));
        m.extend(views.outliers(40));
        let found = estimate_fundamental(&m, &RobustOptions { seed, ..RobustOptions::fundamental() }, &Silent).unwrap();
        errors.push(exact_rms(&views, &found.model));
    }
    errors.sort_by(f64::total_cmp);
    // Twenty points with a noise of 0.3 px determine the two degrees of freedom that the plane leaves, to 0.3 px ·
    // √(2/20) = 0.1 px where they are spread; a degenerate solution is off by tens of pixels.
    assert!(errors[10] < 0.2 && errors[19] < 1.0, "{errors:?}");
}

#[test]
fn a_planar_scene_is_reported_as_degenerate() {
    for seed in 0..10 {
        let views = TwoViews::random(seed);
        let m = planar_matches(&views, 100, 0.1);
        let found = estimate_fundamental(&m, &RobustOptions { seed, ..RobustOptions::fundamental() }, &Silent);
        assert_eq!(
            found.map(|r| r.inliers.len()),
            Err(EstimateError::Degenerate { kind: Degeneracy::Planar }),
            "{seed}"
        );
    }
}

#[test]
fn sampson_distance_of_a_rectified_pair() {
    // bᵀ F a = a.y − b.y; the correction moves each point by half of the difference: |Δy|/√2 in total.
    let f = Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
    let d = sampson(&f, &Correspondence::new(10.0, 7.0, 3.0, 10.0));
    assert!((d - 3.0 / 2f64.sqrt()).abs() < 1e-12);
}

#[test]
fn invalid_and_degenerate_input_is_a_typed_error() {
    let views = TwoViews::random(1);
    let get =
        |m: &[Correspondence]| estimate_fundamental(m, &RobustOptions::fundamental(), &Silent).map(|r| r.inliers.len());
    let good = views.matches(30, 0.0);
    assert_eq!(get(&good[..7]), Err(EstimateError::NotEnoughMatches { got: 7, needed: 8 }));
    assert_eq!(get(&vec![good[0]; 30]), Err(EstimateError::Degenerate { kind: Degeneracy::Coincident }));
    let repeated: Vec<_> = (0..30).map(|i| good[i % 6]).collect();
    assert_eq!(get(&repeated), Err(EstimateError::Degenerate { kind: Degeneracy::Coincident }));
    let line: Vec<_> = (0..30).map(f64::from).map(|i| Correspondence::new(i, 2.0 * i, i + 3.0, 2.0 * i)).collect();
    assert_eq!(get(&line), Err(EstimateError::Degenerate { kind: Degeneracy::Collinear }));
    let mut bad = good.clone();
    bad[3].a.x = f64::NAN;
    assert_eq!(get(&bad), Err(EstimateError::NotFinite { index: 3 }));
    bad[3].a.x = 1e9;
    assert_eq!(get(&bad), Ok(29));
    let plane = planar_matches(&views, 30, 0.0);
    assert_eq!(fundamental_eight_point(&plane), Err(EstimateError::Degenerate { kind: Degeneracy::Planar }));
    assert_eq!(fundamental_eight_point(&plane[..8]), Err(EstimateError::Degenerate { kind: Degeneracy::Planar }));
}
