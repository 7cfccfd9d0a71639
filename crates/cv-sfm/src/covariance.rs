//! How well the cameras and points of a model are known.

use crate::bundle::{BundlePlan, LensFreedom, Problem};
use crate::finish::noise_scale;
use crate::scene::Scene;
use crate::{CameraKnowledge, SfmModel, SfmView, Tracks};
use cv_core::{Matrix3, Pose};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::AdjustError;
use nalgebra::{DMatrix, Matrix3x6};

/// How well the cameras and points of a model are known, given the noise of their keypoints as the residuals show it, to first order. Of a lens that was estimated the focal length and distortion
/// count too; that a lens may be of another model, or that points may be wrong ones that agree, does not.
///
/// Relative to the pose of one view, which counts as exact, and its distance from another, which is the unit: a model tells no more. In the model's frame and unit.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelCovariance {
    /// The view whose pose is exact, and that whose distance from it is.
    pub reference: [usize; 2],
    /// Standard deviation of a keypoint's coordinate, in pixels, as the residuals show it.
    pub noise: f64,
    /// Of each view of the model.
    pub poses: Vec<Option<PoseCovariance>>,
    /// Of each point's position; `None` where nothing determines it.
    pub points: Vec<Option<Matrix3<f64>>>,
}

/// How well a camera's pose is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseCovariance {
    /// Of its center, in the world.
    pub center: Matrix3<f64>,
    /// Of its rotation about the camera's own axes, in square radians.
    pub rotation: Matrix3<f64>,
}

/// Covariances of a model that [`reconstruct_views`](crate::reconstruct_views) found. `views` and `knowledge` are those that it was found of. O(views³ + observations).
///
/// # Errors
/// [`AdjustError`]: the matches leave something free, or the model is not of these views.
pub fn model_covariance(
    views: &[SfmView<'_>],
    knowledge: &[CameraKnowledge],
    model: &SfmModel,
) -> Result<ModelCovariance, AdjustError> {
    let strange = model.poses.len() != views.len()
        || views.iter().any(|v| v.camera >= model.cameras.len().min(knowledge.len()))
        || model
            .points
            .iter()
            .flat_map(|p| &p.observations)
            .any(|o| views.get(o.view as usize).is_none_or(|v| o.keypoint as usize >= v.keypoints.len()));
    if strange {
        return Err(AdjustError::Index { name: "views".to_owned(), index: views.len(), len: model.poses.len() });
    }
    let tracks = Tracks::from_lists(model.points.iter().map(|p| p.observations.clone()));
    let mut scene = Scene::new(views, &model.cameras, knowledge, tracks);
    scene.poses.clone_from(&model.poses);
    scene.points = model.points.iter().map(|p| Some(p.position)).collect();
    scene.active.fill(true);
    // A lens that was given without its distortion is as it was given, unless the matches called for one.
    let estimated = model.cameras.iter().zip(knowledge).any(|(camera, knowledge)| match knowledge {
        CameraKnowledge::Known => false,
        CameraKnowledge::Matrix => camera.distortion.parameters().iter().any(|k| *k != 0.0),
        CameraKnowledge::Focal { .. } | CameraKnowledge::Unknown => true,
    });
    let lens = if estimated { LensFreedom::Distortion } else { LensFreedom::Held };
    let plan = BundlePlan { free: None, lens, scale: noise_scale(&scene), max_iterations: 0, tolerance: 0.0 };
    // What did not agree is no observation any more: without a robust loss, whose weights would understate the noise.
    let problem = Problem::new(&scene, &plan, &vec![true; views.len()], RobustLoss::Trivial)?;
    let variance = problem.adjustment.variance()?;
    let covariance = problem.adjustment.covariance(variance)?;
    let mut poses = vec![None; views.len()];
    for (view, of) in problem.views.iter().zip(covariance.of_group(problem.poses)) {
        poses[*view] = scene.poses[*view].map(|pose| of.map(|of| pose_covariance(&pose, &of))).transpose()?;
    }
    let mut points = vec![None; model.points.len()];
    for (point, of) in problem.tracks.iter().zip(covariance.of_group(problem.points)) {
        points[*point] = of.ok().map(|of| of.fixed_view::<3, 3>(0, 0).into_owned());
    }
    let reference = problem.reference.ok_or_else(|| AdjustError::Index {
        name: "poses".to_owned(),
        index: 1,
        len: problem.views.len(),
    })?;
    Ok(ModelCovariance { reference, noise: variance.sqrt(), poses, points })
}

/// From that of a turn ω and a shift τ, `R ← exp(ω) R` and `t ← t + τ`: the center `−Rᵀ t` moves by `−Rᵀ ([t]× ω + τ)`.
fn pose_covariance(pose: &Pose, of: &DMatrix<f64>) -> PoseCovariance {
    let of = of.fixed_view::<6, 6>(0, 0);
    let back = pose.rotation.inverse();
    let mut by_motion = Matrix3x6::zeros();
    by_motion.fixed_columns_mut::<3>(0).copy_from(&(-(back.matrix() * pose.translation.cross_matrix())));
    by_motion.fixed_columns_mut::<3>(3).copy_from(&-back.matrix());
    PoseCovariance {
        center: by_motion * of * by_motion.transpose(),
        rotation: of.fixed_view::<3, 3>(0, 0).into_owned(),
    }
}
