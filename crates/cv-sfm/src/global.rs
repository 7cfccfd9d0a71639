//! Global reconstruction: all poses at once from the relative poses of the pairs (Moulon, Monasse & Marlet, "Global
//! fusion of relative motions", ICCV 2013; Pan et al., "Global structure-from-motion revisited", ECCV 2024).

use crate::SfmOptions;
use crate::bundle::{BundlePlan, LensFreedom, Motion, adjust};
use crate::global_positions::{adjust_rays, centers_from_baselines};
use crate::model_parts::{Consistency, keep_largest_consistent_component};
use crate::pair_scales::{Distances, estimate_baselines};
use crate::rotation_averaging::average_rotations;
use crate::scene::Scene;
use crate::triangulate_track::{PointLimits, update_tracks};
use crate::view_graph::ViewGraph;
use cv_core::{Cancelled, Pose, Rotation3, Stage, Vector3};

/// Largest angle between a relative rotation and that of the averaged rotations, in radians: 5 degrees, as for
/// triplets.
const MAX_ROTATION_ERROR: f64 = 0.087;
/// Inlier thresholds of rays before and after global positioning, in radians: about 1 degree and half of it. Averaged
/// rotations are accurate to some tenths of a degree.
const RAY_THRESHOLDS: [f64; 2] = [0.0175, 0.0087];

/// Estimates the poses of the largest connected component of the graph and triangulates. Returns false if fewer than
/// three views get a pose. The stages: rotation averaging; baseline lengths from the points that pairs share
/// (`distances`, by pair); centers from baselines; centers and points from rays (global positioning); bundle
/// adjustment.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn estimate_poses(
    scene: &mut Scene<'_>,
    graph: &ViewGraph,
    distances: &[Distances],
    options: &SfmOptions,
    stage: &Stage<'_>,
) -> Result<bool, Cancelled> {
    let graph = graph.largest_component();
    let rotations = average_rotations(&graph, stage)?;
    let graph = graph.filtered(|l| match (rotations[l.a], rotations[l.b]) {
        (Some(a), Some(b)) => rotation_between(&l.pose.rotation, &(b * a.inverse())) <= MAX_ROTATION_ERROR,
        _ => false,
    });
    let measured: Vec<&Distances> = graph.links.iter().map(|l| &distances[l.pair]).collect();
    let lengths = estimate_baselines(&graph, &measured, stage)?;
    let centers = centers_from_baselines(&graph, &rotations, &lengths, stage)?;
    for (v, (rotation, center)) in rotations.iter().zip(&centers).enumerate() {
        if let (Some(rotation), Some(center)) = (rotation, center) {
            scene.poses[v] = Some(Pose::new(*rotation, -(rotation * center.coords)));
        }
    }
    if scene.registered().len() < 3 {
        return Ok(false);
    }
    let max_focal = scene.cameras.iter().map(|c| c.fx).fold(0.0, f64::max);
    let all: Vec<usize> = (0..scene.tracks.len()).collect();
    let limits = |angle: f64| {
        let error = (angle * max_focal).max(options.initial_error());
        PointLimits { error, angle: options.min_angle }
    };
    update_tracks(scene, limits(RAY_THRESHOLDS[0]), &all);
    adjust_rays(scene, stage)?;
    stage.check()?;
    update_tracks(scene, limits(RAY_THRESHOLDS[1]), &all);
    let refinable = scene.knowledge.iter().any(|k| !k.is_calibrated());
    let lens = if refinable { LensFreedom::Distortion } else { LensFreedom::Fixed };
    let scale = options.max_error;
    adjust(
        scene,
        &BundlePlan {
            free: None,
            motion: Motion::Full,
            lens: LensFreedom::Fixed,
            scale,
            max_iterations: 8,
            tolerance: 1e-2,
        },
        stage,
    )?;
    update_tracks(scene, limits(0.0), &all);
    // A guessed focal length bends the whole model, and takes more iterations.
    let (rounds, max_iterations, tolerance) = if refinable { (2, 25, 1e-4) } else { (1, 8, 1e-3) };
    for _ in 0..rounds {
        adjust(
            scene,
            &BundlePlan { free: None, motion: Motion::Full, lens, scale: 1.0, max_iterations, tolerance },
            stage,
        )?;
        update_tracks(scene, limits(0.0), &all);
    }
    // Views with few inliers are left for registration by the points of the others.
    for v in 0..scene.views.len() {
        if scene.view_observations(v).filter(|i| scene.active[*i]).count() < options.min_pose_inliers {
            scene.poses[v] = None;
        }
    }
    update_tracks(scene, limits(0.0), &all);
    // So are components in an inconsistent position or scale: on a rendered street of 50 views, three components
    // overlapped in scales of 0.7 to 1.
    let pairs: Vec<(usize, usize)> = graph.links.iter().map(|l| (l.a, l.b)).collect();
    let all_parts = (options.min_pose_inliers, 1);
    if !keep_largest_consistent_component(scene, &pairs, Consistency::Inliers, all_parts, stage)?.is_empty() {
        update_tracks(scene, limits(0.0), &all);
    }
    Ok(scene.registered().len() > 1)
}

fn rotation_between(a: &Rotation3<f64>, b: &Rotation3<f64>) -> f64 {
    Pose::new(a.inverse() * b, Vector3::zeros()).rotation_angle()
}
