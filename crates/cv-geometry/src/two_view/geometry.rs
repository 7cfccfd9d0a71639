//! Estimation of intrinsics and relative pose of two views from tentative matches.

use super::degeneracy::DegeneracyTest;
use super::lens::{AlternativeFocal, FOCAL_GRID, LensEstimate, find_lens};
use super::{Intrinsics, MatchedViews, TwoViewError, TwoViewOptions};
use crate::{
    EstimateError, RobustModel, RobustOptions, estimate_relative_pose, normalize_matches, pose_difference,
    poses_are_indistinguishable, refine_relative_pose,
};
use cv_core::{Camera, Correspondence, Distortion, Pose, Progress, Stage};
use cv_parallel::prelude::*;

/// Cameras, relative pose and inliers of two views, before bundle adjustment
/// ([`TwoViewAdjustment`](super::TwoViewAdjustment)).
#[derive(Debug, Clone, PartialEq)]
pub struct TwoViewGeometry {
    /// The cameras; unknown focal lengths and radial distortion are estimated.
    pub cameras: [Camera; 2],
    /// First camera frame to second; the translation has length one.
    pub pose: Pose,
    /// Indices of the inliers of the epipolar geometry, ascending.
    pub inliers: Vec<usize>,
    /// Maximum relative change of the focal length that the matches do not exclude; 0 if it was given.
    pub focal_range: f64,
    /// Number of inliers of one homography relative to `inliers`.
    pub planar_ratio: f64,
}

/// Estimates intrinsics (if unknown), relative pose and inliers of two views.
///
/// Unknown intrinsics are estimated first, then the pose with several seeds. Planar scenes, pure rotations and
/// ambiguous directions of the translation are rejected. O(samples × matches).
///
/// # Errors
/// [`TwoViewError`].
pub fn estimate_two_view_geometry(
    views: &MatchedViews<'_>,
    options: &TwoViewOptions,
    progress: &dyn Progress,
) -> Result<TwoViewGeometry, TwoViewError> {
    let prior = options.intrinsics.cameras(views.sizes)?;
    let pairs = &views.correspondences(views.matches)?;
    if pairs.len() < options.min_inliers {
        return Err(TwoViewError::TooFewMatches { got: pairs.len(), needed: options.min_inliers });
    }
    let degeneracy = DegeneracyTest::new(pairs, views.sizes, prior, options, progress)?;
    // The number of matches is an upper bound of the number of inliers.
    degeneracy.check(pairs.len(), options)?;
    let result = search(pairs, views.sizes, prior, options, progress);
    // For a pure rotation, a translation hypothesis has only part of the matches as inliers: half of the points are
    // behind a camera.
    if let Err(
        TwoViewError::TooFewInliers { inliers, .. }
        | TwoViewError::UncertainPose { inliers, .. }
        | TwoViewError::WrongFocal { inliers, .. },
    ) = &result
    {
        degeneracy.check(*inliers, options)?;
    }
    let mut geometry = result?;
    degeneracy.check(geometry.inliers.len(), options)?;
    geometry.planar_ratio = (degeneracy.planar as f64 / geometry.inliers.len() as f64).min(1.0);
    Ok(geometry)
}

/// Dispatches on the known intrinsics.
fn search(
    pairs: &[Correspondence],
    sizes: [(usize, usize); 2],
    prior: Option<[Camera; 2]>,
    options: &TwoViewOptions,
    progress: &dyn Progress,
) -> Result<TwoViewGeometry, TwoViewError> {
    match (options.intrinsics, prior) {
        (Intrinsics::Known(_), Some(cameras)) => estimate_calibrated(pairs, cameras, options, progress),
        (_, Some(cameras)) => estimate_distortion_and_pose(pairs, cameras, options, progress, MAX_ALTERNATIVES),
        (_, None) => estimate_focal_and_pose(pairs, sizes, options, progress),
    }
}

/// Maximum number of successive alternatives to a given focal length: the suggested one must be accepted itself.
const MAX_ALTERNATIVES: usize = 2;

/// Estimates the radial distortion and the pose of cameras with a given focal length, and detects a wrong focal length.
fn estimate_distortion_and_pose(
    pairs: &[Correspondence],
    cameras: [Camera; 2],
    options: &TwoViewOptions,
    progress: &dyn Progress,
    max_alternatives: usize,
) -> Result<TwoViewGeometry, TwoViewError> {
    let lens = find_lens(pairs, cameras, false, &options.robust, progress)?;
    let Some(LensEstimate { cameras: with_lens, alternative, .. }) = lens else {
        return estimate_calibrated(pairs, cameras, options, progress);
    };
    if let (Some(AlternativeFocal { focal, deviations, inliers }), 1..) = (alternative, max_alternatives) {
        // Rounded as in the message.
        let better = focal.round();
        let other = cameras.map(|c| Camera { fx: better, fy: better * (c.fy / c.fx), ..c });
        match estimate_distortion_and_pose(pairs, other, options, progress, max_alternatives - 1) {
            Ok(_) => return Err(TwoViewError::WrongFocal { given: cameras[0].fx, better, deviations, inliers }),
            Err(TwoViewError::WrongFocal { better, deviations, inliers, .. }) => {
                return Err(TwoViewError::WrongFocal { given: cameras[0].fx, better, deviations, inliers });
            }
            Err(TwoViewError::Cancelled(stop)) => return Err(stop.into()),
            // The alternative is not valid itself.
            Err(_) => {}
        }
    }
    TwoViewError::check_focal(cameras[0].fx, cameras[0].width.max(cameras[0].height))?;
    estimate_calibrated(pairs, with_lens, options, progress)
}

