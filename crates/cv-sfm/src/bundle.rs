//! Bundle adjustment of many views.

use crate::CameraKnowledge;
use crate::scene::Scene;
use cv_core::{Camera, Cancelled, Point2, Point3, Pose, Progress, Stage, Vector3};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{
    AdjustError, AdjustIteration, AdjustOptions, Adjustment, Euclidean, GroupId, Prior, Residual, RigidMotion,
};
use nalgebra::{Matrix2, Matrix2x3, SMatrix, Vector2};
use std::ops::ControlFlow;

/// Numbers of a lens that may be refined: focal length, aspect ratio fy/fx, principal point, the first four of its distortion.
const LENS: usize = 8;
/// Parameters of distortion among them.
const DISTORTION: usize = 4;

/// How much of the lenses that are not known is refined; each step holds what comes later.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum LensFreedom {
    /// Nothing.
    Held,
    /// Focal length and distortion.
    Distortion,
    /// The principal point as well.
    Center,
}

/// What [`adjust`] may move, and for how long.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BundlePlan<'p> {
    /// Views whose poses are free; `None`: all that have one.
    pub(crate) free: Option<&'p [usize]>,
    pub(crate) lens: LensFreedom,
    /// Scale of Cauchy's loss, in pixels.
    pub(crate) scale: f64,
    pub(crate) max_iterations: usize,
    pub(crate) tolerance: f64,
}

/// Standard deviations of what is not known of a lens, before anything is seen: of distortion as the displacement of the corners, of the principal point as a share of half
/// the diagonal.
const DISTORTION_DEVIATION: f64 = 0.1;
const CENTER_DEVIATION: f64 = 0.02;
/// And of a focal length of which nothing is known, as a factor's logarithm.
const FOCAL_DEVIATION: f64 = 0.5;

/// And of a calibration matrix that came without its lens.
const MATRIX_DEVIATION: f64 = 0.02;

/// Observations. Of pose and point, their cameras are not changed; of pose, lens and point, they are.
struct Observed {
    cameras: Vec<Camera>,
    camera_of: Vec<u32>,
    pixels: Vec<Point2<f64>>,
}

/// A point in the frame of a camera.
struct Moved {
    rotation: cv_core::Rotation3<f64>,
    /// Turned, but not moved yet.
    turned: Vector3<f64>,
    inverse_depth: f64,
    /// In normalized coordinates.
    ideal: Point2<f64>,
}

impl Moved {
    /// `None` behind the camera.
    #[inline]
    fn new(pose: &[f64], point: &[f64]) -> Option<Self> {
        let (rotation, translation) = RigidMotion::load(pose);
        let turned = rotation * Vector3::from_column_slice(point);
        let p = turned + translation;
        if p.z <= 0.0 || p.z.is_nan() {
            return None;
        }
        let inverse_depth = 1.0 / p.z;
        Some(Self { rotation, turned, inverse_depth, ideal: Point2::new(p.x * inverse_depth, p.y * inverse_depth) })
    }

    /// The derivatives of a pixel by the point in the camera's frame, of those of the lens by normalized coordinates.
    #[inline]
    fn by_point(&self, camera: &Camera, by_ideal: &Matrix2<f64>) -> Matrix2x3<f64> {
        let (fx, fy) = (camera.fx * self.inverse_depth, camera.fy * self.inverse_depth);
        let ray = Matrix2x3::new(1.0, 0.0, -self.ideal.x, 0.0, 1.0, -self.ideal.y);
        Matrix2::new(fx, 0.0, 0.0, fy) * by_ideal * ray
    }
}

impl Residual<2, 2, 9> for Observed {
    const DIMS: [usize; 2] = [6, 3];

