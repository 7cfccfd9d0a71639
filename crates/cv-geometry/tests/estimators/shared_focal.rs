//! Relative pose and focal length of two views by one lens.

use crate::testing::TwoViews;
use cv_core::{Correspondence, Point2, Silent};
use cv_geometry::{Degeneracy, EstimateError, RobustOptions, estimate_shared_focal_pose, refine_shared_focal_pose};

/// Returns the matches relative to the principal point.
fn centered(views: &TwoViews, matches: Vec<Correspondence>) -> Vec<Correspondence> {
    let c = Point2::new(views.camera.cx, views.camera.cy).coords;
    matches.into_iter().map(|m| Correspondence { a: m.a - c, b: m.b - c }).collect()
}

#[test]
fn the_focal_length_is_exact_on_exact_matches_and_robust_to_outliers() {
    let (mut exact, mut contaminated) = (Vec::new(), Vec::new());
    for seed in 0..40 {
        let views = TwoViews::random(seed);
        let mut m = centered(&views, views.matches(60, 0.0));
        let options = RobustOptions { threshold: 1.0, seed, ..RobustOptions::default() };
        let error = |m: &[Correspondence]| {
            let found = estimate_shared_focal_pose(m, &options, &Silent).unwrap();
            assert!(found.inliers.len() >= 60);
            (refine_shared_focal_pose(&found.model, m, 1.0).0.focal / 500.0 - 1.0).abs()
        };
        exact.push(error(&m));
        m.extend(centered(&views, views.outliers(40)));
        contaminated.push(error(&m));
    }
    exact.sort_by(f64::total_cmp);
    contaminated.sort_by(f64::total_cmp);
    // The relative cost tolerance is 1e-6, so the residuals stop at about 1e-3 px. For the least favorable of the
    // forty motions, a change of the focal length by 1 % changes the residuals by 0.01 px.
    assert!(exact[39] < 1e-3, "{exact:?}");
    // One or two of the forty outliers are near their epipolar lines by chance and bias the estimate.
    assert!(contaminated[20] < 5e-3 && contaminated[39] < 0.1, "{contaminated:?}");
}

#[test]
fn invalid_and_degenerate_input_is_a_typed_error() {
    let views = TwoViews::random(1);
    let options = RobustOptions { threshold: 1.0, ..RobustOptions::default() };
    let good = centered(&views, views.matches(20, 0.0));
    let get = |m: &[Correspondence]| estimate_shared_focal_pose(m, &options, &Silent).unwrap_err();
    assert_eq!(get(&good[..6]), EstimateError::NotEnoughMatches { got: 6, needed: 7 });
    assert_eq!(
        get(&[Correspondence::new(0.0, 0.0, 0.0, 0.0); 9]),
        EstimateError::Degenerate { kind: Degeneracy::Coincident }
    );
    assert_eq!(get(&[good[0]; 9]), EstimateError::Degenerate { kind: Degeneracy::Coincident });
    let mut bad = good.clone();
    bad[2].b.x = f64::NAN;
    assert_eq!(get(&bad), EstimateError::NotFinite { index: 2 });
}
