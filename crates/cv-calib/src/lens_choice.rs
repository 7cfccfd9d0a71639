//! The lens model of one camera: each is fitted, and judged by the views that it was not fitted to.

use crate::adjustment::{Failure, check_model};
use crate::fit::{Fit, Limits, fit};
use crate::holdout::{HoldOut, hold_out};
use crate::start::{Start, all_corners, poses, start};
use crate::target::Sightings;
use crate::{CalibrateError, LensChoice};
use cv_core::{Cancelled, Distortion, DistortionModel, LensProjection, Progress, Stage};

/// Why a lens model was taken, or was not.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LensVerdict {
    /// It was the only one asked for.
    Asked,
    /// Taken: the least error on held-out views, or one no larger up to chance by fewer parameters.
    Chosen,
    /// Its error on held-out views is larger, beyond what chance explains.
    LessExact,
    /// As exact as the chosen one up to chance, with more parameters.
    NotNeeded,
    /// Its rays fold back within the picture.
    Folds,
    /// The views do not determine it.
    Undetermined,
    /// There is no start, of which the median error is this many pixels.
    NoStart {
        /// In pixels.
        error_px: f64,
    },
}

/// A lens model that was tried.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LensTrial {
    /// The model.
    pub model: DistortionModel,
    /// Root mean square distance of the used corners, in pixels; NaN where there is no fit.
    pub rms_px: f64,
    /// The same on views that it was not fitted to, with only their poses adjusted; NaN where that was not computed.
    pub holdout_rms_px: f64,
    /// Corners that it leaves out.
    pub outliers: usize,
    /// What became of it.
    pub verdict: LensVerdict,
}

/// A camera by itself.
#[derive(Debug, Clone)]
pub(crate) struct Mono {
    pub(crate) fit: Fit,
    pub(crate) trials: Vec<LensTrial>,
    pub(crate) holdout: Option<HoldOut>,
}

/// Views are held out in two turns where there are so many, each half being enough to calibrate from; else in more turns of fewer.
const HALVES_FROM: usize = 12;

/// Turns in which views are held out; `None` where there are too few.
pub(crate) fn folds(views: usize) -> Option<usize> {
    match views {
        0..=3 => None,
        4..HALVES_FROM => Some(views.min(5)),
        _ => Some(2),
    }
}

/// Root mean square distance of the used corners of a camera, or of all; and how many they are.
pub(crate) fn rms(data: &Sightings, fit: &Fit, camera: Option<usize>) -> (f64, usize) {
    let (mut squares, mut count) = (0.0, 0);
    for v in 0..data.views.len() {
        for c in (0..data.sizes.len()).filter(|c| camera.is_none_or(|camera| camera == *c)) {
            let residuals = fit.estimate.residuals(data, v, c);
            for r in residuals.iter().zip(&fit.used[v][c]).filter(|(_, used)| **used).filter_map(|(r, _)| *r) {
                squares += r.norm_squared();
                count += 1;
            }
        }
    }
    ((squares / count.max(1) as f64).sqrt(), count)
}

/// Whether a lens is monotonic as far out as it saw corners.
fn reaches(data: &Sightings, fit: &Fit) -> bool {
    let camera = &fit.estimate.cameras[0];
    (0..data.views.len()).all(|v| {
        let Some(pose) = fit.estimate.poses[v] else { return true };
        data.views[v][0].iter().zip(&fit.used[v][0]).filter(|(_, used)| **used).all(|(c, _)| {
            let p = pose.transform(&data.target.bent(c.point, fit.estimate.shape));
            p.z > 0.0 && camera.distortion.distort_in_range(cv_core::Point2::new(p.x / p.z, p.y / p.z)).is_some()
        })
    })
}

/// The rational function of two terms above and below that is nearest to `atan(r)/r` around zero (Padé): an equidistant fisheye as a
/// rational lens.
const EQUIDISTANT: [f64; 8] = [7.0 / 9.0, 64.0 / 945.0, 0.0, 0.0, 0.0, 10.0 / 9.0, 5.0 / 21.0, 0.0];

