//! Similarities of two point sets with outliers.

use crate::testing::{gauss, uniform};
use cv_core::{Point3, Rotation3, Silent, Vector3};
use cv_geometry::{Degeneracy, EstimateError, RobustOptions, Similarity, SimilarityFreedom, estimate_similarity};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

const FREE: SimilarityFreedom = SimilarityFreedom { scale: true, tilt: true };

/// Points around the origin, and their noisy images under a similarity with a large translation.
fn point_sets(seed: u64, n: usize, noise: f64, tilt: bool) -> (Similarity, Vec<Point3<f64>>, Vec<Point3<f64>>) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut rotation_vector = Vector3::from_fn(|_, _| gauss(&mut rng));
    if !tilt {
        (rotation_vector.x, rotation_vector.y) = (0.0, 0.0);
    }
    let truth = Similarity {
        scale: 1.0 + 5.0 * uniform(&mut rng),
        rotation: Rotation3::new(rotation_vector),
        translation: Vector3::new(5e5, 4e6, 300.0),
    };
    let a: Vec<_> = (0..n).map(|_| Point3::from(Vector3::from_fn(|_, _| 4.0 * gauss(&mut rng)))).collect();
    let b = a.iter().map(|p| truth.transform(p) + Vector3::from_fn(|_, _| noise * gauss(&mut rng))).collect();
    (truth, a, b)
}

#[test]
fn the_similarity_is_accurate_with_outliers() {
    for seed in 0..20 {
        for tilt in [true, false] {
            let (truth, a, mut b) = point_sets(seed, 30, 0.1, tilt);
            let mut rng = ChaCha8Rng::seed_from_u64(seed + 99);
            for q in &mut b[..12] {
                *q += Vector3::from_fn(|_, _| 30.0 * gauss(&mut rng) + 10.0);
            }
            let freedom = SimilarityFreedom { tilt, ..FREE };
            let options = RobustOptions { threshold: 0.4, seed, ..RobustOptions::default() };
            let found = estimate_similarity(&a, &b, freedom, &options, &Silent).unwrap();
            // Eighteen points with a noise of 0.1 over 4 to 24 units: 0.01 is four standard deviations.
            assert!((found.model.scale / truth.scale - 1.0).abs() < 0.03, "{seed}: {}", found.model.scale);
            let rotation_error = (found.model.rotation.matrix() - truth.rotation.matrix()).norm();
            assert!(
                rotation_error < 0.06 && (tilt || found.model.rotation.matrix()[(2, 2)] == 1.0),
                "{seed}: {rotation_error}"
            );
            // Four standard deviations in three dimensions include all but one in a thousand.
            let true_positives = found.inliers.iter().filter(|i| **i >= 12).count();
            assert!(true_positives >= 17 && found.inliers.len() <= true_positives + 1, "{seed}: {:?}", found.inliers);
            assert!((0.08..0.25).contains(&found.rms), "{}", found.rms);
        }
    }
}

#[test]
fn a_fixed_scale_is_one() {
    let (truth, a, b) = point_sets(3, 10, 0.0, true);
    let rigid = SimilarityFreedom { scale: false, tilt: true };
    let scaled: Vec<_> = a.iter().map(|p| p * truth.scale).collect();
    let options = RobustOptions { threshold: 0.01, ..RobustOptions::default() };
    let found = estimate_similarity(&scaled, &b, rigid, &options, &Silent).unwrap();
    assert!(found.model.scale == 1.0 && found.inliers.len() == 10);
    // With a wrong fixed scale, there is no consensus beyond the minimal sample.
    assert!(estimate_similarity(&a, &b, rigid, &options, &Silent).is_err());
}

#[test]
fn degenerate_configurations_are_rejected() {
    let options = RobustOptions { threshold: 0.1, ..RobustOptions::default() };
    let line: Vec<_> = (0..6).map(|i| Point3::new(f64::from(i), 2.0 * f64::from(i), 1.0)).collect();
    let get = |a: &[Point3<f64>], freedom| estimate_similarity(a, a, freedom, &options, &Silent);
    assert_eq!(get(&line, FREE).unwrap_err(), EstimateError::Degenerate { kind: Degeneracy::Collinear });
    assert_eq!(get(&line[..2], FREE).unwrap_err(), EstimateError::NotEnoughMatches { got: 2, needed: 3 });
    // A line that is not vertical determines the rotation about Z; a vertical one does not.
    let level = get(&line, SimilarityFreedom { scale: true, tilt: false }).unwrap();
    assert!((level.model.scale - 1.0).abs() < 1e-9 && level.inliers.len() == 6);
    let pole: Vec<_> = (0..6).map(|i| Point3::new(1.0, 2.0, f64::from(i))).collect();
    assert!(get(&pole, SimilarityFreedom { scale: true, tilt: false }).is_err());
}
