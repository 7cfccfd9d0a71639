//! Homographies.

use crate::testing::{a_homography, gauss, homography_matches as matches, map, uniform};
use cv_core::{Correspondence, Matrix3, Silent};
use cv_geometry::{
    Degeneracy, EstimateError, RobustOptions, Scoring, estimate_homography, homography_four_point,
    homography_from_points, homography_residual, refine_homography,
};
use proptest::prelude::*;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// Maximum distance between the mapped corners of 640 × 480.
fn corner_error(a: &Matrix3<f64>, b: &Matrix3<f64>) -> f64 {
    [(0.0, 0.0), (639.0, 0.0), (0.0, 479.0), (639.0, 479.0)]
        .iter()
        .map(|&(x, y)| {
            let ((u, v), (s, t)) = (map(a, x, y), map(b, x, y));
            (u - s).hypot(v - t)
        })
        .fold(0.0, f64::max)
}

/// Maximum singular value of the Jacobian of the map at the corners of 640 × 480.
fn largest_magnification(h: &Matrix3<f64>) -> f64 {
    let at = |(x, y): (f64, f64)| {
        let ((u, v), (ux, vx), (uy, vy)) = (map(h, x, y), map(h, x + 1e-3, y), map(h, x, y + 1e-3));
        let jacobian = nalgebra::Matrix2::new(ux - u, uy - u, vx - v, vy - v) * 1e3;
        jacobian.singular_values().max()
    };
    [(0.0, 0.0), (639.0, 0.0), (0.0, 479.0), (639.0, 479.0)].map(at).into_iter().fold(0.0, f64::max)
}

proptest! {
    #[test]
    fn every_entry_is_recovered_from_exact_points(h in a_homography(), n in 4usize..20, seed: u64) {
        let m = matches(&h, n, 0.0, &mut ChaCha8Rng::seed_from_u64(seed));
        // Nearly collinear points lose digits: well-spread ones only.
        let a = [m[0].a, m[1].a, m[2].a, m[3].a];
        let area = |i: usize, j: usize, k: usize| ((a[j] - a[i]).perp(&(a[k] - a[i]))).abs();
        prop_assume!([area(0, 1, 2), area(0, 1, 3), area(0, 2, 3), area(1, 2, 3)].iter().all(|v| *v > 5000.0));
        let found = homography_from_points(&m).unwrap();
        prop_assert_eq!(found[(2, 2)], 1.0);
        // AᵀA halves the number of digits to eight; the perspective terms are of order 1e-4, other entries of order
        // 100.
        prop_assert!(corner_error(&found, &h) < 1e-4, "{}", corner_error(&found, &h));
        for i in 0..9 {
            let unit = if i < 6 { if i % 3 == 2 { 1e-4 } else { 1e-6 } } else { 1e-9 };
            prop_assert!((found[(i / 3, i % 3)] - h[(i / 3, i % 3)]).abs() < unit, "{found} {h}");
        }
        let b = [m[0].b, m[1].b, m[2].b, m[3].b];
        let minimal = homography_four_point(&a, &b).unwrap();
        prop_assert!(corner_error(&minimal, &h) < 1e-6);
    }

    #[test]
    fn accuracy_with_half_outliers_is_close_to_least_squares_on_inliers(h in a_homography(), seed in 0u64..1000) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut m = matches(&h, 100, 0.3, &mut rng);
        for _ in 0..100 {
            m.push(Correspondence::new(640.0 * uniform(&mut rng), 480.0 * uniform(&mut rng), 640.0 * uniform(&mut rng), 480.0 * uniform(&mut rng)));
        }
        let found = estimate_homography(&m, &RobustOptions { seed, ..RobustOptions::homography() }, &Silent).unwrap();
        prop_assert_eq!(found.model[(2, 2)], 1.0);
        // As accurate as least squares on the true inliers, except for the few outliers that fit by chance: half a pixel, times the
        // magnification at the corner, by which perspective amplifies every error there.
        let oracle = refine_homography(&h, &m[..100]).unwrap();
        let tolerance = 0.5 * largest_magnification(&h).max(1.0);
        prop_assert!(corner_error(&found.model, &h) < 2.0 * corner_error(&oracle, &h) + tolerance);
        let true_positives = found.inliers.iter().filter(|i| **i < 100).count();
        // 3 px is ten standard deviations of the noise, before the map's own scale of at most 2.5 and its perspective.
        prop_assert!(true_positives >= 90 && found.inliers.len() <= true_positives + 6, "{true_positives} of {}", found.inliers.len());
    }
}

#[test]
fn residual_of_a_known_homography() {
    let h = Matrix3::new(2.0, 0.0, 3.0, 0.0, 2.0, -1.0, 0.0, 0.0, 1.0);
    // (1, 1) maps to (5, 1), at a distance of 5 from (8, 5), whose pre-image has a distance of 2.5.
    let r = homography_residual(&h, &Correspondence::new(1.0, 1.0, 8.0, 5.0));
    assert!((r - ((25.0 + 6.25) / 2.0f64).sqrt()).abs() < 1e-12);
    assert_eq!(homography_residual(&Matrix3::zeros(), &Correspondence::new(1.0, 1.0, 8.0, 5.0)), f64::INFINITY);
}

