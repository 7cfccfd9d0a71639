//! Calibrations of synthetic views, against the truth.

use crate::studio::{Studio, uniform};
use cv_calib::{
    CalibrateError, CalibrateOptions, Calibration, ImageOutcome, LensChoice, LensVerdict, TargetCorner,
    TargetObservations, TargetPoints, calibrate,
};
use cv_core::{Camera, Cancelled, Distortion, DistortionModel, Point2, Pose, Progress, Rotation3, Silent, Vector3};

fn options_with(lens: LensChoice) -> CalibrateOptions {
    CalibrateOptions { lens, holdout: false, ..CalibrateOptions::default() }
}

const DISTORTION5: [f64; 5] = [-0.35, 0.14, 1e-3, -5e-4, -0.02];

#[test]
fn exact_corners_determine_every_lens_model() {
    let rational = [1.2, 0.3, 5e-4, -2e-4, 0.02, 1.5, 0.5, 0.05];
    let mut prism = [0.0; 12];
    prism[..8].copy_from_slice(&rational);
    prism[8..].copy_from_slice(&[2e-3, -1e-3, -1e-3, 5e-4]);
    let cases = [
        (LensChoice::RadialTangential4, Distortion::radial_tangential4([-0.3, 0.1, 1e-3, -5e-4])),
        (LensChoice::RadialTangential5, Distortion::radial_tangential5(DISTORTION5)),
        (LensChoice::Rational8, Distortion::rational8(rational)),
        (LensChoice::ThinPrism12, Distortion::thin_prism12(prism)),
        (LensChoice::Fisheye4, Distortion::fisheye4([0.05, -0.01, 0.003, -0.001])),
    ];
    for (choice, distortion) in cases {
        let mut studio = Studio::new(5, distortion);
        let data = studio.observations(15, 0.0);
        let calibration = calibrate(&data, &options_with(choice), &Silent).unwrap();
        // The adjustment ends at a relative cost decrease of 1e-7: rounding of pixels of a thousand, and the rest. The
        // prior on rational models costs about 1e-4 square pixels in all.
        let tolerance = if distortion.parameters().len() < 8 { 1e-5 } else { 1e-3 };
        assert!(calibration.rms_px < tolerance, "{choice}: {}", calibration.rms_px);
        let (truth, camera) = (studio.cameras[0], calibration.cameras[0].camera);
        // The coefficients of rational models are correlated; the projection at observed positions is determined.
        let tolerance = if distortion.parameters().len() < 8 { 1e-3 } else { 0.03 };
        for (x, y) in [(200.0, 150.0), (640.0, 480.0), (1100.0, 150.0), (200.0, 850.0)] {
            let pixel = camera.denormalize(truth.normalize(Point2::new(x, y)));
            assert!((pixel - Point2::new(x, y)).norm() < tolerance, "{choice}: {pixel}");
        }
        assert!((calibration.target_shape.deflection[0] - 1.0).abs() < 1e-3, "{:?}", calibration.target_shape);
    }
}

/// Runs a trial: the calibration, and its parameter errors in stated standard deviations.
fn trial(seed: u64) -> (Calibration, Vec<f64>) {
    let mut studio = Studio::new(seed, Distortion::radial_tangential5(DISTORTION5));
    let data = studio.observations(20, 0.1);
    let calibration = calibrate(&data, &options_with(LensChoice::RadialTangential5), &Silent).unwrap();
    let truth = studio.cameras[0].intrinsics();
    let truth = truth[..9].iter().chain(&studio.shape);
    let off = calibration.parameters.iter().zip(truth).map(|(p, t)| (p.value - t) / p.deviation).collect();
    (calibration, off)
}

/// Runs a trial of a rig: the errors of the rig pose in stated standard deviations.
fn rig_trial(seed: u64) -> Vec<f64> {
    let mut studio = Studio::rig(seed);
    let data = studio.observations(20, 0.1);
    let calibration = calibrate(&data, &options_with(LensChoice::RadialTangential5), &Silent).unwrap();
    let rig_pose = calibration.cameras[1].from_first;
    let turn = (rig_pose.rotation * studio.rig_poses[1].rotation.inverse()).scaled_axis();
    let shift = rig_pose.translation - studio.rig_poses[1].translation;
    let sigmas: Vec<f64> =
        calibration.parameters.iter().filter(|p| p.camera == Some(1)).skip(9).map(|p| p.deviation).collect();
    turn.iter().chain(shift.iter()).zip(sigmas).map(|(off, deviation)| off / deviation).collect()
}

