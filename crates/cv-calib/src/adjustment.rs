//! The joint adjustment: intrinsics, rig poses, target poses and the target's shape minimize the reprojection error.

use crate::CalibrateError;
use crate::corner_residual::{Corner, FirstCameraResidual, RigCameraResidual};
use crate::target::TargetObservations;
use cv_core::{Camera, Cancelled, DistortionModel, MAX_INTRINSICS, Pose, Progress, Vector2};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{
    AdjustError, AdjustIteration, AdjustOptions, Adjustment, Euclidean, GroupId, Prior, RigidMotion,
};
use nalgebra::DMatrix;
use std::ops::ControlFlow;

/// The parameters of a calibration.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Estimate {
    pub(crate) cameras: Vec<Camera>,
    /// Pose of each camera in the rig: first camera's frame to its own. The first is the identity.
    pub(crate) rig_poses: Vec<Pose>,
    /// Pose of the target in each view: target frame to first camera's frame. `None` where it is unknown.
    pub(crate) poses: Vec<Option<Pose>>,
    /// Deflections of the target (see [`TargetPoints::bent`](crate::TargetPoints::bent)).
    pub(crate) shape: [f64; 2],
}

impl Estimate {
    /// Returns the estimate of some of its views.
    pub(crate) fn subset(&self, views: &[usize]) -> Self {
        Self { poses: views.iter().map(|v| self.poses[*v]).collect(), ..self.clone() }
    }

    /// Returns the reprojection residuals of the corners in pixels (projected minus detected); `None` in a view without
    /// a pose or for a point that does not project.
    pub(crate) fn residuals(&self, data: &TargetObservations, view: usize, camera: usize) -> Vec<Option<Vector2<f64>>> {
        let corners = &data.views[view][camera];
        let Some(pose) = self.poses[view] else { return vec![None; corners.len()] };
        let pose = self.rig_poses[camera].compose(&pose);
        let lens = &self.cameras[camera];
        corners
            .iter()
            .map(|c| Some(lens.project(&pose.transform(&data.target.bent(c.point, self.shape)))? - c.pixel))
            .collect()
    }
}

/// Inlier mask of the corners, by view, camera and corner.
pub(crate) type InlierMask = Vec<Vec<Vec<bool>>>;

/// Which parameters are free, besides the target poses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct FreeParameters {
    /// Free intrinsics: fx, fy, cx, cy and the distortion coefficients.
    pub(crate) intrinsics: FreeIntrinsics,
    pub(crate) rig_poses: bool,
    pub(crate) shape: bool,
}

/// Which intrinsics are free.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FreeIntrinsics {
    None,
    /// Focal lengths and the first two distortion coefficients.
    Coarse,
    All,
}

impl FreeParameters {
    pub(crate) const ALL: Self = Self { intrinsics: FreeIntrinsics::All, rig_poses: true, shape: true };
    pub(crate) const POSES: Self = Self { intrinsics: FreeIntrinsics::None, rig_poses: false, shape: false };
}

/// The least squares problem. All corners have unit weight, residuals are in pixels.
pub(crate) struct Problem<'a> {
    pub(crate) adjustment: Adjustment<'a>,
    lenses: Vec<GroupId>,
    rig_poses: GroupId,
    shape: GroupId,
    poses: GroupId,
    /// Number of residuals of corners.
    residual_count: usize,
    /// Number of fitted parameters.
    parameter_count: usize,
    /// Number of cameras: the first residual blocks are their corners, then come the priors.
    cameras: usize,
}

/// Prior standard deviation of the distortion of a rational model, as a factor on the radius at the image corner (or at
/// 45°, if that is closer), at a corner noise of [`PRIOR_NOISE_PX`]. Numerator and denominator are correlated,
/// perfectly so without distortion: the prior regularizes them.
const PRIOR_SIGMA: f64 = 5.0;
/// Corner noise that the prior is relative to, in pixels.
const PRIOR_NOISE_PX: f64 = 0.1;
/// Number of corners from which on the prior's weight grows with the number of corners, to stay above rounding errors.
const PRIOR_MIN_CORNERS: f64 = 1000.0;

