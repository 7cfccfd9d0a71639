//! Registration of a view: its pose from the points that it observes.

use crate::SfmOptions;
use crate::scene::Scene;
use cv_core::{Cancelled, Pose, Progress};
use cv_geometry::{EstimateError, RobustOptions, WorldMatch, estimate_pose, refine_pose};

/// The visible points of a view.
pub(crate) struct VisiblePoints {
    pub(crate) view: usize,
    pub(crate) count: usize,
    /// Their visibility score: number and spread over the image.
    pub(crate) score: usize,
}

/// Cells along a side of the coarsest grid of [`next_best_views`].
const COARSEST_CELLS: usize = 2;
/// Number of grids, each twice as fine as the previous one.
const GRID_LEVELS: usize = 4;

/// Returns the unregistered views with visible points, next best view first, by their multi-resolution visibility score
/// (Schönberger & Frahm, "Structure-from-motion revisited", CVPR 2016, §4.2).
pub(crate) fn next_best_views(scene: &Scene<'_>) -> Vec<VisiblePoints> {
    let unregistered = (0..scene.views.len()).filter(|v| scene.poses[*v].is_none());
    let mut all: Vec<VisiblePoints> =
        unregistered.map(|view| score_visibility(scene, view)).filter(|v| v.count > 0).collect();
    all.sort_by(|a, b| b.score.cmp(&a.score).then(b.count.cmp(&a.count)).then(a.view.cmp(&b.view)));
    all
}

fn score_visibility(scene: &Scene<'_>, view: usize) -> VisiblePoints {
    let camera = scene.camera_of(view);
    let finest = COARSEST_CELLS << (GRID_LEVELS - 1);
    let mut cells = vec![false; finest * finest];
    let mut count = 0;
    for i in scene.view_observations(view).filter(|i| scene.points[scene.track_of(*i)].is_some()) {
        count += 1;
        let p = scene.pixel(i);
        let cell = |v: f64, n: usize| (((v + 0.5) / n as f64 * finest as f64) as usize).min(finest - 1);
        cells[cell(p.y, camera.height) * finest + cell(p.x, camera.width)] = true;
    }
    let mut score = 0;
    for level in 0..GRID_LEVELS {
        let n = COARSEST_CELLS << level;
        let size = finest / n;
        let is_full = |c: usize| {
            let (x0, y0) = (c % n * size, c / n * size);
            (y0..y0 + size).any(|y| cells[y * finest + x0..][..size].contains(&true))
        };
        // The weight of a cell is the number of cells along a side.
        score += n * (0..n * n).filter(|c| is_full(*c)).count();
    }
    VisiblePoints { view, count, score }
}

/// Result of the registration of a view.
pub(crate) enum Registration {
    Registered(Pose),
    /// No pose has enough inliers: the number of the best.
    Refused(usize),
}

/// Estimates the pose of a view from its visible points (P3P with RANSAC, then refinement).
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn register(
    scene: &Scene<'_>,
    view: usize,
    options: &SfmOptions,
    progress: &dyn Progress,
) -> Result<Registration, Cancelled> {
    let matches: Vec<WorldMatch> = scene
        .view_observations(view)
        .filter_map(|i| Some(WorldMatch { world: scene.points[scene.track_of(i)]?, image: scene.ray(i) }))
        .filter(|m| m.image.x.is_finite())
        .collect();
    let threshold = options.growing_error(scene) / scene.camera_of(view).fx;
    let robust = RobustOptions { threshold, seed: options.seed, max_iterations: 5000, ..RobustOptions::essential() };
    let estimate = match estimate_pose(&matches, &robust, progress) {
        Ok(estimate) => estimate,
        Err(EstimateError::Cancelled(stop)) => return Err(stop),
        Err(_) => return Ok(Registration::Refused(0)),
    };
    let needed = options.min_pose_inliers.max((options.min_pose_inlier_ratio * matches.len() as f64) as usize);
    if estimate.inliers.len() < needed {
        return Ok(Registration::Refused(estimate.inliers.len()));
    }
    Ok(Registration::Registered(refine_pose(&estimate.model, &matches, threshold).0))
}