fn fraction_within_95_percent(errors: &[f64]) -> f64 {
    errors.iter().filter(|e| e.abs() < 1.96).count() as f64 / errors.len() as f64
}

#[test]
fn noisy_corners_give_the_camera_with_valid_standard_deviations() {
    let (mut all, mut center) = (Vec::new(), 0.0);
    for seed in 0..8 {
        let (calibration, errors) = trial(seed);
        let camera = calibration.cameras[0].camera;
        // Stated standard deviations are about 0.14 px of 900, and 0.2 px for the principal point.
        assert!((camera.fx / 900.0 - 1.0).abs() < 5e-4 && (camera.fy / 902.0 - 1.0).abs() < 5e-4, "{seed}: {camera:?}");
        center += ((camera.cx - 650.0).powi(2) + (camera.cy - 470.0).powi(2)) / 16.0;
        // A tenth of a pixel; 3,000 coordinates determine it to 2 %.
        assert!((calibration.noise_px - 0.1).abs() < 0.008, "{}", calibration.noise_px);
        all.extend(errors);
    }
    assert!(center.sqrt() < 0.3, "{center}");
    all.extend((0..4).flat_map(rig_trial));
    // 112 values, correlated within a trial: 95 % ± 4 %. The long test is more precise.
    assert!(fraction_within_95_percent(&all) > 0.85, "{}", fraction_within_95_percent(&all));
}

#[test]
#[ignore = "400 trials of a camera and of a rig take a minute"]
fn confidence_intervals_cover_the_truth_in_95_percent_of_trials() {
    let trials: Vec<Vec<f64>> = (0..400).map(|seed| trial(seed).1).collect();
    let rigs: Vec<Vec<f64>> = (0..400).map(rig_trial).collect();
    for trials in [trials, rigs] {
        for k in 0..trials[0].len() {
            let fraction = fraction_within_95_percent(&trials.iter().map(|t| t[k]).collect::<Vec<_>>());
            println!("{k}: {fraction}");
            // A binomial fraction of 400 has a standard deviation of 1.1 %.
            assert!((0.92..=0.98).contains(&fraction), "parameter {k}: {fraction}");
        }
    }
}

#[test]
fn the_uncertainty_map_agrees_with_the_errors_of_rays() {
    let (mut sum, mut count) = (0.0, 0.0);
    for seed in 0..6 {
        let mut studio = Studio::new(seed + 70, Distortion::radial_tangential4([-0.3, 0.1, 1e-3, -5e-4]));
        let data = studio.observations(12, 0.1);
        let target = &studio.target;
        let calibration = calibrate(&data, &options_with(LensChoice::RadialTangential4), &Silent).unwrap();
        let (camera, truth) = (&calibration.cameras[0], studio.cameras[0]);
        // The motion between the two camera frames that fits the corners best, by Gauss-Newton steps.
        let points: Vec<_> = (0..12)
            .flat_map(|v| data.views[v][0].iter().map(move |c| (v, c.point)))
            .map(|(v, point)| {
                calibration.views[v].pose.unwrap().transform(&target.bent(point, calibration.target_shape.deflection))
            })
            .collect();
        let mut motion = Pose::identity();
        for _ in 0..3 {
            let (mut a, mut b) = (nalgebra::Matrix6::zeros(), nalgebra::Vector6::zeros());
            for p in &points {
                let moved = motion.transform(p);
                let s = camera.camera.project_with_jacobians(&moved).unwrap();
                let mut j = nalgebra::Matrix2x6::zeros();
                j.fixed_columns_mut::<3>(0)
                    .copy_from(&(-s.point_jacobian * (moved - motion.translation).coords.cross_matrix()));
                j.fixed_columns_mut::<3>(3).copy_from(&s.point_jacobian);
                a += j.transpose() * j;
                b += j.transpose() * (s.pixel - truth.project(p).unwrap());
            }
            let step = -(a.try_inverse().unwrap() * b);
            let turn = Rotation3::new(step.fixed_rows::<3>(0).into_owned());
            motion = Pose::new(turn * motion.rotation, motion.translation + step.fixed_rows::<3>(3));
        }
        for index in [17, 40, 88, 103, 150] {
            let pixel = camera.uncertainty.position(index, (1280, 960));
            let ray = truth.normalize(pixel).to_homogeneous();
            let off = (camera.camera.project(&(motion.rotation * ray).into()).unwrap() - pixel).norm();
            sum += (off / camera.uncertainty.pixels[index]).powi(2);
            count += 1.0;
        }
    }
    // The mean of the squared length over the variance in the worst direction is between one and two, for thirty values
    // that are correlated within a trial.
    assert!((0.5..3.0).contains(&(sum / count)), "{}", sum / count);
}

