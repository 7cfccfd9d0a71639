//! Incremental reconstruction: from two views on, one view after the other (Snavely, Seitz & Szeliski, "Photo tourism", 2006; Schönberger & Frahm, "Structure-from-motion
//! revisited", CVPR 2016).

use crate::SfmOptions;
use crate::bundle::{BundlePlan, LensFreedom, adjust};
use crate::initial_pair::Start;
use crate::model::ViewOutcome;
use crate::registration::{Registration, register, visible};
use crate::scene::Scene;
use crate::triangulate_track::{PointLimits, update_tracks};
use cv_core::{Cancelled, Pose, Stage};

/// Views that are adjusted with a new one.
const NEAR_VIEWS: usize = 6;

/// While a model grows: poses and lenses are not what they will be.
pub(crate) fn wide_limits(options: &SfmOptions) -> PointLimits {
    PointLimits { error: options.growing_error(), angle: options.min_angle }
}

/// Adjustments while a model grows.
pub(crate) const QUICK: BundlePlan<'static> =
    BundlePlan { free: None, lens: LensFreedom::Held, scale: 1.0, max_iterations: 6, tolerance: 1e-3 };

/// Starts a model with a pair.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn begin(
    scene: &mut Scene<'_>,
    start: &Start,
    options: &SfmOptions,
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    scene.poses[start.a] = Some(Pose::identity());
    scene.poses[start.b] = Some(start.pose);
    let tracks: Vec<usize> = scene.of_view(start.a).map(|i| scene.track_of(i)).collect();
    update_tracks(scene, wide_limits(options), &tracks);
    adjust(scene, &QUICK, stage)?;
    update_tracks(scene, wide_limits(options), &tracks);
    Ok(())
}

/// Adds views to a model, one after the other, as far as it goes.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn extend(
    scene: &mut Scene<'_>,
    taken: &[bool],
    options: &SfmOptions,
    outcomes: &mut [ViewOutcome],
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    let all: Vec<usize> = (0..scene.tracks.len()).collect();
    let mut adjusted = scene.registered().len();
    // Where a pose was refused: how many points were seen, so that it is tried again when there are more.
    let mut refused = vec![0usize; scene.views.len()];
    loop {
        stage.check()?;
        let mut next = None;
        for candidate in visible(scene).into_iter().filter(|c| !taken[c.view]) {
            let (seen, needed) = (candidate.count, options.min_pose_inliers);
            if seen < needed {
                outcomes[candidate.view] = ViewOutcome::TooFewPoints { seen, needed };
                continue;
            }
            if seen * 10 < refused[candidate.view] * 11 {
                continue;
            }
            match register(scene, candidate.view, options, stage)? {
                Registration::Found(pose) => {
                    next = Some((candidate.view, pose));
                    break;
                }
                Registration::Refused(agree) => {
                    refused[candidate.view] = seen;
                    outcomes[candidate.view] = ViewOutcome::NoPose { seen, agree, needed };
                }
            }
        }
        let Some((view, pose)) = next else { break };
        scene.poses[view] = Some(pose);
        let tracks: Vec<usize> = scene.of_view(view).map(|i| scene.track_of(i)).collect();
        update_tracks(scene, wide_limits(options), &tracks);
        let near = near_views(scene, view);
        let local = BundlePlan { free: Some(&near), max_iterations: 3, ..QUICK };
        let registered = scene.registered().len();
        if registered as f64 >= adjusted as f64 * options.growth || registered < 6 {
            let refinable = registered > 2 && scene.knowledge.iter().any(|k| !k.is_calibrated());
            let lens = if refinable { LensFreedom::Distortion } else { LensFreedom::Held };
            adjust(scene, &BundlePlan { lens, ..QUICK }, stage)?;
            update_tracks(scene, wide_limits(options), &all);
            adjusted = registered;
        } else {
            adjust(scene, &local, stage)?;
            update_tracks(scene, wide_limits(options), &tracks);
        }
        stage.add(1)?;
    }
    Ok(())
}

/// The view and those that share most points with it.
fn near_views(scene: &Scene<'_>, view: usize) -> Vec<usize> {
    let mut shared = vec![0usize; scene.views.len()];
    for i in scene.of_view(view).filter(|i| scene.active[*i]) {
        for j in scene.tracks.range(scene.track_of(i)).filter(|j| scene.active[*j]) {
            shared[scene.view_of(j)] += 1;
        }
    }
    let mut order: Vec<usize> = (0..shared.len()).filter(|v| *v != view && shared[*v] > 0).collect();
    order.sort_by(|a, b| shared[*b].cmp(&shared[*a]).then(a.cmp(b)));
    order.truncate(NEAR_VIEWS);
    order.push(view);
    order
}