    #[inline]
    fn evaluate(
        &self,
        item: usize,
        [pose, point]: [&[f64]; 2],
        jacobian: Option<&mut SMatrix<f64, 2, 9>>,
    ) -> Option<Vector2<f64>> {
        let camera = &self.cameras[self.camera_of[item] as usize];
        let moved = Moved::new(pose, point)?;
        let Some(out) = jacobian else { return Some(camera.denormalize(moved.ideal) - self.pixels[item]) };
        let (d, j) = camera.distortion.distort_with_jacobian(moved.ideal);
        write_motion(out, 0, 6, &moved.by_point(camera, &j), &moved);
        Some(Point2::new(camera.fx * d.x + camera.cx, camera.fy * d.y + camera.cy) - self.pixels[item])
    }
}

/// The derivatives by pose (rotation, translation; from column `pose`) and point (from column `point`).
#[inline]
fn write_motion<const C: usize>(
    out: &mut SMatrix<f64, 2, C>,
    pose: usize,
    point: usize,
    by_p: &Matrix2x3<f64>,
    moved: &Moved,
) {
    let (turned, rotation) = (&moved.turned, moved.rotation.matrix());
    for row in 0..2 {
        let b = [by_p[(row, 0)], by_p[(row, 1)], by_p[(row, 2)]];
        // −b [turned]× = turned × b.
        out[(row, pose)] = turned.y * b[2] - turned.z * b[1];
        out[(row, pose + 1)] = turned.z * b[0] - turned.x * b[2];
        out[(row, pose + 2)] = turned.x * b[1] - turned.y * b[0];
        for k in 0..3 {
            out[(row, pose + 3 + k)] = b[k];
            out[(row, point + k)] = b[0] * rotation[(0, k)] + b[1] * rotation[(1, k)] + b[2] * rotation[(2, k)];
        }
    }
}

impl Residual<2, 3, { 6 + LENS + 3 }> for Observed {
    const DIMS: [usize; 3] = [6, LENS, 3];

    #[inline]
    fn evaluate(
        &self,
        item: usize,
        [pose, lens, point]: [&[f64]; 3],
        jacobian: Option<&mut SMatrix<f64, 2, { 6 + LENS + 3 }>>,
    ) -> Option<Vector2<f64>> {
        let camera = with_lens(&self.cameras[self.camera_of[item] as usize], lens);
        let moved = Moved::new(pose, point)?;
        let Some(out) = jacobian else { return Some(camera.denormalize(moved.ideal) - self.pixels[item]) };
        let (d, j, by_parameters) = camera.distortion.distort_with_jacobians(moved.ideal);
        write_motion(out, 0, 6 + LENS, &moved.by_point(&camera, &j), &moved);
        (out[(0, 6)], out[(1, 6)]) = (d.x, lens[1] * d.y);
        out[(1, 7)] = lens[0] * d.y;
        (out[(0, 8)], out[(1, 9)]) = (1.0, 1.0);
        for k in 0..DISTORTION {
            out[(0, 10 + k)] = camera.fx * by_parameters[(0, k)];
            out[(1, 10 + k)] = camera.fy * by_parameters[(1, k)];
        }
        Some(Point2::new(camera.fx * d.x + camera.cx, camera.fy * d.y + camera.cy) - self.pixels[item])
    }
}

/// The numbers of a lens.
fn lens_of(camera: &Camera) -> [f64; LENS] {
    let mut lens = [camera.fx, camera.fy / camera.fx, camera.cx, camera.cy, 0.0, 0.0, 0.0, 0.0];
    lens[4..].iter_mut().zip(camera.distortion.parameters()).for_each(|(l, k)| *l = *k);
    lens
}

/// The camera with other numbers.
#[inline]
fn with_lens(camera: &Camera, lens: &[f64]) -> Camera {
    let mut out = Camera { fx: lens[0], fy: lens[0] * lens[1], cx: lens[2], cy: lens[3], ..*camera };
    out.distortion.parameters_mut().iter_mut().zip(&lens[4..]).for_each(|(k, l)| *k = *l);
    out
}