#[test]
fn outlier_corners_and_views_are_rejected_and_reported() {
    let mut studio = Studio::new(11, Distortion::radial_tangential5(DISTORTION5));
    let mut data = studio.observations(14, 0.1);
    data.views[3][0][7].pixel.x += 5.0;
    data.views[4][0][9].pixel.y -= 80.0;
    // Added views: points permuted, mirrored, collinear, three corners, no corner.
    let pose = studio.pose();
    let mut shuffled = studio.view(&pose, 0.1);
    shuffled[0].iter_mut().for_each(|c| c.point = (c.point * 37 + 11) % 88);
    let mut mirrored = data.views[0].clone();
    mirrored[0].iter_mut().for_each(|c| c.pixel.x = 1279.0 - c.pixel.x);
    let line = vec![data.views[1][0].iter().filter(|c| c.point / 11 == 4).copied().collect::<Vec<_>>()];
    let three = vec![data.views[2][0][..3].to_vec()];
    data.views.extend([shuffled, mirrored, line, three, vec![Vec::new()]]);
    let calibration = calibrate(&data, &options_with(LensChoice::RadialTangential5), &Silent).unwrap();
    let outcome = |v: usize| calibration.views[v].images[0].outcome;
    assert!(matches!(outcome(3), ImageOutcome::Used { outliers: 1, .. }), "{:?}", outcome(3));
    assert!(!calibration.views[3].images[0].corners[7].used && !calibration.views[4].images[0].corners[9].used);
    assert!(!outcome(14).is_used(), "{:?}", outcome(14));
    assert_eq!(outcome(15), ImageOutcome::Mirrored);
    assert!(!outcome(16).is_used(), "{:?}", outcome(16));
    assert_eq!(outcome(17), ImageOutcome::TooFewCorners { got: 3, needed: 6 });
    assert_eq!(outcome(18), ImageOutcome::Nothing);
    assert!((calibration.cameras[0].camera.fx / 900.0 - 1.0).abs() < 1e-3, "{:?}", calibration.cameras[0].camera);
}

#[test]
fn cameras_that_number_a_symmetric_board_differently_are_one_rig() {
    let mut studio = Studio::rig(5);
    let data = studio.observations(12, 0.1);
    let plain = calibrate(&data, &options_with(LensChoice::RadialTangential5), &Silent).unwrap();
    let mut turned = TargetObservations { target: data.target.clone().with_rotational_symmetry(2), ..data.clone() };
    // Most views of the second camera, and some of the first.
    let is_turned = |v: usize, c: usize| if c == 1 { !v.is_multiple_of(3) } else { v % 4 == 1 };
    for (v, c) in (0..12).flat_map(|v| [(v, 0), (v, 1)]) {
        if is_turned(v, c) {
            turned.views[v][c].iter_mut().for_each(|corner| corner.point = 87 - corner.point);
        }
    }
    let calibration = calibrate(&turned, &options_with(LensChoice::RadialTangential5), &Silent).unwrap();
    // The same least squares problem up to point indices: the rest is the termination of the iterations, far below the
    // standard deviations of 0.01.
    assert!((calibration.rms_px - plain.rms_px).abs() < 1e-4, "{} {}", calibration.rms_px, plain.rms_px);
    let shift = calibration.cameras[1].from_first.translation - plain.cameras[1].from_first.translation;
    assert!(shift.norm() < 1e-2, "{shift}");
    for (v, view) in calibration.views.iter().enumerate() {
        assert_eq!(view.images[0].symmetry, 0);
        if view.images.iter().all(|p| p.outcome.is_used()) {
            assert_eq!(view.images[1].symmetry, usize::from(is_turned(v, 0) != is_turned(v, 1)), "{v}");
        }
    }
    // Without the symmetry, inconsistently numbered views are rejected.
    let without_symmetry = TargetObservations { target: data.target.clone(), ..turned };
    let poor = calibrate(&without_symmetry, &options_with(LensChoice::RadialTangential5), &Silent);
    let complete = |c: &Calibration| c.complete_views().count();
    assert!(poor.is_err() || poor.is_ok_and(|poor| complete(&poor) < complete(&calibration)));
}

