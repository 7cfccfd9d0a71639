//! From corners to a calibration.

use crate::adjustment::{Estimate, Failure, Free, Problem, Used};
use crate::calibration::{
    CalibratedCamera, CalibratedCorner, CalibratedParameter, CalibratedPicture, CalibratedView, Calibration,
    PictureOutcome, TargetShape,
};
use crate::fit::{Fit, Limits, ShapeState, fit};
use crate::holdout::{HoldOut, hold_out};
use crate::lens_choice::{Mono, choose, folds, rms};
use crate::plane_pose::is_mirrored;
use crate::rig_start::{mounts, turns_of_views};
use crate::target::Sightings;
use crate::uncertainty::{CoverageMap, uncertainty};
use crate::verdict::{
    BENT, CaptureNote, EMPTY, ENOUGH_VIEWS, HOLDOUT_RATIO, PARALLEL_DEGREES, PictureSide, UNCERTAIN_PX, Verdict,
};
use crate::{CalibrateError, CalibrateOptions};
use cv_core::{Cancelled, Pose, Progress, Vector3};
use cv_numeric::RobustLoss;
use nalgebra::DMatrix;

/// Fewest views of a camera: two determine a pinhole and leave nothing for a lens.
const LEAST_VIEWS: usize = 3;
/// Above this relative standard deviation, a focal length is as good as unknown.
const UNKNOWN_FOCAL: f64 = 0.1;

/// Calibrates cameras, one or a rig of several, from what they saw of a flat target.
///
/// Zhang's closed form and a search over focal lengths and barrels give the first lens; then one adjustment of lenses, poses, places of the cameras and the
/// target's own shape to the least reprojection error, robustly first, then by least squares on the corners that are near enough. Where the lens model is to be
/// chosen, each is judged by the views that it was not fitted to. O(corners) for each of some tens of iterations and each model.
///
/// # Errors
/// [`CalibrateError`]: corners that cannot be those of the target, too few views (three for each camera), views that do not determine the lens, cameras that share
/// no view, an option out of its range, or the job was stopped.
pub fn calibrate(
    data: &Sightings,
    options: &CalibrateOptions,
    progress: &dyn Progress,
) -> Result<Calibration, CalibrateError> {
    options.check()?;
    data.check()?;
    let limits = Limits {
        outlier_deviations: options.outlier_deviations,
        min_corners: options.min_corners,
        board_shape: options.board_shape,
    };
    let refused = refusals(data, options.min_corners);
    let cameras = data.sizes.len();
    let mut alone = Vec::with_capacity(cameras);
    for camera in 0..cameras {
        let (own, views) = data.of_camera(camera);
        let usable: Vec<usize> = (0..views.len()).filter(|i| refused[views[*i]][camera].is_none()).collect();
        if usable.len() < LEAST_VIEWS {
            return Err(too_few(&refused, camera, usable.len()));
        }
        let holdout = options.holdout && cameras == 1;
        let mono = choose(&own, &usable, options.lens, limits, holdout, progress).map_err(|e| of_camera(e, camera))?;
        if cameras > 1 {
            check_determined(&mono.fit, camera, covariance_of(&own, &mono.fit).ok())?;
        }
        alone.push((mono, views));
    }
    if cameras == 1 {
        let (fit, holdout, mono) = expand(data, alone.remove(0))?;
        return report(data, options, fit, holdout, vec![mono], &refused);
    }
    let usable = usable_corners(data, &refused);
    let turns = data.target.turns();
    let mut poses = own_poses(data.views.len(), &alone);
    let mounts = mounts(&poses, &turns)?;
    // What cameras numbered otherwise gets the numbers of the first camera's picture.
    let numbered = turns_of_views(&poses, &mounts, &turns);
    let mut same = data.clone();
    for (v, c) in (0..numbered.len()).flat_map(|v| (0..cameras).map(move |c| (v, c))) {
        let turn = numbered[v][c];
        same.views[v][c].iter_mut().for_each(|corner| corner.point = data.target.turned(corner.point, turn));
        poses[c][v] = poses[c][v].map(|pose| pose.compose(&turns[turn].inverse()));
    }
    let (fit, holdout) = joint(&same, &alone, (&mounts, &poses), &usable, limits, options.holdout, progress)?;
    let mut found = report(&same, options, fit, holdout, alone.into_iter().map(|a| a.0).collect(), &refused)?;
    for (view, turns) in found.views.iter_mut().zip(numbered) {
        view.pictures.iter_mut().zip(turns).for_each(|(picture, turn)| picture.turn = turn);
    }
    Ok(found)
}

