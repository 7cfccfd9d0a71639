//! Bundle adjustment of poses, points and intrinsics.

use crate::CameraKnowledge;
use crate::scene::Scene;
use cv_core::{Camera, Cancelled, Point2, Point3, Pose, Progress, Stage, Vector3};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{
    AdjustError, AdjustIteration, AdjustOptions, Adjustment, Euclidean, GroupId, Prior, Residual, RigidMotion,
};
use nalgebra::{Matrix2, Matrix2x3, SMatrix, Vector2};
use std::ops::ControlFlow;

/// Number of intrinsic parameters that may be refined: focal length, aspect ratio fy/fx, principal point (2), the first
/// four distortion coefficients.
const INTRINSICS: usize = 8;
/// Number of distortion coefficients among them.
const DISTORTION_COEFFICIENTS: usize = 4;

/// Which intrinsics of cameras that are not known are refined; each variant keeps constant what the later ones refine.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum LensFreedom {
    /// No intrinsics.
    Fixed,
    /// Focal length and distortion.
    Distortion,
    /// The principal point as well.
    PrincipalPoint,
}

/// Which parameters of the poses are refined.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Motion {
    /// Rotation and translation.
    Full,
    /// The rotation only; translations stay constant.
    Rotation,
}

/// Free parameters and termination criteria of [`adjust`].
#[derive(Debug, Clone, Copy)]
pub(crate) struct BundlePlan<'p> {
    /// Views whose poses are free; `None`: all registered views.
    pub(crate) free: Option<&'p [usize]>,
    /// Which parameters of these poses are free.
    pub(crate) motion: Motion,
    /// Which intrinsics are free.
    pub(crate) lens: LensFreedom,
    /// Scale of the Cauchy loss, in pixels.
    pub(crate) scale: f64,
    /// Maximum number of iterations.
    pub(crate) max_iterations: usize,
    /// Relative cost decrease below which iterations stop.
    pub(crate) tolerance: f64,
}

/// Prior standard deviation of a distortion coefficient, as the displacement that it causes at the image corner in
/// normalized coordinates.
const DISTORTION_SIGMA: f64 = 0.1;
/// Prior standard deviation of the principal point, as a ratio of half the image diagonal.
const PRINCIPAL_POINT_SIGMA: f64 = 0.02;
/// Prior standard deviation of an unknown focal length, as a ratio of it.
const FOCAL_SIGMA: f64 = 0.5;

/// Prior standard deviation of the focal length of a given calibration matrix, as a ratio of it.
const MATRIX_FOCAL_SIGMA: f64 = 0.02;

/// Reprojection residuals of observations: of pose and point with constant intrinsics, or of pose, intrinsics and
/// point.
struct ReprojectionResidual {
    cameras: Vec<Camera>,
    camera_of: Vec<u32>,
    pixels: Vec<Point2<f64>>,
}

/// A point in the camera frame.
struct CameraPoint {
    rotation: cv_core::Rotation3<f64>,
    /// `R X`, without the translation.
    rotated: Vector3<f64>,
    inverse_depth: f64,
    /// Undistorted normalized coordinates.
    normalized: Point2<f64>,
}

impl CameraPoint {
    /// Returns `None` for a point behind the camera.
    #[inline]
    fn new(pose: &[f64], point: &[f64]) -> Option<Self> {
        let (rotation, translation) = RigidMotion::load(pose);
        let rotated = rotation * Vector3::from_column_slice(point);
        let p = rotated + translation;
        if p.z <= 0.0 || p.z.is_nan() {
            return None;
        }
        let inverse_depth = 1.0 / p.z;
        Some(Self {
            rotation,
            rotated,
            inverse_depth,
            normalized: Point2::new(p.x * inverse_depth, p.y * inverse_depth),
        })
    }

