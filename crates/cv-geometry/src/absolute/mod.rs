//! Absolute pose (PnP) and absolute orientation.

mod dlt;
mod p3p;
mod similarity;
mod umeyama;

pub use dlt::pose_from_points;
pub use p3p::pose_three_points;
pub use similarity::estimate_similarity;
pub use umeyama::{Similarity, SimilarityFreedom, align_points};

use crate::error::{Degeneracy, EstimateError};
use crate::match_blocks::{LANES, distinct_pairs};
use crate::ransac::{Estimator, RansacData, RobustOptions, Scorer, TukeyBiweight, ransac};
use crate::robust::RobustModel;
use crate::rotation::orthonormalized;
use cv_core::{Matrix3, Point2, Point3, Pose, Progress, Rotation3, Vector3, median};
use cv_numeric::{LeastSquares, LmOptions, NormalEquations, levenberg_marquardt};
use nalgebra::{Const, Matrix2x3, SVector};

/// A 2D–3D correspondence: a world point and its observation in normalized coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct WorldMatch {
    /// In the world frame.
    pub world: Point3<f64>,
    /// Normalized: pixels through [`cv_core::Camera::normalize`].
    pub image: Point2<f64>,
}

/// Estimates the absolute pose, world to camera, robustly from tentative 2D–3D correspondences (PnP).
///
/// RANSAC with P3P and local optimization on the reprojection error. `options.threshold` is in normalized units: pixels
/// divided by the focal length. Inliers lie in front of the camera.
///
/// # Errors
/// [`EstimateError`]: fewer than four matches, a coordinate that is not finite, collinear or coincident points, or no
/// model with a small enough number of false alarms.
pub fn estimate_pose(
    matches: &[WorldMatch],
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<RobustModel<Pose>, EstimateError> {
    options.check()?;
    check_world(matches, 4)?;
    if let Some(kind) = world_degeneracy(matches) {
        return Err(EstimateError::Degenerate { kind });
    }
    let estimator = AbsoluteEstimator::new(matches);
    let consensus = ransac(&estimator, options, progress)?;
    let pose = estimator.uncentered(&consensus.model);
    let (mut inliers, mut sum) = (Vec::new(), 0.0);
    for (i, m) in matches.iter().enumerate() {
        let r = reprojection_error(&pose, m);
        if r < options.threshold {
            inliers.push(i);
            sum += r * r;
        }
    }
    let rms = (sum / inliers.len() as f64).sqrt();
    Ok(RobustModel { model: pose, inliers, rms, iterations: consensus.iterations, log_nfa: consensus.log_nfa })
}

/// Refines an absolute pose by minimizing the robust reprojection error of `matches`.
///
/// Returns the pose and its loss, to which each match adds 0 (exact) to 1 (beyond 2.5 thresholds, or behind the
/// camera). `threshold` in normalized units.
pub fn refine_pose(pose: &Pose, matches: &[WorldMatch], threshold: f64) -> (Pose, f64) {
    let problem = ReprojectionProblem { matches, scorer: &TukeyBiweight, threshold };
    let refined = refine(&problem, pose, 30).unwrap_or(*pose);
    (refined, problem.cost(&refined))
}

/// Computes the reprojection error of a match in normalized units; infinite behind the camera.
fn reprojection_error(pose: &Pose, m: &WorldMatch) -> f64 {
    let p = pose.transform(&m.world);
    if p.z > 0.0 { (p.x / p.z - m.image.x).hypot(p.y / p.z - m.image.y) } else { f64::INFINITY }
}

/// Rejects too few matches and coordinates that are NaN, infinite or too large.
pub(crate) fn check_world(matches: &[WorldMatch], needed: usize) -> Result<(), EstimateError> {
    if matches.len() < needed {
        return Err(EstimateError::NotEnoughMatches { got: matches.len(), needed });
    }
    // The same limit as for image matches.
    let is_invalid = |m: &WorldMatch| !m.world.iter().chain(m.image.iter()).all(|v| v.abs() <= 1e12);
    match matches.iter().position(is_invalid) {
        Some(index) => Err(EstimateError::NotFinite { index }),
        None => Ok(()),
    }
}

/// Tests whether the world points are coincident or collinear.
fn world_degeneracy(matches: &[WorldMatch]) -> Option<Degeneracy> {
    let first = matches[0].world;
    let squared_distance = |p: &WorldMatch| (p.world - first).norm_squared();
    let direction = matches.iter().max_by(|a, b| squared_distance(a).total_cmp(&squared_distance(b)))?.world - first;
    if direction.norm_squared() <= 1e-24 * first.coords.norm_squared() {
        return Some(Degeneracy::Coincident);
    }
    // The rounding error of the cross product.
    let limit = 1e-12 * direction.norm_squared();
    let is_on_line = |m: &WorldMatch| (m.world - first).cross(&direction).norm() <= limit;
    matches.iter().all(is_on_line).then_some(Degeneracy::Collinear)
}

/// Minimizes the robust reprojection error `Σ ρ(error² / threshold²)` over poses.
struct ReprojectionProblem<'a> {
    matches: &'a [WorldMatch],
    scorer: &'a dyn Scorer,
    threshold: f64,
}

