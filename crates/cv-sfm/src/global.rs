//! Global reconstruction: all poses at once from those of the pairs (Moulon, Monasse & Marlet, "Global fusion of relative motions", ICCV 2013; Pan et al., "Global structure-from-motion
//! revisited", ECCV 2024).

use crate::SfmOptions;
use crate::bundle::{BundlePlan, LensFreedom, adjust};
use crate::global_positions::{adjust_rays, centers_of_baselines};
use crate::model_parts::keep_largest_part;
use crate::pair_scales::{Distances, baselines};
use crate::rotation_averaging::average_rotations;
use crate::scene::Scene;
use crate::triangulate_track::{PointLimits, update_tracks};
use crate::view_graph::ViewGraph;
use cv_core::{Cancelled, Pose, Rotation3, Stage, Vector3};

/// Largest angle between the rotation of a pair and that of its views, in radians: 5 degrees, as of loops.
const AGREES: f64 = 0.087;
/// Errors of rays as long as poses are not adjusted, in radians: about 1 degree, then half of it. Averaged rotations are right to some tenths of a degree.
const COARSE: [f64; 2] = [0.0175, 0.0087];

/// Places all views of the largest part of a graph whose poses can be told, and triangulates; false where there are not three. Rotations are averaged; lengths of baselines are compared by way
/// of the points that pairs share (`distances`, by pair); centers follow from those, then centers and points together from rays; in the end, all is adjusted.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn place(
    scene: &mut Scene<'_>,
    graph: &ViewGraph,
    distances: &[Distances],
    options: &SfmOptions,
    stage: &Stage<'_>,
) -> Result<bool, Cancelled> {
    let graph = graph.largest_component();
    let rotations = average_rotations(&graph, stage)?;
    let graph = graph.filtered(|l| match (rotations[l.a], rotations[l.b]) {
        (Some(a), Some(b)) => rotation_between(&l.pose.rotation, &(b * a.inverse())) <= AGREES,
        _ => false,
    });
    let measured: Vec<&Distances> = graph.links.iter().map(|l| &distances[l.pair]).collect();
    let lengths = baselines(&graph, &measured, stage)?;
    let centers = centers_of_baselines(&graph, &rotations, &lengths, stage)?;
    for (v, (rotation, center)) in rotations.iter().zip(&centers).enumerate() {
        if let (Some(rotation), Some(center)) = (rotation, center) {
            scene.poses[v] = Some(Pose::new(*rotation, -(rotation * center.coords)));
        }
    }
    if scene.registered().len() < 3 {
        return Ok(false);
    }
    let focal = scene.cameras.iter().map(|c| c.fx).fold(0.0, f64::max);
    let all: Vec<usize> = (0..scene.tracks.len()).collect();
    let limits = |angle: f64| {
        let error = (angle * focal).max(options.growing_error());
        PointLimits { error, angle: options.min_angle }
    };
    update_tracks(scene, limits(COARSE[0]), &all);
    adjust_rays(scene, stage)?;
    stage.check()?;
    update_tracks(scene, limits(COARSE[1]), &all);
    let refinable = scene.knowledge.iter().any(|k| !k.is_calibrated());
    let lens = if refinable { LensFreedom::Distortion } else { LensFreedom::Held };
    let scale = options.max_error;
    adjust(
        scene,
        &BundlePlan { free: None, lens: LensFreedom::Held, scale, max_iterations: 8, tolerance: 1e-2 },
        stage,
    )?;
    update_tracks(scene, limits(0.0), &all);
    // A focal length that was a guess has bent the whole model, which takes a while to straighten.
    let (rounds, max_iterations, tolerance) = if refinable { (2, 25, 1e-4) } else { (1, 8, 1e-3) };
    for _ in 0..rounds {
        adjust(scene, &BundlePlan { free: None, lens, scale: 1.0, max_iterations, tolerance }, stage)?;
        update_tracks(scene, limits(0.0), &all);
    }
    // Views that hardly anything agrees with are left to be placed by the points of the others.
    for v in 0..scene.views.len() {
        if scene.of_view(v).filter(|i| scene.active[*i]).count() < options.min_pose_inliers {
            scene.poses[v] = None;
        }
    }
    update_tracks(scene, limits(0.0), &all);
    // So are parts whose place beside the largest one is wrong: of a rendered street of 50 views, three parts lay beside each other, 32 steps apart and in scales of 0.7 to 1.
    if keep_largest_part(scene, &graph, options.min_pose_inliers) {
        update_tracks(scene, limits(0.0), &all);
    }
    Ok(scene.registered().len() > 1)
}

fn rotation_between(a: &Rotation3<f64>, b: &Rotation3<f64>) -> f64 {
    Pose::new(a.inverse() * b, Vector3::zeros()).rotation_angle()
}
