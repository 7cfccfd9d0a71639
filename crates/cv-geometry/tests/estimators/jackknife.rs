//! Deviations of a relative pose by the jackknife, and differences between poses.

use crate::testing::TwoViews;
use cv_core::{Pose, Rotation3, Silent, Vector3};
use cv_geometry::{jackknife_pose_deviation, pose_difference, poses_are_indistinguishable, refine_relative_pose};

#[test]
fn a_locally_biased_region_increases_the_deviation() {
    let views = TwoViews::random(3);
    let mut matches = views.normalized_matches(400, 2e-4);
    let unbiased =
        jackknife_pose_deviation(&refine_relative_pose(&views.pose, &matches, 4e-3).0, &matches, 4e-3, &Silent)
            .unwrap();
    // A noise of 0.1 px at 500 px on 400 points: hundredths of a degree for the rotation, at most tenths for the
    // direction.
    assert!(unbiased[0] < 2e-3 && unbiased[1] < 1e-2, "{unbiased:?}");
    // The left of the image is displaced by one pixel, ten times the noise, as by a wrong lens model.
    for m in matches.iter_mut().filter(|m| m.a.x < -0.3) {
        m.b.y += 2e-3;
    }
    let biased =
        jackknife_pose_deviation(&refine_relative_pose(&views.pose, &matches, 4e-3).0, &matches, 4e-3, &Silent)
            .unwrap();
    assert!(biased[1] > 2.0 * unbiased[1], "{biased:?} {unbiased:?}");
}

#[test]
fn poses_with_a_significant_difference_of_loss_are_distinguishable() {
    let views = TwoViews::random(5);
    let matches = views.normalized_matches(100, 5e-4);
    let nearly = Pose::new(views.pose.rotation * Rotation3::new(Vector3::new(1e-6, 0.0, 0.0)), views.pose.translation);
    let other = Pose::new(views.pose.rotation * Rotation3::new(Vector3::new(0.1, 0.0, 0.0)), views.pose.translation);
    assert!(poses_are_indistinguishable(&views.pose, &nearly, &matches, 3e-3));
    assert!(!poses_are_indistinguishable(&views.pose, &other, &matches, 3e-3));
    assert!((pose_difference(&views.pose, &other)[0] - 0.1).abs() < 1e-9);
}