impl LeastSquares for ReprojectionProblem<'_> {
    type Dim = Const<6>;
    type Params = Pose;

    fn dim(&self) -> Const<6> {
        Const
    }

    fn cost(&self, pose: &Pose) -> f64 {
        let loss = |m| {
            let r = reprojection_error(pose, m) / self.threshold;
            f64::from(self.scorer.loss((r * r) as f32))
        };
        self.matches.iter().map(loss).sum()
    }

    fn linearize(&self, pose: &Pose) -> NormalEquations<Const<6>> {
        let mut equations = NormalEquations::zeros(Const);
        let rotation = pose.rotation.matrix();
        for m in self.matches {
            let p = rotation * m.world.coords + pose.translation;
            let i = 1.0 / p.z;
            let r = [p.x * i - m.image.x, p.y * i - m.image.y];
            let u = (r[0] * r[0] + r[1] * r[1]) / (self.threshold * self.threshold);
            if p.z.is_nan() || p.z <= 0.0 || u.is_nan() || u >= self.scorer.cutoff() {
                equations.cost += 1.0;
                continue;
            }
            equations.cost += f64::from(self.scorer.loss(u as f32));
            let weight = self.scorer.weight(u);
            let j_point = Matrix2x3::new(i, 0.0, -p.x * i * i, 0.0, i, -p.y * i * i);
            // R exp(ω) x ≈ R x − R [x]× ω.
            let j_rotation = -j_point * rotation * m.world.coords.cross_matrix();
            for (k, r) in r.into_iter().enumerate() {
                let (w, t) = (j_rotation.row(k), j_point.row(k));
                equations.add(r, &SVector::from([w[0], w[1], w[2], t[0], t[1], t[2]]), weight);
            }
        }
        equations
    }

    fn step(&self, pose: &Pose, d: &SVector<f64, 6>) -> Pose {
        let rotation = Rotation3::new(Vector3::new(d[0], d[1], d[2]));
        Pose::new(pose.rotation * rotation, pose.translation + Vector3::new(d[3], d[4], d[5]))
    }
}

fn refine(problem: &ReprojectionProblem<'_>, start: &Pose, iterations: usize) -> Option<Pose> {
    let options = LmOptions { max_iterations: iterations, cost_tolerance: 1e-6, ..LmOptions::default() };
    let report = levenberg_marquardt(problem, *start, &options);
    let rotation = orthonormalized(&report.params.rotation)?;
    (report.cost < report.initial_cost).then(|| Pose::new(rotation, report.params.translation))
}

/// [`LANES`] matches as a structure of arrays; padding lanes are NaN.
struct WorldBlock {
    world: [[f32; LANES]; 3],
    image: [[f32; LANES]; 2],
}

impl WorldBlock {
    fn new(chunk: &[WorldMatch]) -> Self {
        let lanes = |of: &dyn Fn(&WorldMatch) -> f64| -> [f32; LANES] {
            std::array::from_fn(|i| chunk.get(i).map_or(f32::NAN, |m| of(m) as f32))
        };
        Self {
            world: [0, 1, 2].map(|k: usize| lanes(&|m| m.world[k])),
            image: [0, 1].map(|k: usize| lanes(&|m| m.image[k])),
        }
    }
}

struct AbsoluteEstimator {
    /// With centered world points, for the precision of f32.
    matches: Vec<WorldMatch>,
    center: Vector3<f64>,
    blocks: Vec<WorldBlock>,
}

impl AbsoluteEstimator {
    fn new(matches: &[WorldMatch]) -> Self {
        // Medians are robust to outliers.
        let median_coordinate = |k: usize| {
            let mut v: Vec<f64> = matches.iter().map(|m| m.world[k]).collect();
            median(&mut v).unwrap_or(0.0)
        };
        let center = Vector3::new(median_coordinate(0), median_coordinate(1), median_coordinate(2));
        let centered = |m: &WorldMatch| WorldMatch { world: m.world - center, image: m.image };
        let matches: Vec<WorldMatch> = matches.iter().map(centered).collect();
        let blocks = matches.chunks(LANES).map(WorldBlock::new).collect();
        Self { matches, center, blocks }
    }

