//! Selection of the lens model of one camera by cross-validation.

use crate::adjustment::{Estimate, Failure, InlierMask, check_adjustable};
use crate::fit::{Fit, Limits, fit};
use crate::holdout::{HoldOut, hold_out};
use crate::start::{InitialValues, estimate_initial_values, mask_of_views, poses_from_homographies};
use crate::target::TargetObservations;
use crate::{CalibrateError, LensChoice};
use cv_core::{Cancelled, Distortion, DistortionModel, LensProjection, Point2, Progress, Stage};

/// Outcome of a lens model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LensVerdict {
    /// The only model that was requested.
    Asked,
    /// Selected: the fewest parameters among the models whose hold-out error is not significantly larger than the smallest.
    Chosen,
    /// Its hold-out error is significantly larger.
    LessExact,
    /// Its hold-out error is not significantly different, with at least as many parameters.
    NotNeeded,
    /// Its distortion is not monotonic within the image.
    Folds,
    /// The views do not determine its parameters.
    Undetermined,
    /// No initial values were found.
    NoStart {
        /// Median error of the best ones, in pixels.
        error_px: f64,
    },
}

/// Result of a lens model that was tried.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LensTrial {
    /// The model.
    pub model: DistortionModel,
    /// Root mean square reprojection error of the inlier corners, in pixels; NaN without a fit.
    pub rms_px: f64,
    /// The same on held-out views, with only their poses adjusted; NaN where it was not computed.
    pub holdout_rms_px: f64,
    /// Number of outliers.
    pub outliers: usize,
    /// Outcome.
    pub verdict: LensVerdict,
}

/// The calibration of a single camera.
#[derive(Debug, Clone)]
pub(crate) struct Mono {
    pub(crate) fit: Fit,
    pub(crate) trials: Vec<LensTrial>,
    pub(crate) holdout: Option<HoldOut>,
}

/// Number of views from which on cross-validation has two folds, since each half is enough to calibrate; with fewer
/// views there are more folds.
const TWO_FOLD_MIN_VIEWS: usize = 12;

/// Returns the number of cross-validation folds; `None` with too few views.
pub(crate) fn fold_count(views: usize) -> Option<usize> {
    match views {
        0..=3 => None,
        4..TWO_FOLD_MIN_VIEWS => Some(views.min(5)),
        _ => Some(2),
    }
}

/// Returns the root mean square error of the inlier corners of one camera, or of all cameras, and their number.
pub(crate) fn rms(data: &TargetObservations, fit: &Fit, camera: Option<usize>) -> (f64, usize) {
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

/// Maximum fraction of the corners beyond the monotonic range of the distortion that are rejected as outliers.
const MAX_BEYOND_RANGE: f64 = 0.01;

/// Fits a model as [`fit`]; also returns whether the distortion is monotonic up to the outermost inlier corner. A few corners
/// beyond its monotonic range are rejected, once: numerator and denominator of a rational model may have almost the same root,
/// just at the outermost corner.
fn fit_monotonic(
    data: &TargetObservations,
    start: &Estimate,
    corners: &InlierMask,
    limits: Limits,
    progress: &dyn Progress,
) -> Result<(Fit, bool), Failure> {
    let first = fit(data, start, corners, limits, progress)?;
    let beyond = corners_beyond_range(data, &first);
    let inliers = first.used.iter().flatten().flatten().filter(|used| **used).count();
    if beyond.is_empty() || beyond.len() as f64 > MAX_BEYOND_RANGE * inliers as f64 {
        return Ok((first, beyond.is_empty()));
    }
    let mut usable = corners.clone();
    for (v, i) in beyond {
        usable[v][0][i] = false;
    }
    let second = fit(data, start, &usable, limits, progress)?;
    let is_monotonic = corners_beyond_range(data, &second).is_empty();
    Ok((second, is_monotonic))
}

/// Returns the inlier corners at which the distortion is not monotonic: view, index.
fn corners_beyond_range(data: &TargetObservations, fit: &Fit) -> Vec<(usize, usize)> {
    let camera = &fit.estimate.cameras[0];
    let mut beyond = Vec::new();
    for (v, pose) in fit.estimate.poses.iter().enumerate() {
        let Some(pose) = pose else { continue };
        for (i, (c, used)) in data.views[v][0].iter().zip(&fit.used[v][0]).enumerate() {
            let p = pose.transform(&data.target.bent(c.point, fit.estimate.shape));
            let in_range = || camera.distortion.distort_in_range(Point2::new(p.x / p.z, p.y / p.z)).is_some();
            if *used && !(p.z > 0.0 && in_range()) {
                beyond.push((v, i));
            }
        }
    }
    beyond
}

/// Padé approximant of `atan(r)/r` with two terms in numerator and denominator: an equidistant fisheye as a rational
/// model.
const EQUIDISTANT_RATIONAL: [f64; 8] = [7.0 / 9.0, 64.0 / 945.0, 0.0, 0.0, 0.0, 10.0 / 9.0, 5.0 / 21.0, 0.0];

/// Initial values by projection, computed once.
struct InitialValueCache<'a> {
    data: &'a TargetObservations,
    usable: &'a [usize],
    perspective: Option<Result<InitialValues, CalibrateError>>,
    fisheye: Option<Result<InitialValues, CalibrateError>>,
}

