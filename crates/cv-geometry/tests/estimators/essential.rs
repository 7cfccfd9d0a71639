//! Essential matrices and relative poses.

use crate::testing::{TwoViews, cosine};
use cv_core::{Matrix3, Point2, Pose, Rotation3, Silent, Vector3};
use cv_geometry::{
    Degeneracy, EstimateError, RobustOptions, decompose_essential, essential_five_point, essential_from_fundamental,
    estimate_essential, estimate_relative_pose, estimate_rotation, normalize_matches, pose_difference, recover_pose,
    refine_relative_pose,
};
use cv_numeric::adjust::UnitVector;
use proptest::prelude::*;

fn rotation_angle_between(a: &Rotation3<f64>, b: &Rotation3<f64>) -> f64 {
    Pose::new(a.inverse() * b, Vector3::zeros()).rotation_angle()
}

proptest! {
    #[test]
    fn essential_from_fundamental_is_exact(seed: u64) {
        let views = TwoViews::random(seed);
        let e = essential_from_fundamental(&views.fundamental(), &views.camera, &views.camera).unwrap();
        prop_assert!(cosine(&e, &views.essential()) > 1.0 - 1e-10);
        let s = cv_numeric::svd3(&e).unwrap().s;
        prop_assert!((s - Vector3::new(1.0, 1.0, 0.0)).norm() < 1e-12);
    }
}

#[test]
fn the_result_does_not_depend_on_the_number_of_threads() {
    // A high outlier ratio, so that the batches reach the size that is evaluated in parallel.
    let views = TwoViews::random(7);
    let mut m = views.matches(40, 0.5);
    m.extend(views.outliers(110));
    let (m, unit) = normalize_matches(&m, &views.camera, &views.camera);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let options = RobustOptions { threshold: 1.5 * unit, ..RobustOptions::essential() };
        pool.install(|| estimate_relative_pose(&m, &options, &Silent).unwrap())
    };
    let (one, four) = (run(1), run(4));
    assert!(one.iterations > 2048 + 256, "{}", one.iterations);
    assert_eq!(one, four);
    assert!(pose_difference(&views.pose, &one.model)[0].to_degrees() < 1.0);
}

#[test]
fn one_of_the_five_point_solutions_is_the_truth_and_all_satisfy_the_constraints() {
    for seed in 0..1000 {
        let views = TwoViews::random(seed);
        let m = views.normalized_matches(5, 0.0);
        let (a, b) = (std::array::from_fn(|i| m[i].a), std::array::from_fn(|i| m[i].b));
        let mut best = 0.0f64;
        let mut count = 0;
        essential_five_point(&a, &b, |e| {
            count += 1;
            best = best.max(cosine(&e, &views.essential()));
            assert!((e.norm_squared() - 2.0).abs() < 1e-12);
            for m in &m {
                assert!(m.b.to_homogeneous().dot(&(e * m.a.to_homogeneous())).abs() < 1e-9);
            }
        });
        assert!(count <= 10);
        // The sine of the angle is √(2 · 1e-12) = 1.4e-6: the effect of roundings of 1e-16 on two roots with a
        // distance of 1e-10.
        assert!(1.0 - best < 1e-12, "{seed}: {:e}", 1.0 - best);
    }
}

#[test]
fn the_pose_is_accurate_with_half_outliers() {
    let mut errors = Vec::new();
    for seed in 0..40 {
        let views = TwoViews::random(seed);
        let mut m = views.matches(150, 0.5);
        m.extend(views.outliers(150));
        let (normalized, unit) = normalize_matches(&m, &views.camera, &views.camera);
        let options = RobustOptions { threshold: 1.5 * unit, seed, ..RobustOptions::default() };
        let found = estimate_relative_pose(&normalized, &options, &Silent).unwrap();
        errors.push(pose_difference(&found.model, &views.pose).map(f64::to_degrees));
        let true_positives = found.inliers.iter().filter(|i| **i < 150).count();
        // 1.5 px is three standard deviations; an outlier is that close to an epipolar line with a probability of
        // about 3/480.
        assert!(true_positives >= 140 && found.inliers.len() - true_positives <= 15);
    }
    errors.sort_by(|a, b| (a[0] + a[1]).total_cmp(&(b[0] + b[1])));
    // Half a pixel at a focal length of 500 px is 0.06 degrees for one ray; 150 of them determine the rotation to a
    // few hundredths and the direction to a few tenths of a degree. The worst of forty has the least favorable
    // motion and points.
    assert!(errors[20][0] < 0.3 && errors[20][1] < 1.0 && errors[39][1] < 5.0, "{errors:?}");
}