    /// Returns the derivatives of the pixel by the point in the camera frame; `by_normalized` are those of the
    /// distortion.
    #[inline]
    fn by_point(&self, camera: &Camera, by_normalized: &Matrix2<f64>) -> Matrix2x3<f64> {
        let (fx, fy) = (camera.fx * self.inverse_depth, camera.fy * self.inverse_depth);
        let ray = Matrix2x3::new(1.0, 0.0, -self.normalized.x, 0.0, 1.0, -self.normalized.y);
        Matrix2::new(fx, 0.0, 0.0, fy) * by_normalized * ray
    }
}

impl Residual<2, 2, 9> for ReprojectionResidual {
    const DIMS: [usize; 2] = [6, 3];

    #[inline]
    fn evaluate(
        &self,
        item: usize,
        [pose, point]: [&[f64]; 2],
        jacobian: Option<&mut SMatrix<f64, 2, 9>>,
    ) -> Option<Vector2<f64>> {
        let camera = &self.cameras[self.camera_of[item] as usize];
        let local = CameraPoint::new(pose, point)?;
        let Some(out) = jacobian else { return Some(camera.denormalize(local.normalized) - self.pixels[item]) };
        let (d, j) = camera.distortion.distort_with_jacobian(local.normalized);
        write_motion(out, 0, 6, &local.by_point(camera, &j), &local);
        Some(Point2::new(camera.fx * d.x + camera.cx, camera.fy * d.y + camera.cy) - self.pixels[item])
    }
}

/// Writes the derivatives by the pose (rotation, then translation, from column `pose`) and by the point (from column
/// `point`).
#[inline]
fn write_motion<const C: usize>(
    out: &mut SMatrix<f64, 2, C>,
    pose: usize,
    point: usize,
    by_p: &Matrix2x3<f64>,
    local: &CameraPoint,
) {
    let (rotated, rotation) = (&local.rotated, local.rotation.matrix());
    for row in 0..2 {
        let b = [by_p[(row, 0)], by_p[(row, 1)], by_p[(row, 2)]];
        // −b [rotated]× = rotated × b.
        out[(row, pose)] = rotated.y * b[2] - rotated.z * b[1];
        out[(row, pose + 1)] = rotated.z * b[0] - rotated.x * b[2];
        out[(row, pose + 2)] = rotated.x * b[1] - rotated.y * b[0];
        for k in 0..3 {
            out[(row, pose + 3 + k)] = b[k];
            out[(row, point + k)] = b[0] * rotation[(0, k)] + b[1] * rotation[(1, k)] + b[2] * rotation[(2, k)];
        }
    }
}

impl Residual<2, 3, { 6 + INTRINSICS + 3 }> for ReprojectionResidual {
    const DIMS: [usize; 3] = [6, INTRINSICS, 3];

    #[inline]
    fn evaluate(
        &self,
        item: usize,
        [pose, intrinsics, point]: [&[f64]; 3],
        jacobian: Option<&mut SMatrix<f64, 2, { 6 + INTRINSICS + 3 }>>,
    ) -> Option<Vector2<f64>> {
        let camera = with_intrinsics(&self.cameras[self.camera_of[item] as usize], intrinsics);
        let local = CameraPoint::new(pose, point)?;
        let Some(out) = jacobian else { return Some(camera.denormalize(local.normalized) - self.pixels[item]) };
        let (d, j, by_parameters) = camera.distortion.distort_with_jacobians(local.normalized);
        write_motion(out, 0, 6 + INTRINSICS, &local.by_point(&camera, &j), &local);
        (out[(0, 6)], out[(1, 6)]) = (d.x, intrinsics[1] * d.y);
        out[(1, 7)] = intrinsics[0] * d.y;
        (out[(0, 8)], out[(1, 9)]) = (1.0, 1.0);
        for k in 0..DISTORTION_COEFFICIENTS {
            out[(0, 10 + k)] = camera.fx * by_parameters[(0, k)];
            out[(1, 10 + k)] = camera.fy * by_parameters[(1, k)];
        }
        Some(Point2::new(camera.fx * d.x + camera.cx, camera.fy * d.y + camera.cy) - self.pixels[item])
    }
}