/// The poses of the views as each camera has them by itself, by camera and view.
fn own_poses(views: usize, alone: &[(Mono, Vec<usize>)]) -> Vec<Vec<Option<Pose>>> {
    let mut poses = vec![vec![None; views]; alone.len()];
    for ((mono, views), poses) in alone.iter().zip(&mut poses) {
        for (i, v) in views.iter().enumerate() {
            poses[*v] = mono.fit.estimate.poses[i].filter(|_| mono.fit.used[i].iter().flatten().any(|u| *u));
        }
    }
    poses
}

/// The error of a camera by itself as that of a camera of several.
fn of_camera(error: CalibrateError, number: usize) -> CalibrateError {
    match error {
        CalibrateError::NoStart { model, error_px, .. } => CalibrateError::NoStart { camera: number, model, error_px },
        CalibrateError::Degenerate { largest_tilt_degrees, .. } => {
            CalibrateError::Degenerate { camera: number, largest_tilt_degrees }
        }
        other => other,
    }
}

/// Why pictures cannot be used, by view and camera, before anything is fitted.
fn refusals(data: &Sightings, min_corners: usize) -> Vec<Vec<Option<PictureOutcome>>> {
    let of = |corners: &Vec<crate::TargetCorner>| match corners.len() {
        0 => Some(PictureOutcome::Nothing),
        got if got < min_corners => Some(PictureOutcome::TooFewCorners { got, needed: min_corners }),
        _ => match is_mirrored(&data.target, corners) {
            None => Some(PictureOutcome::Flat),
            Some(true) => Some(PictureOutcome::Mirrored),
            Some(false) => None,
        },
    };
    data.views.iter().map(|cameras| cameras.iter().map(of).collect()).collect()
}

fn too_few(refused: &[Vec<Option<PictureOutcome>>], camera: usize, got: usize) -> CalibrateError {
    let count = |of: fn(&PictureOutcome) -> bool| refused.iter().filter(|v| v[camera].as_ref().is_some_and(of)).count();
    CalibrateError::TooFewViews {
        camera,
        got,
        needed: LEAST_VIEWS,
        small: count(|o| matches!(o, PictureOutcome::TooFewCorners { .. } | PictureOutcome::Flat)),
        mirrored: count(|o| matches!(o, PictureOutcome::Mirrored)),
    }
}

fn usable_corners(data: &Sightings, refused: &[Vec<Option<PictureOutcome>>]) -> Used {
    let picture = |(corners, refused): (&Vec<_>, &Option<_>)| vec![refused.is_none(); corners.len()];
    data.views.iter().zip(refused).map(|(v, r)| v.iter().zip(r).map(picture).collect()).collect()
}

/// Covariance of everything but the poses of the views, and the variance of a coordinate.
fn covariance_of(data: &Sightings, fit: &Fit) -> Result<(DMatrix<f64>, f64), cv_numeric::adjust::AdjustError> {
    let free = Free { shape: fit.shape == ShapeState::Adjusted, ..Free::ALL };
    Problem::new(data, &fit.estimate, &fit.used, free, RobustLoss::Trivial)?.covariance()
}

/// Refuses a focal length that the views leave open. `covariance`: where there is one, that of the camera before others.
fn check_determined(
    fit: &Fit,
    camera: usize,
    covariance: Option<(DMatrix<f64>, f64)>,
) -> Result<(DMatrix<f64>, f64), CalibrateError> {
    if let Some((covariance, variance)) = covariance {
        // Exact corners too: as if they had noise of a tenth of a pixel.
        let more = (1e-2 / variance.max(f64::MIN_POSITIVE)).max(1.0);
        if (covariance[(0, 0)] * more).sqrt() <= UNKNOWN_FOCAL * fit.estimate.cameras[0].fx {
            return Ok((covariance, variance));
        }
    }
    let tilt = |pose: &Pose| pose.rotation.matrix()[(2, 2)].abs().min(1.0).acos().to_degrees();
    let largest = fit.estimate.poses.iter().flatten().map(tilt).fold(0.0, f64::max);
    Err(CalibrateError::Degenerate { camera, largest_tilt_degrees: largest })
}

/// What one camera saw, put back among the views in which it saw nothing.
fn expand(
    data: &Sightings,
    (mut mono, views): (Mono, Vec<usize>),
) -> Result<(Fit, Option<HoldOut>, Mono), CalibrateError> {
    let mut fit = mono.fit.clone();
    let mut poses = vec![None; data.views.len()];
    let mut used: Used = data.views.iter().map(|v| v.iter().map(|c| vec![false; c.len()]).collect()).collect();
    for (i, v) in views.iter().enumerate() {
        poses[*v] = fit.estimate.poses[i];
        used[*v] = std::mem::take(&mut fit.used[i]);
    }
    fit.estimate.poses = poses;
    fit.used = used;
    let holdout = mono.holdout.take();
    Ok((fit, holdout, mono))
}

