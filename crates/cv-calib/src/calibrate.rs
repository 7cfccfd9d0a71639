//! Calibration of a camera or rig from the corners of a target: the job as a whole.

use crate::adjustment::{Estimate, Failure, FreeParameters, InlierMask, Problem};
use crate::calibration::{
    CalibratedCamera, CalibratedCorner, CalibratedImage, CalibratedParameter, CalibratedView, Calibration,
    ImageOutcome, TargetShape,
};
use crate::fit::{Fit, Limits, ShapeState, fit};
use crate::holdout::{HoldOut, hold_out};
use crate::lens_choice::{Mono, choose_lens, fold_count, rms};
use crate::plane_pose::is_mirrored;
use crate::rig_start::{estimate_rig_poses, symmetries_of_views};
use crate::target::TargetObservations;
use crate::uncertainty::{CoverageMap, uncertainty_map};
use crate::verdict::{
    CaptureNote, HOLDOUT_RATIO, ImageSide, MAX_DEFLECTION_RATIO, MIN_COVERED_FRACTION, PARALLEL_DEGREES,
    RECOMMENDED_VIEWS, UNCERTAIN_PX, Verdict,
};
use crate::{CalibrateError, CalibrateOptions};
use cv_core::{Cancelled, Pose, Progress, Vector3};
use cv_numeric::RobustLoss;
use nalgebra::DMatrix;

/// Minimum number of views of a camera: two determine a pinhole and leave no redundancy.
const MIN_VIEWS: usize = 3;
/// Largest relative standard deviation of the focal length of a determined camera.
const MAX_FOCAL_SIGMA: f64 = 0.1;

/// Calibrates a camera, or a rig of several, from observations of a planar target.
///
/// Initial intrinsics are from Zhang's closed form and a search over focal lengths and barrel distortions. A joint
/// adjustment of intrinsics, target poses, rig poses and the target's shape then minimizes the reprojection error,
/// first with a robust loss, then by least squares on the inliers. A lens model is selected by cross-validation over
/// the views. O(corners) for each of some tens of iterations and each model.
///
/// [`CalibrateError`]: corners that are not of the target, too few views (three for each camera), views that do not
/// determine the intrinsics, cameras without common views, an option out of range, or the job was stopped.
pub fn calibrate(
    data: &TargetObservations,
    options: &CalibrateOptions,
    progress: &dyn Progress,
) -> Result<Calibration, CalibrateError> {
    options.validate()?;
    data.validate()?;
    let limits = Limits {
        outlier_deviations: options.outlier_deviations,
        min_corners: options.min_corners,
        board_shape: options.board_shape,
    };
    let rejections = find_rejections(data, options.min_corners);
    let cameras = data.sizes.len();
    let mut monos = Vec::with_capacity(cameras);
    for camera in 0..cameras {
        let (observations, views) = data.of_camera(camera);
        let usable: Vec<usize> = (0..views.len()).filter(|i| rejections[views[*i]][camera].is_none()).collect();
        if usable.len() < MIN_VIEWS {
            return Err(too_few_views(&rejections, camera, usable.len()));
        }
        let holdout = options.holdout && cameras == 1;
        let mono = choose_lens(&observations, &usable, options.lens, limits, holdout, progress)
            .map_err(|e| with_camera_index(e, camera))?;
        if cameras > 1 {
            check_determined(&mono.fit, camera, estimate_covariance(&observations, &mono.fit).ok())?;
        }
        monos.push((mono, views));
    }
    if cameras == 1 {
        let (fit, holdout, mono) = expand(data, monos.remove(0))?;
        return report(data, options, fit, holdout, vec![mono], &rejections);
    }
    let usable = usable_corners(data, &rejections);
    let symmetries = data.target.symmetries();
    let mut poses = mono_poses(data.views.len(), &monos);
    let rig_poses = estimate_rig_poses(&poses, &symmetries)?;
    // Corners that a camera numbers otherwise get the numbering of the first camera's image.
    let numberings = symmetries_of_views(&poses, &rig_poses, &symmetries);
    let mut renumbered = data.clone();
    for (v, c) in (0..numberings.len()).flat_map(|v| (0..cameras).map(move |c| (v, c))) {
        let symmetry = numberings[v][c];
        renumbered.views[v][c]
            .iter_mut()
            .for_each(|corner| corner.point = data.target.symmetric_index(corner.point, symmetry));
        poses[c][v] = poses[c][v].map(|pose| pose.compose(&symmetries[symmetry].inverse()));
    }
    let (fit, holdout) =
        calibrate_jointly(&renumbered, &monos, (&rig_poses, &poses), &usable, limits, options.holdout, progress)?;
    let mut calibration =
        report(&renumbered, options, fit, holdout, monos.into_iter().map(|a| a.0).collect(), &rejections)?;
    for (view, symmetries) in calibration.views.iter_mut().zip(numberings) {
        view.images.iter_mut().zip(symmetries).for_each(|(image, symmetry)| image.symmetry = symmetry);
    }
    Ok(calibration)
}

