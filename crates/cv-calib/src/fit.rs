//! The robust fit of one lens model: robust adjustment, outlier rejection, least squares on the inliers.

use crate::adjustment::{Estimate, Failure, FreeParameters, InlierMask, Problem, adjust};
use crate::start::{cauchy, sample_mask};
use crate::target::TargetObservations;
use cv_core::{Progress, Vector2, median};
use cv_numeric::RobustLoss;

/// Median of the Rayleigh distribution: the median length of a vector of two standard normal coordinates.
const RAYLEIGH_MEDIAN: f64 = 1.1774;
/// Lower bound of the noise standard deviation for robust losses and outliers, in pixels. Aliasing moves all corners on edges
/// that are parallel to pixel rows by up to 0.1 px: no reason to reject a photograph among others that fit to 0.01 px.
const MIN_SIGMA_PX: f64 = 0.04;
/// Maximum number of rounds of outlier rejection.
const REJECTION_ROUNDS: usize = 5;
/// Number of views, evenly sampled, of the first robust fit; from its result, all views need few iterations.
const INITIAL_VIEWS: usize = 30;
/// Relative cost decrease that terminates an adjustment.
const COST_TOLERANCE: f64 = 1e-7;
/// Largest standard deviation of the deflections, as a ratio of the target's longer side, for them to be adjusted.
const MAX_SHAPE_SIGMA: f64 = 0.01;

/// State of the target's deflections.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ShapeState {
    /// Adjusted.
    Adjusted,
    /// Kept at zero: the views do not determine them.
    Undetermined,
    /// Kept at zero by the options.
    Disabled,
}

/// The fit of a lens model.
#[derive(Debug, Clone)]
pub(crate) struct Fit {
    pub(crate) estimate: Estimate,
    /// Inliers of the last adjustment.
    pub(crate) used: InlierMask,
    pub(crate) shape: ShapeState,
    /// Robust standard deviation of a corner coordinate, in pixels.
    pub(crate) sigma: f64,
}

/// The options of a fit.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Limits {
    pub(crate) outlier_deviations: f64,
    pub(crate) min_corners: usize,
    pub(crate) board_shape: bool,
}

/// Residuals of all corners, by view, camera and corner.
type Residuals = Vec<Vec<Vec<Option<Vector2<f64>>>>>;

/// Computes the residuals of all corners.
fn all_residuals(data: &TargetObservations, estimate: &Estimate) -> Residuals {
    let of_view = |v| (0..data.sizes.len()).map(|c| estimate.residuals(data, v, c)).collect();
    (0..data.views.len()).map(of_view).collect()
}

/// Estimates the standard deviation of a coordinate of the usable corners, from the median residual.
fn robust_sigma(residuals: &Residuals, of: &InlierMask) -> f64 {
    let corners = residuals.iter().flatten().flatten().zip(of.iter().flatten().flatten());
    let mut lengths: Vec<f64> =
        corners.filter(|(_, used)| **used).map(|(r, _)| r.map_or(f64::INFINITY, |r| r.norm())).collect();
    (median(&mut lengths).unwrap_or(0.0) / RAYLEIGH_MEDIAN).max(MIN_SIGMA_PX)
}

/// Returns the usable corners within `max_error` pixels. Images are rejected that have fewer than half of their corners
/// left, or fewer than `min_corners`.
fn select_inliers(residuals: &Residuals, usable: &InlierMask, max_error: f64, min_corners: usize) -> InlierMask {
    let select_in_image = |(residuals, usable): (&Vec<Option<Vector2<f64>>>, &Vec<bool>)| {
        let is_inlier = |(r, of): (&Option<Vector2<f64>>, &bool)| *of && r.is_some_and(|r| r.norm() <= max_error);
        let inliers: Vec<bool> = residuals.iter().zip(usable).map(is_inlier).collect();
        let (count, all) = (inliers.iter().filter(|k| **k).count(), usable.iter().filter(|k| **k).count());
        if 2 * count < all || count < min_corners { vec![false; inliers.len()] } else { inliers }
    };
    residuals.iter().zip(usable).map(|(r, o)| r.iter().zip(o).map(select_in_image).collect()).collect()
}