/// Joins cameras that were calibrated by themselves, and adjusts all together.
fn joint(
    data: &Sightings,
    alone: &[(Mono, Vec<usize>)],
    (mounts, poses): (&[Pose], &[Vec<Option<Pose>>]),
    usable: &Used,
    limits: Limits,
    holdout: bool,
    progress: &dyn Progress,
) -> Result<(Fit, Option<HoldOut>), CalibrateError> {
    let n = data.views.len();
    let of_view = |v: usize| {
        // Where cameras do not agree, the residuals will tell.
        let seen = mounts.iter().zip(poses).find_map(|(m, poses)| poses[v].map(|p| m.inverse().compose(&p)))?;
        Some(seen)
    };
    let shapes = alone.iter().map(|(m, _)| m.fit.estimate.shape);
    let count = alone.len() as f64;
    let shape = shapes.fold([0.0; 2], |s, x| [s[0] + x[0] / count, s[1] + x[1] / count]);
    let estimate = Estimate {
        cameras: alone.iter().map(|(m, _)| m.fit.estimate.cameras[0]).collect(),
        mounts: mounts.to_vec(),
        poses: (0..n).map(of_view).collect(),
        shape,
    };
    let degenerate = CalibrateError::Degenerate { camera: 0, largest_tilt_degrees: f64::NAN };
    let failed = |failure| match failure {
        Failure::Cancelled => CalibrateError::Cancelled(Cancelled),
        Failure::Adjust(_) => degenerate,
    };
    let found = fit(data, &estimate, usable, limits, progress).map_err(failed)?;
    let views = found.used.iter().filter(|v| v.iter().flatten().any(|u| *u)).count();
    let holdout = match folds(views).filter(|_| holdout) {
        Some(folds) => match hold_out(data, &found, (usable, &found.used), limits, folds, progress) {
            Ok(error) => Some(error),
            Err(Failure::Cancelled) => return Err(Cancelled.into()),
            Err(Failure::Adjust(_)) => None,
        },
        None => None,
    };
    Ok((found, holdout))
}

/// Everything that is said of a fit.
fn report(
    data: &Sightings,
    options: &CalibrateOptions,
    fit: Fit,
    holdout: Option<HoldOut>,
    alone: Vec<Mono>,
    refused: &[Vec<Option<PictureOutcome>>],
) -> Result<Calibration, CalibrateError> {
    let free = Free { shape: fit.shape == ShapeState::Adjusted, ..Free::ALL };
    let (covariance, variance) = check_determined(&fit, 0, covariance_of(data, &fit).ok())?;
    let limit_px = options.outlier_deviations * fit.deviation;
    let views: Vec<CalibratedView> = (0..data.views.len()).map(|v| view(data, &fit, v, refused, limit_px)).collect();
    let mut cameras = Vec::with_capacity(alone.len());
    let mut first = 0;
    for (c, mono) in alone.into_iter().enumerate() {
        let camera = fit.estimate.cameras[c];
        let n = camera.intrinsic_count();
        let own = covariance.view((first, first), (n, n)).into_owned();
        first += n;
        let used = || {
            let of =
                |v: usize| data.views[v][c].iter().zip(&fit.used[v][c]).map(move |(corner, used)| (v, corner, *used));
            (0..data.views.len()).flat_map(of).filter(|(_, _, used)| *used).map(|(v, corner, _)| (v, corner))
        };
        let in_camera = |(v, corner): (usize, &crate::TargetCorner)| {
            let pose = fit.estimate.mounts[c].compose(&fit.estimate.poses[v]?);
            Some(pose.transform(&data.target.bent(corner.point, fit.estimate.shape)))
        };
        let points: Vec<_> = used().filter_map(in_camera).collect();
        cameras.push(CalibratedCamera {
            camera,
            from_first: fit.estimate.mounts[c],
            rms_px: rms(data, &fit, Some(c)).0,
            holdout_rms_px: holdout.as_ref().map_or(f64::NAN, |h| h.rms(Some(c))),
            holdout_all_rms_px: holdout.as_ref().map_or(f64::NAN, |h| h.rms_of_all(Some(c))),
            lenses: mono.trials,
            uncertainty: uncertainty(&camera, &own, &points, options.grid),
            coverage: CoverageMap::new(used().map(|(_, corner)| corner.pixel), data.sizes[c], options.grid),
        });
    }
    let parameters = parameters(&fit, &covariance);
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
    calibration.verdict = Verdict::new(notes(data, &calibration));
    Ok(calibration)
}

