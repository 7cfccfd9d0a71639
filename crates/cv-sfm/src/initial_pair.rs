//! Selection of the initial pair of a model.

use crate::scene::Scene;
use crate::{PairMatches, SfmOptions};
use cv_core::{Cancelled, Correspondence, Pose, Progress};
use cv_geometry::{
    EstimateError, LocalOptimization, RobustOptions, estimate_relative_pose, estimate_rotation, normalize_matches,
    parallax_angle, triangulate,
};
use cv_parallel::prelude::*;

/// Maximum number of pairs that are scored.
const MAX_PAIRS: usize = 60;
/// Triangulation angle from which on a point has full weight, in radians; below, the weight is proportional to the
/// angle.
const SATURATION_ANGLE: f64 = 0.15;

/// An initial pair.
pub(crate) struct InitialPair {
    pub(crate) a: usize,
    pub(crate) b: usize,
    /// From the first camera frame to the second.
    pub(crate) pose: Pose,
}

/// Returns candidates for the initial pair, best first: those with many points at large triangulation angles.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn initial_pairs(
    scene: &Scene<'_>,
    pairs: &[&PairMatches],
    options: &SfmOptions,
    progress: &dyn Progress,
) -> Result<Vec<InitialPair>, Cancelled> {
    let mut order = pairs.to_vec();
    order.sort_by(|x, y| y.matches.len().cmp(&x.matches.len()).then((x.a, x.b).cmp(&(y.a, y.b))));
    // In sequences the pairs with most matches are all adjacent: half of the candidates are sampled evenly from the
    // rest.
    let step = ((order.len().saturating_sub(MAX_PAIRS / 2)) as f64 / (MAX_PAIRS / 2) as f64).max(1.0);
    let head = order.len().min(MAX_PAIRS / 2);
    let rest = (0..MAX_PAIRS / 2).map(|i| head + (i as f64 * step) as usize).take_while(|i| *i < order.len());
    let candidates: Vec<&PairMatches> = (0..head).chain(rest).map(|i| order[i]).collect();
    let scored: Vec<Option<(f64, InitialPair)>> =
        candidates.par_iter().map(|pair| score_pair(scene, pair, options, progress)).try_collect()?;
    let mut scored: Vec<(f64, InitialPair)> = scored.into_iter().flatten().collect();
    scored.sort_by(|x, y| y.0.total_cmp(&x.0).then((x.1.a, x.1.b).cmp(&(y.1.a, y.1.b))));
    Ok(scored.into_iter().map(|r| r.1).collect())
}

/// Estimates the relative pose of a pair and its score: the sum of the weights of the inliers. `None` for a degenerate
/// pair or too few inliers.
fn score_pair(
    scene: &Scene<'_>,
    pair: &PairMatches,
    options: &SfmOptions,
    progress: &dyn Progress,
) -> Result<Option<(f64, InitialPair)>, Cancelled> {
    let (a, b) = (pair.a, pair.b);
    let keypoints = [scene.views[a].keypoints, scene.views[b].keypoints];
    let pixels: Vec<Correspondence> =
        pair.matches.iter().filter_map(|m| m.correspondence(keypoints[0], keypoints[1])).collect();
    let (rays, unit) = normalize_matches(&pixels, scene.camera_of(a), scene.camera_of(b));
    let rays: Vec<Correspondence> = rays.into_iter().filter(Correspondence::is_finite).collect();
    let threshold = options.growing_error(scene) * unit;
    let robust = RobustOptions {
        threshold,
        seed: options.seed,
        max_iterations: 1000,
        local_optimization: LocalOptimization::Iterative,
        ..RobustOptions::essential()
    };
    let estimate = match estimate_relative_pose(&rays, &robust, progress) {
        Ok(estimate) => estimate,
        Err(EstimateError::Cancelled(stop)) => return Err(stop),
        Err(_) => return Ok(None),
    };
    // A rotation explains the matches: no baseline.
    if estimate_rotation(&rays, threshold).is_ok_and(|r| r.1 > 0.8) {
        return Ok(None);
    }
    let weight = |i: &usize| {
        let point = triangulate(&rays[*i], &estimate.model).ok()?;
        Some((parallax_angle(&point, &estimate.model) / SATURATION_ANGLE).min(1.0))
    };
    let score: f64 = estimate.inliers.iter().filter_map(weight).sum();
    Ok((estimate.inliers.len() >= options.min_pose_inliers)
        .then_some((score, InitialPair { a, b, pose: estimate.model })))
}