/// Returns the target poses that each camera estimates alone, by camera and view.
fn mono_poses(views: usize, monos: &[(Mono, Vec<usize>)]) -> Vec<Vec<Option<Pose>>> {
    let mut poses = vec![vec![None; views]; monos.len()];
    for ((mono, views), poses) in monos.iter().zip(&mut poses) {
        for (i, v) in views.iter().enumerate() {
            poses[*v] = mono.fit.estimate.poses[i].filter(|_| mono.fit.used[i].iter().flatten().any(|u| *u));
        }
    }
    poses
}

/// Converts the error of a single camera to that of a camera of a rig.
fn with_camera_index(error: CalibrateError, index: usize) -> CalibrateError {
    match error {
        CalibrateError::NoStart { model, error_px, .. } => CalibrateError::NoStart { camera: index, model, error_px },
        CalibrateError::Degenerate { largest_tilt_degrees, .. } => {
            CalibrateError::Degenerate { camera: index, largest_tilt_degrees }
        }
        other => other,
    }
}

/// Returns by view and camera why an image is rejected before the fit; `None` where it is not.
fn find_rejections(data: &TargetObservations, min_corners: usize) -> Vec<Vec<Option<ImageOutcome>>> {
    let rejection = |corners: &Vec<crate::TargetCorner>| match corners.len() {
        0 => Some(ImageOutcome::Nothing),
        got if got < min_corners => Some(ImageOutcome::TooFewCorners { got, needed: min_corners }),
        _ => match is_mirrored(&data.target, corners) {
            None => Some(ImageOutcome::Flat),
            Some(true) => Some(ImageOutcome::Mirrored),
            Some(false) => None,
        },
    };
    data.views.iter().map(|cameras| cameras.iter().map(rejection).collect()).collect()
}

/// Creates the error of a camera with too few usable views.
fn too_few_views(rejections: &[Vec<Option<ImageOutcome>>], camera: usize, got: usize) -> CalibrateError {
    let count = |is_kind: fn(&ImageOutcome) -> bool| {
        rejections.iter().filter(|v| v[camera].as_ref().is_some_and(is_kind)).count()
    };
    CalibrateError::TooFewViews {
        camera,
        got,
        needed: MIN_VIEWS,
        small: count(|o| matches!(o, ImageOutcome::TooFewCorners { .. } | ImageOutcome::Flat)),
        mirrored: count(|o| matches!(o, ImageOutcome::Mirrored)),
    }
}

/// Returns the mask of the corners in images that are not rejected.
fn usable_corners(data: &TargetObservations, rejections: &[Vec<Option<ImageOutcome>>]) -> InlierMask {
    let image_mask = |(corners, rejections): (&Vec<_>, &Option<_>)| vec![rejections.is_none(); corners.len()];
    data.views.iter().zip(rejections).map(|(v, r)| v.iter().zip(r).map(image_mask).collect()).collect()
}

/// Computes the covariance of all parameters but the target poses, and the noise variance of a coordinate.
fn estimate_covariance(
    data: &TargetObservations,
    fit: &Fit,
) -> Result<(DMatrix<f64>, f64), cv_numeric::adjust::AdjustError> {
    let free = FreeParameters { shape: fit.shape == ShapeState::Adjusted, ..FreeParameters::ALL };
    Problem::new(data, &fit.estimate, &fit.used, free, RobustLoss::Trivial)?.covariance()
}

