//! Similarities of two point sets without outliers.

use crate::testing::{gauss, uniform};
use cv_core::{Point3, Rotation3, Vector3};
use cv_geometry::{Degeneracy, EstimateError, Similarity, align_points};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

#[test]
fn every_parameter_is_recovered_from_exact_points_also_coplanar() {
    for seed in 0..50 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let truth = Similarity {
            scale: 0.2 + 3.0 * uniform(&mut rng),
            rotation: Rotation3::new(Vector3::from_fn(|_, _| gauss(&mut rng))),
            translation: Vector3::from_fn(|_, _| 10.0 * gauss(&mut rng)),
        };
        // Every other point set is coplanar.
        let n = 3 + seed as usize % 5;
        let flat = if seed % 2 == 0 { 0.0 } else { 1.0 };
        let a: Vec<_> =
            (0..n).map(|_| Point3::new(gauss(&mut rng), gauss(&mut rng), 5.0 + flat * gauss(&mut rng))).collect();
        let b: Vec<_> = a.iter().map(|p| truth.transform(p)).collect();
        let found = align_points(&a, &b, true).unwrap();
        assert!((found.scale / truth.scale - 1.0).abs() < 1e-9);
        assert!((found.rotation.matrix() - truth.rotation.matrix()).norm() < 1e-6);
        assert!((found.translation - truth.translation).norm() < 1e-6);
        let b: Vec<_> = a.iter().map(|p| Point3::from(truth.rotation * p.coords + truth.translation)).collect();
        let rigid = align_points(&a, &b, false).unwrap();
        assert!(rigid.scale == 1.0 && (rigid.translation - truth.translation).norm() < 1e-6);
    }
}

#[test]
fn mirrored_points_have_a_proper_rotation() {
    let a = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.1]].map(Point3::from);
    let b = a.map(|p| Point3::new(-p.x, p.y, p.z));
    assert!((align_points(&a, &b, true).unwrap().rotation.matrix().determinant() - 1.0).abs() < 1e-12);
}

#[test]
fn invalid_and_degenerate_input_is_a_typed_error() {
    let line: Vec<_> = (0..5).map(|i| Point3::new(f64::from(i), 2.0 * f64::from(i), 1.0)).collect();
    let kind = |a: &[Point3<f64>]| align_points(a, a, true).unwrap_err();
    assert_eq!(kind(&line), EstimateError::Degenerate { kind: Degeneracy::Collinear });
    assert_eq!(kind(&[line[1]; 4]), EstimateError::Degenerate { kind: Degeneracy::Coincident });
    assert_eq!(kind(&line[..2]), EstimateError::NotEnoughMatches { got: 2, needed: 3 });
    assert_eq!(kind(&[Point3::new(f64::NAN, 0.0, 0.0); 3]), EstimateError::NotFinite { index: 0 });
}