impl InitialValueCache<'_> {
    fn with_projection(
        &mut self,
        projection: LensProjection,
        progress: &dyn Progress,
    ) -> Result<InitialValues, CalibrateError> {
        let cached = match projection {
            LensProjection::Perspective => &mut self.perspective,
            LensProjection::Fisheye => &mut self.fisheye,
        };
        cached.get_or_insert_with(|| estimate_initial_values(self.data, self.usable, projection, progress)).clone()
    }

    /// Returns initial values with the distortion of a model.
    fn with_model(&mut self, model: DistortionModel, progress: &dyn Progress) -> Result<InitialValues, CalibrateError> {
        let mut start = self.with_projection(model.info().projection, progress);
        let is_rational = matches!(model, DistortionModel::Rational8 | DistortionModel::ThinPrism12);
        // Beyond about 140° polynomials in tan θ do not fit, and the fisheye model gives better initial values.
        if is_rational && start.as_ref().map_or(true, |s| s.error > 2.0) {
            check_cancelled(&start)?;
            let fisheye = self.with_projection(LensProjection::Fisheye, progress);
            check_cancelled(&fisheye)?;
            if let Ok(mut fisheye) = fisheye
                && start.as_ref().map_or(true, |s| fisheye.error < 0.5 * s.error)
            {
                let camera = &mut fisheye.estimate.cameras[0];
                camera.distortion = Distortion::rational8(EQUIDISTANT_RATIONAL);
                fisheye.estimate.poses = poses_from_homographies(self.data, self.usable, camera);
                start = Ok(fisheye);
            }
        }
        let mut start = start?;
        let camera = &mut start.estimate.cameras[0];
        // All perspective models have two radial and two tangential coefficients.
        camera.distortion = camera.distortion.converted(model).ok_or(CalibrateError::Lens { model })?;
        Ok(start)
    }
}

/// Returns an error if a result is that of a cancelled job.
fn check_cancelled<T>(result: &Result<T, CalibrateError>) -> Result<(), Cancelled> {
    if matches!(result, Err(CalibrateError::Cancelled(_))) { Err(Cancelled) } else { Ok(()) }
}

