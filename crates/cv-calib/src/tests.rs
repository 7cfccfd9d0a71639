//! Calibrations of generated views, whose truth is known.

use super::*;
use crate::testing::Studio;
use cv_core::{Camera, Cancelled, Distortion, DistortionModel, Point2, Pose, Progress, Rotation3, Silent, Vector3};

fn with(lens: LensChoice) -> CalibrateOptions {
    CalibrateOptions { lens, holdout: false, ..CalibrateOptions::default() }
}

const FIVE: [f64; 5] = [-0.35, 0.14, 1e-3, -5e-4, -0.02];

#[test]
fn exact_corners_give_every_lens_back() {
    let rational = [1.2, 0.3, 5e-4, -2e-4, 0.02, 1.5, 0.5, 0.05];
    let mut prism = [0.0; 12];
    prism[..8].copy_from_slice(&rational);
    prism[8..].copy_from_slice(&[2e-3, -1e-3, -1e-3, 5e-4]);
    let cases = [
        (LensChoice::RadialTangential4, Distortion::radial_tangential4([-0.3, 0.1, 1e-3, -5e-4])),
        (LensChoice::RadialTangential5, Distortion::radial_tangential5(FIVE)),
        (LensChoice::Rational8, Distortion::rational8(rational)),
        (LensChoice::ThinPrism12, Distortion::thin_prism12(prism)),
        (LensChoice::Fisheye4, Distortion::fisheye4([0.05, -0.01, 0.003, -0.001])),
    ];
    for (choice, distortion) in cases {
        let mut studio = Studio::new(5, distortion);
        let data = studio.sightings(15, 0.0);
        let found = calibrate(&data, &with(choice), &Silent).unwrap();
        // The adjustment ends where a step gains a ten-millionth of the cost: pixels of a thousand, exact to rounding and what that leaves. The prior
        // on rational lenses costs about a ten-thousandth of a square pixel in all.
        let exact = if distortion.parameters().len() < 8 { 1e-5 } else { 1e-3 };
        assert!(found.rms_px < exact, "{choice}: {}", found.rms_px);
        let (truth, camera) = (studio.cameras[0], found.cameras[0].camera);
        // The parameters of rational lenses make up for each other; what they do to a ray where there are corners does not.
        let exact = if distortion.parameters().len() < 8 { 1e-3 } else { 0.03 };
        for (x, y) in [(200.0, 150.0), (640.0, 480.0), (1100.0, 150.0), (200.0, 850.0)] {
            let pixel = camera.denormalize(truth.normalize(Point2::new(x, y)));
            assert!((pixel - Point2::new(x, y)).norm() < exact, "{choice}: {pixel}");
        }
        assert!((found.target_shape.deflection[0] - 1.0).abs() < 1e-3, "{:?}", found.target_shape);
    }
}

/// A trial: the calibration, and its errors over their stated deviations.
fn trial(seed: u64) -> (Calibration, Vec<f64>) {
    let mut studio = Studio::new(seed, Distortion::radial_tangential5(FIVE));
    let data = studio.sightings(20, 0.1);
    let found = calibrate(&data, &with(LensChoice::RadialTangential5), &Silent).unwrap();
    let truth = studio.cameras[0].intrinsics();
    let truth = truth[..9].iter().chain(&studio.shape);
    let off = found.parameters.iter().zip(truth).map(|(p, t)| (p.value - t) / p.deviation).collect();
    (found, off)
}

fn rig_trial(seed: u64) -> Vec<f64> {
    let mut studio = Studio::rig(seed);
    let data = studio.sightings(20, 0.1);
    let found = calibrate(&data, &with(LensChoice::RadialTangential5), &Silent).unwrap();
    let mount = found.cameras[1].from_first;
    let turn = (mount.rotation * studio.mounts[1].rotation.inverse()).scaled_axis();
    let shift = mount.translation - studio.mounts[1].translation;
    let own: Vec<f64> = found.parameters.iter().filter(|p| p.camera == Some(1)).skip(9).map(|p| p.deviation).collect();
    turn.iter().chain(shift.iter()).zip(own).map(|(off, deviation)| off / deviation).collect()
}