struct Starts<'a> {
    data: &'a Sightings,
    usable: &'a [usize],
    perspective: Option<Result<Start, CalibrateError>>,
    fisheye: Option<Result<Start, CalibrateError>>,
}

impl Starts<'_> {
    fn of(&mut self, projection: LensProjection, progress: &dyn Progress) -> Result<Start, CalibrateError> {
        let known = match projection {
            LensProjection::Perspective => &mut self.perspective,
            LensProjection::Fisheye => &mut self.fisheye,
        };
        known.get_or_insert_with(|| start(self.data, self.usable, projection, progress)).clone()
    }

    /// A start with the lens of a model.
    fn with_model(&mut self, model: DistortionModel, progress: &dyn Progress) -> Result<Start, CalibrateError> {
        let mut start = self.of(model.info().projection, progress);
        let rational = matches!(model, DistortionModel::Rational8 | DistortionModel::ThinPrism12);
        // More than about 140° is beyond polynomials in tan θ; the fisheye is then the nearer start.
        if rational && start.as_ref().map_or(true, |s| s.error > 2.0) {
            stop(&start)?;
            let fisheye = self.of(LensProjection::Fisheye, progress);
            stop(&fisheye)?;
            if let Ok(mut fisheye) = fisheye
                && start.as_ref().map_or(true, |s| fisheye.error < 0.5 * s.error)
            {
                let camera = &mut fisheye.estimate.cameras[0];
                camera.distortion = Distortion::rational8(EQUIDISTANT);
                fisheye.estimate.poses = poses(self.data, self.usable, camera);
                start = Ok(fisheye);
            }
        }
        let mut start = start?;
        let camera = &mut start.estimate.cameras[0];
        // Two radial and two tangential parameters are part of every perspective model.
        camera.distortion = camera.distortion.converted(model).ok_or(CalibrateError::Lens { model })?;
        Ok(start)
    }
}

fn stop<T>(result: &Result<T, CalibrateError>) -> Result<(), Cancelled> {
    if matches!(result, Err(CalibrateError::Cancelled(_))) { Err(Cancelled) } else { Ok(()) }
}

