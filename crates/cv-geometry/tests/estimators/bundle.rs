//! Bundle adjustment of two views.

use crate::testing::{TwoViews, gauss, uniform};
use cv_core::{Correspondence, Distortion, Point3, Rotation3, Silent, Vector3};
use cv_geometry::{
    BundleOptions, FocalPrior, RobustLoss, TwoViewBundle, adjust_two_views, parallax_angle, pose_difference,
    triangulate,
};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// No prior but the same lens.
const UNKNOWN: FocalPrior =
    FocalPrior { focal: 500.0, deviation: f64::INFINITY, ratio: FocalPrior::SAME_LENS_RATIO_DEVIATION };

/// Matches of a camera with distortion, the true bundle, and a perturbed initial one.
fn problem(seed: u64, n: usize, noise: f64) -> (Vec<Correspondence>, TwoViewBundle, TwoViewBundle) {
    let mut views = TwoViews::random(seed);
    views.camera.distortion = Distortion::radial(-0.1, 0.01);
    let mut rng = ChaCha8Rng::seed_from_u64(seed + 1000);
    let (mut points, mut matches) = (Vec::new(), Vec::new());
    while points.len() < n {
        let (p, m) = views.point(None);
        // Points without parallax have no depth.
        if parallax_angle(&p, &views.pose) < 0.03 {
            continue;
        }
        let mut e = || noise * gauss(&mut rng);
        matches.push(Correspondence::new(m.a.x + e(), m.a.y + e(), m.b.x + e(), m.b.y + e()));
        points.push(p);
    }
    let truth = TwoViewBundle { cameras: [views.camera; 2], pose: views.pose, points };
    let mut start = truth.clone();
    let mut e = || 0.02 * (uniform(&mut rng) - 0.5);
    start.pose.rotation *= Rotation3::new(Vector3::new(e(), e(), e()));
    start.pose.translation = (start.pose.translation + Vector3::new(e(), e(), e())).normalize();
    for x in &mut start.points {
        *x *= 1.0 + e();
    }
    (matches, truth, start)
}

#[test]
fn exact_matches_converge_to_the_exact_scene() {
    for focal in [None, Some(UNKNOWN)] {
        for seed in 0..30 {
            let (matches, truth, mut start) = problem(seed, 60, 0.0);
            if focal.is_some() {
                start.cameras.iter_mut().for_each(|c| (c.fx, c.fy) = (c.fx * 1.01, c.fy * 1.01));
            }
            let options = BundleOptions { focal, max_iterations: 200, ..BundleOptions::default() };
            let report = adjust_two_views(&mut start, &matches, &options, &Silent).unwrap().unwrap();
            // Rounding of pixels: 1e-13 for a few hundred, squared, over 240 residuals.
            assert!(report.cost[1] < 1e-17, "{report:?}");
            let [turn, direction] = pose_difference(&start.pose, &truth.pose);
            let focal = (start.cameras[0].fx / truth.cameras[0].fx - 1.0).abs();
            let position = start.points.iter().zip(&truth.points).map(|(x, t)| (x - t).norm()).fold(0.0, f64::max);
            // That rounding is 1e-16 of a focal length. The worst-conditioned motion and the point at depth 12 with
            // a parallax of 0.03 rad amplify it to 1e-12 and 1e-11. A hundred times that for other seeds.
            assert!(
                turn < 1e-10 && direction < 1e-10 && focal < 1e-10 && position < 1e-9,
                "{seed}: {turn} {direction} {focal} {position}"
            );
        }
    }
}

#[test]
fn errors_are_consistent_with_the_covariances() {
    for loss in [RobustLoss::Trivial, BundleOptions::default().loss] {
        let (mut sum, mut count, mut within) = (0.0, 0.0, 0.0);
        let (mut rotations, mut directions) = (0.0, 0.0);
        for seed in 0..40 {
            let (matches, truth, mut start) = problem(seed, 60, 0.5);
            for (x, m) in start.points.iter_mut().zip(&matches) {
                let m = Correspondence { a: truth.cameras[0].normalize(m.a), b: truth.cameras[0].normalize(m.b) };
                *x = triangulate(&m, &truth.pose).unwrap();
            }
            let options = BundleOptions { loss, ..BundleOptions::default() };
            let report = adjust_two_views(&mut start, &matches, &options, &Silent).unwrap().unwrap();
            for ((x, t), c) in start.points.iter().zip(&truth.points).zip(&report.covariances) {
                let d = x - t;
                let squared = d.dot(&(c.try_inverse().unwrap() * d));
                sum += squared;
                count += 1.0;
                within += f64::from(u8::from(squared < 7.815));
            }
            rotations += (pose_difference(&start.pose, &truth.pose)[0] / report.pose_deviation[0]).powi(2);
            let sine = start.pose.translation.cross(&truth.pose.translation).norm();
            directions += (sine / report.pose_deviation[1]).powi(2);
        }
        // The squared Mahalanobis distance has the expectation 3. The errors of one scene's points are correlated,
        // so the mean over 40 scenes is about 3 ± 0.5, and depth is nonlinear in the measurements.
        assert!((2.25..4.05).contains(&(sum / count)), "{}", sum / count);
        // The 95 % quantile of chi-squared with three degrees of freedom is 7.815. Least squares: 94.8 % of these
        // points; Cauchy's loss underweights large residuals, and its standard deviations are 4 % too small: 92.6
        // %.
        assert!((0.91..0.97).contains(&(within / count)), "{}", within / count);
        // The least certain of three (two) axes is reported: the mean square is between one and three (two), ± 0.3
        // over 40 scenes.
        assert!(
            (0.6..3.0).contains(&(rotations / 40.0)) && (0.6..2.4).contains(&(directions / 40.0)),
            "{rotations} {directions}"
        );
    }
}