/// Returns the intrinsic parameters of a camera.
fn intrinsics_of(camera: &Camera) -> [f64; INTRINSICS] {
    let mut intrinsics = [camera.fx, camera.fy / camera.fx, camera.cx, camera.cy, 0.0, 0.0, 0.0, 0.0];
    intrinsics[4..].iter_mut().zip(camera.distortion.parameters()).for_each(|(l, k)| *l = *k);
    intrinsics
}

/// Returns the camera with other intrinsics.
#[inline]
fn with_intrinsics(camera: &Camera, intrinsics: &[f64]) -> Camera {
    let mut out = Camera {
        fx: intrinsics[0],
        fy: intrinsics[0] * intrinsics[1],
        cx: intrinsics[2],
        cy: intrinsics[3],
        ..*camera
    };
    out.distortion.parameters_mut().iter_mut().zip(&intrinsics[4..]).for_each(|(k, l)| *k = *l);
    out
}

/// Returns which intrinsics are constant, and the prior of the others: the mean and the weight of each.
fn intrinsics_prior(
    camera: &Camera,
    knowledge: &CameraKnowledge,
    freedom: LensFreedom,
    noise: f64,
) -> ([bool; INTRINSICS], ([f64; INTRINSICS], [f64; INTRINSICS])) {
    let mut fixed = [true; INTRINSICS];
    let (mut mean, mut weight) = (intrinsics_of(camera), [0.0; INTRINSICS]);
    let half_diagonal = 0.5 * (camera.width as f64).hypot(camera.height as f64);
    let centered = Camera::from_focal(camera.width, camera.height, camera.fx);
    let focal_sigma = match *knowledge {
        CameraKnowledge::Known => None,
        CameraKnowledge::Matrix => Some(MATRIX_FOCAL_SIGMA * camera.fx),
        CameraKnowledge::Focal { deviation, focal } => {
            mean[0] = focal;
            Some(deviation * focal)
        }
        CameraKnowledge::Unknown => Some(FOCAL_SIGMA * camera.fx),
    };
    let Some(focal_sigma) = focal_sigma.filter(|_| freedom != LensFreedom::Fixed) else {
        return (fixed, (mean, weight));
    };
    (fixed[0], weight[0]) = (false, noise / focal_sigma);
    for k in 0..camera.distortion.parameters().len().min(DISTORTION_COEFFICIENTS) {
        // Displacement at the corner per unit of a radial coefficient: r^(2k+3) in normalized coordinates, of which one
        // r is that of the corner.
        let corner = (half_diagonal / camera.fx).powi(2 * k as i32 + 2);
        (fixed[4 + k], mean[4 + k], weight[4 + k]) = (false, 0.0, noise / (DISTORTION_SIGMA / corner));
    }
    if freedom == LensFreedom::PrincipalPoint {
        let sigma = PRINCIPAL_POINT_SIGMA * half_diagonal;
        (fixed[2], fixed[3]) = (false, false);
        (mean[2], mean[3]) = (centered.cx, centered.cy);
        (weight[2], weight[3]) = (noise / sigma, noise / sigma);
    }
    (fixed, (mean, weight))
}

/// Result of [`adjust`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct BundleOutcome {
    /// Number of linearizations.
    pub(crate) iterations: usize,
    /// Robust cost `Σ ρ(r²)`, in square pixels, before and after.
    pub(crate) cost: [f64; 2],
}

