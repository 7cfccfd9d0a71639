//! The pose of one more view from the points it sees.

use crate::SfmOptions;
use crate::scene::Scene;
use cv_core::{Cancelled, Pose, Progress};
use cv_geometry::{EstimateError, RobustOptions, WorldMatch, estimate_pose, refine_pose};

/// Points that a view sees.
pub(crate) struct Visible {
    pub(crate) view: usize,
    pub(crate) count: usize,
    /// How well they are spread over the picture.
    pub(crate) score: usize,
}

/// Cells along a side of the coarsest grid of [`visible`], and how many grids there are, each twice as fine.
const COARSEST: usize = 2;
const LEVELS: usize = 4;

/// The views without a pose that see points, those that see most all over the picture first (Schönberger & Frahm, "Structure-from-motion revisited", CVPR 2016, §4.2).
pub(crate) fn visible(scene: &Scene<'_>) -> Vec<Visible> {
    let free = (0..scene.views.len()).filter(|v| scene.poses[*v].is_none());
    let mut all: Vec<Visible> = free.map(|view| count(scene, view)).filter(|v| v.count > 0).collect();
    all.sort_by(|a, b| b.score.cmp(&a.score).then(b.count.cmp(&a.count)).then(a.view.cmp(&b.view)));
    all
}

fn count(scene: &Scene<'_>, view: usize) -> Visible {
    let camera = scene.camera_of(view);
    let finest = COARSEST << (LEVELS - 1);
    let mut cells = vec![false; finest * finest];
    let mut count = 0;
    for i in scene.of_view(view).filter(|i| scene.points[scene.track_of(*i)].is_some()) {
        count += 1;
        let p = scene.pixel(i);
        let cell = |v: f64, n: usize| (((v + 0.5) / n as f64 * finest as f64) as usize).min(finest - 1);
        cells[cell(p.y, camera.height) * finest + cell(p.x, camera.width)] = true;
    }
    let mut score = 0;
    for level in 0..LEVELS {
        let n = COARSEST << level;
        let size = finest / n;
        let full = |c: usize| {
            let (x0, y0) = (c % n * size, c / n * size);
            (y0..y0 + size).any(|y| cells[y * finest + x0..][..size].contains(&true))
        };
        // A cell counts as many times as there are cells along a side.
        score += n * (0..n * n).filter(|c| full(*c)).count();
    }
    Visible { view, count, score }
}

/// What a search for a pose gave.
pub(crate) enum Registration {
    Found(Pose),
    /// No pose agrees with enough points: so many did.
    Refused(usize),
}

/// The pose of a view from the points it sees.
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
        .of_view(view)
        .filter_map(|i| Some(WorldMatch { world: scene.points[scene.track_of(i)]?, image: scene.ray(i) }))
        .filter(|m| m.image.x.is_finite())
        .collect();
    let threshold = options.growing_error() / scene.camera_of(view).fx;
    let robust = RobustOptions { threshold, seed: options.seed, max_iterations: 5000, ..RobustOptions::essential() };
    let found = match estimate_pose(&matches, &robust, progress) {
        Ok(found) => found,
        Err(EstimateError::Cancelled(stop)) => return Err(stop),
        Err(_) => return Ok(Registration::Refused(0)),
    };
    let needed = options.min_pose_inliers.max((options.min_pose_share * matches.len() as f64) as usize);
    if found.inliers.len() < needed {
        return Ok(Registration::Refused(found.inliers.len()));
    }
    Ok(Registration::Found(refine_pose(&found.model, &matches, threshold).0))
}
