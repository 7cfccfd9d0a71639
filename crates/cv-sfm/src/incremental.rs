//! Incremental reconstruction: from an initial pair, one view after the other (Snavely, Seitz & Szeliski, "Photo
//! tourism", 2006; Schönberger & Frahm, "Structure-from-motion revisited", CVPR 2016).

use crate::SfmOptions;
use crate::bundle::{BundlePlan, LensFreedom, Motion, adjust};
use crate::initial_pair::InitialPair;
use crate::model::ViewOutcome;
use crate::registration::{Registration, next_best_views, register};
use crate::scene::Scene;
use crate::triangulate_track::{PointLimits, update_tracks};
use cv_core::{Cancelled, Pose, Stage};

/// Number of neighboring views in a local bundle adjustment.
const LOCAL_BUNDLE_VIEWS: usize = 6;

/// Returns the limits while a model grows, when poses and intrinsics are not final.
pub(crate) fn growing_limits(scene: &Scene<'_>, options: &SfmOptions) -> PointLimits {
    PointLimits { error: options.growing_error(scene), angle: options.min_angle }
}

/// Bundle adjustment while a model grows.
pub(crate) const GROWING_BUNDLE: BundlePlan<'static> = BundlePlan {
    free: None,
    motion: Motion::Full,
    lens: LensFreedom::Fixed,
    scale: 1.0,
    max_iterations: 6,
    tolerance: 1e-3,
};

/// Returns the same with intrinsics, to convergence and with a loss that is nearly quadratic for inliers: poses and
/// points adapt to wrong intrinsics at nearly the same cost, so that they converge slowly, and not at all once the
/// observations that contradict them are outliers.
fn growing_bundle_with_intrinsics(scene: &Scene<'_>, options: &SfmOptions) -> BundlePlan<'static> {
    BundlePlan {
        lens: LensFreedom::Distortion,
        scale: options.growing_error(scene),
        max_iterations: 200,
        tolerance: 1e-6,
        ..GROWING_BUNDLE
    }
}

/// Starts a model from an initial pair.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn initialize(
    scene: &mut Scene<'_>,
    pair: &InitialPair,
    options: &SfmOptions,
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    scene.poses[pair.a] = Some(Pose::identity());
    scene.poses[pair.b] = Some(pair.pose);
    let tracks: Vec<usize> = scene.view_observations(pair.a).map(|i| scene.track_of(i)).collect();
    let limits = growing_limits(scene, options);
    update_tracks(scene, limits, &tracks);
    adjust(scene, &GROWING_BUNDLE, stage)?;
    update_tracks(scene, limits, &tracks);
    Ok(())
}

/// Registers views one after the other, until none has enough points.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn extend(
    scene: &mut Scene<'_>,
    excluded: &[bool],
    options: &SfmOptions,
    outcomes: &mut [ViewOutcome],
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    let all: Vec<usize> = (0..scene.tracks.len()).collect();
    let limits = growing_limits(scene, options);
    let mut adjusted = scene.registered().len();
    // For a refused view, the number of visible points at the time: it is tried again with a tenth more.
    let mut refused = vec![0usize; scene.views.len()];
    loop {
        stage.check()?;
        let mut next = None;
        for candidate in next_best_views(scene).into_iter().filter(|c| !excluded[c.view]) {
            let (visible, needed) = (candidate.count, options.min_pose_inliers);
            if visible < needed {
                outcomes[candidate.view] = ViewOutcome::TooFewPoints { seen: visible, needed };
                continue;
            }
            if visible * 10 < refused[candidate.view] * 11 {
                continue;
            }
            match register(scene, candidate.view, options, stage)? {
                Registration::Registered(pose) => {
                    next = Some((candidate.view, pose));
                    break;
                }
                Registration::Refused(agree) => {
                    refused[candidate.view] = visible;
                    outcomes[candidate.view] = ViewOutcome::NoPose { seen: visible, agree, needed };
                }
            }
        }
        let Some((view, pose)) = next else { break };
        scene.poses[view] = Some(pose);
        let tracks: Vec<usize> = scene.view_observations(view).map(|i| scene.track_of(i)).collect();
        update_tracks(scene, limits, &tracks);
        let local_views = local_bundle_views(scene, view);
        let local = BundlePlan { free: Some(&local_views), max_iterations: 3, ..GROWING_BUNDLE };
        let registered = scene.registered().len();
        if registered as f64 >= adjusted as f64 * options.growth || registered < 6 {
            let refinable = registered > 2 && !scene.is_calibrated();
            let plan = if refinable { growing_bundle_with_intrinsics(scene, options) } else { GROWING_BUNDLE };
            adjust(scene, &plan, stage)?;
            update_tracks(scene, limits, &all);
            adjusted = registered;
        } else {
            adjust(scene, &local, stage)?;
            update_tracks(scene, limits, &tracks);
        }
        stage.add(1)?;
    }
    Ok(())
}

/// Returns the view and the views that share the most points with it.
fn local_bundle_views(scene: &Scene<'_>, view: usize) -> Vec<usize> {
    let shared = scene.shared_inliers(view);
    let mut order: Vec<usize> = (0..shared.len()).filter(|v| *v != view && shared[*v] > 0).collect();
    order.sort_by(|a, b| shared[*b].cmp(&shared[*a]).then(a.cmp(b)));
    order.truncate(LOCAL_BUNDLE_VIEWS);
    order.push(view);
    order
}
