//! Covariances of the poses and points of a model.

use crate::bundle::{BundlePlan, LensFreedom, Motion, Problem};
use crate::refine_model::noise_scale;
use crate::scene::Scene;
use crate::{CameraKnowledge, SfmModel, SfmView, Tracks};
use cv_core::{Matrix3, Pose};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::AdjustError;
use nalgebra::{DMatrix, Matrix3x6};

/// First-order covariances of the poses and points of a model, for the keypoint noise estimated from the residuals. The
/// uncertainty of estimated focal lengths and distortion is included; errors of the lens model and outliers among the
/// inliers are not.
///
/// The gauge is the pose of one view, taken as exact, and its distance from another view, taken as the unit of length.
/// In the model's frame and unit.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelCovariance {
    /// The view whose pose is exact, and the view whose distance from it is.
    pub reference: [usize; 2],
    /// Standard deviation of a keypoint coordinate, in pixels, estimated from the residuals.
    pub noise: f64,
    /// Of each view; `None` where it is not in the model.
    pub poses: Vec<Option<PoseCovariance>>,
    /// Of the position of each point; `None` where nothing determines it.
    pub points: Vec<Option<Matrix3<f64>>>,
}

/// Covariance of a camera pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseCovariance {
    /// Of the camera center, in the world frame.
    pub center: Matrix3<f64>,
    /// Of the rotation vector in the camera frame, in square radians.
    pub rotation: Matrix3<f64>,
}

/// Computes the covariances of a model of [`reconstruct_views`](crate::reconstruct_views). `views` and `knowledge` are
/// those of its input. O(views³ + observations).
///
/// # Errors
/// [`AdjustError`]: the matches leave a parameter undetermined, or the model is not of these views.
pub fn model_covariance(
    views: &[SfmView<'_>],
    knowledge: &[CameraKnowledge],
    model: &SfmModel,
) -> Result<ModelCovariance, AdjustError> {
    let (scene, problem) = problem_of(views, knowledge, model, LensFreedom::Distortion)?;
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

/// Computes the standard deviation in pixels of each focal length that was estimated, by the matches and the weak prior of
/// the adjustment: `None` for a calibrated camera, and for one that no view of the model has. The principal point counts
/// as estimated. It is a tenth of the focal length or more where the views do not determine it, as with cameras that only
/// translate. Arguments and complexity are those of [`model_covariance`].
///
/// # Errors
/// As [`model_covariance`].
pub fn focal_deviations(
    views: &[SfmView<'_>],
    knowledge: &[CameraKnowledge],
    model: &SfmModel,
) -> Result<Vec<Option<f64>>, AdjustError> {
    let (scene, problem) = problem_of(views, knowledge, model, LensFreedom::PrincipalPoint)?;
    let Some(lenses) = problem.lenses else { return Ok(vec![None; model.cameras.len()]) };
    let covariance = problem.adjustment.covariance(problem.adjustment.variance()?)?;
    let mut is_estimated = vec![false; model.cameras.len()];
    for view in scene.registered() {
        let camera = views[view].camera;
        is_estimated[camera] = !knowledge[camera].is_calibrated();
    }
    let deviation = |c: usize| match is_estimated[c] {
        true => Ok(Some(covariance.of(lenses, c)?[(0, 0)].max(0.0).sqrt())),
        false => Ok(None),
    };
    (0..model.cameras.len()).map(deviation).collect()
}

/// Returns a model as a scene and its least squares problem; `freedom` is that of intrinsics that were estimated.
fn problem_of<'a>(
    views: &'a [SfmView<'a>],
    knowledge: &'a [CameraKnowledge],
    model: &SfmModel,
    freedom: LensFreedom,
) -> Result<(Scene<'a>, Problem<'static>), AdjustError> {
    let is_mismatched = model.poses.len() != views.len()
        || views.iter().any(|v| v.camera >= model.cameras.len().min(knowledge.len()))
        || model
            .points
            .iter()
            .flat_map(|p| &p.observations)
            .any(|o| views.get(o.view as usize).is_none_or(|v| o.keypoint as usize >= v.keypoints.len()));
    if is_mismatched {
        return Err(AdjustError::Index { name: "views".to_owned(), index: views.len(), len: model.poses.len() });
    }
    let tracks = Tracks::from_lists(model.points.iter().map(|p| p.observations.clone()));
    let mut scene = Scene::new(views, &model.cameras, knowledge, tracks);
    scene.poses.clone_from(&model.poses);
    scene.points = model.points.iter().map(|p| Some(p.position)).collect();
    scene.active.fill(true);
    // The intrinsics of a given calibration matrix are constant, unless a distortion was estimated.
    let is_estimated = model.cameras.iter().zip(knowledge).any(|(camera, knowledge)| match knowledge {
        CameraKnowledge::Known => false,
        CameraKnowledge::Matrix => camera.distortion.parameters().iter().any(|k| *k != 0.0),
        CameraKnowledge::Focal { .. } | CameraKnowledge::Unknown => true,
    });
    let lens = if is_estimated { freedom } else { LensFreedom::Fixed };
    let plan = BundlePlan {
        free: None,
        motion: Motion::Full,
        lens,
        scale: noise_scale(&scene),
        max_iterations: 0,
        tolerance: 0.0,
    };
    // Outliers are no observations any more, so the loss is the square: the weights of a robust loss would understate
    // the noise.
    let problem = Problem::new(&scene, &plan, &vec![true; views.len()], RobustLoss::Trivial)?;
    Ok((scene, problem))
}

/// Converts the covariance of a rotation ω and a translation τ, `R ← exp(ω) R` and `t ← t + τ`: the center `−Rᵀ t`
/// changes by `−Rᵀ ([t]× ω + τ)`.
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
