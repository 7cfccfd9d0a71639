//! A model that goes on from poses that are known.

use crate::SfmOptions;
use crate::bundle::adjust;
use crate::incremental::{QUICK, wide_limits};
use crate::scene::Scene;
use crate::triangulate_track::update_tracks;
use cv_core::{Cancelled, Pose, Stage};

/// Gives views their known poses and triangulates what they see; poses that too few of them agree with are left out. False where fewer than two are left.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn place_known(
    scene: &mut Scene<'_>,
    known: &[Option<Pose>],
    options: &SfmOptions,
    stage: &Stage<'_>,
) -> Result<bool, Cancelled> {
    for (pose, known) in scene.poses.iter_mut().zip(known) {
        *pose = *known;
    }
    let all: Vec<usize> = (0..scene.tracks.len()).collect();
    let limits = wide_limits(options);
    loop {
        stage.check()?;
        update_tracks(scene, limits, &all);
        let weak: Vec<usize> = scene.registered().into_iter().filter(|v| is_weak(scene, *v, options)).collect();
        if weak.is_empty() {
            break;
        }
        weak.into_iter().for_each(|v| scene.poses[v] = None);
    }
    if scene.registered().len() < 2 {
        return Ok(false);
    }
    adjust(scene, &QUICK, stage)?;
    update_tracks(scene, limits, &all);
    Ok(true)
}

/// Whether fewer points agree with a view's pose than with that of a new one must, of those that other views see too.
fn is_weak(scene: &Scene<'_>, view: usize, options: &SfmOptions) -> bool {
    let (mut agree, mut of) = (0, 0);
    for i in scene.of_view(view).filter(|i| scene.seen(scene.track_of(*i)).nth(1).is_some()) {
        (agree, of) = (agree + usize::from(scene.active[i]), of + 1);
    }
    agree < options.min_pose_inliers.max((options.min_pose_share * f64::from(of)) as usize)
}
