//! The adjustment of lenses, mounts of cameras, poses and the target's shape to the least reprojection error.

use crate::CalibrateError;
use crate::corner_residual::{Corner, FromMount, FromReference};
use crate::target::Sightings;
use cv_core::{Camera, Cancelled, DistortionModel, MAX_INTRINSICS, Pose, Progress, Vector2};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{
    AdjustError, AdjustIteration, AdjustOptions, Adjustment, Euclidean, GroupId, Prior, RigidMotion,
};
use nalgebra::DMatrix;
use std::ops::ControlFlow;

/// Everything that is adjusted.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Estimate {
    pub(crate) cameras: Vec<Camera>,
    /// Takes the first camera's frame to each camera's; the first is the identity.
    pub(crate) mounts: Vec<Pose>,
    /// Of each view: takes the target's frame to the first camera's. `None` where nothing is known of it.
    pub(crate) poses: Vec<Option<Pose>>,
    pub(crate) shape: [f64; 2],
}

impl Estimate {
    /// The same with only some of its views.
    pub(crate) fn subset(&self, views: &[usize]) -> Self {
        Self { poses: views.iter().map(|v| self.poses[*v]).collect(), ..self.clone() }
    }

    /// Where a corner is against where it should be, in pixels; `None` where the view has no pose or the point is behind the camera.
    pub(crate) fn residuals(&self, data: &Sightings, view: usize, camera: usize) -> Vec<Option<Vector2<f64>>> {
        let corners = &data.views[view][camera];
        let Some(pose) = self.poses[view] else { return vec![None; corners.len()] };
        let pose = self.mounts[camera].compose(&pose);
        let lens = &self.cameras[camera];
        corners
            .iter()
            .map(|c| Some(lens.project(&pose.transform(&data.target.bent(c.point, self.shape)))? - c.pixel))
            .collect()
    }
}

/// Which corners count, by view, camera and corner.
pub(crate) type Used = Vec<Vec<Vec<bool>>>;

/// What may change beside the poses of the views.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Free {
    /// How many of the lens's intrinsics: fx, fy, cx, cy, then distortion. See [`Free::held`].
    pub(crate) lenses: Lenses,
    pub(crate) mounts: bool,
    pub(crate) shape: bool,
}

/// What of the lenses may change.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Lenses {
    Nothing,
    /// Focal lengths and the first two parameters of the distortion.
    Coarse,
    All,
}

impl Free {
    pub(crate) const ALL: Self = Self { lenses: Lenses::All, mounts: true, shape: true };
    pub(crate) const POSES: Self = Self { lenses: Lenses::Nothing, mounts: false, shape: false };
}

/// Corners weigh alike: residuals in pixels.
pub(crate) struct Problem<'a> {
    pub(crate) adjustment: Adjustment<'a>,
    lenses: Vec<GroupId>,
    mounts: GroupId,
    shape: GroupId,
    poses: GroupId,
    /// Numbers of residuals of corners, and what is fitted to them.
    numbers: usize,
    fitted: usize,
    /// Kinds of residuals that are corners; priors come after them.
    cameras: usize,
}

/// The denominator of a rational lens and its numerator make up for each other, entirely so where there is no distortion. So the distortion of such lenses is a
/// little drawn to zero: its effect where the picture ends (or at 45°, if that is nearer) has this standard deviation beforehand, as a factor on the radius,
/// where a corner has one of [`PRIOR_NOISE`].
const PRIOR: f64 = 5.0;
/// Pixels.
const PRIOR_NOISE: f64 = 0.1;
/// The prior weighs as if there were no more corners than so many, that it stays above rounding.
const PRIOR_CORNERS: f64 = 1000.0;

/// Weights of the prior on the intrinsics of a camera; `None` where the model needs none.
fn prior_weights<const N: usize>(camera: &Camera, corners: usize) -> Option<[f64; N]> {
    let names = camera.distortion.model().info().parameters;
    if !names.contains(&"k6") {
        return None;
    }
    let half = 0.5 * (camera.width as f64).hypot(camera.height as f64);
    let squared = (half / camera.fx.min(camera.fy)).min(1.0).powi(2);
    let more = (corners as f64 / PRIOR_CORNERS).max(1.0).sqrt();
    let mut weights = [0.0; N];
    for (weight, name) in weights[4..].iter_mut().zip(names) {
        let power = match *name {
            "k1" | "k4" => 1,
            "k2" | "k5" => 2,
            "k3" | "k6" => 3,
            _ => continue,
        };
        *weight = more * PRIOR_NOISE / PRIOR * squared.powi(power);
    }
    Some(weights)
}