/// Fits the candidate lens models and selects one.
///
/// `data` is of one camera, `usable` the views with enough corners.
pub(crate) fn choose_lens(
    data: &TargetObservations,
    usable: &[usize],
    lens: LensChoice,
    limits: Limits,
    holdout: bool,
    progress: &dyn Progress,
) -> Result<Mono, CalibrateError> {
    let models = lens.models();
    let stage = Stage::new(progress, "lens", 2 * models.len())?;
    let corners = mask_of_views(data, usable);
    let mut starts = InitialValueCache { data, usable, perspective: None, fisheye: None };
    let mut trials = Vec::new();
    let mut fits = Vec::new();
    let mut failed = None;
    for &model in models {
        check_adjustable(model)?;
        let no_fit = LensTrial {
            model,
            rms_px: f64::NAN,
            holdout_rms_px: f64::NAN,
            outliers: 0,
            verdict: LensVerdict::Undetermined,
        };
        let fitted = match starts.with_model(model, &stage) {
            Ok(start) => match fit_monotonic(data, &start.estimate, &corners, limits, &stage) {
                Ok(fitted) => Some(fitted),
                Err(Failure::Cancelled) => return Err(Cancelled.into()),
                Err(Failure::Adjust(_)) => None,
            },
            Err(CalibrateError::NoStart { error_px, .. }) => {
                trials.push(LensTrial { verdict: LensVerdict::NoStart { error_px }, ..no_fit });
                failed = failed.or(Some(CalibrateError::NoStart { camera: 0, model, error_px }));
                stage.add(1)?;
                continue;
            }
            Err(error) => return Err(error),
        };
        stage.add(1)?;
        let Some((fitted, is_monotonic)) = fitted else {
            trials.push(no_fit);
            continue;
        };
        let (rms_px, count) = rms(data, &fitted, None);
        let outliers = corners.iter().flatten().flatten().filter(|u| **u).count() - count;
        let verdict = if is_monotonic { LensVerdict::Asked } else { LensVerdict::Folds };
        trials.push(LensTrial { rms_px, outliers, verdict, ..no_fit });
        if is_monotonic && count > 0 {
            fits.push((trials.len() - 1, fitted));
        }
    }
    if fits.is_empty() {
        return Err(failed.unwrap_or(CalibrateError::Degenerate { camera: 0, largest_tilt_degrees: f64::NAN }));
    }
    // An inlier of one model is no detection error, and is scored for all models.
    let mut scored = fits[0].1.used.clone();
    for (_, fit) in &fits[1..] {
        for (a, b) in scored.iter_mut().flatten().flatten().zip(fit.used.iter().flatten().flatten()) {
            *a |= *b;
        }
    }
    let mut errors = Vec::new();
    if let (Some(fold_count), true) = (fold_count(usable.len()), holdout || models.len() > 1) {
        for (i, (trial, fit)) in fits.iter().enumerate() {
            match hold_out(data, fit, (&corners, &scored), limits, fold_count, &stage) {
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
    let selected = if models.len() > 1 { select_model(&errors, &fits, &mut trials) } else { 0 };
    let holdout = errors.into_iter().find(|(i, _)| *i == selected).map(|(_, error)| error);
    let (_, fit) = fits.swap_remove(selected);
    Ok(Mono { fit, trials, holdout })
}

/// Ratio of the hold-out errors up to which more parameters are not worth it: where no board was seen, as in the corners of
/// the image, they are hardly determined.
const EQUAL_HOLDOUT_RATIO: f64 = 1.05;

/// Selects the model with the fewest parameters among those whose hold-out error is not significantly larger than the
/// smallest one, the first of several. Without held-out views the first model.
///
/// Not significant: the error is up to a twentieth larger, or the sum of the differences of the views' squared errors is below
/// its standard deviation.
fn select_model(errors: &[(usize, HoldOut)], fits: &[(usize, Fit)], trials: &mut [LensTrial]) -> usize {
    let parameters = |i: usize| model_of_fit(fits, i).parameter_count();
    let best = errors.iter().min_by(|a, b| a.1.rms(None).total_cmp(&b.1.rms(None)));
    let Some((best, smallest)) = best.map(|(i, e)| (*i, e)) else {
        for (trial, _) in fits {
            trials[*trial].verdict = LensVerdict::NotNeeded;
        }
        trials[fits[0].0].verdict = LensVerdict::Chosen;
        return 0;
    };
    let is_as_accurate = |error: &HoldOut| {
        let views = error.inliers.iter().flatten().zip(smallest.inliers.iter().flatten());
        let differences: Vec<f64> = views.filter(|(e, _)| e.1 > 0).map(|(e, l)| e.0 - l.0).collect();
        let n = differences.len() as f64;
        let mean = differences.iter().sum::<f64>() / n;
        let variance = differences.iter().map(|d| (d - mean) * (d - mean)).sum::<f64>() / (n - 1.0).max(1.0);
        mean * n <= (variance * n).sqrt() || error.rms(None) <= EQUAL_HOLDOUT_RATIO * smallest.rms(None)
    };
    let accurate = errors.iter().filter(|(_, error)| is_as_accurate(error)).map(|(i, _)| *i);
    let selected = accurate.min_by_key(|i| parameters(*i)).unwrap_or(best);
    for (i, error) in errors {
        let verdict = if *i == selected {
            LensVerdict::Chosen
        } else if is_as_accurate(error) {
            LensVerdict::NotNeeded
        } else {
            LensVerdict::LessExact
        };
        trials[fits[*i].0].verdict = verdict;
    }
    selected
}

fn model_of_fit(fits: &[(usize, Fit)], i: usize) -> DistortionModel {
    fits[i].1.estimate.cameras[0].distortion.model()
}