fn within(errors: &[f64]) -> f64 {
    errors.iter().filter(|e| e.abs() < 1.96).count() as f64 / errors.len() as f64
}

#[test]
fn noisy_corners_give_the_camera_and_honest_deviations() {
    let (mut all, mut center) = (Vec::new(), 0.0);
    for seed in 0..8 {
        let (found, errors) = trial(seed);
        let camera = found.cameras[0].camera;
        // Stated deviations are about 0.14 px of 900, and 0.2 px for the principal point.
        assert!((camera.fx / 900.0 - 1.0).abs() < 5e-4 && (camera.fy / 902.0 - 1.0).abs() < 5e-4, "{seed}: {camera:?}");
        center += ((camera.cx - 650.0).powi(2) + (camera.cy - 470.0).powi(2)) / 16.0;
        // A tenth of a pixel; by 3,000 numbers known to two in a hundred.
        assert!((found.noise_px - 0.1).abs() < 0.008, "{}", found.noise_px);
        all.extend(errors);
    }
    assert!(center.sqrt() < 0.3, "{center}");
    all.extend((0..4).flat_map(rig_trial));
    // 112 numbers, those of a trial not independent: 95 in a hundred, plus or minus four. The long test counts better.
    assert!(within(&all) > 0.85, "{}", within(&all));
}

#[test]
#[ignore = "400 trials of a camera and of a rig take a minute"]
fn deviations_cover_the_truth_in_95_of_100_trials() {
    let trials: Vec<Vec<f64>> = (0..400).map(|seed| trial(seed).1).collect();
    let rigs: Vec<Vec<f64>> = (0..400).map(rig_trial).collect();
    for trials in [trials, rigs] {
        for k in 0..trials[0].len() {
            let share = within(&trials.iter().map(|t| t[k]).collect::<Vec<_>>());
            println!("{k}: {share}");
            // A binomial share of 400 has a deviation of 1.1 in a hundred.
            assert!((0.92..=0.98).contains(&share), "parameter {k}: {share}");
        }
    }
}