/// Which numbers of a lens are held, and what is known of the others: the mean and the weight of each.
fn lens_prior(
    camera: &Camera,
    knowledge: &CameraKnowledge,
    freedom: LensFreedom,
    noise: f64,
) -> ([bool; LENS], ([f64; LENS], [f64; LENS])) {
    let mut held = [true; LENS];
    let (mut mean, mut weight) = (lens_of(camera), [0.0; LENS]);
    let half = 0.5 * (camera.width as f64).hypot(camera.height as f64);
    let middle = Camera::from_focal(camera.width, camera.height, camera.fx);
    let deviation = match *knowledge {
        CameraKnowledge::Known => None,
        CameraKnowledge::Matrix => Some(MATRIX_DEVIATION * camera.fx),
        CameraKnowledge::Focal { deviation, focal } => {
            mean[0] = focal;
            Some(deviation * focal)
        }
        CameraKnowledge::Unknown => Some(FOCAL_DEVIATION * camera.fx),
    };
    let Some(focal_deviation) = deviation.filter(|_| freedom != LensFreedom::Held) else {
        return (held, (mean, weight));
    };
    (held[0], weight[0]) = (false, noise / focal_deviation);
    for k in 0..camera.distortion.parameters().len().min(DISTORTION) {
        // The displacement of the corner by a parameter of radial distortion, r^(2k+3) of it in normalized coordinates.
        let corner = (half / camera.fx).powi(2 * k as i32 + 2);
        (held[4 + k], mean[4 + k], weight[4 + k]) = (false, 0.0, noise / (DISTORTION_DEVIATION / corner));
    }
    if freedom == LensFreedom::Center {
        let center_deviation = CENTER_DEVIATION * half;
        (held[2], held[3]) = (false, false);
        (mean[2], mean[3]) = (middle.cx, middle.cy);
        (weight[2], weight[3]) = (noise / center_deviation, noise / center_deviation);
    }
    (held, (mean, weight))
}

/// What [`adjust`] did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct BundleOutcome {
    /// Linearizations.
    pub(crate) iterations: usize,
    /// `Σ ρ(r²)` in square pixels at the start and at the end.
    pub(crate) cost: [f64; 2],
}

/// Moves poses, points and lenses to the least robust reprojection error. Points with no observation in a free view stay. `None` where there is nothing to adjust.
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
    let moved: Vec<Pose> = adjustment
        .values(poses)
        .chunks_exact(12)
        .map(|x| {
            let (rotation, translation) = RigidMotion::load(x);
            Pose::new(rotation, translation)
        })
        .collect();
    let positions: Vec<f64> = adjustment.values(points).to_vec();
    let lens_values = lenses.map(|l| adjustment.values(l).to_vec());
    drop(adjustment);
    for (view, pose) in views.iter().zip(moved) {
        scene.poses[*view] = Some(pose);
    }
    for (track, x) in tracks.iter().zip(positions.chunks_exact(3)) {
        scene.points[*track] = Some(Point3::new(x[0], x[1], x[2]));
    }
    if let Some(values) = lens_values {
        for (camera, lens) in scene.cameras.iter_mut().zip(values.chunks_exact(LENS)) {
            *camera = with_lens(camera, lens);
        }
        scene.cameras_changed();
    }
    Ok(Some(BundleOutcome { iterations: report.iterations, cost: [report.initial_cost, report.cost] }))
}

/// Reprojection errors of a scene over its poses, points and lenses.
pub(crate) struct Problem<'a> {
    pub(crate) adjustment: Adjustment<'a>,
    pub(crate) poses: GroupId,
    pub(crate) points: GroupId,
    lenses: Option<GroupId>,
    /// The view of each pose, the track of each point.
    pub(crate) views: Vec<usize>,
    pub(crate) tracks: Vec<usize>,
    /// Where all poses are free: the view whose own is held, and that whose distance from it is.
    pub(crate) reference: Option<[usize; 2]>,
}

