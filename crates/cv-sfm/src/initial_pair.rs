//! The two views a model starts from.

use crate::scene::Scene;
use crate::{PairMatches, SfmOptions};
use cv_core::{Cancelled, Correspondence, Pose, Progress};
use cv_geometry::{
    EstimateError, LocalOptimization, RobustOptions, estimate_relative_pose, estimate_rotation, normalize_matches,
    parallax_angle, triangulate,
};
use rayon::prelude::*;

/// Pairs with most matches that are looked at.
const MOST_PAIRS: usize = 60;
/// An angle between the rays of a point from which on it counts in full, in radians; the others by their share of it.
const FULL_ANGLE: f64 = 0.15;

/// A pair to start from.
pub(crate) struct Start {
    pub(crate) a: usize,
    pub(crate) b: usize,
    /// First camera frame to second.
    pub(crate) pose: Pose,
}

/// Pairs to start from, the best first: those with many points at wide angles.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn initial_pairs(
    scene: &Scene<'_>,
    pairs: &[&PairMatches],
    options: &SfmOptions,
    progress: &dyn Progress,
) -> Result<Vec<Start>, Cancelled> {
    let mut order = pairs.to_vec();
    order.sort_by(|x, y| y.matches.len().cmp(&x.matches.len()).then((x.a, x.b).cmp(&(y.a, y.b))));
    // Of sequences, the pairs with most matches are all neighbors: every other one is taken evenly from the rest.
    let step = ((order.len().saturating_sub(MOST_PAIRS / 2)) as f64 / (MOST_PAIRS / 2) as f64).max(1.0);
    let head = order.len().min(MOST_PAIRS / 2);
    let rest = (0..MOST_PAIRS / 2).map(|i| head + (i as f64 * step) as usize).take_while(|i| *i < order.len());
    let chosen: Vec<&PairMatches> = (0..head).chain(rest).map(|i| order[i]).collect();
    let rated: Vec<Option<(f64, Start)>> =
        chosen.par_iter().map(|pair| rate(scene, pair, options, progress)).collect::<Result<_, _>>()?;
    let mut rated: Vec<(f64, Start)> = rated.into_iter().flatten().collect();
    rated.sort_by(|x, y| y.0.total_cmp(&x.0).then((x.1.a, x.1.b).cmp(&(y.1.a, y.1.b))));
    Ok(rated.into_iter().map(|r| r.1).collect())
}

/// The pose of a pair, and how good it is to start from.
fn rate(
    scene: &Scene<'_>,
    pair: &PairMatches,
    options: &SfmOptions,
    progress: &dyn Progress,
) -> Result<Option<(f64, Start)>, Cancelled> {
    let (a, b) = (pair.a, pair.b);
    let keypoints = [scene.views[a].keypoints, scene.views[b].keypoints];
    let pixels: Vec<Correspondence> =
        pair.matches.iter().filter_map(|m| m.correspondence(keypoints[0], keypoints[1])).collect();
    let (rays, unit) = normalize_matches(&pixels, scene.camera_of(a), scene.camera_of(b));
    let rays: Vec<Correspondence> = rays.into_iter().filter(Correspondence::is_finite).collect();
    let threshold = options.growing_error() * unit;
    let robust = RobustOptions {
        threshold,
        seed: options.seed,
        max_iterations: 1000,
        local_optimization: LocalOptimization::Iterative,
        ..RobustOptions::essential()
    };
    let found = match estimate_relative_pose(&rays, &robust, progress) {
        Ok(found) => found,
        Err(EstimateError::Cancelled(stop)) => return Err(stop),
        Err(_) => return Ok(None),
    };
    // A camera that only turned.
    if estimate_rotation(&rays, threshold).is_ok_and(|r| r.1 > 0.8) {
        return Ok(None);
    }
    let weight = |i: &usize| {
        let point = triangulate(&rays[*i], &found.model).ok()?;
        Some((parallax_angle(&point, &found.model) / FULL_ANGLE).min(1.0))
    };
    let score: f64 = found.inliers.iter().filter_map(weight).sum();
    Ok((found.inliers.len() >= options.min_pose_inliers).then_some((score, Start { a, b, pose: found.model })))
}