#[test]
fn the_uncertainty_map_is_how_far_off_rays_are() {
    let (mut sum, mut count) = (0.0, 0.0);
    for seed in 0..6 {
        let mut studio = Studio::new(seed + 70, Distortion::radial_tangential4([-0.3, 0.1, 1e-3, -5e-4]));
        let data = studio.sightings(12, 0.1);
        let target = &studio.target;
        let found = calibrate(&data, &with(LensChoice::RadialTangential4), &Silent).unwrap();
        let (camera, truth) = (&found.cameras[0], studio.cameras[0]);
        // The motion between the two cameras' frames that fits the corners best, by small steps of Gauss and Newton.
        let points: Vec<_> = (0..12)
            .flat_map(|v| data.views[v][0].iter().map(move |c| (v, c.point)))
            .map(|(v, point)| {
                found.views[v].pose.unwrap().transform(&target.bent(point, found.target_shape.deflection))
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
    // Of the squared length over the variance in the worst direction, the mean is between one and two. Thirty values, of which those of a
    // trial go together.
    assert!((0.5..3.0).contains(&(sum / count)), "{}", sum / count);
}

#[test]
fn wrong_corners_and_views_are_left_out_and_said_to_be() {
    let mut studio = Studio::new(11, Distortion::radial_tangential5(FIVE));
    let mut data = studio.sightings(14, 0.1);
    data.views[3][0][7].pixel.x += 5.0;
    data.views[4][0][9].pixel.y -= 80.0;
    // One view is of points shifted by a column, one mirrored, one of a line, one of three corners, one of nothing.
    let pose = studio.pose();
    let mut shuffled = studio.view(&pose, 0.1);
    shuffled[0].iter_mut().for_each(|c| c.point = (c.point * 37 + 11) % 88);
    let mut mirrored = data.views[0].clone();
    mirrored[0].iter_mut().for_each(|c| c.pixel.x = 1279.0 - c.pixel.x);
    let line = vec![data.views[1][0].iter().filter(|c| c.point / 11 == 4).copied().collect::<Vec<_>>()];
    let three = vec![data.views[2][0][..3].to_vec()];
    data.views.extend([shuffled, mirrored, line, three, vec![Vec::new()]]);
    let found = calibrate(&data, &with(LensChoice::RadialTangential5), &Silent).unwrap();
    let outcome = |v: usize| found.views[v].pictures[0].outcome;
    assert!(matches!(outcome(3), PictureOutcome::Used { outliers: 1, .. }), "{:?}", outcome(3));
    assert!(!found.views[3].pictures[0].corners[7].used && !found.views[4].pictures[0].corners[9].used);
    assert!(!outcome(14).is_used(), "{:?}", outcome(14));
    assert_eq!(outcome(15), PictureOutcome::Mirrored);
    assert!(!outcome(16).is_used(), "{:?}", outcome(16));
    assert_eq!(outcome(17), PictureOutcome::TooFewCorners { got: 3, needed: 6 });
    assert_eq!(outcome(18), PictureOutcome::Nothing);
    assert!((found.cameras[0].camera.fx / 900.0 - 1.0).abs() < 1e-3, "{:?}", found.cameras[0].camera);
}

#[test]
fn cameras_that_count_a_symmetric_board_from_different_ends_are_one_rig() {
    let mut studio = Studio::rig(5);
    let data = studio.sightings(12, 0.1);
    let plain = calibrate(&data, &with(LensChoice::RadialTangential5), &Silent).unwrap();
    let mut turned = Sightings { target: data.target.clone().with_equal_turns(2), ..data.clone() };
    // Most views of the second camera, and some of the first.
    let is_turned = |v: usize, c: usize| if c == 1 { !v.is_multiple_of(3) } else { v % 4 == 1 };
    for (v, c) in (0..12).flat_map(|v| [(v, 0), (v, 1)]) {
        if is_turned(v, c) {
            turned.views[v][c].iter_mut().for_each(|corner| corner.point = 87 - corner.point);
        }
    }
    let found = calibrate(&turned, &with(LensChoice::RadialTangential5), &Silent).unwrap();
    // The same least squares problem but for the names of points: what is left is where the iterations stop, far below the deviations of a hundredth.
    assert!((found.rms_px - plain.rms_px).abs() < 1e-4, "{} {}", found.rms_px, plain.rms_px);
    let shift = found.cameras[1].from_first.translation - plain.cameras[1].from_first.translation;
    assert!(shift.norm() < 1e-2, "{shift}");
    for (v, view) in found.views.iter().enumerate() {
        assert_eq!(view.pictures[0].turn, 0);
        if view.pictures.iter().all(|p| p.outcome.is_used()) {
            assert_eq!(view.pictures[1].turn, usize::from(is_turned(v, 0) != is_turned(v, 1)), "{v}");
        }
    }
    // Without being told, what is not in order is left out.
    let untold = Sightings { target: data.target.clone(), ..turned };
    let poor = calibrate(&untold, &with(LensChoice::RadialTangential5), &Silent);
    let complete = |c: &Calibration| c.complete_views().count();
    assert!(poor.is_err() || poor.is_ok_and(|poor| complete(&poor) < complete(&found)));
}

#[test]
fn a_rig_with_views_missing_is_calibrated_as_one() {
    let mut studio = Studio::rig(3);
    let mut data = studio.sightings(16, 0.1);
    data.views[2][0].clear();
    data.views[5][1].clear();
    data.views[6] = vec![Vec::new(), Vec::new()];
    let options = CalibrateOptions { lens: LensChoice::RadialTangential5, ..CalibrateOptions::default() };
    let found = calibrate(&data, &options, &Silent).unwrap();
    let rig = found.stereo().unwrap();
    // Deviations are about 0.1 mm.
    assert!((rig.right_from_left.translation - studio.mounts[1].translation).norm() < 0.6, "{rig:?}");
    assert_eq!((rig.right.width, rig.right.height), (800, 600));
    assert_eq!(found.views[6].pose, None);
    assert!(found.views[5].pictures[0].outcome.is_used() && found.views[2].pictures[1].outcome.is_used());
    // Views that had no part in it are a little worse, and no more.
    assert!(found.holdout_rms_px > 0.9 * found.rms_px && found.holdout_rms_px < 1.2 * found.rms_px);
    // Outliers included, which these views hardly have.
    assert!((found.holdout_all_rms_px / found.holdout_rms_px - 1.0).abs() < 0.1, "{}", found.holdout_all_rms_px);
    assert_eq!(found.parameters.len(), 9 + 9 + 6 + 2);
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
fn the_lens_is_chosen_by_views_it_was_not_fitted_to() {
    let cases = [
        (Distortion::radial_tangential4([-0.25, 0.08, 1e-3, -5e-4]), DistortionModel::RadialTangential4),
        (Distortion::fisheye4([0.02, -0.01, 0.004, -0.001]), DistortionModel::Fisheye4),
    ];
    for (distortion, model) in cases {
        let mut studio = Studio::new(21, distortion);
        studio.cameras[0].fx = 500.0;
        studio.cameras[0].fy = 501.0;
        let data = studio.sightings(14, 0.1);
        let found = calibrate(&data, &CalibrateOptions::default(), &Silent).unwrap();
        let camera = &found.cameras[0];
        assert_eq!(camera.camera.distortion.model(), model, "{:?}", camera.lenses);
        assert_eq!(camera.lenses.len(), 5);
        let chosen = camera.lenses.iter().find(|l| l.verdict == LensVerdict::Chosen).unwrap();
        assert_eq!(chosen.model, model);
        // Chosen: no worse than others up to chance.
        assert!(
            camera.lenses.iter().all(|l| l.holdout_rms_px.is_nan() || chosen.holdout_rms_px < 1.05 * l.holdout_rms_px)
        );
    }
}

#[test]
fn what_determines_nothing_is_refused_with_numbers() {
    let options = with(LensChoice::RadialTangential4);
    let target = TargetPoints::grid(9, 6, 1.0).unwrap();
    let none = Sightings { target: target.clone(), sizes: vec![(640, 480)], views: Vec::new() };
    assert_eq!(calibrate(&none, &options, &Silent), Err(CalibrateError::NoViews));
    let camera = Camera::from_focal(640, 480, 500.0);
    let seen = |turn: [f64; 3], shift: [f64; 3]| {
        let pose = Pose::new(Rotation3::new(Vector3::from(turn)), Vector3::from(shift));
        let at = |point| camera.project(&pose.transform(&target.bent(point, [0.0; 2]))).unwrap();
        vec![(0..54).map(|point| TargetCorner { point, pixel: at(point) }).collect::<Vec<_>>()]
    };
    let data = |views: Vec<Vec<Vec<TargetCorner>>>| Sightings { views, ..none.clone() };
    let one = data(vec![seen([0.3, 0.2, 0.0], [-4.0, -3.0, 10.0])]);
    let few = CalibrateError::TooFewViews { camera: 0, got: 1, needed: 3, small: 0, mirrored: 0 };
    assert_eq!(calibrate(&one, &options, &Silent), Err(few));
    // Parallel to the picture in all views: any focal length will do.
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
        c.pixel = Point2::new(640.0 * testing::uniform(&mut studio.rng), 480.0 * testing::uniform(&mut studio.rng));
    });
    assert!(calibrate(&noise, &options, &Silent).is_err());
}

#[test]
fn a_job_that_is_stopped_says_so() {
    struct Never;
    impl Progress for Never {
        fn report(&self, _: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
            Err(Cancelled)
        }
    }
    let data = Studio::new(1, Distortion::NONE).sightings(5, 0.1);
    let stopped = calibrate(&data, &CalibrateOptions::default(), &Never);
    assert_eq!(stopped, Err(CalibrateError::Cancelled(Cancelled)));
}