/// Returns the prior weights on the intrinsics of a camera; `None` for models that need no prior.
fn prior_weights<const N: usize>(camera: &Camera, corners: usize) -> Option<[f64; N]> {
    let names = camera.distortion.model().info().parameters;
    if !names.contains(&"k6") {
        return None;
    }
    let half_diagonal = 0.5 * (camera.width as f64).hypot(camera.height as f64);
    let squared = (half_diagonal / camera.fx.min(camera.fy)).min(1.0).powi(2);
    let scale = (corners as f64 / PRIOR_MIN_CORNERS).max(1.0).sqrt();
    let mut weights = [0.0; N];
    for (weight, name) in weights[4..].iter_mut().zip(names) {
        let power = match *name {
            "k1" | "k4" => 1,
            "k2" | "k5" => 2,
            "k3" | "k6" => 3,
            _ => continue,
        };
        *weight = scale * PRIOR_NOISE_PX / PRIOR_SIGMA * squared.powi(power);
    }
    Some(weights)
}

impl Problem<'_> {
    pub(crate) fn new(
        data: &TargetObservations,
        estimate: &Estimate,
        used: &InlierMask,
        free: FreeParameters,
        loss: RobustLoss,
    ) -> Result<Self, AdjustError> {
        let mut adjustment = Adjustment::default();
        let store = |p: &Pose| RigidMotion::store(&p.rotation, &p.translation);
        let poses = estimate.poses.iter().flat_map(|p| store(&p.unwrap_or(Pose::identity()))).collect();
        let poses = adjustment.add_group("pose", RigidMotion, poses)?;
        let rig_poses =
            adjustment.add_group("rig_pose", RigidMotion, estimate.rig_poses.iter().flat_map(store).collect())?;
        let shape = adjustment.add_group("shape", Euclidean(2), estimate.shape.to_vec())?;
        adjustment.eliminate(poses)?;
        let mut lenses = Vec::with_capacity(estimate.cameras.len());
        let (mut residual_count, mut parameter_count) = (0, if free.shape { 2 } else { 0 });
        let is_observed = |v: &usize| estimate.poses[*v].is_some() && used[*v].iter().flatten().any(|u| *u);
        parameter_count += 6 * (0..data.views.len()).filter(is_observed).count();
        for (c, camera) in estimate.cameras.iter().enumerate() {
            let count = camera.intrinsic_count();
            let lens = adjustment.add_group("lens", Euclidean(count), camera.intrinsics()[..count].to_vec())?;
            match free.intrinsics {
                FreeIntrinsics::All => {}
                FreeIntrinsics::None => adjustment.fix(lens, 0)?,
                FreeIntrinsics::Coarse => {
                    let constant: Vec<usize> = [2, 3].into_iter().chain(6..count).collect();
                    adjustment.fix_parameters(lens, 0, &constant)?;
                }
            }
            parameter_count += match free.intrinsics {
                FreeIntrinsics::All => count,
                FreeIntrinsics::None => 0,
                FreeIntrinsics::Coarse => 4,
            };
            if c == 0 || !free.rig_poses {
                adjustment.fix(rig_poses, c)?;
            } else {
                parameter_count += 6;
            }
            lenses.push(lens);
            let (mut items, mut views) = (Vec::new(), Vec::new());
            for (v, cameras) in data.views.iter().enumerate().filter(|(v, _)| estimate.poses[*v].is_some()) {
                for (corner, _) in cameras[c].iter().zip(&used[v][c]).filter(|(_, used)| **used) {
                    items.push(Corner::new(&data.target, corner));
                    views.push(v as u32);
                }
            }
            residual_count += 2 * items.len();
            let groups = Groups { poses, rig_poses, lens, shape };
            match count {
                8 => add_corners::<8, 16, 22>(&mut adjustment, *camera, c, items, &views, groups, loss)?,
                9 => add_corners::<9, 17, 23>(&mut adjustment, *camera, c, items, &views, groups, loss)?,
                12 => add_corners::<12, 20, 26>(&mut adjustment, *camera, c, items, &views, groups, loss)?,
                16 => add_corners::<16, 24, 30>(&mut adjustment, *camera, c, items, &views, groups, loss)?,
                got => return Err(AdjustError::Size { group: "lens".to_owned(), got, most: MAX_INTRINSICS }),
            }
        }
        for (camera, lens) in estimate.cameras.iter().zip(&lenses) {
            match camera.intrinsic_count() {
                12 => add_prior::<12>(&mut adjustment, camera, *lens, residual_count / 2)?,
                16 => add_prior::<16>(&mut adjustment, camera, *lens, residual_count / 2)?,
                _ => {}
            }
        }
        if !free.shape {
            adjustment.fix(shape, 0)?;
        }
        Ok(Self {
            adjustment,
            lenses,
            rig_poses,
            shape,
            poses,
            residual_count,
            parameter_count,
            cameras: estimate.cameras.len(),
        })
    }

    /// Stores the adjusted parameters in an estimate.
    fn store_to(&self, estimate: &mut Estimate) {
        let load = |x: &[f64]| {
            let (rotation, translation) = RigidMotion::load(x);
            Pose::new(rotation, translation)
        };
        for (camera, lens) in estimate.cameras.iter_mut().zip(&self.lenses) {
            let mut values = [0.0; MAX_INTRINSICS];
            let adjusted = self.adjustment.values(*lens);
            values[..adjusted.len()].copy_from_slice(adjusted);
            *camera = camera.with_intrinsics(&values);
        }
        let rig_poses = self.adjustment.values(self.rig_poses).chunks_exact(12);
        estimate.rig_poses.iter_mut().zip(rig_poses).skip(1).for_each(|(m, x)| *m = load(x));
        let poses = self.adjustment.values(self.poses).chunks_exact(12);
        for (pose, x) in estimate.poses.iter_mut().zip(poses).filter(|(pose, _)| pose.is_some()) {
            *pose = Some(load(x));
        }
        estimate.shape.copy_from_slice(self.adjustment.values(self.shape));
    }

    /// Returns the covariance of all intrinsics, then the rig poses but the first, then the shape, for the noise
    /// estimated from the residuals; and the variance of that noise, in square pixels of a coordinate.
    pub(crate) fn covariance(&self) -> Result<(DMatrix<f64>, f64), AdjustError> {
        let sums = self.adjustment.residual_sums()?;
        let sum_of_squares: f64 = sums.iter().take(self.cameras).map(|s| s.weighted_squares).sum();
        let variance = sum_of_squares / self.residual_count.saturating_sub(self.parameter_count).max(1) as f64;
        // For exact corners only rounding is left; the structure of the covariance is still useful.
        let covariance = self.adjustment.covariance(variance.max(f64::MIN_POSITIVE))?;
        let blocks: Vec<(GroupId, usize)> = self
            .lenses
            .iter()
            .map(|l| (*l, 0))
            .chain((1..self.lenses.len()).map(|m| (self.rig_poses, m)))
            .chain([(self.shape, 0)])
            .collect();
        let mut parts = Vec::with_capacity(blocks.len());
        for a in &blocks {
            parts.push(blocks.iter().map(|b| covariance.between(*a, *b)).collect::<Result<Vec<_>, _>>()?);
        }
        let sizes: Vec<usize> = (0..blocks.len()).map(|b| parts[b][b].nrows()).collect();
        let n = sizes.iter().sum();
        let mut all = DMatrix::zeros(n, n);
        let mut row = 0;
        for (a, height) in sizes.iter().enumerate() {
            let mut column = 0;
            for (b, width) in sizes.iter().enumerate() {
                all.view_mut((row, column), (*height, *width)).copy_from(&parts[a][b]);
                column += width;
            }
            row += height;
        }
        // Symmetrized against rounding.
        Ok(((&all + all.transpose()) * 0.5, variance))
    }
}