/// Fits the models that may be, and takes one.
///
/// `data` is of one camera, `usable` the views that have enough corners.
pub(crate) fn choose(
    data: &Sightings,
    usable: &[usize],
    lens: LensChoice,
    limits: Limits,
    holdout: bool,
    progress: &dyn Progress,
) -> Result<Mono, CalibrateError> {
    let models = lens.models();
    let stage = Stage::new(progress, "lens", 2 * models.len())?;
    let corners = all_corners(data, usable);
    let mut starts = Starts { data, usable, perspective: None, fisheye: None };
    let mut trials = Vec::new();
    let mut fits = Vec::new();
    let mut failed = None;
    for &model in models {
        check_model(model)?;
        let nothing = LensTrial {
            model,
            rms_px: f64::NAN,
            holdout_rms_px: f64::NAN,
            outliers: 0,
            verdict: LensVerdict::Undetermined,
        };
        let found = match starts.with_model(model, &stage) {
            Ok(start) => match fit(data, &start.estimate, &corners, limits, &stage) {
                Ok(found) => Some(found),
                Err(Failure::Cancelled) => return Err(Cancelled.into()),
                Err(Failure::Adjust(_)) => None,
            },
            Err(CalibrateError::NoStart { error_px, .. }) => {
                trials.push(LensTrial { verdict: LensVerdict::NoStart { error_px }, ..nothing });
                failed = failed.or(Some(CalibrateError::NoStart { camera: 0, model, error_px }));
                stage.add(1)?;
                continue;
            }
            Err(error) => return Err(error),
        };
        stage.add(1)?;
        let Some(found) = found else {
            trials.push(nothing);
            continue;
        };
        let (rms_px, count) = rms(data, &found, None);
        let outliers = corners.iter().flatten().flatten().filter(|u| **u).count() - count;
        let verdict = if reaches(data, &found) { LensVerdict::Asked } else { LensVerdict::Folds };
        trials.push(LensTrial { rms_px, outliers, verdict, ..nothing });
        if verdict == LensVerdict::Asked && count > 0 {
            fits.push((trials.len() - 1, found));
        }
    }
    if fits.is_empty() {
        return Err(failed.unwrap_or(CalibrateError::Degenerate { camera: 0, largest_tilt_degrees: f64::NAN }));
    }
    // A corner that one of the models can explain is no mistake of the detector.
    let mut judged = fits[0].1.used.clone();
    for (_, fit) in &fits[1..] {
        for (a, b) in judged.iter_mut().flatten().flatten().zip(fit.used.iter().flatten().flatten()) {
            *a |= *b;
        }
    }
    let mut errors = Vec::new();
    if let (Some(folds), true) = (folds(usable.len()), holdout || models.len() > 1) {
        for (i, (trial, fit)) in fits.iter().enumerate() {
            match hold_out(data, fit, (&corners, &judged), limits, folds, &stage) {
                Ok(error) => {
                    trials[*trial].holdout_rms_px = error.rms(None);
                    errors.push((i, error));
                }
                Err(Failure::Cancelled) => return Err(Cancelled.into()),
                Err(Failure::Adjust(_)) if models.len() > 1 => trials[*trial].verdict = LensVerdict::Undetermined,
                Err(Failure::Adjust(_)) => {}
            }
            stage.add(1)?;
        }
    }
    let taken = if models.len() > 1 { simplest(&errors, &fits, &mut trials) } else { 0 };
    let holdout = errors.into_iter().find(|(i, _)| *i == taken).map(|(_, error)| error);
    let (_, fit) = fits.swap_remove(taken);
    Ok(Mono { fit, trials, holdout })
}

/// Of the models whose errors are the least up to chance, that with the fewest parameters. Without held-out views the first.
///
/// Chance: the sum of the differences of the views' squared errors is less than its own standard deviation.
fn simplest(errors: &[(usize, HoldOut)], fits: &[(usize, Fit)], trials: &mut [LensTrial]) -> usize {
    let parameters = |i: usize| trials_model(fits, i).parameter_count();
    let best = errors.iter().min_by(|a, b| a.1.rms(None).total_cmp(&b.1.rms(None)));
    let Some((best, least)) = best.map(|(i, e)| (*i, e)) else {
        for (trial, _) in fits {
            trials[*trial].verdict = LensVerdict::NotNeeded;
        }
        trials[fits[0].0].verdict = LensVerdict::Chosen;
        return 0;
    };
    let as_exact = |error: &HoldOut| {
        let views = error.pictures.iter().flatten().zip(least.pictures.iter().flatten());
        let more: Vec<f64> = views.filter(|(e, _)| e.1 > 0).map(|(e, l)| e.0 - l.0).collect();
        let n = more.len() as f64;
        let mean = more.iter().sum::<f64>() / n;
        let variance = more.iter().map(|d| (d - mean) * (d - mean)).sum::<f64>() / (n - 1.0).max(1.0);
        mean * n <= (variance * n).sqrt()
    };
    let mut taken = best;
    for (i, error) in errors {
        if as_exact(error) && parameters(*i) < parameters(taken) {
            taken = *i;
        }
    }
    for (i, error) in errors {
        let verdict = if *i == taken {
            LensVerdict::Chosen
        } else if as_exact(error) {
            LensVerdict::NotNeeded
        } else {
            LensVerdict::LessExact
        };
        trials[fits[*i].0].verdict = verdict;
    }
    taken
}

fn trials_model(fits: &[(usize, Fit)], i: usize) -> DistortionModel {
    fits[i].1.estimate.cameras[0].distortion.model()
}