#[test]
fn a_short_baseline_keeps_its_direction() {
    let mut errors = Vec::new();
    for seed in 0..40 {
        let mut views = TwoViews::random(seed);
        views.pose.translation *= 0.1;
        let mut m = views.matches(150, 0.2);
        m.extend(views.outliers(100));
        let (normalized, unit) = normalize_matches(&m, &views.camera, &views.camera);
        let options = RobustOptions { threshold: 1.5 * unit, seed, ..RobustOptions::essential() };
        let found = estimate_relative_pose(&normalized, &options, &Silent).unwrap();
        errors.push(pose_difference(&found.model, &views.pose)[1].to_degrees());
    }
    errors.sort_by(f64::total_cmp);
    // Ten times the uncertainty of a baseline of one unit (a few tenths of a degree per pixel of noise); and never
    // the opposite direction, which only cheirality excludes.
    assert!(errors[20] < 2.0 && errors[39] < 45.0, "{errors:?}");
}

#[test]
fn a_pure_rotation_is_distinguished_from_a_translation() {
    let views = TwoViews::random(4);
    let truth = Rotation3::new(Vector3::new(0.1, -0.2, 0.05));
    let mut rotated = views.normalized_matches(60, 0.0);
    for m in &mut rotated {
        m.b = Point2::from_homogeneous(truth * m.a.to_homogeneous()).unwrap();
    }
    rotated[3].b.x += 0.3;
    let (rotation, inlier_ratio) = estimate_rotation(&rotated, 1e-3).unwrap();
    // The one outlier of sixty has a weight of 1/300.
    assert!(rotation_angle_between(&rotation, &truth) < 1e-4 && inlier_ratio == 59.0 / 60.0);
    assert!(estimate_rotation(&views.normalized_matches(60, 0.0), 1e-3).unwrap().1 < 0.5);
    assert!(estimate_rotation(&rotated[..1], 1e-3).is_err());
}

#[test]
fn refinement_converges_to_the_exact_pose() {
    let views = TwoViews::random(2);
    let m = views.normalized_matches(60, 0.0);
    let turn = Rotation3::new(Vector3::new(2e-3, -1e-3, 1e-3));
    let [u, v] = UnitVector::basis(&views.pose.translation);
    let direction = (views.pose.translation + u * 3e-3 + v * 2e-3).normalize();
    let start = Pose::new(views.pose.rotation * turn, direction);
    let (pose, loss) = refine_relative_pose(&start, &m, 4e-3);
    // The minimum is zero; the iterations stop when the relative decrease of the cost is below 1e-6.
    assert!(loss < 1e-6 && (pose.translation - views.pose.translation).norm() < 1e-4, "{loss}");
}

#[test]
fn invalid_and_degenerate_input_is_a_typed_error() {
    let views = TwoViews::random(1);
    let options = RobustOptions { threshold: 1e-3, ..RobustOptions::default() };
    let good = views.normalized_matches(20, 0.0);
    assert_eq!(
        estimate_relative_pose(&good[..5], &options, &Silent).unwrap_err(),
        EstimateError::NotEnoughMatches { got: 5, needed: 6 }
    );
    let same = vec![good[0]; 20];
    assert_eq!(
        estimate_relative_pose(&same, &options, &Silent).unwrap_err(),
        EstimateError::Degenerate { kind: Degeneracy::Coincident }
    );
    let mut bad = good.clone();
    bad[2].b.x = f64::NAN;
    assert_eq!(estimate_essential(&bad, &options, &Silent).unwrap_err(), EstimateError::NotFinite { index: 2 });
    assert!(decompose_essential(&Matrix3::zeros()).is_err());
    assert!(decompose_essential(&Matrix3::from_element(f64::NAN)).is_err());
    assert!(recover_pose(&views.essential(), &[]).is_err());
    assert!(essential_from_fundamental(&Matrix3::zeros(), &views.camera, &views.camera).is_err());
}