#[derive(Clone, Copy)]
struct Groups {
    poses: GroupId,
    rig_poses: GroupId,
    lens: GroupId,
    shape: GroupId,
}

/// Adds the residuals of a camera's corners. The first camera has no rig pose.
fn add_corners<const N: usize, const FIRST_DIMS: usize, const RIG_DIMS: usize>(
    adjustment: &mut Adjustment<'_>,
    camera: Camera,
    index: usize,
    items: Vec<Corner>,
    views: &[u32],
    groups: Groups,
    loss: RobustLoss,
) -> Result<(), AdjustError> {
    let Groups { poses, rig_poses, lens, shape } = groups;
    if index == 0 {
        let blocks = views.iter().map(|v| [*v, 0, 0]).collect();
        let residual = FirstCameraResidual::<N, FIRST_DIMS> { camera, items };
        adjustment.add_residuals("corner", residual, [poses, lens, shape], blocks, loss)
    } else {
        let blocks = views.iter().map(|v| [*v, index as u32, 0, 0]).collect();
        let residual = RigCameraResidual::<N, RIG_DIMS> { camera, items };
        adjustment.add_residuals("corner", residual, [poses, rig_poses, lens, shape], blocks, loss)
    }
}

/// Adds the prior on a camera's intrinsics, if it needs one.
fn add_prior<const N: usize>(
    adjustment: &mut Adjustment<'_>,
    camera: &Camera,
    lens: GroupId,
    corners: usize,
) -> Result<(), AdjustError> {
    let Some(weights) = prior_weights::<N>(camera, corners) else { return Ok(()) };
    adjustment.add_residuals(
        "prior",
        Prior { items: vec![([0.0; N], weights)] },
        [lens],
        vec![[0]],
        RobustLoss::Trivial,
    )
}

