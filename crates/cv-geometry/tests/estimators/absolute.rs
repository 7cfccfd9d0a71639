//! Absolute pose from points and their images.

use crate::testing::{TwoViews, gauss, uniform};
use cv_core::{Point2, Point3, Pose, Silent};
use cv_geometry::{Degeneracy, EstimateError, RobustOptions, WorldMatch, estimate_pose, pose_from_points, refine_pose};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

fn world(seed: u64, n: usize, noise: f64) -> (TwoViews, Vec<WorldMatch>) {
    let views = TwoViews::random(seed);
    let mut rng = ChaCha8Rng::seed_from_u64(seed + 77);
    let matches = (0..n)
        .map(|_| {
            let (p, pair) = views.point(None);
            let image = views.normalize(&pair).b + nalgebra::Vector2::from_fn(|_, _| noise * gauss(&mut rng));
            WorldMatch { world: p, image }
        })
        .collect();
    (views, matches)
}

fn error(a: &Pose, b: &Pose) -> [f64; 2] {
    [(a.rotation.matrix() - b.rotation.matrix()).norm(), (a.translation - b.translation).norm()]
}

#[test]
fn dlt_recovers_the_exact_pose() {
    for seed in 0..50 {
        let (views, m) = world(seed, 6 + seed as usize % 20, 0.0);
        let [r, t] = error(&pose_from_points(&m).unwrap(), &views.pose);
        // Some configurations of six random points are nearly critical and lose digits.
        assert!(r < 1e-6 && t < 1e-5, "{seed} {r} {t}");
    }
}

#[test]
fn accuracy_with_outliers_is_close_to_least_squares_on_inliers() {
    for seed in 0..20 {
        // Half a pixel at a focal length of 500 px; an outlier ratio of 0.6.
        let (views, mut m) = world(seed, 100, 1e-3);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for m in &mut m[40..] {
            m.image = Point2::new(1.2 * uniform(&mut rng) - 0.6, uniform(&mut rng) - 0.5);
        }
        let options = RobustOptions { threshold: 4e-3, seed, ..RobustOptions::default() };
        let found = estimate_pose(&m, &options, &Silent).unwrap();
        let least_squares = refine_pose(&views.pose, &m[..40], 1.0).0;
        let ([r, t], [r0, t0]) = (error(&found.model, &views.pose), error(&least_squares, &views.pose));
        // About as accurate as least squares on the true inliers; forty points with that noise determine a rotation
        // to 1e-3.
        assert!(r < 1.5 * r0 + 1e-3 && t < 1.5 * t0 + 5e-3, "{seed}: {r} {r0} {t} {t0}");
        let true_positives = found.inliers.iter().filter(|i| **i < 40).count();
        // Four standard deviations in two dimensions include all but one in three thousand.
        assert!(true_positives >= 39 && found.inliers.len() <= true_positives + 3);
    }
}

#[test]
fn invalid_and_degenerate_input_is_a_typed_error() {
    let (_, good) = world(1, 20, 0.0);
    let options = RobustOptions { threshold: 1e-3, ..RobustOptions::default() };
    let get = |m: &[WorldMatch]| estimate_pose(m, &options, &Silent).unwrap_err();
    assert_eq!(get(&good[..3]), EstimateError::NotEnoughMatches { got: 3, needed: 4 });
    assert_eq!(get(&[good[0]; 9]), EstimateError::Degenerate { kind: Degeneracy::Coincident });
    let line: Vec<_> = (0..9)
        .map(|i| WorldMatch { world: Point3::new(f64::from(i), 1.0, 5.0), image: good[i as usize].image })
        .collect();
    assert_eq!(get(&line), EstimateError::Degenerate { kind: Degeneracy::Collinear });
    let mut bad = good.clone();
    bad[4].world.z = f64::NAN;
    assert_eq!(get(&bad), EstimateError::NotFinite { index: 4 });
    bad[4].world.z = 1e9;
    assert_eq!(estimate_pose(&bad, &options, &Silent).unwrap().inliers.len(), 19);
    let flat: Vec<_> =
        good.iter().map(|m| WorldMatch { world: Point3::new(m.world.x, m.world.y, 5.0), ..*m }).collect();
    assert_eq!(pose_from_points(&flat), Err(EstimateError::Degenerate { kind: Degeneracy::Planar }));
    assert_eq!(pose_from_points(&good[..5]), Err(EstimateError::NotEnoughMatches { got: 5, needed: 6 }));
}