/// Minimizes the robust reprojection error over poses, points and intrinsics. Points without an observation in a free
/// view stay constant. Returns `None` where there is nothing to adjust.
///
/// # Errors
/// [`Cancelled`]; the scene is then as it was.
pub(crate) fn adjust(
    scene: &mut Scene<'_>,
    plan: &BundlePlan<'_>,
    progress: &dyn Progress,
) -> Result<Option<BundleOutcome>, Cancelled> {
    let stage = Stage::new(progress, "adjust", plan.max_iterations)?;
    let mut free = vec![plan.free.is_none(); scene.views.len()];
    plan.free.iter().flat_map(|list| list.iter()).for_each(|v| free[*v] = true);
    let loss = RobustLoss::Cauchy { scale: plan.scale };
    let Ok(mut problem) = Problem::new(scene, plan, &free, loss) else { return Ok(None) };
    let settings = AdjustOptions {
        max_iterations: plan.max_iterations,
        cost_tolerance: plan.tolerance,
        ..AdjustOptions::default()
    };
    let next = |_: &AdjustIteration| match stage.add(1) {
        Ok(()) => ControlFlow::Continue(()),
        Err(Cancelled) => ControlFlow::Break(()),
    };
    let Ok(report) = problem.adjustment.solve(&settings, next) else { return Ok(None) };
    stage.check()?;
    let Problem { adjustment, poses, points, lenses, views, tracks, .. } = problem;
    let adjusted: Vec<Pose> = adjustment
        .values(poses)
        .chunks_exact(12)
        .map(|x| {
            let (rotation, translation) = RigidMotion::load(x);
            Pose::new(rotation, translation)
        })
        .collect();
    let positions: Vec<f64> = adjustment.values(points).to_vec();
    let intrinsics = lenses.map(|l| adjustment.values(l).to_vec());
    drop(adjustment);
    for (view, pose) in views.iter().zip(adjusted) {
        scene.poses[*view] = Some(pose);
    }
    for (track, x) in tracks.iter().zip(positions.chunks_exact(3)) {
        scene.points[*track] = Some(Point3::new(x[0], x[1], x[2]));
    }
    if let Some(values) = intrinsics {
        for (camera, values) in scene.cameras.iter_mut().zip(values.chunks_exact(INTRINSICS)) {
            *camera = with_intrinsics(camera, values);
        }
        scene.cameras_changed();
    }
    Ok(Some(BundleOutcome { iterations: report.iterations, cost: [report.initial_cost, report.cost] }))
}

/// The least squares problem of a scene: reprojection errors over poses, points and intrinsics.
pub(crate) struct Problem<'a> {
    pub(crate) adjustment: Adjustment<'a>,
    pub(crate) poses: GroupId,
    pub(crate) points: GroupId,
    pub(crate) lenses: Option<GroupId>,
    /// View of each pose block.
    pub(crate) views: Vec<usize>,
    /// Track of each point block.
    pub(crate) tracks: Vec<usize>,
    /// Where all poses are free, the gauge: the view with the constant pose, and the view with the constant coordinate
    /// of the translation.
    pub(crate) reference: Option<[usize; 2]>,
}

