//! Models that start from known poses.

use crate::SfmOptions;
use crate::bundle::adjust;
use crate::incremental::{GROWING_BUNDLE, growing_limits};
use crate::scene::Scene;
use crate::triangulate_track::update_tracks;
use cv_core::{Cancelled, Pose, Stage};

/// Registers views with their known poses and triangulates. Poses with too few inliers are dropped. Returns false if
/// fewer than two are left.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn register_known_poses(
    scene: &mut Scene<'_>,
    known: &[Option<Pose>],
    options: &SfmOptions,
    stage: &Stage<'_>,
) -> Result<bool, Cancelled> {
    for (pose, known) in scene.poses.iter_mut().zip(known) {
        *pose = *known;
    }
    let all: Vec<usize> = (0..scene.tracks.len()).collect();
    let limits = growing_limits(scene, options);
    loop {
        stage.check()?;
        update_tracks(scene, limits, &all);
        let unsupported: Vec<usize> =
            scene.registered().into_iter().filter(|v| has_too_few_inliers(scene, *v, options)).collect();
        if unsupported.is_empty() {
            break;
        }
        unsupported.into_iter().for_each(|v| scene.poses[v] = None);
    }
    if scene.registered().len() < 2 {
        return Ok(false);
    }
    adjust(scene, &GROWING_BUNDLE, stage)?;
    update_tracks(scene, limits, &all);
    Ok(true)
}

/// Returns whether a view has fewer inliers than [`register`](crate::registration::register) requires, among the points
/// that another registered view observes too.
fn has_too_few_inliers(scene: &Scene<'_>, view: usize, options: &SfmOptions) -> bool {
    let (mut inliers, mut observations) = (0, 0);
    for i in scene.view_observations(view).filter(|i| scene.posed_observations(scene.track_of(*i)).nth(1).is_some()) {
        (inliers, observations) = (inliers + usize::from(scene.active[i]), observations + 1);
    }
    inliers < options.min_pose_inliers.max((options.min_pose_inlier_ratio * f64::from(observations)) as usize)
}