/// Returns `covariance`, or an error if it leaves the focal length undetermined. Its first block is that of the camera.
fn check_determined(
    fit: &Fit,
    camera: usize,
    covariance: Option<(DMatrix<f64>, f64)>,
) -> Result<(DMatrix<f64>, f64), CalibrateError> {
    if let Some((covariance, variance)) = covariance {
        // Scaled to a noise of at least a tenth of a pixel, for exact corners.
        let scale = (1e-2 / variance.max(f64::MIN_POSITIVE)).max(1.0);
        if (covariance[(0, 0)] * scale).sqrt() <= MAX_FOCAL_SIGMA * fit.estimate.cameras[0].fx {
            return Ok((covariance, variance));
        }
    }
    let tilt = |pose: &Pose| pose.rotation.matrix()[(2, 2)].abs().min(1.0).acos().to_degrees();
    let largest = fit.estimate.poses.iter().flatten().map(tilt).fold(0.0, f64::max);
    Err(CalibrateError::Degenerate { camera, largest_tilt_degrees: largest })
}

/// Restores the views without observations to the result of a single camera.
fn expand(
    data: &TargetObservations,
    (mut mono, views): (Mono, Vec<usize>),
) -> Result<(Fit, Option<HoldOut>, Mono), CalibrateError> {
    let mut fit = mono.fit.clone();
    let mut poses = vec![None; data.views.len()];
    let mut used: InlierMask = data.views.iter().map(|v| v.iter().map(|c| vec![false; c.len()]).collect()).collect();
    for (i, v) in views.iter().enumerate() {
        poses[*v] = fit.estimate.poses[i];
        used[*v] = std::mem::take(&mut fit.used[i]);
    }
    fit.estimate.poses = poses;
    fit.used = used;
    let holdout = mono.holdout.take();
    Ok((fit, holdout, mono))
}

/// Adjusts the cameras of a rig jointly, starting from the calibrations of single cameras.
fn calibrate_jointly(
    data: &TargetObservations,
    monos: &[(Mono, Vec<usize>)],
    (rig_poses, poses): (&[Pose], &[Vec<Option<Pose>>]),
    usable: &InlierMask,
    limits: Limits,
    holdout: bool,
    progress: &dyn Progress,
) -> Result<(Fit, Option<HoldOut>), CalibrateError> {
    let n = data.views.len();
    let target_pose = |v: usize| {
        let pose = rig_poses.iter().zip(poses).find_map(|(m, poses)| poses[v].map(|p| m.inverse().compose(&p)))?;
        Some(pose)
    };
    let shapes = monos.iter().map(|(m, _)| m.fit.estimate.shape);
    let count = monos.len() as f64;
    let shape = shapes.fold([0.0; 2], |s, x| [s[0] + x[0] / count, s[1] + x[1] / count]);
    let estimate = Estimate {
        cameras: monos.iter().map(|(m, _)| m.fit.estimate.cameras[0]).collect(),
        rig_poses: rig_poses.to_vec(),
        poses: (0..n).map(target_pose).collect(),
        shape,
    };
    let degenerate = CalibrateError::Degenerate { camera: 0, largest_tilt_degrees: f64::NAN };
    let failed = |failure| match failure {
        Failure::Cancelled => CalibrateError::Cancelled(Cancelled),
        Failure::Adjust(_) => degenerate,
    };
    let fitted = fit(data, &estimate, usable, limits, progress).map_err(failed)?;
    let views = fitted.used.iter().filter(|v| v.iter().flatten().any(|u| *u)).count();
    let holdout = match fold_count(views).filter(|_| holdout) {
        Some(folds) => match hold_out(data, &fitted, (usable, &fitted.used), limits, folds, progress) {
            Ok(error) => Some(error),
            Err(Failure::Cancelled) => return Err(Cancelled.into()),
            Err(Failure::Adjust(_)) => None,
        },
        None => None,
    };
    Ok((fitted, holdout))
}