    /// Converts a pose for the centered points to one for the original points.
    fn uncentered(&self, pose: &Pose) -> Pose {
        Pose::new(pose.rotation, pose.translation - pose.rotation * self.center)
    }
}

/// The 3×4 pose matrix in f32.
struct PoseKernel([[f32; 4]; 3]);

impl RansacData for AbsoluteEstimator {
    type Block = WorldBlock;

    fn count(&self) -> usize {
        self.matches.len()
    }

    fn blocks(&self) -> &[WorldBlock] {
        &self.blocks
    }

    fn background(&self, max_count: usize) -> Vec<WorldBlock> {
        let recombine =
            |(i, j): (usize, usize)| WorldMatch { world: self.matches[i].world, image: self.matches[j].image };
        let recombined: Vec<WorldMatch> = distinct_pairs(self.matches.len(), max_count).map(recombine).collect();
        recombined.chunks(LANES).map(WorldBlock::new).collect()
    }
}

impl Estimator for AbsoluteEstimator {
    type Model = Pose;
    type Data = Self;
    type Kernel = PoseKernel;
    const SAMPLE_SIZE: usize = 3;
    const RESIDUAL_DIMENSION: i32 = 2;

    fn data(&self) -> &Self {
        self
    }

    fn threshold_scale(&self) -> f64 {
        1.0
    }

    fn solve(&self, sample: &[u32], models: &mut Vec<Pose>) {
        let three: [WorldMatch; 3] = std::array::from_fn(|i| self.matches[sample[i] as usize]);
        pose_three_points(&three, |pose| models.push(pose));
    }

    fn kernel(&self, model: &Pose) -> PoseKernel {
        let (r, t): (&Matrix3<f64>, _) = (model.rotation.matrix(), &model.translation);
        PoseKernel([0, 1, 2].map(|i: usize| [r[(i, 0)], r[(i, 1)], r[(i, 2)], t[i]].map(|v| v as f32)))
    }

    #[inline(always)]
    fn squared_residuals(kernel: &PoseKernel, block: &WorldBlock) -> [f32; LANES] {
        let [r0, r1, r2] = &kernel.0;
        let mut out = [0f32; LANES];
        for (i, r2_out) in out.iter_mut().enumerate() {
            let (x, y, z) = (block.world[0][i], block.world[1][i], block.world[2][i]);
            let p = r0[0] * x + r0[1] * y + r0[2] * z + r0[3];
            let q = r1[0] * x + r1[1] * y + r1[2] * z + r1[3];
            let s = r2[0] * x + r2[1] * y + r2[2] * z + r2[3];
            let inverse = if s > 0.0 { 1.0 / s } else { f32::NAN };
            let (dx, dy) = (p * inverse - block.image[0][i], q * inverse - block.image[1][i]);
            *r2_out = dx * dx + dy * dy;
        }
        out
    }

    fn refine(&self, model: &Pose, scorer: &dyn Scorer, threshold: f64, iterations: usize) -> Option<Pose> {
        refine(&ReprojectionProblem { matches: &self.matches, scorer, threshold }, model, iterations)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ransac::LeastSquaresLoss;
    use crate::testing::{TwoViews, gauss};
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;

    #[test]
    fn the_analytic_gradient_equals_the_numeric_one() {
        let views = TwoViews::random(3);
        let mut rng = ChaCha8Rng::seed_from_u64(3 + 77);
        let mut noise = || nalgebra::Vector2::from_fn(|_, _| 1e-2 * gauss(&mut rng));
        let one = |(world, pair)| WorldMatch { world, image: views.normalize(&pair).b + noise() };
        let m: Vec<_> = std::iter::repeat_with(|| views.point(None)).map(one).take(20).collect();
        let problem = ReprojectionProblem { matches: &m, scorer: &LeastSquaresLoss, threshold: 1.0 };
        let gradient = problem.linearize(&views.pose).gradient;
        let cost = |p: &Pose| m.iter().map(|m| reprojection_error(p, m).powi(2)).sum::<f64>();
        for i in 0..6 {
            let mut d = SVector::<f64, 6>::zeros();
            d[i] = 1e-6;
            let numeric = (cost(&problem.step(&views.pose, &d)) - cost(&problem.step(&views.pose, &-d))) / 2e-6;
            // Central differences: h² truncation and rounding over h; the gradient is half of the derivative.
            assert!((0.5 * numeric - gradient[i]).abs() < 1e-6 * (1.0 + gradient.amax()), "{i}");
        }
    }
}