impl Problem<'_> {
    pub(crate) fn new(
        data: &Sightings,
        estimate: &Estimate,
        used: &Used,
        free: Free,
        loss: RobustLoss,
    ) -> Result<Self, AdjustError> {
        let mut adjustment = Adjustment::default();
        let store = |p: &Pose| RigidMotion::store(&p.rotation, &p.translation);
        let poses = estimate.poses.iter().flat_map(|p| store(&p.unwrap_or(Pose::identity()))).collect();
        let poses = adjustment.add_group("pose", RigidMotion, poses)?;
        let mounts = adjustment.add_group("mount", RigidMotion, estimate.mounts.iter().flat_map(store).collect())?;
        let shape = adjustment.add_group("shape", Euclidean(2), estimate.shape.to_vec())?;
        adjustment.eliminate(poses)?;
        let mut lenses = Vec::with_capacity(estimate.cameras.len());
        let (mut numbers, mut fitted) = (0, if free.shape { 2 } else { 0 });
        let seen = |v: &usize| estimate.poses[*v].is_some() && used[*v].iter().flatten().any(|u| *u);
        fitted += 6 * (0..data.views.len()).filter(seen).count();
        for (c, camera) in estimate.cameras.iter().enumerate() {
            let count = camera.intrinsic_count();
            let lens = adjustment.add_group("lens", Euclidean(count), camera.intrinsics()[..count].to_vec())?;
            match free.lenses {
                Lenses::All => {}
                Lenses::Nothing => adjustment.fix(lens, 0)?,
                Lenses::Coarse => {
                    let held: Vec<usize> = [2, 3].into_iter().chain(6..count).collect();
                    adjustment.fix_parameters(lens, 0, &held)?;
                }
            }
            fitted += match free.lenses {
                Lenses::All => count,
                Lenses::Nothing => 0,
                Lenses::Coarse => 4,
            };
            if c == 0 || !free.mounts {
                adjustment.fix(mounts, c)?;
            } else {
                fitted += 6;
            }
            lenses.push(lens);
            let (mut items, mut views) = (Vec::new(), Vec::new());
            for (v, cameras) in data.views.iter().enumerate().filter(|(v, _)| estimate.poses[*v].is_some()) {
                for (corner, _) in cameras[c].iter().zip(&used[v][c]).filter(|(_, used)| **used) {
                    items.push(Corner::new(&data.target, corner));
                    views.push(v as u32);
                }
            }
            numbers += 2 * items.len();
            let groups = Groups { poses, mounts, lens, shape };
            match count {
                8 => add::<8, 16, 22>(&mut adjustment, *camera, c, items, &views, groups, loss)?,
                9 => add::<9, 17, 23>(&mut adjustment, *camera, c, items, &views, groups, loss)?,
                12 => add::<12, 20, 26>(&mut adjustment, *camera, c, items, &views, groups, loss)?,
                16 => add::<16, 24, 30>(&mut adjustment, *camera, c, items, &views, groups, loss)?,
                got => return Err(AdjustError::Size { group: "lens".to_owned(), got, most: MAX_INTRINSICS }),
            }
        }
        for (camera, lens) in estimate.cameras.iter().zip(&lenses) {
            match camera.intrinsic_count() {
                12 => add_prior::<12>(&mut adjustment, camera, *lens, numbers / 2)?,
                16 => add_prior::<16>(&mut adjustment, camera, *lens, numbers / 2)?,
                _ => {}
            }
        }
        if !free.shape {
            adjustment.fix(shape, 0)?;
        }
        Ok(Self { adjustment, lenses, mounts, shape, poses, numbers, fitted, cameras: estimate.cameras.len() })
    }

    fn write(&self, estimate: &mut Estimate) {
        let load = |x: &[f64]| {
            let (rotation, translation) = RigidMotion::load(x);
            Pose::new(rotation, translation)
        };
        for (camera, lens) in estimate.cameras.iter_mut().zip(&self.lenses) {
            let mut values = [0.0; MAX_INTRINSICS];
            let found = self.adjustment.values(*lens);
            values[..found.len()].copy_from_slice(found);
            *camera = camera.with_intrinsics(&values);
        }
        let mounts = self.adjustment.values(self.mounts).chunks_exact(12);
        estimate.mounts.iter_mut().zip(mounts).skip(1).for_each(|(m, x)| *m = load(x));
        let poses = self.adjustment.values(self.poses).chunks_exact(12);
        for (pose, x) in estimate.poses.iter_mut().zip(poses).filter(|(pose, _)| pose.is_some()) {
            *pose = Some(load(x));
        }
        estimate.shape.copy_from_slice(self.adjustment.values(self.shape));
    }

    /// Covariance of all lenses, then the mounts but the first, then the shape, for the noise that the residuals show; and that noise's variance, in square
    /// pixels of a coordinate.
    pub(crate) fn covariance(&self) -> Result<(DMatrix<f64>, f64), AdjustError> {
        let sums = self.adjustment.residual_sums()?;
        let squares: f64 = sums.iter().take(self.cameras).map(|s| s.weighted_squares).sum();
        let variance = squares / self.numbers.saturating_sub(self.fitted).max(1) as f64;
        // Exact corners leave only rounding; the pattern of the covariance is still of use.
        let covariance = self.adjustment.covariance(variance.max(f64::MIN_POSITIVE))?;
        let blocks: Vec<(GroupId, usize)> = self
            .lenses
            .iter()
            .map(|l| (*l, 0))
            .chain((1..self.lenses.len()).map(|m| (self.mounts, m)))
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
        // By halves from either side: rounding must not make it asymmetric.
        Ok(((&all + all.transpose()) * 0.5, variance))
    }
}

