//! The robust fit of one lens model: adjustment, outliers out, adjustment by least squares.

use crate::adjustment::{Estimate, Failure, Free, Problem, Used, adjust};
use crate::start::{cauchy, thinned};
use crate::target::Sightings;
use cv_core::{Progress, Vector2, median};
use cv_numeric::RobustLoss;

/// The median of the length of a vector of two standard normal numbers.
const MEDIAN_LENGTH: f64 = 1.1774;
/// Standard deviation in pixels that no corner is better than: below it, differences are rounding.
const LEAST_DEVIATION: f64 = 1e-4;
/// Times that outliers are looked for.
const ROUNDS: usize = 5;
/// Of many views so many, evenly, are fitted robustly first; from what they give, all need a few steps.
const FIRST_VIEWS: usize = 30;
/// Relative change of the cost at which an adjustment ends.
const TOLERANCE: f64 = 1e-7;
/// Deflections must be known to this share of the target's longer side to be adjusted.
const KNOWN_SHAPE: f64 = 0.01;

/// Why the target's shape is as it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ShapeState {
    Adjusted,
    Undetermined,
    NotAsked,
}

/// A fitted model.
#[derive(Debug, Clone)]
pub(crate) struct Fit {
    pub(crate) estimate: Estimate,
    /// Corners that the last adjustment was of.
    pub(crate) used: Used,
    pub(crate) shape: ShapeState,
    /// Standard deviation of a coordinate, in pixels, as the typical corner has it.
    pub(crate) deviation: f64,
}

/// What a fit needs to know of the options.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Limits {
    pub(crate) outlier_deviations: f64,
    pub(crate) min_corners: usize,
    pub(crate) board_shape: bool,
}

/// Residuals of all corners by view, camera and corner.
type Residuals = Vec<Vec<Vec<Option<Vector2<f64>>>>>;

fn residuals(data: &Sightings, estimate: &Estimate) -> Residuals {
    let of_view = |v| (0..data.sizes.len()).map(|c| estimate.residuals(data, v, c)).collect();
    (0..data.views.len()).map(of_view).collect()
}

/// Robust standard deviation of a coordinate of the corners that may count.
fn deviation(residuals: &Residuals, of: &Used) -> f64 {
    let corners = residuals.iter().flatten().flatten().zip(of.iter().flatten().flatten());
    let mut lengths: Vec<f64> =
        corners.filter(|(_, used)| **used).map(|(r, _)| r.map_or(f64::INFINITY, |r| r.norm())).collect();
    (median(&mut lengths).unwrap_or(0.0) / MEDIAN_LENGTH).max(LEAST_DEVIATION)
}

/// The corners of `of` that are near enough. Pictures that keep less than half of their corners, or too few, are left out.
fn near(residuals: &Residuals, of: &Used, farthest: f64, min_corners: usize) -> Used {
    let picture = |(residuals, of): (&Vec<Option<Vector2<f64>>>, &Vec<bool>)| {
        let near = |(r, of): (&Option<Vector2<f64>>, &bool)| *of && r.is_some_and(|r| r.norm() <= farthest);
        let kept: Vec<bool> = residuals.iter().zip(of).map(near).collect();
        let (count, all) = (kept.iter().filter(|k| **k).count(), of.iter().filter(|k| **k).count());
        if 2 * count < all || count < min_corners { vec![false; kept.len()] } else { kept }
    };
    residuals.iter().zip(of).map(|(r, o)| r.iter().zip(o).map(picture).collect()).collect()
}

/// Fits all that is free from a start: Cauchy's loss first, then least squares on what is within the limits, until that no longer changes.
///
/// `usable`: corners that may be used. Poses of views that lose their corners stay where the robust adjustment left them.
pub(crate) fn fit(
    data: &Sightings,
    start: &Estimate,
    usable: &Used,
    limits: Limits,
    progress: &dyn Progress,
) -> Result<Fit, Failure> {
    let n = data.views.len();
    let (mut estimate, free, state) = if n > 2 * FIRST_VIEWS {
        let few: Vec<usize> = (0..FIRST_VIEWS).map(|i| i * n / FIRST_VIEWS).collect();
        let corners: Used = few.iter().map(|v| usable[*v].clone()).collect();
        let (found, free, state) = robust(&data.subset(&few), start.subset(&few), &corners, limits, progress)?;
        let mut all = Estimate { poses: start.poses.clone(), ..found };
        let loss = cauchy(deviation(&residuals(data, &all), usable));
        adjust(data, &mut all, &thinned(usable), (Free::POSES, loss), (30, 1e-3), progress)?;
        (all, free, state)
    } else {
        robust(data, start.clone(), usable, limits, progress)?
    };
    let mut typical = 0.0;
    let mut used = Used::new();
    for round in 0..=ROUNDS {
        let residuals = residuals(data, &estimate);
        typical = deviation(&residuals, usable);
        let kept = near(&residuals, usable, limits.outlier_deviations * typical, limits.min_corners);
        if (round > 1 && kept == used) || round == ROUNDS {
            break;
        }
        used = kept;
        // The first step leads so near that outliers can be judged again; what comes after it would be of the old ones.
        let most = if round == 0 { 1 } else { 100 };
        adjust(data, &mut estimate, &used, (free, RobustLoss::Trivial), (most, TOLERANCE), progress)?;
    }
    Ok(Fit { estimate, used, shape: state, deviation: typical })
}

/// The robust part of a fit; what of it is free, and why the target's shape is or is not.
fn robust(
    data: &Sightings,
    mut estimate: Estimate,
    usable: &Used,
    limits: Limits,
    progress: &dyn Progress,
) -> Result<(Estimate, Free, ShapeState), Failure> {
    // Bending is small, and a shape that is not determined would lead astray: at first the target is flat.
    if !limits.board_shape {
        estimate.shape = [0.0; 2];
    }
    let flat = Free { shape: false, ..Free::ALL };
    let mut typical = deviation(&residuals(data, &estimate), usable);
    for _ in 0..3 {
        let before = typical;
        adjust(data, &mut estimate, usable, (flat, cauchy(typical)), (40, 1e-3), progress)?;
        typical = deviation(&residuals(data, &estimate), usable);
        if typical > 0.7 * before {
            break;
        }
    }
    if !limits.board_shape {
        return Ok((estimate, flat, ShapeState::NotAsked));
    }
    if !shape_is_known(data, &estimate, usable) {
        estimate.shape = [0.0; 2];
        return Ok((estimate, flat, ShapeState::Undetermined));
    }
    adjust(data, &mut estimate, usable, (Free::ALL, cauchy(typical)), (40, 1e-4), progress)?;
    Ok((estimate, Free::ALL, ShapeState::Adjusted))
}

/// Whether the corners determine the target's deflections well enough to adjust them.
fn shape_is_known(data: &Sightings, estimate: &Estimate, used: &Used) -> bool {
    let known = || -> Result<f64, cv_numeric::adjust::AdjustError> {
        let problem = Problem::new(data, estimate, used, Free::ALL, RobustLoss::Trivial)?;
        let (covariance, _) = problem.covariance()?;
        let n = covariance.nrows();
        Ok(covariance[(n - 1, n - 1)].max(covariance[(n - 2, n - 2)]).sqrt())
    };
    known().is_ok_and(|deviation| deviation <= KNOWN_SHAPE * data.target.size().max())
}