#[test]
fn focal_length_errors_are_consistent_with_their_deviation() {
    let mut squares = Vec::new();
    for seed in 0..60 {
        let (_, truth, _) = problem(seed, 300, 0.0);
        let mut rng = ChaCha8Rng::seed_from_u64(seed + 5000);
        let mut e = || gauss(&mut rng);
        // Unmodeled errors: k2, a principal point offset of 4 px (half diagonal 400 px), refocusing for the second
        // image.
        let mut cameras = truth.cameras;
        let (k2, cx, cy, ratio) = (0.03 * e(), 4.0 * e(), 4.0 * e(), 0.002 * e());
        for (camera, sign) in cameras.iter_mut().zip([-0.5, 0.5]) {
            camera.distortion = Distortion::radial(-0.1, k2);
            (camera.cx, camera.cy) = (camera.cx + cx, camera.cy + cy);
            (camera.fx, camera.fy) = (camera.fx * f64::exp(sign * ratio), camera.fy * f64::exp(sign * ratio));
        }
        (cameras[1].cx, cameras[1].cy) = (cameras[1].cx + 0.8 * e(), cameras[1].cy + 0.8 * e());
        let project = |x: &Point3<f64>| Some((cameras[0].project(x)?, cameras[1].project(&truth.pose.transform(x))?));
        let (mut matches, mut points) = (Vec::new(), Vec::new());
        for (x, (a, b)) in truth.points.iter().filter_map(|x| Some((x, project(x)?))) {
            matches.push(Correspondence::new(a.x + 0.4 * e(), a.y + 0.4 * e(), b.x + 0.4 * e(), b.y + 0.4 * e()));
            points.push(*x);
        }
        let mut start = TwoViewBundle { points, ..truth.clone() };
        start.cameras.iter_mut().for_each(|c| c.distortion = Distortion::radial(-0.1, 0.0));
        let options = BundleOptions { focal: Some(UNKNOWN), refine_radial: true, ..BundleOptions::default() };
        let report = adjust_two_views(&mut start, &matches, &options, &Silent).unwrap().unwrap();
        let error = (start.cameras[0].fx / truth.cameras[0].fx).ln();
        squares.push((error / report.focal_deviation).powi(2));
    }
    squares.sort_by(f64::total_cmp);
    let mean = squares.iter().sum::<f64>() / 60.0;
    // For normal errors, the mean square is 1 ± 0.18 and the median 0.45; ill-conditioned focal lengths have
    // non-normal errors.
    assert!((0.6..1.8).contains(&mean) && (0.25..0.9).contains(&squares[30]), "{squares:?}");
}

#[test]
fn the_loss_is_robust_to_an_outlier() {
    let (mut matches, truth, mut start) = problem(3, 80, 0.2);
    matches[7].b.x += 40.0;
    adjust_two_views(&mut start, &matches, &BundleOptions::default(), &Silent).unwrap();
    let turn = pose_difference(&start.pose, &truth.pose)[0];
    // 0.2 px is 4e-4 rad for one ray, much less for 80; 40 px without a robust loss would be 0.08 rad for one.
    assert!(turn < 2e-3, "{turn}");
}

#[test]
fn an_initial_point_behind_a_camera_is_rejected() {
    let (matches, _, mut start) = problem(3, 20, 0.2);
    start.points[4].z = -1.0;
    assert_eq!(adjust_two_views(&mut start, &matches, &BundleOptions::default(), &Silent), Ok(None));
    start.points.clear();
    assert_eq!(adjust_two_views(&mut start, &matches, &BundleOptions::default(), &Silent), Ok(None));
}
