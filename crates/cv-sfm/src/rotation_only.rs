//! Detection of models without parallax: views from one center, whose unknown distortion was taken for parallax.

use crate::SfmOptions;
use crate::bundle::{BundlePlan, LensFreedom, Motion, adjust};
use crate::scene::Scene;
use cv_core::{Cancelled, Point3, Pose, Progress, Vector3};

/// Maximum number of points that are tested.
const MAX_POINTS: usize = 2000;

/// Returns whether rotations about one center explain at least the ratio `min_explained` of the inliers of a model, with
/// some focal length and distortion of the cameras that are not calibrated. The points of a model have parallaxes far
/// above [`SfmOptions::max_error`], which rotations do not explain. The scene is not changed. O(views³), for at most
/// 2,000 points.
///
/// # Errors
/// [`Cancelled`]; the scene is then without its solution.
pub(crate) fn is_rotation_only(
    scene: &mut Scene<'_>,
    min_explained: f64,
    options: &SfmOptions,
    progress: &dyn Progress,
) -> Result<bool, Cancelled> {
    let solution = scene.solution();
    let has_inliers = |t: &usize| scene.tracks.range(*t).any(|i| scene.active[i]);
    let tracks: Vec<usize> = (0..scene.tracks.len()).filter(has_inliers).collect();
    let step = tracks.len().div_ceil(MAX_POINTS).max(1);
    scene.points.fill(None);
    for track in tracks.into_iter().step_by(step) {
        let active = scene.tracks.range(track).filter(|i| scene.active[*i]);
        let direction = |i: usize| {
            let pose = scene.poses[scene.view_of(i)].as_ref()?;
            Some((pose.rotation.inverse() * scene.ray(i).to_homogeneous()).normalize())
        };
        let sum: Vector3<f64> = active.filter_map(direction).sum();
        scene.points[track] = sum.try_normalize(f64::EPSILON).map(Point3::from);
    }
    for pose in scene.poses.iter_mut().flatten() {
        *pose = Pose::new(pose.rotation, Vector3::zeros());
    }
    let plan = BundlePlan {
        free: None,
        motion: Motion::Rotation,
        lens: LensFreedom::Distortion,
        scale: options.growing_error(scene),
        max_iterations: 50,
        tolerance: 1e-6,
    };
    adjust(scene, &plan, progress)?;
    let (mut explained, mut all) = (0, 0);
    for (track, point) in scene.points.iter().enumerate() {
        let Some(point) = point else { continue };
        for (i, pose) in scene.posed_observations(track).filter(|(i, _)| scene.active[*i]) {
            all += 1;
            explained += usize::from(scene.reprojection_error(i, pose, point) <= options.max_error);
        }
    }
    scene.restore(solution);
    Ok(all > 0 && explained as f64 >= min_explained * all as f64)
}