#[test]
fn refinement_converges_to_the_exact_entries_on_exact_points() {
    let h = Matrix3::new(1.1, 0.1, 20.0, -0.05, 0.9, -7.0, 2e-4, -1e-4, 1.0);
    let m = matches(&h, 30, 0.0, &mut ChaCha8Rng::seed_from_u64(5));
    let start = Matrix3::new(1.12, 0.1, 25.0, -0.05, 0.91, -5.0, 1.9e-4, -1e-4, 1.0);
    let found = refine_homography(&start, &m).unwrap();
    // Quadratic convergence until the relative decrease of the cost is below 1e-6.
    assert!(corner_error(&found, &h) < 1e-5 && (found - h).norm() < 1e-6, "{found}");
}

#[test]
fn mirrored_images_are_accepted() {
    let h = Matrix3::new(-1.0, 0.0, 639.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0);
    let m = matches(&h, 20, 0.0, &mut ChaCha8Rng::seed_from_u64(5));
    let found = estimate_homography(&m, &RobustOptions::homography(), &Silent).unwrap();
    assert!(corner_error(&found.model, &h) < 1e-6);
}

#[test]
fn invalid_and_degenerate_input_is_a_typed_error() {
    let options = RobustOptions::homography();
    let get = |m: &[Correspondence]| estimate_homography(m, &options, &Silent).map(|r| r.model);
    let good = matches(&Matrix3::identity(), 20, 0.0, &mut ChaCha8Rng::seed_from_u64(1));
    assert_eq!(get(&good[..3]), Err(EstimateError::NotEnoughMatches { got: 3, needed: 4 }));
    assert_eq!(get(&[]), Err(EstimateError::NotEnoughMatches { got: 0, needed: 4 }));
    let mut bad = good.clone();
    bad[7].b.y = f64::NAN;
    assert_eq!(get(&bad), Err(EstimateError::NotFinite { index: 7 }));
    bad[7].b.y = f64::INFINITY;
    assert_eq!(get(&bad), Err(EstimateError::NotFinite { index: 7 }));
    // A very large finite coordinate is an outlier.
    bad[7].b.y = 1e9;
    assert!(corner_error(&get(&bad).unwrap(), &Matrix3::identity()) < 1e-3);
    let same = vec![good[0]; 30];
    assert_eq!(get(&same), Err(EstimateError::Degenerate { kind: Degeneracy::Coincident }));
    assert_eq!(homography_from_points(&same), Err(EstimateError::Degenerate { kind: Degeneracy::Coincident }));
    let line: Vec<_> = (0..30).map(f64::from).map(|i| Correspondence::new(i, 2.0 * i, i + 3.0, 2.0 * i)).collect();
    assert!(matches!(get(&line), Err(EstimateError::Degenerate { kind: Degeneracy::Collinear })), "{:?}", get(&line));
    assert_eq!(homography_from_points(&line), Err(EstimateError::Degenerate { kind: Degeneracy::Collinear }));
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let noisy: Vec<_> =
        line.iter().map(|m| Correspondence::new(m.a.x, m.a.y + 0.3 * gauss(&mut rng), m.b.x, m.b.y)).collect();
    assert_eq!(get(&noisy), Err(EstimateError::Degenerate { kind: Degeneracy::Collinear }));
    let repeated: Vec<_> = (0..30).map(|i| good[i % 3]).collect();
    assert_eq!(get(&repeated), Err(EstimateError::Degenerate { kind: Degeneracy::Coincident }));
    assert!(homography_from_points(&repeated).is_err());
    for (threshold, confidence) in [(0.0, 0.99), (f64::NAN, 0.99), (3.0, 1.0), (3.0, f64::NAN)] {
        let options = RobustOptions { threshold, confidence, ..options };
        assert!(matches!(estimate_homography(&good, &options, &Silent), Err(EstimateError::Option(_))));
    }
}

#[test]
fn the_result_does_not_depend_on_the_number_of_threads() {
    let h = Matrix3::new(1.1, 0.1, 20.0, -0.05, 0.9, -7.0, 2e-4, -1e-4, 1.0);
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    // Enough data for parallel evaluation.
    let mut m = matches(&h, 5000, 0.5, &mut rng);
    m.extend((0..5000).map(|_| {
        Correspondence::new(
            640.0 * uniform(&mut rng),
            480.0 * uniform(&mut rng),
            640.0 * uniform(&mut rng),
            480.0 * uniform(&mut rng),
        )
    }));
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            estimate_homography(&m, &RobustOptions { scoring: Scoring::Msac, ..RobustOptions::homography() }, &Silent)
                .unwrap()
        })
    };
    let (one, four) = (run(1), run(4));
    assert_eq!(one.model.as_slice(), four.model.as_slice());
    assert_eq!(one, four);
}