/// Fits all free parameters: first with the Cauchy loss, then by least squares on the inliers, until these no longer
/// change.
///
/// `usable`: corners that may be used. Views whose corners are all rejected keep the pose of the robust adjustment.
pub(crate) fn fit(
    data: &TargetObservations,
    start: &Estimate,
    usable: &InlierMask,
    limits: Limits,
    progress: &dyn Progress,
) -> Result<Fit, Failure> {
    let n = data.views.len();
    let (mut estimate, free, state) = if n > 2 * INITIAL_VIEWS {
        let sampled: Vec<usize> = (0..INITIAL_VIEWS).map(|i| i * n / INITIAL_VIEWS).collect();
        let corners: InlierMask = sampled.iter().map(|v| usable[*v].clone()).collect();
        let (sampled_estimate, free, state) =
            fit_robustly(&data.subset(&sampled), start.subset(&sampled), &corners, limits, progress)?;
        let mut all = Estimate { poses: start.poses.clone(), ..sampled_estimate };
        let loss = cauchy(robust_sigma(&all_residuals(data, &all), usable));
        adjust(data, &mut all, &sample_mask(usable), (FreeParameters::POSES, loss), (30, 1e-3), progress)?;
        (all, free, state)
    } else {
        fit_robustly(data, start.clone(), usable, limits, progress)?
    };
    let mut sigma = 0.0;
    let mut used = InlierMask::new();
    for round in 0..=REJECTION_ROUNDS {
        let residuals = all_residuals(data, &estimate);
        sigma = robust_sigma(&residuals, usable);
        let inliers = select_inliers(&residuals, usable, limits.outlier_deviations * sigma, limits.min_corners);
        if (round > 1 && inliers == used) || round == REJECTION_ROUNDS {
            break;
        }
        used = inliers;
        // Inliers are selected again after the first step; further steps would be for the old ones.
        let max_iterations = if round == 0 { 1 } else { 100 };
        adjust(data, &mut estimate, &used, (free, RobustLoss::Trivial), (max_iterations, COST_TOLERANCE), progress)?;
    }
    Ok(Fit { estimate, used, shape: state, sigma })
}

/// The robust stage of a fit. Returns the estimate, the free parameters and the state of the target's shape.
fn fit_robustly(
    data: &TargetObservations,
    mut estimate: Estimate,
    usable: &InlierMask,
    limits: Limits,
    progress: &dyn Progress,
) -> Result<(Estimate, FreeParameters, ShapeState), Failure> {
    // The deflections are small, and diverge if they are not determined: at first the target is planar.
    if !limits.board_shape {
        estimate.shape = [0.0; 2];
    }
    let flat = FreeParameters { shape: false, ..FreeParameters::ALL };
    let mut sigma = robust_sigma(&all_residuals(data, &estimate), usable);
    for _ in 0..3 {
        let before = sigma;
        adjust(data, &mut estimate, usable, (flat, cauchy(sigma)), (40, 1e-3), progress)?;
        sigma = robust_sigma(&all_residuals(data, &estimate), usable);
        if sigma > 0.7 * before {
            break;
        }
    }
    if !limits.board_shape {
        return Ok((estimate, flat, ShapeState::Disabled));
    }
    if !is_shape_determined(data, &estimate, usable) {
        estimate.shape = [0.0; 2];
        return Ok((estimate, flat, ShapeState::Undetermined));
    }
    adjust(data, &mut estimate, usable, (FreeParameters::ALL, cauchy(sigma)), (40, 1e-4), progress)?;
    Ok((estimate, FreeParameters::ALL, ShapeState::Adjusted))
}

/// Returns whether the corners determine the target's deflections well enough to adjust them.
fn is_shape_determined(data: &TargetObservations, estimate: &Estimate, used: &InlierMask) -> bool {
    let sigma_of_shape = || -> Result<f64, cv_numeric::adjust::AdjustError> {
        let problem = Problem::new(data, estimate, used, FreeParameters::ALL, RobustLoss::Trivial)?;
        let (covariance, _) = problem.covariance()?;
        let n = covariance.nrows();
        Ok(covariance[(n - 1, n - 1)].max(covariance[(n - 2, n - 2)]).sqrt())
    };
    sigma_of_shape().is_ok_and(|deviation| deviation <= MAX_SHAPE_SIGMA * data.target.size().max())
}