/// Assembles the result from a fit.
fn report(
    data: &TargetObservations,
    options: &CalibrateOptions,
    fit: Fit,
    holdout: Option<HoldOut>,
    monos: Vec<Mono>,
    rejections: &[Vec<Option<ImageOutcome>>],
) -> Result<Calibration, CalibrateError> {
    let free = FreeParameters { shape: fit.shape == ShapeState::Adjusted, ..FreeParameters::ALL };
    let (covariance, variance) = check_determined(&fit, 0, estimate_covariance(data, &fit).ok())?;
    let limit_px = options.outlier_deviations * fit.sigma;
    let views: Vec<CalibratedView> =
        (0..data.views.len()).map(|v| assemble_view(data, &fit, v, rejections, limit_px)).collect();
    let mut cameras = Vec::with_capacity(monos.len());
    let mut first = 0;
    for (c, mono) in monos.into_iter().enumerate() {
        let camera = fit.estimate.cameras[c];
        let n = camera.intrinsic_count();
        let camera_covariance = covariance.view((first, first), (n, n)).into_owned();
        first += n;
        let inlier_corners = || {
            let of =
                |v: usize| data.views[v][c].iter().zip(&fit.used[v][c]).map(move |(corner, used)| (v, corner, *used));
            (0..data.views.len()).flat_map(of).filter(|(_, _, used)| *used).map(|(v, corner, _)| (v, corner))
        };
        let in_camera = |(v, corner): (usize, &crate::TargetCorner)| {
            let pose = fit.estimate.rig_poses[c].compose(&fit.estimate.poses[v]?);
            Some(pose.transform(&data.target.bent(corner.point, fit.estimate.shape)))
        };
        let points: Vec<_> = inlier_corners().filter_map(in_camera).collect();
        cameras.push(CalibratedCamera {
            camera,
            from_first: fit.estimate.rig_poses[c],
            rms_px: rms(data, &fit, Some(c)).0,
            holdout_rms_px: holdout.as_ref().map_or(f64::NAN, |h| h.rms(Some(c))),
            holdout_all_rms_px: holdout.as_ref().map_or(f64::NAN, |h| h.rms_of_all(Some(c))),
            lenses: mono.trials,
            uncertainty: uncertainty_map(&camera, &camera_covariance, &points, options.grid),
            coverage: CoverageMap::new(inlier_corners().map(|(_, corner)| corner.pixel), data.sizes[c], options.grid),
        });
    }
    let parameters = list_parameters(&fit, &covariance);
    let mut calibration = Calibration {
        cameras,
        target_shape: TargetShape { deflection: fit.estimate.shape, adjusted: free.shape },
        views,
        rms_px: rms(data, &fit, None).0,
        holdout_rms_px: holdout.as_ref().map_or(f64::NAN, |h| h.rms(None)),
        holdout_all_rms_px: holdout.as_ref().map_or(f64::NAN, |h| h.rms_of_all(None)),
        noise_px: variance.sqrt(),
        covariance: covariance.view((0, 0), (parameters.len(), parameters.len())).into_owned(),
        parameters,
        verdict: Verdict::new(Vec::new()),
    };
    calibration.verdict = Verdict::new(capture_notes(data, &calibration));
    Ok(calibration)
}

/// Assembles the result of a view.
fn assemble_view(
    data: &TargetObservations,
    fit: &Fit,
    v: usize,
    rejections: &[Vec<Option<ImageOutcome>>],
    limit_px: f64,
) -> CalibratedView {
    let assemble_image = |c: usize| {
        let residuals = fit.estimate.residuals(data, v, c);
        let used = &fit.used[v][c];
        let count = used.iter().filter(|u| **u).count();
        let outcome = match rejections[v][c] {
            Some(rejections) => rejections,
            None if fit.estimate.poses[v].is_none() => ImageOutcome::NoPose,
            None if count == 0 => ImageOutcome::Inconsistent {
                near: residuals.iter().flatten().filter(|r| r.norm() <= limit_px).count(),
                of: residuals.len(),
                limit_px,
            },
            None => ImageOutcome::Used { corners: count, outliers: used.len() - count },
        };
        let scored = residuals.iter().zip(used).filter(|(_, used)| **used || count == 0).filter_map(|(r, _)| *r);
        let (squares, n) = scored.fold((0.0, 0), |s, r| (s.0 + r.norm_squared(), s.1 + 1));
        let corners = residuals.iter().zip(used).map(|(r, u)| CalibratedCorner { residual: *r, used: *u }).collect();
        let rms_px = if n == 0 { f64::NAN } else { (squares / f64::from(n)).sqrt() };
        CalibratedImage { outcome, rms_px, corners, symmetry: 0 }
    };
    let images: Vec<CalibratedImage> = (0..data.sizes.len()).map(assemble_image).collect();
    let is_used = images.iter().any(|p| p.outcome.is_used());
    CalibratedView { pose: fit.estimate.poses[v].filter(|_| is_used), images }
}