#[test]
fn a_rig_with_missing_views_is_calibrated() {
    let mut studio = Studio::rig(3);
    let mut data = studio.observations(16, 0.1);
    data.views[2][0].clear();
    data.views[5][1].clear();
    data.views[6] = vec![Vec::new(), Vec::new()];
    let options = CalibrateOptions { lens: LensChoice::RadialTangential5, ..CalibrateOptions::default() };
    let calibration = calibrate(&data, &options, &Silent).unwrap();
    let rig = calibration.stereo().unwrap();
    // Standard deviations are about 0.1 mm.
    assert!((rig.right_from_left.translation - studio.rig_poses[1].translation).norm() < 0.6, "{rig:?}");
    assert_eq!((rig.right.width, rig.right.height), (800, 600));
    assert_eq!(calibration.views[6].pose, None);
    assert!(calibration.views[5].images[0].outcome.is_used() && calibration.views[2].images[1].outcome.is_used());
    // Held-out views have slightly larger errors.
    assert!(
        calibration.holdout_rms_px > 0.9 * calibration.rms_px && calibration.holdout_rms_px < 1.2 * calibration.rms_px
    );
    // With outliers, of which these views have hardly any.
    assert!(
        (calibration.holdout_all_rms_px / calibration.holdout_rms_px - 1.0).abs() < 0.1,
        "{}",
        calibration.holdout_all_rms_px
    );
    assert_eq!(calibration.parameters.len(), 9 + 9 + 6 + 2);
    for v in data.views.iter_mut().take(8) {
        v[0].clear();
    }
    for v in data.views.iter_mut().skip(8) {
        v[1].clear();
    }
    let error = calibrate(&data, &options, &Silent).unwrap_err();
    assert_eq!(error, CalibrateError::Unconnected { camera: 1 });
}

#[test]
fn the_lens_model_is_selected_by_cross_validation() {
    let cases = [
        (Distortion::radial_tangential4([-0.25, 0.08, 1e-3, -5e-4]), DistortionModel::RadialTangential4),
        (Distortion::fisheye4([0.02, -0.01, 0.004, -0.001]), DistortionModel::Fisheye4),
    ];
    for (distortion, model) in cases {
        let mut studio = Studio::new(21, distortion);
        studio.cameras[0].fx = 500.0;
        studio.cameras[0].fy = 501.0;
        let data = studio.observations(14, 0.1);
        let calibration = calibrate(&data, &CalibrateOptions::default(), &Silent).unwrap();
        let camera = &calibration.cameras[0];
        assert_eq!(camera.camera.distortion.model(), model, "{:?}", camera.lenses);
        assert_eq!(camera.lenses.len(), 5);
        let chosen = camera.lenses.iter().find(|l| l.verdict == LensVerdict::Chosen).unwrap();
        assert_eq!(chosen.model, model);
        // Selected: not significantly worse than the others.
        assert!(
            camera.lenses.iter().all(|l| l.holdout_rms_px.is_nan() || chosen.holdout_rms_px < 1.05 * l.holdout_rms_px)
        );
    }
}