impl Problem<'_> {
    pub(crate) fn new(
        scene: &Scene<'_>,
        plan: &BundlePlan<'_>,
        free: &[bool],
        loss: RobustLoss,
    ) -> Result<Problem<'static>, AdjustError> {
        let is_free = |t: &usize| {
            let mut active = scene.tracks.range(*t).filter(|i| scene.active[*i]);
            scene.points[*t].is_some() && active.any(|i| free[scene.view_of(i)])
        };
        let tracks: Vec<usize> = (0..scene.points.len()).filter(is_free).collect();
        let mut pose_index = vec![u32::MAX; scene.views.len()];
        let (mut views, mut blocks, mut camera_of, mut pixels) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let mut coordinates = Vec::with_capacity(3 * tracks.len());
        for (p, &track) in tracks.iter().enumerate() {
            let Some(point) = scene.points[track] else { continue };
            coordinates.extend_from_slice(point.coords.as_slice());
            for i in scene.tracks.range(track).filter(|i| scene.active[*i]) {
                let view = scene.view_of(i);
                // A point behind the camera has no residual.
                let is_in_front = scene.poses[view].is_some_and(|pose| pose.transform(&point).z > 0.0);
                if is_in_front {
                    if pose_index[view] == u32::MAX {
                        pose_index[view] = views.len() as u32;
                        views.push(view);
                    }
                    blocks.push([pose_index[view], p as u32]);
                    camera_of.push(scene.views[view].camera as u32);
                    pixels.push(scene.pixel(i));
                }
            }
        }
        let mut adjustment = Adjustment::default();
        let store = |v: &usize| scene.poses[*v].map_or([0.0; 12], |p| RigidMotion::store(&p.rotation, &p.translation));
        let poses = adjustment.add_group("poses", RigidMotion, views.iter().flat_map(store).collect())?;
        let points = adjustment.add_group("points", Euclidean(3), coordinates)?;
        adjustment.eliminate(points)?;
        let fixed: Vec<usize> = (0..views.len()).filter(|n| !free[views[*n]]).collect();
        for n in &fixed {
            adjustment.fix(poses, *n)?;
        }
        if plan.motion == Motion::Rotation {
            for n in 0..views.len() {
                adjustment.fix_parameters(poses, n, &[3, 4, 5])?;
            }
        }
        let mut reference = None;
        if fixed.is_empty() {
            reference = fix_gauge(scene, &mut adjustment, poses, &views)?;
        }
        let refinable = |c: &CameraKnowledge| *c != CameraKnowledge::Known;
        let mut lenses = None;
        if plan.lens == LensFreedom::Fixed || !scene.knowledge.iter().any(refinable) {
            let residual = ReprojectionResidual { cameras: scene.cameras.clone(), camera_of, pixels };
            adjustment.add_residuals("reprojection", residual, [poses, points], blocks, loss)?;
        } else {
            let values = scene.cameras.iter().flat_map(intrinsics_of).collect();
            let group = adjustment.add_group("lenses", Euclidean(INTRINSICS), values)?;
            let mut priors = Vec::new();
            for (c, (camera, knowledge)) in scene.cameras.iter().zip(scene.knowledge).enumerate() {
                let (fixed, prior) = intrinsics_prior(camera, knowledge, plan.lens, 0.5 * plan.scale);
                let fixed: Vec<usize> = (0..INTRINSICS).filter(|k| fixed[*k]).collect();
                adjustment.fix_parameters(group, c, &fixed)?;
                priors.push(prior);
            }
            let count = scene.cameras.len() as u32;
            let blocks = blocks.iter().zip(&camera_of).map(|(b, c)| [b[0], *c, b[1]]).collect();
            let residual = ReprojectionResidual { cameras: scene.cameras.clone(), camera_of, pixels };
            adjustment.add_residuals("reprojection", residual, [poses, group, points], blocks, loss)?;
            let items = (0..count).map(|c| [c]).collect();
            adjustment.add_residuals("lens", Prior { items: priors }, [group], items, RobustLoss::Trivial)?;
            lenses = Some(group);
        }
        Ok(Problem { adjustment, poses, points, lenses, views, tracks, reference })
    }
}

/// Fixes the gauge: the first pose, and of the pose farthest from it the coordinate of the translation with the largest
/// difference. Returns both views.
fn fix_gauge(
    scene: &Scene<'_>,
    adjustment: &mut Adjustment<'_>,
    poses: GroupId,
    views: &[usize],
) -> Result<Option<[usize; 2]>, AdjustError> {
    let pose_of = |n: usize| Some((n, scene.poses[*views.get(n)?]?));
    let Some((_, first)) = pose_of(0) else { return Ok(None) };
    adjustment.fix(poses, 0)?;
    let distance = |p: &Pose| (p.center() - first.center()).norm_squared();
    let others = (1..views.len()).filter_map(pose_of);
    let Some((n, farthest)) = others.max_by(|a, b| distance(&a.1).total_cmp(&distance(&b.1))) else { return Ok(None) };
    // Of t = −R c, the change with the distance from the first camera.
    let along = farthest.rotation * (farthest.center() - first.center());
    adjustment.fix_parameters(poses, n, &[3 + along.iamax()])?;
    Ok(Some([views[0], views[n]]))
}