fn view(
    data: &Sightings,
    fit: &Fit,
    v: usize,
    refused: &[Vec<Option<PictureOutcome>>],
    limit_px: f64,
) -> CalibratedView {
    let picture = |c: usize| {
        let residuals = fit.estimate.residuals(data, v, c);
        let used = &fit.used[v][c];
        let count = used.iter().filter(|u| **u).count();
        let outcome = match refused[v][c] {
            Some(refused) => refused,
            None if fit.estimate.poses[v].is_none() => PictureOutcome::NoPose,
            None if count == 0 => PictureOutcome::Inconsistent {
                near: residuals.iter().flatten().filter(|r| r.norm() <= limit_px).count(),
                of: residuals.len(),
                limit_px,
            },
            None => PictureOutcome::Used { corners: count, outliers: used.len() - count },
        };
        let counted = residuals.iter().zip(used).filter(|(_, used)| **used || count == 0).filter_map(|(r, _)| *r);
        let (squares, n) = counted.fold((0.0, 0), |s, r| (s.0 + r.norm_squared(), s.1 + 1));
        let corners = residuals.iter().zip(used).map(|(r, u)| CalibratedCorner { residual: *r, used: *u }).collect();
        let rms_px = if n == 0 { f64::NAN } else { (squares / f64::from(n)).sqrt() };
        CalibratedPicture { outcome, rms_px, corners, turn: 0 }
    };
    let pictures: Vec<CalibratedPicture> = (0..data.sizes.len()).map(picture).collect();
    let seen = pictures.iter().any(|p| p.outcome.is_used());
    CalibratedView { pose: fit.estimate.poses[v].filter(|_| seen), pictures }
}

/// In the order of the covariance; without the target's deflections where they were not adjusted.
fn parameters(fit: &Fit, covariance: &DMatrix<f64>) -> Vec<CalibratedParameter> {
    let mut values: Vec<(Option<usize>, &'static str, f64)> = Vec::new();
    for (c, camera) in fit.estimate.cameras.iter().enumerate() {
        let names = ["fx", "fy", "cx", "cy"].iter().chain(camera.distortion.model().info().parameters);
        values.extend(names.zip(camera.intrinsics()).map(|(name, value)| (Some(c), *name, value)));
    }
    for (c, mount) in fit.estimate.mounts.iter().enumerate().skip(1) {
        let turn = mount.rotation.scaled_axis();
        values.extend(["rx", "ry", "rz"].into_iter().zip(turn.iter().copied()).map(|(n, x)| (Some(c), n, x)));
        let shift = mount.translation;
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

fn notes(data: &Sightings, of: &Calibration) -> Vec<CaptureNote> {
    let mut notes = Vec::new();
    for (camera, c) in of.cameras.iter().enumerate() {
        let pictures = || of.views.iter().map(|v| &v.pictures[camera]);
        let got = pictures().filter(|p| p.outcome.is_used()).count();
        if got < ENOUGH_VIEWS {
            notes.push(CaptureNote::FewViews { camera, got, wanted: ENOUGH_VIEWS });
        }
        let with = pictures().filter(|p| p.outcome != PictureOutcome::Nothing).count();
        if 5 * (with - got) > with {
            notes.push(CaptureNote::LeftOut { camera, pictures: with - got, of: with });
        }
        let all = [0.0, 1.0];
        let sides = [
            (PictureSide::Left, [0.0, 0.25], all),
            (PictureSide::Right, [0.75, 1.0], all),
            (PictureSide::Top, all, [0.0, 0.25]),
            (PictureSide::Bottom, all, [0.75, 1.0]),
        ];
        for (side, x, y) in sides {
            let covered = c.coverage.share(x, y);
            if covered < EMPTY {
                notes.push(CaptureNote::EmptySide { camera, side, covered });
            }
        }
        let normals: Vec<Vector3<f64>> = of
            .views
            .iter()
            .filter(|v| v.pictures[camera].outcome.is_used())
            .filter_map(|v| Some(v.pose?.rotation.matrix().column(2).into_owned()))
            .collect();
        let least = normals.iter().flat_map(|a| normals.iter().map(|b| a.dot(b))).fold(1.0, f64::min);
        let spread_degrees = least.clamp(-1.0, 1.0).acos().to_degrees();
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
            v.pictures[camera].outcome.is_used() && v.pictures.iter().filter(|p| p.outcome.is_used()).count() > 1
        };
        let got = of.views.iter().filter(shared).count();
        if camera > 0 && got < ENOUGH_VIEWS {
            notes.push(CaptureNote::FewShared { camera, got, wanted: ENOUGH_VIEWS });
        }
    }
    let [x, y] = of.target_shape.deflection;
    let share = x.abs().max(y.abs()) / data.target.size().max();
    if share > BENT {
        notes.push(CaptureNote::BentTarget { share });
    }
    notes
}