#[test]
fn degenerate_and_invalid_input_is_an_error_with_numbers() {
    let options = options_with(LensChoice::RadialTangential4);
    let target = TargetPoints::grid(9, 6, 1.0).unwrap();
    let none = TargetObservations { target: target.clone(), sizes: vec![(640, 480)], views: Vec::new() };
    assert_eq!(calibrate(&none, &options, &Silent), Err(CalibrateError::NoViews));
    let camera = Camera::from_focal(640, 480, 500.0);
    let seen = |turn: [f64; 3], shift: [f64; 3]| {
        let pose = Pose::new(Rotation3::new(Vector3::from(turn)), Vector3::from(shift));
        let at = |point| camera.project(&pose.transform(&target.bent(point, [0.0; 2]))).unwrap();
        vec![(0..54).map(|point| TargetCorner { point, pixel: at(point) }).collect::<Vec<_>>()]
    };
    let data = |views: Vec<Vec<Vec<TargetCorner>>>| TargetObservations { views, ..none.clone() };
    let one = data(vec![seen([0.3, 0.2, 0.0], [-4.0, -3.0, 10.0])]);
    let few = CalibrateError::TooFewViews { camera: 0, got: 1, needed: 3, small: 0, mirrored: 0 };
    assert_eq!(calibrate(&one, &options, &Silent), Err(few));
    // Parallel to the image plane in all views: the focal length is undetermined.
    let parallel =
        data((0..8).map(|i| seen([0.0, 0.0, 0.1 * f64::from(i)], [-4.0, -3.0, 9.0 + f64::from(i)])).collect());
    match calibrate(&parallel, &options, &Silent) {
        Err(CalibrateError::Degenerate { camera: 0, largest_tilt_degrees }) => assert!(largest_tilt_degrees < 5.0),
        other => panic!("{:?}", other.map(|c| c.parameters)),
    }
    let views = || (0..6).map(|i| seen([0.3 * f64::from(i).sin(), 0.3 * f64::from(i).cos(), 0.0], [-4.0, -3.0, 10.0]));
    let mut mirrored = data(views().collect());
    mirrored.views.iter_mut().flatten().flatten().for_each(|c| c.pixel.x = 639.0 - c.pixel.x);
    let all = CalibrateError::TooFewViews { camera: 0, got: 0, needed: 3, small: 0, mirrored: 6 };
    assert_eq!(calibrate(&mirrored, &options, &Silent), Err(all));
    let mut broken = data(views().collect());
    broken.views[2][0][5].pixel.x = f64::NAN;
    let nan = CalibrateError::NotFinite { view: 2, camera: 0, corner: 5 };
    assert_eq!(calibrate(&broken, &options, &Silent), Err(nan));
    broken.views[2][0][5] = TargetCorner { point: 99, pixel: Point2::origin() };
    let point = CalibrateError::Point { view: 2, camera: 0, point: 99, points: 54 };
    assert_eq!(calibrate(&broken, &options, &Silent), Err(point));
    broken.views[2][0][5].point = 4;
    assert_eq!(calibrate(&broken, &options, &Silent), Err(CalibrateError::Twice { view: 2, camera: 0, point: 4 }));
    broken.views[2].push(Vec::new());
    assert_eq!(calibrate(&broken, &options, &Silent), Err(CalibrateError::Cameras { view: 2, got: 2, needed: 1 }));
    let all_one = data(vec![vec![vec![TargetCorner { point: 0, pixel: Point2::origin() }]]; 5]);
    let small = CalibrateError::TooFewViews { camera: 0, got: 0, needed: 3, small: 5, mirrored: 0 };
    assert_eq!(calibrate(&all_one, &options, &Silent), Err(small));
    // Random pixels are no board.
    let mut studio = Studio::new(1, Distortion::NONE);
    let mut noise = data(views().collect());
    noise.views.iter_mut().flatten().flatten().for_each(|c| {
        c.pixel = Point2::new(640.0 * uniform(&mut studio.rng), 480.0 * uniform(&mut studio.rng));
    });
    assert!(calibrate(&noise, &options, &Silent).is_err());
}

#[test]
fn a_cancelled_job_returns_that_error() {
    struct AlwaysCancelled;
    impl Progress for AlwaysCancelled {
        fn report(&self, _: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
            Err(Cancelled)
        }
    }
    let data = Studio::new(1, Distortion::NONE).observations(5, 0.1);
    let stopped = calibrate(&data, &CalibrateOptions::default(), &AlwaysCancelled);
    assert_eq!(stopped, Err(CalibrateError::Cancelled(Cancelled)));
}