/// Checks that a distortion model can be adjusted.
pub(crate) fn check_adjustable(model: DistortionModel) -> Result<(), CalibrateError> {
    if [4, 5, 8, 12].contains(&model.parameter_count()) { Ok(()) } else { Err(CalibrateError::Lens { model }) }
}

/// Why an adjustment failed.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Failure {
    Cancelled,
    /// The parameters are not determined by the residuals, or there are no initial values.
    Adjust(AdjustError),
}

impl From<Cancelled> for Failure {
    fn from(_: Cancelled) -> Self {
        Self::Cancelled
    }
}

impl From<AdjustError> for Failure {
    fn from(error: AdjustError) -> Self {
        Self::Adjust(error)
    }
}

/// Initial damping of the least squares stage, which starts from the result of the robust one: the default would delay
/// weakly determined parameters, such as focal length against distance, for some steps.
const REFINEMENT_DAMPING: f64 = 1e-7;
/// Maximum number of distortion coefficients with that damping. Those of a rational model are correlated and diverge
/// without the default damping.
const REFINEMENT_MAX_COEFFICIENTS: usize = 5;

/// Adjusts an estimate; the cost never increases. Returns the root mean cost of a corner, in pixels.
pub(crate) fn adjust(
    data: &TargetObservations,
    estimate: &mut Estimate,
    used: &InlierMask,
    (free, loss): (FreeParameters, RobustLoss),
    (max_iterations, cost_tolerance): (usize, f64),
    progress: &dyn Progress,
) -> Result<f64, Failure> {
    let mut problem = Problem::new(data, estimate, used, free, loss)?;
    let mut options = AdjustOptions { max_iterations, cost_tolerance, ..AdjustOptions::default() };
    if loss == RobustLoss::Trivial
        && estimate.cameras.iter().all(|c| c.distortion.parameters().len() <= REFINEMENT_MAX_COEFFICIENTS)
    {
        options.initial_damping = REFINEMENT_DAMPING;
    }
    let mut progress_result = Ok(());
    let next = |_: &AdjustIteration| {
        progress_result = progress.report("adjust", 0, 0);
        if progress_result.is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    };
    let report = problem.adjustment.solve(&options, next)?;
    progress_result?;
    problem.store_to(estimate);
    Ok((report.cost / (problem.residual_count.max(2) as f64 / 2.0)).sqrt())
}