/// Lists the parameters in the order of the covariance; without the target's deflections where they were not adjusted.
fn list_parameters(fit: &Fit, covariance: &DMatrix<f64>) -> Vec<CalibratedParameter> {
    let mut values: Vec<(Option<usize>, &'static str, f64)> = Vec::new();
    for (c, camera) in fit.estimate.cameras.iter().enumerate() {
        let names = ["fx", "fy", "cx", "cy"].iter().chain(camera.distortion.model().info().parameters);
        values.extend(names.zip(camera.intrinsics()).map(|(name, value)| (Some(c), *name, value)));
    }
    for (c, rig_pose) in fit.estimate.rig_poses.iter().enumerate().skip(1) {
        let turn = rig_pose.rotation.scaled_axis();
        values.extend(["rx", "ry", "rz"].into_iter().zip(turn.iter().copied()).map(|(n, x)| (Some(c), n, x)));
        let shift = rig_pose.translation;
        values.extend(["tx", "ty", "tz"].into_iter().zip(shift.iter().copied()).map(|(n, x)| (Some(c), n, x)));
    }
    if fit.shape == ShapeState::Adjusted {
        values.extend(["kx", "ky"].into_iter().zip(fit.estimate.shape).map(|(n, x)| (None, n, x)));
    }
    let one = |(i, (camera, name, value))| {
        let deviation = f64::sqrt(covariance[(i, i)]);
        CalibratedParameter { camera, name, value, deviation }
    };
    values.into_iter().enumerate().map(one).collect()
}

/// Lists the remarks on the capture.
fn capture_notes(data: &TargetObservations, calibration: &Calibration) -> Vec<CaptureNote> {
    let mut notes = Vec::new();
    for (camera, c) in calibration.cameras.iter().enumerate() {
        let images = || calibration.views.iter().map(|v| &v.images[camera]);
        let got = images().filter(|p| p.outcome.is_used()).count();
        if got < RECOMMENDED_VIEWS {
            notes.push(CaptureNote::FewViews { camera, got, wanted: RECOMMENDED_VIEWS });
        }
        let observed = images().filter(|p| p.outcome != ImageOutcome::Nothing).count();
        if 5 * (observed - got) > observed {
            notes.push(CaptureNote::LeftOut { camera, images: observed - got, of: observed });
        }
        let all = [0.0, 1.0];
        let sides = [
            (ImageSide::Left, [0.0, 0.25], all),
            (ImageSide::Right, [0.75, 1.0], all),
            (ImageSide::Top, all, [0.0, 0.25]),
            (ImageSide::Bottom, all, [0.75, 1.0]),
        ];
        for (side, x, y) in sides {
            let covered = c.coverage.covered_fraction(x, y);
            if covered < MIN_COVERED_FRACTION {
                notes.push(CaptureNote::EmptySide { camera, side, covered });
            }
        }
        let normals: Vec<Vector3<f64>> = calibration
            .views
            .iter()
            .filter(|v| v.images[camera].outcome.is_used())
            .filter_map(|v| Some(v.pose?.rotation.matrix().column(2).into_owned()))
            .collect();
        let min_cosine = normals.iter().flat_map(|a| normals.iter().map(|b| a.dot(b))).fold(1.0, f64::min);
        let spread_degrees = min_cosine.clamp(-1.0, 1.0).acos().to_degrees();
        if spread_degrees < PARALLEL_DEGREES {
            notes.push(CaptureNote::ParallelTargets { camera, spread_degrees });
        }
        if let Some((index, pixels)) = c.uncertainty.worst().filter(|(_, pixels)| *pixels > UNCERTAIN_PX[0]) {
            let p = c.uncertainty.position(index, data.sizes[camera]);
            notes.push(CaptureNote::Uncertain { camera, pixels, x: p.x, y: p.y, median_px: c.uncertainty.median() });
        }
        if c.holdout_rms_px > HOLDOUT_RATIO[0] * c.rms_px {
            let (rms_px, holdout_rms_px) = (c.rms_px, c.holdout_rms_px);
            notes.push(CaptureNote::HoldOut { camera, rms_px, holdout_rms_px });
        }
        let shared = |v: &&CalibratedView| {
            v.images[camera].outcome.is_used() && v.images.iter().filter(|p| p.outcome.is_used()).count() > 1
        };
        let got = calibration.views.iter().filter(shared).count();
        if camera > 0 && got < RECOMMENDED_VIEWS {
            notes.push(CaptureNote::FewShared { camera, got, wanted: RECOMMENDED_VIEWS });
        }
    }
    let [x, y] = calibration.target_shape.deflection;
    let ratio = x.abs().max(y.abs()) / data.target.size().max();
    if ratio > MAX_DEFLECTION_RATIO {
        notes.push(CaptureNote::BentTarget { share: ratio });
    }
    notes
}