/// Estimates a shared focal length, the radial distortion and the pose.
fn estimate_focal_and_pose(
    pairs: &[Correspondence],
    sizes: [(usize, usize); 2],
    options: &TwoViewOptions,
    progress: &dyn Progress,
) -> Result<TwoViewGeometry, TwoViewError> {
    let longest = sizes[0].0.max(sizes[0].1) as f64;
    let cameras_of = |ratio: f64| {
        let camera = |(width, height)| Camera::from_focal(width, height, ratio * longest);
        sizes.map(camera).map(|camera| Camera { distortion: Distortion::radial(0.0, 0.0), ..camera })
    };
    let lens =
        find_lens(pairs, sizes.map(|(w, h)| Camera::from_focal(w, h, longest)), true, &options.robust, progress)?;
    let first = match lens {
        Some(LensEstimate { cameras, focal_range, .. }) => {
            estimate_calibrated(pairs, cameras, options, progress).map(|found| TwoViewGeometry { focal_range, ..found })
        }
        // If no lens has a pose, the error is that of a normal lens.
        None => estimate_calibrated(pairs, cameras_of(1.2), options, progress),
    };
    let Err(uncertain @ TwoViewError::UncertainPose { .. }) = first else { return first };
    // If two poses are indistinguishable with the best focal length, another focal length may resolve the ambiguity.
    let mut best: Option<TwoViewGeometry> = None;
    for ratio in FOCAL_GRID {
        match estimate_calibrated(pairs, cameras_of(ratio), options, progress) {
            Ok(found) if best.as_ref().is_none_or(|b| found.inliers.len() > b.inliers.len()) => best = Some(found),
            Err(TwoViewError::Cancelled(stop)) => return Err(stop.into()),
            _ => {}
        }
    }
    best.map(|found| TwoViewGeometry { focal_range: 1.0, ..found }).ok_or(uncertain)
}

/// Checks the number of inliers and the inlier ratio.
fn check_inliers(inliers: usize, matches: usize, options: &TwoViewOptions) -> Result<(), TwoViewError> {
    let needed = options.min_inliers.max((options.min_inlier_ratio * matches as f64).ceil() as usize);
    if inliers < needed {
        return Err(TwoViewError::TooFewInliers { inliers, matches, needed });
    }
    Ok(())
}

/// Estimates the pose of two calibrated cameras with several seeds.
fn estimate_calibrated(
    pairs: &[Correspondence],
    cameras: [Camera; 2],
    options: &TwoViewOptions,
    progress: &dyn Progress,
) -> Result<TwoViewGeometry, TwoViewError> {
    let (normalized, unit) = normalize_matches(pairs, &cameras[0], &cameras[1]);
    // Pixels outside the valid range of the distortion model have no ray.
    let usable: Vec<usize> = (0..normalized.len()).filter(|&i| normalized[i].is_finite()).collect();
    let normalized: Vec<_> = usable.iter().map(|&i| normalized[i]).collect();
    let threshold = options.robust.threshold * unit;
    let stage = Stage::new(progress, "pose", SEARCHES)?;
    let search = |k: usize| {
        let seed = options.robust.seed.wrapping_add(k as u64);
        let options = RobustOptions { threshold, seed, ..options.robust };
        let estimate = estimate_relative_pose(&normalized, &options, &stage)?;
        let (pose, loss) = refine_relative_pose(&estimate.model, &normalized, threshold);
        stage.add(1)?;
        Ok((RobustModel { model: pose, ..estimate }, loss))
    };
    let searches = (0..SEARCHES).into_par_iter().map(search).try_collect();
    let mut estimates: Vec<(RobustModel<Pose>, f64)> =
        searches.map_err(|error| two_view_error(error, pairs.len(), options))?;
    estimates.sort_by(|a, b| a.1.total_cmp(&b.1));
    let (best, others) = (&estimates[0].0, &estimates[1..]);
    check_inliers(best.inliers.len(), pairs.len(), options)?;
    // The largest angle to the direction of another search whose pose is indistinguishable from the best.
    let ambiguity = others
        .iter()
        .filter(|other| poses_are_indistinguishable(&best.model, &other.0.model, &normalized, threshold))
        .map(|other| pose_difference(&best.model, &other.0.model)[1])
        .fold(0.0, f64::max);
    if ambiguity > options.max_deviation {
        return Err(TwoViewError::UncertainPose {
            degrees: ambiguity.to_degrees(),
            allowed: options.max_deviation.to_degrees(),
            inliers: best.inliers.len(),
            matches: pairs.len(),
        });
    }
    let inliers = best.inliers.iter().map(|&i| usable[i]).collect();
    Ok(TwoViewGeometry { cameras, pose: best.model, inliers, focal_range: 0.0, planar_ratio: 0.0 })
}

/// Number of searches with different seeds. If the matches determine the pose, all find it. Of two equally likely
/// poses, five searches miss one with a probability of 1/16.
const SEARCHES: usize = 5;

/// Converts an estimation error: no consensus becomes too few inliers.
fn two_view_error(error: EstimateError, matches: usize, options: &TwoViewOptions) -> TwoViewError {
    match error {
        EstimateError::NoConsensus { inliers, needed, .. } => {
            TwoViewError::TooFewInliers { inliers, matches, needed: needed.max(options.min_inliers) }
        }
        EstimateError::NotEnoughMatches { got, .. } => TwoViewError::TooFewMatches { got, needed: options.min_inliers },
        EstimateError::Cancelled(stop) => stop.into(),
        other => TwoViewError::Estimate(other),
    }
}
