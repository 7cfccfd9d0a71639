//! Estimation of the fundamental matrix.

mod degensac;
mod eight_point;
mod rank_two;
mod seven_point;

pub use eight_point::fundamental_eight_point;
pub(crate) use seven_point::epipolar_row;
pub use seven_point::fundamental_seven_point;

use crate::epipolar::{Epipolar, SampsonKernel, SampsonProblem, refine_sampson, sampson, second_epipole};
use crate::error::{Degeneracy, EstimateError};
use crate::homography::{homography_from_points, homography_residual};
use crate::match_blocks::{LANES, MatchBlock, NormalizedMatches, point_degeneracy};
use crate::ransac::{Estimator, RobustOptions, Scorer, ransac};
use crate::robust::RobustModel;
use cv_core::{Correspondence, Matrix3, Point2, Progress};
use rank_two::RankTwo;

/// Estimates the fundamental matrix between two images of a rigid scene robustly from tentative matches.
///
/// RANSAC with the seven-point algorithm, local optimization on the Sampson error, and recovery from H-degenerate
/// samples (DEGENSAC, Chum, Werner & Matas 2005). `bᵀ F a = 0`; Frobenius norm 1, the entry of largest magnitude
/// positive.
///
/// # Errors
/// [`EstimateError`]: fewer than eight matches, a coordinate that is not finite, coincident, collinear or coplanar
/// points, or no model with a small enough number of false alarms.
pub fn estimate_fundamental(
    matches: &[Correspondence],
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<RobustModel<Matrix3<f64>>, EstimateError> {
    options.check()?;
    let set = NormalizedMatches::new(matches, 8)?;
    let degenerate = |kind| EstimateError::Degenerate { kind };
    // Degenerate input is rejected before RANSAC, which would draw the maximum number of samples in vain.
    let width = options.threshold / 3.0 * set.first.scale;
    if let Some(kind) = point_degeneracy(set.pairs.iter(), 8, width) {
        return Err(degenerate(kind));
    }
    let all: Vec<usize> = (0..matches.len()).collect();
    if is_planar(matches, &all, options.threshold) {
        return Err(degenerate(Degeneracy::Planar));
    }
    let estimator = FundamentalEstimator { set };
    let consensus = ransac(&estimator, options, progress)?;
    let set = &estimator.set;
    let f = eight_point::normalize_scale_and_sign(
        &(set.second.matrix().transpose() * consensus.model * set.first.matrix()),
    );
    let result = RobustModel::new(f, matches, options.threshold, &consensus, sampson);
    match point_degeneracy(result.inliers.iter().map(|&i| &set.pairs[i]), 8, width) {
        Some(kind) => Err(degenerate(kind)),
        None if is_planar(matches, &result.inliers, options.threshold) => Err(degenerate(Degeneracy::Planar)),
        None => Ok(result),
    }
}

/// Returns whether a homography fits all inliers but at most two. Two off-plane points always determine an epipole, so
/// they are no evidence for it.
fn is_planar(matches: &[Correspondence], inliers: &[usize], threshold: f64) -> bool {
    let mut on_plane: Vec<Correspondence> = inliers.iter().map(|&i| matches[i]).collect();
    // Least squares with a decreasing threshold, in multiples of the epipolar one (the residual is two-dimensional, the
    // epipolar distance one-dimensional). General scenes have most residuals above the first.
    for threshold_ratio in [12.0, 3.0, 1.5] {
        let Ok(h) = homography_from_points(&on_plane) else { return false };
        on_plane = inliers
            .iter()
            .map(|&i| matches[i])
            .filter(|m| homography_residual(&h, m) < threshold_ratio * threshold)
            .collect();
        if 2 * on_plane.len() < inliers.len() {
            return false;
        }
    }
    inliers.len() - on_plane.len() <= 2
}

struct FundamentalEstimator {
    set: NormalizedMatches,
}

impl Estimator for FundamentalEstimator {
    type Model = Matrix3<f64>;
    type Data = NormalizedMatches;
    type Kernel = SampsonKernel;
    const SAMPLE_SIZE: usize = 7;
    const RESIDUAL_DIMENSION: i32 = 1;
    const INNER_SAMPLES: usize = 20;

    fn data(&self) -> &NormalizedMatches {
        &self.set
    }

    fn threshold_scale(&self) -> f64 {
        self.set.first.scale
    }

    fn solve(&self, sample: &[u32], models: &mut Vec<Matrix3<f64>>) {
        let pair = |i: usize| &self.set.pairs[sample[i] as usize];
        let a: [Point2<f64>; 7] = std::array::from_fn(|i| Point2::new(pair(i)[0], pair(i)[1]));
        let b: [Point2<f64>; 7] = std::array::from_fn(|i| Point2::new(pair(i)[2], pair(i)[3]));
        fundamental_seven_point(&a, &b, |f| {
            // The oriented epipolar constraint (Chum, Werner & Matas, "Epipolar geometry estimation via RANSAC benefits
            // from the oriented epipolar constraint", 2004).
            let e = second_epipole(&f);
            let orientation = |i: usize| (f * a[i].to_homogeneous()).dot(&e.cross(&b[i].to_homogeneous())) > 0.0;
            let first = orientation(0);
            if (1..7).all(|i| orientation(i) == first) {
                models.push(f);
            }
        });
    }

    fn kernel(&self, model: &Matrix3<f64>) -> SampsonKernel {
        SampsonKernel::new(model)
    }

    #[inline(always)]
    fn squared_residuals(kernel: &SampsonKernel, block: &MatchBlock) -> [f32; LANES] {
        kernel.squared_residuals(block)
    }

    fn refine(
        &self,
        model: &Matrix3<f64>,
        scorer: &dyn Scorer,
        threshold: f64,
        iterations: usize,
    ) -> Option<Matrix3<f64>> {
        let problem = SampsonProblem::new(&self.set.pair_blocks, scorer, threshold);
        refine_sampson(&problem, RankTwo::new(model)?, iterations).map(|f| f.matrix().normalize())
    }

    fn alternatives(&self, model: &Matrix3<f64>, sample: &[u32], threshold: f64, models: &mut Vec<Matrix3<f64>>) {
        degensac::alternatives(&self.set, model, sample, threshold, models);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::match_blocks::PairBlocks;
    use crate::ransac::{LeastSquaresLoss, TukeyBiweight};
    use crate::testing::TwoViews;
    use cv_numeric::LeastSquares as _;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_analytic_gradient_equals_the_numeric_one(seed: u64, count in 15usize..40) {
            let views = TwoViews::random(seed);
            let pairs: Vec<[f64; 4]> = views.normalized_matches(count, 1e-3).iter().map(|m| [m.a.x, m.a.y, m.b.x, m.b.y]).collect();
            let blocks = PairBlocks::new(&pairs);
            let problem = SampsonProblem::new(&blocks, &LeastSquaresLoss, 1.0);
            let start = RankTwo::new(&views.essential()).unwrap();
            let start = start.step(&nalgebra::SVector::from([0.01, -0.02, 0.01, 0.02, 0.01, -0.01, 0.02]));
            let gradient = problem.linearize(&start).gradient;
            let cost = |f: &RankTwo| {
                let f = f.matrix();
                pairs.iter().map(|p| sampson(&f, &Correspondence::new(p[0], p[1], p[2], p[3])).powi(2)).sum::<f64>()
            };
            for i in 0..7 {
                let mut d = nalgebra::SVector::<f64, 7>::zeros();
                d[i] = 1e-6;
                let numeric = (cost(&start.step(&d)) - cost(&start.step(&-d))) / 2e-6;
                // Central differences: h² truncation and rounding over h; the gradient is half the derivative of Σr².
                prop_assert!((0.5 * numeric - gradient[i]).abs() < 1e-6 + 1e-4 * gradient.amax(), "{i} {numeric} {}", gradient[i]);
            }
        }

        #[test]
        fn matches_beyond_the_cutoff_change_only_the_cost(seed: u64, count in 15usize..40, outliers in 0usize..40) {
            let views = TwoViews::random(seed);
            let pair = |m: &Correspondence| [m.a.x, m.a.y, m.b.x, m.b.y];
            let mut pairs: Vec<[f64; 4]> = views.normalized_matches(count, 1e-3).iter().map(pair).collect();
            let model = RankTwo::new(&views.essential()).unwrap();
            let linearize = |pairs: &[[f64; 4]]| {
                let blocks = PairBlocks::new(pairs);
                let problem = SampsonProblem::new(&blocks, &TukeyBiweight, 0.01);
                let equations = problem.linearize(&model);
                assert_eq!(problem.cost(&model), equations.cost);
                equations
            };
            let expected = linearize(&pairs);
            let f = model.matrix();
            // The products overflow: infinity times zero.
            let mut beyond = vec![[1e200; 4]];
            let is_beyond = |m: &Correspondence| sampson(&f, m) > 0.1;
            beyond.extend(views.outliers(outliers).iter().map(|m| views.normalize(m)).filter(is_beyond).map(|m| pair(&m)));
            // In between, in any lane.
            for (i, p) in beyond.iter().enumerate() {
                pairs.insert((7 * i + seed as usize % 5) % pairs.len(), *p);
            }
            let found = linearize(&pairs);
            // Sums of a hundred terms in another order.
            let tolerance = 1e-12;
            prop_assert!((found.cost - expected.cost - beyond.len() as f64).abs() < tolerance * found.cost);
            prop_assert!((found.gradient - expected.gradient).amax() < tolerance * (1.0 + expected.gradient.amax()));
            prop_assert!((found.hessian - expected.hessian).amax() < tolerance * expected.hessian.amax());
        }

        #[test]
        fn simd_residuals_equal_the_scalar_ones(seed: u64) {
            let views = TwoViews::random(seed);
            let m = views.matches(40, 1.0);
            let set = NormalizedMatches::new(&m, 8).unwrap();
            let f = set.second.inverse_matrix().transpose() * views.fundamental() * set.first.inverse_matrix();
            let kernel = SampsonKernel::new(&f.normalize());
            let mut fast: Vec<f32> = set.blocks.iter().flat_map(|b| kernel.squared_residuals(b)).take(40).collect();
            let mut plain: Vec<f64> = m.iter().map(|m| sampson(&views.fundamental(), m) * set.first.scale).collect();
            fast.sort_by(f32::total_cmp);
            plain.sort_by(f64::total_cmp);
            for (f, p) in fast.iter().zip(plain) {
                // Coordinates of order one in f32; the normals of the epipolar lines may be a hundred times shorter
                // than F.
                prop_assert!((f64::from(*f).sqrt() - p).abs() < 1e-4, "{f} {p}");
            }
        }
    }
}