impl Problem<'_> {
    pub(crate) fn new(
        scene: &Scene<'_>,
        plan: &BundlePlan<'_>,
        free: &[bool],
        loss: RobustLoss,
    ) -> Result<Problem<'static>, AdjustError> {
        let chosen = |t: &usize| {
            let mut active = scene.tracks.range(*t).filter(|i| scene.active[*i]);
            scene.points[*t].is_some() && active.any(|i| free[scene.view_of(i)])
        };
        let tracks: Vec<usize> = (0..scene.points.len()).filter(chosen).collect();
        let mut number = vec![u32::MAX; scene.views.len()];
        let (mut views, mut blocks, mut camera_of, mut pixels) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        let mut coordinates = Vec::with_capacity(3 * tracks.len());
        for (p, &track) in tracks.iter().enumerate() {
            let Some(point) = scene.points[track] else { continue };
            coordinates.extend_from_slice(point.coords.as_slice());
            for i in scene.tracks.range(track).filter(|i| scene.active[*i]) {
                let view = scene.view_of(i);
                // What is behind its camera has no residual.
                let front = scene.poses[view].is_some_and(|pose| pose.transform(&point).z > 0.0);
                if front {
                    if number[view] == u32::MAX {
                        number[view] = views.len() as u32;
                        views.push(view);
                    }
                    blocks.push([number[view], p as u32]);
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
        let held: Vec<usize> = (0..views.len()).filter(|n| !free[views[*n]]).collect();
        for n in &held {
            adjustment.fix(poses, *n)?;
        }
        let mut reference = None;
        if held.is_empty() {
            reference = hold_gauge(scene, &mut adjustment, poses, &views)?;
        }
        let refinable = |c: &CameraKnowledge| *c != CameraKnowledge::Known;
        let mut lenses = None;
        if plan.lens == LensFreedom::Held || !scene.knowledge.iter().any(refinable) {
            let residual = Observed { cameras: scene.cameras.clone(), camera_of, pixels };
            adjustment.add_residuals("reprojection", residual, [poses, points], blocks, loss)?;
        } else {
            let values = scene.cameras.iter().flat_map(lens_of).collect();
            let group = adjustment.add_group("lenses", Euclidean(LENS), values)?;
            let mut prior = Vec::new();
            for (c, (camera, knowledge)) in scene.cameras.iter().zip(scene.knowledge).enumerate() {
                let (held, items) = lens_prior(camera, knowledge, plan.lens, 0.5 * plan.scale);
                let held: Vec<usize> = (0..LENS).filter(|k| held[*k]).collect();
                adjustment.fix_parameters(group, c, &held)?;
                prior.push(items);
            }
            let count = scene.cameras.len() as u32;
            let blocks = blocks.iter().zip(&camera_of).map(|(b, c)| [b[0], *c, b[1]]).collect();
            let residual = Observed { cameras: scene.cameras.clone(), camera_of, pixels };
            adjustment.add_residuals("reprojection", residual, [poses, group, points], blocks, loss)?;
            let items = (0..count).map(|c| [c]).collect();
            adjustment.add_residuals("lens", Prior { items: prior }, [group], items, RobustLoss::Trivial)?;
            lenses = Some(group);
        }
        Ok(Problem { adjustment, poses, points, lenses, views, tracks, reference })
    }
}

/// Holds the first pose, and of the one farthest from it (both are given back) the coordinate of the translation in which it is farthest: position, turn and scale of the world.
fn hold_gauge(
    scene: &Scene<'_>,
    adjustment: &mut Adjustment<'_>,
    poses: GroupId,
    views: &[usize],
) -> Result<Option<[usize; 2]>, AdjustError> {
    let posed = |n: usize| Some((n, scene.poses[*views.get(n)?]?));
    let Some((_, first)) = posed(0) else { return Ok(None) };
    adjustment.fix(poses, 0)?;
    let apart = |p: &Pose| (p.center() - first.center()).norm_squared();
    let others = (1..views.len()).filter_map(posed);
    let Some((n, far)) = others.max_by(|a, b| apart(&a.1).total_cmp(&apart(&b.1))) else { return Ok(None) };
    // Of t = −R c, what changes with the distance from the first camera.
    let along = far.rotation * (far.center() - first.center());
    adjustment.fix_parameters(poses, n, &[3 + along.iamax()])?;
    Ok(Some([views[0], views[n]]))
}
