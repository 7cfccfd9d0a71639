//! Robust estimation of a similarity between two point sets.

use super::umeyama::{Similarity, SimilarityFreedom, align_points_weighted};
use crate::error::EstimateError;
use crate::match_blocks::LANES;
use crate::ransac::{Estimator, RansacData, RobustOptions, Scorer, ransac};
use crate::robust::RobustModel;
use cv_core::{Point3, Progress, Vector3, median};

/// Estimates the similarity from points `a` to points `b` robustly.
///
/// RANSAC over three-point samples with local optimization by iteratively reweighted least squares. `options.threshold`
/// is a distance in the frame of `b`. No number of false alarms is computed, since inputs typically have few points.
///
/// # Errors
/// [`EstimateError`]: as [`align_points`](super::align_points); no consensus of more than three pairs where there are more than three.
pub fn estimate_similarity(
    a: &[Point3<f64>],
    b: &[Point3<f64>],
    freedom: SimilarityFreedom,
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<RobustModel<Similarity>, EstimateError> {
    options.check()?;
    let n = a.len().min(b.len());
    // Rejects degenerate input, of which every sample is degenerate.
    align_points_weighted(a, b, &vec![1.0; n], freedom)?;
    let estimator = SimilarityEstimator::new(&a[..n], &b[..n], freedom);
    let consensus = ransac(&estimator, options, progress)?;
    let model = estimator.uncentered(&consensus.model);
    let (mut inliers, mut sum) = (Vec::new(), 0.0);
    for (i, (p, q)) in a.iter().zip(b).enumerate() {
        let r = (model.transform(p) - q).norm();
        if r < options.threshold {
            inliers.push(i);
            sum += r * r;
        }
    }
    let rms = (sum / inliers.len() as f64).sqrt();
    Ok(RobustModel { model, inliers, rms, iterations: consensus.iterations, log_nfa: consensus.log_nfa })
}

/// [`LANES`] pairs as a structure of arrays; padding lanes are NaN.
struct PointPairBlock {
    a: [[f32; LANES]; 3],
    b: [[f32; LANES]; 3],
}

struct SimilarityEstimator {
    /// Both are centered, for the precision of f32.
    a: Vec<Point3<f64>>,
    b: Vec<Point3<f64>>,
    center: [Vector3<f64>; 2],
    freedom: SimilarityFreedom,
    blocks: Vec<PointPairBlock>,
}

/// Computes the coordinate-wise median, which is robust to outliers.
fn median_point(points: &[Point3<f64>]) -> Vector3<f64> {
    Vector3::from_fn(|k, _| median(&mut points.iter().map(|p| p[k]).collect::<Vec<_>>()).unwrap_or(0.0))
}

impl SimilarityEstimator {
    fn new(a: &[Point3<f64>], b: &[Point3<f64>], freedom: SimilarityFreedom) -> Self {
        let center = [median_point(a), median_point(b)];
        let centered = |points: &[Point3<f64>], by: Vector3<f64>| points.iter().map(|p| p - by).collect::<Vec<_>>();
        let (a, b) = (centered(a, center[0]), centered(b, center[1]));
        let lanes = |points: &[Point3<f64>]| {
            [0, 1, 2].map(|k: usize| std::array::from_fn(|i| points.get(i).map_or(f32::NAN, |p| p[k] as f32)))
        };
        let chunks = a.chunks(LANES).zip(b.chunks(LANES));
        let blocks = chunks.map(|(a, b)| PointPairBlock { a: lanes(a), b: lanes(b) }).collect();
        Self { a, b, center, freedom, blocks }
    }

    /// Converts `q − c_b = s R (p − c_a) + t` to the original coordinates.
    fn uncentered(&self, model: &Similarity) -> Similarity {
        let [ca, cb] = self.center;
        Similarity { translation: model.translation + cb - model.rotation * ca * model.scale, ..*model }
    }

    /// Computes the squared residuals divided by the squared threshold.
    fn relative_squared_residuals<'s>(
        &'s self,
        model: &'s Similarity,
        threshold: f64,
    ) -> impl Iterator<Item = f64> + 's {
        let square = threshold * threshold;
        self.a.iter().zip(&self.b).map(move |(p, q)| (model.transform(p) - q).norm_squared() / square)
    }
}

/// The 3×4 matrix of scaled rotation and translation in f32.
struct SimilarityKernel([[f32; 4]; 3]);

impl RansacData for SimilarityEstimator {
    type Block = PointPairBlock;

    fn count(&self) -> usize {
        self.a.len()
    }

    fn blocks(&self) -> &[PointPairBlock] {
        &self.blocks
    }
}

impl Estimator for SimilarityEstimator {
    type Model = Similarity;
    type Data = Self;
    type Kernel = SimilarityKernel;
    const SAMPLE_SIZE: usize = 3;
    const RESIDUAL_DIMENSION: i32 = 3;

    fn data(&self) -> &Self {
        self
    }

    fn threshold_scale(&self) -> f64 {
        1.0
    }

    fn solve(&self, sample: &[u32], models: &mut Vec<Similarity>) {
        let three = |points: &[Point3<f64>]| [0, 1, 2].map(|i: usize| points[sample[i] as usize]);
        models.extend(align_points_weighted(&three(&self.a), &three(&self.b), &[1.0; 3], self.freedom));
    }

    fn kernel(&self, model: &Similarity) -> SimilarityKernel {
        let (r, t) = (model.rotation.matrix() * model.scale, &model.translation);
        SimilarityKernel([0, 1, 2].map(|i: usize| [r[(i, 0)], r[(i, 1)], r[(i, 2)], t[i]].map(|v| v as f32)))
    }

    #[inline(always)]
    fn squared_residuals(kernel: &SimilarityKernel, block: &PointPairBlock) -> [f32; LANES] {
        std::array::from_fn(|i| {
            let p = [0, 1, 2].map(|k: usize| block.a[k][i]);
            let residual = |k: usize| {
                let r = &kernel.0[k];
                r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + r[3] - block.b[k][i]
            };
            let (x, y, z) = (residual(0), residual(1), residual(2));
            x * x + y * y + z * z
        })
    }

    fn refine(&self, model: &Similarity, scorer: &dyn Scorer, threshold: f64, iterations: usize) -> Option<Similarity> {
        let cost = |model: &Similarity| {
            self.relative_squared_residuals(model, threshold).map(|u| f64::from(scorer.loss(u as f32))).sum::<f64>()
        };
        let (mut best, mut min_cost) = (None, cost(model));
        for _ in 0..iterations {
            let current = best.as_ref().unwrap_or(model);
            let weights: Vec<f64> =
                self.relative_squared_residuals(current, threshold).map(|u| scorer.weight(u)).collect();
            let Ok(next) = align_points_weighted(&self.a, &self.b, &weights, self.freedom) else { break };
            let next_cost = cost(&next);
            if next_cost.is_nan() || next_cost >= min_cost * (1.0 - 1e-9) {
                break;
            }
            (best, min_cost) = (Some(next), next_cost);
        }
        best
    }
}