#[derive(Clone, Copy)]
struct Groups {
    poses: GroupId,
    mounts: GroupId,
    lens: GroupId,
    shape: GroupId,
}

/// Adds the corners of a camera, of which the first needs no mount.
fn add<const N: usize, const ONE: usize, const MORE: usize>(
    adjustment: &mut Adjustment<'_>,
    camera: Camera,
    number: usize,
    items: Vec<Corner>,
    views: &[u32],
    groups: Groups,
    loss: RobustLoss,
) -> Result<(), AdjustError> {
    let Groups { poses, mounts, lens, shape } = groups;
    if number == 0 {
        let blocks = views.iter().map(|v| [*v, 0, 0]).collect();
        let residual = FromReference::<N, ONE> { camera, items };
        adjustment.add_residuals("corner", residual, [poses, lens, shape], blocks, loss)
    } else {
        let blocks = views.iter().map(|v| [*v, number as u32, 0, 0]).collect();
        let residual = FromMount::<N, MORE> { camera, items };
        adjustment.add_residuals("corner", residual, [poses, mounts, lens, shape], blocks, loss)
    }
}

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

/// Whether a model can be adjusted.
pub(crate) fn check_model(model: DistortionModel) -> Result<(), CalibrateError> {
    if [4, 5, 8, 12].contains(&model.parameter_count()) { Ok(()) } else { Err(CalibrateError::Lens { model }) }
}

/// Why there is no adjustment.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Failure {
    Cancelled,
    /// The residuals do not determine it, or it has no start.
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

/// Damping at the start of least squares, which begins where a robust adjustment ended: the usual one would hold back what is determined least, such as a focal
/// length against the distances, for a few steps.
const NEAR_DAMPING: f64 = 1e-7;
/// Most distortion parameters of lenses that begin so. Those of a rational lens make up for each other: without damping they run away together.
const MOST_NEAR: usize = 5;

/// Adjusts an estimate, which is never worse afterwards. Square root of the mean cost of a corner, in pixels.
pub(crate) fn adjust(
    data: &Sightings,
    estimate: &mut Estimate,
    used: &Used,
    (free, loss): (Free, RobustLoss),
    (max_iterations, cost_tolerance): (usize, f64),
    progress: &dyn Progress,
) -> Result<f64, Failure> {
    let mut problem = Problem::new(data, estimate, used, free, loss)?;
    let mut options = AdjustOptions { max_iterations, cost_tolerance, ..AdjustOptions::default() };
    if loss == RobustLoss::Trivial && estimate.cameras.iter().all(|c| c.distortion.parameters().len() <= MOST_NEAR) {
        options.initial_damping = NEAR_DAMPING;
    }
    let mut stopped = Ok(());
    let next = |_: &AdjustIteration| {
        stopped = progress.report("adjust", 0, 0);
        if stopped.is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    };
    let report = problem.adjustment.solve(&options, next)?;
    stopped?;
    problem.write(estimate);
    Ok((report.cost / (problem.numbers.max(2) as f64 / 2.0)).sqrt())
}
