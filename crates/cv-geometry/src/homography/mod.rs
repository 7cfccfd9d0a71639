//! Estimation of homographies.

mod dlt;
mod four_point;
mod radial;
mod refine;

pub use dlt::homography_from_points;
pub use four_point::homography_four_point;
pub(crate) use radial::{Division, RadialHomography, estimate_radial_homography};

use crate::error::EstimateError;
use crate::match_blocks::{LANES, MatchBlock, NormalizedMatches, PairBlocks, point_degeneracy};
use crate::ransac::LeastSquaresLoss;
use crate::ransac::{Estimator, RobustOptions, Scorer, TukeyBiweight, ransac};
use crate::robust::RobustModel;
use cv_core::{Correspondence, Matrix3, Point2, Progress};
use refine::{TransferProblem, refine_transfer};

/// Computes the symmetric transfer error: the RMS of the distances from `b` to `H a` and from `a` to `H⁻¹ b`, in
/// pixels.
///
/// Infinite if `h` is singular or maps one of the points to infinity.
pub fn homography_residual(h: &Matrix3<f64>, m: &Correspondence) -> f64 {
    let Some(g) = h.try_inverse() else { return f64::INFINITY };
    let map = |h: &Matrix3<f64>, p: Point2<f64>| Point2::from_homogeneous(h * p.to_homogeneous());
    match (map(h, m.a), map(&g, m.b)) {
        (Some(p), Some(q)) => (((p - m.b).norm_squared() + (q - m.a).norm_squared()) / 2.0).sqrt(),
        _ => f64::INFINITY,
    }
}

/// Estimates the homography between two images of a plane, or from the same camera center, robustly from tentative
/// matches.
///
/// RANSAC with local optimization on the symmetric transfer error; the model is scaled to `H[2][2] = 1`.
///
/// ```
/// use cv_core::{Correspondence, Silent};
/// use cv_geometry::{RobustOptions, estimate_homography};
/// // A shift by (10, 5), and one outlier.
/// let mut matches: Vec<_> = (0..20)
///     .map(|i| (f64::from(i % 5) * 40.0, f64::from(i / 5) * 30.0))
///     .map(|(x, y)| Correspondence::new(x, y, x + 10.0, y + 5.0))
///     .collect();
/// matches.push(Correspondence::new(50.0, 50.0, 300.0, 20.0));
/// let found = estimate_homography(&matches, &RobustOptions::homography(), &Silent)?;
/// assert_eq!(found.inliers, (0..20).collect::<Vec<_>>());
/// assert!((found.model[(0, 2)] - 10.0).abs() < 1e-6);
/// # Ok::<(), cv_geometry::EstimateError>(())
/// ```
///
/// # Errors
/// [`EstimateError`]: fewer than four matches, a coordinate that is not finite, coincident or collinear points, or no
/// model with a small enough number of false alarms (if there are more than four matches).
pub fn estimate_homography(
    matches: &[Correspondence],
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<RobustModel<Matrix3<f64>>, EstimateError> {
    options.check()?;
    let set = NormalizedMatches::new(matches, 4)?;
    let degenerate = |kind| EstimateError::Degenerate { kind };
    // Points that are collinear within a third of the threshold, about their noise, are degenerate.
    let width = options.threshold / 3.0 * set.first.scale;
    // Before RANSAC, which would draw the maximum number of samples in vain.
    if let Some(kind) = point_degeneracy(set.pairs.iter(), 4, width) {
        return Err(degenerate(kind));
    }
    let estimator = HomographyEstimator { set };
    let consensus = ransac(&estimator, options, progress)?;
    let set = &estimator.set;
    let h = dlt::normalize_scale(&(set.second.inverse_matrix() * consensus.model * set.first.matrix()));
    let result = RobustModel::new(h, matches, options.threshold, &consensus, homography_residual);
    match point_degeneracy(result.inliers.iter().map(|&i| &set.pairs[i]), 4, width) {
        Some(kind) => Err(degenerate(kind)),
        None => Ok(result),
    }
}

/// Refines a homography by minimizing the symmetric transfer error of `matches` (which should be inliers), scaled to
/// `H[2][2] = 1`.
///
/// # Errors
/// [`EstimateError`] as for [`homography_from_points`].
pub fn refine_homography(h: &Matrix3<f64>, matches: &[Correspondence]) -> Result<Matrix3<f64>, EstimateError> {
    let set = NormalizedMatches::new(matches, 4)?;
    let normalized = set.second.matrix() * h * set.first.inverse_matrix();
    let problem = TransferProblem { pairs: &set.pair_blocks, scorer: &LeastSquaresLoss, threshold: 1.0 };
    let refined = refine_transfer(&problem, &normalized, 50).unwrap_or(normalized);
    Ok(dlt::normalize_scale(&(set.second.inverse_matrix() * refined * set.first.matrix())))
}

/// Refines `h` by minimizing the robust symmetric transfer error (Tukey's biweight) of normalized pairs.
pub(crate) fn refine_robustly(pairs: &PairBlocks, h: &Matrix3<f64>, threshold: f64) -> Matrix3<f64> {
    let problem = TransferProblem { pairs, scorer: &TukeyBiweight, threshold };
    refine_transfer(&problem, h, 10).unwrap_or(*h)
}

struct HomographyEstimator {
    set: NormalizedMatches,
}

/// H and its inverse in f32, both with positive denominators in front of the camera.
pub(crate) struct TransferKernel {
    h: [f32; 9],
    g: [f32; 9],
}

impl TransferKernel {
    pub(crate) fn new(h: &Matrix3<f64>) -> Self {
        // The adjugate, scaled so that G H is a positive multiple of I, which preserves the sign of the denominators.
        let g = Matrix3::from_columns(&[
            h.row(1).transpose().cross(&h.row(2).transpose()),
            h.row(2).transpose().cross(&h.row(0).transpose()),
            h.row(0).transpose().cross(&h.row(1).transpose()),
        ]);
        let det = h[(0, 0)] * g[(0, 0)] + h[(0, 1)] * g[(1, 0)] + h[(0, 2)] * g[(2, 0)];
        let s = 1.0 / h[(2, 2)];
        let h = h * s;
        let g = g / (det * s);
        let rows = |m: &Matrix3<f64>| std::array::from_fn(|i| m[(i / 3, i % 3)] as f32);
        Self { h: rows(&h), g: rows(&g) }
    }

    /// Computes `(d₁² + d₂²) / 2`; infinite behind the camera.
    #[inline(always)]
    pub(crate) fn squared_residuals(&self, block: &MatchBlock) -> [f32; LANES] {
        let (h, g) = (&self.h, &self.g);
        let mut out = [0f32; LANES];
        for (i, d2) in out.iter_mut().enumerate() {
            let (x, y, s, t) = (block.x1[i], block.y1[i], block.x2[i], block.y2[i]);
            let wa = h[6] * x + h[7] * y + h[8];
            let wb = g[6] * s + g[7] * t + g[8];
            let (ia, ib) = (1.0 / wa, 1.0 / wb);
            let p = (h[0] * x + h[1] * y + h[2]) * ia - s;
            let q = (h[3] * x + h[4] * y + h[5]) * ia - t;
            let m = (g[0] * s + g[1] * t + g[2]) * ib - x;
            let n = (g[3] * s + g[4] * t + g[5]) * ib - y;
            let sum = (p * p + q * q) + (m * m + n * n);
            *d2 = if wa.min(wb) > 0.0 { 0.5 * sum } else { f32::INFINITY };
        }
        out
    }
}

impl Estimator for HomographyEstimator {
    type Model = Matrix3<f64>;
    type Data = NormalizedMatches;
    type Kernel = TransferKernel;
    const SAMPLE_SIZE: usize = 4;
    const RESIDUAL_DIMENSION: i32 = 2;

    fn data(&self) -> &NormalizedMatches {
        &self.set
    }

    fn threshold_scale(&self) -> f64 {
        self.set.first.scale
    }

    fn solve(&self, sample: &[u32], models: &mut Vec<Matrix3<f64>>) {
        let pair = |i: usize| &self.set.pairs[sample[i] as usize];
        let a = std::array::from_fn(|i| Point2::new(pair(i)[0], pair(i)[1]));
        let b = std::array::from_fn(|i| Point2::new(pair(i)[2], pair(i)[3]));
        models.extend(homography_four_point(&a, &b));
    }

    fn kernel(&self, model: &Matrix3<f64>) -> TransferKernel {
        TransferKernel::new(model)
    }

    #[inline(always)]
    fn squared_residuals(kernel: &TransferKernel, block: &MatchBlock) -> [f32; LANES] {
        kernel.squared_residuals(block)
    }

    fn refine(
        &self,
        model: &Matrix3<f64>,
        scorer: &dyn Scorer,
        threshold: f64,
        iterations: usize,
    ) -> Option<Matrix3<f64>> {
        let problem = TransferProblem { pairs: &self.set.pair_blocks, scorer, threshold };
        refine_transfer(&problem, model, iterations)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{a_homography, homography_matches as matches};
    use cv_numeric::LeastSquares;
    use nalgebra::SVector;
    use proptest::prelude::*;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;

    /// The cost in f64: the problem's own cost has f32 losses and is not precise enough.
    fn plain_cost(pairs: &[[f64; 4]], h: &Matrix3<f64>) -> f64 {
        let residual = |p: &[f64; 4]| homography_residual(h, &Correspondence::new(p[0], p[1], p[2], p[3]));
        pairs.iter().map(|p| residual(p).powi(2)).sum()
    }

    proptest! {
        #[test]
        fn the_analytic_gradient_equals_the_numeric_one(h in a_homography(), count in 12usize..40, seed: u64) {
            let m = matches(&h, count, 0.01, &mut ChaCha8Rng::seed_from_u64(seed));
            let set = NormalizedMatches::new(&m, 4).unwrap();
            let problem = TransferProblem { pairs: &set.pair_blocks, scorer: &LeastSquaresLoss, threshold: 1.0 };
            let start = set.second.matrix() * h * set.first.inverse_matrix();
            let start = start / start[(2, 2)];
            let start = problem.step(&start, &SVector::from([0.02, -0.01, 0.03, 0.01, 0.02, -0.03, 0.005, -0.004]));
            prop_assume!(problem.cost(&start).is_finite() && problem.cost(&start) < count as f64);
            let equations = problem.linearize(&start);
            for i in 0..8 {
                let step = 1e-6;
                let mut d = SVector::<f64, 8>::zeros();
                d[i] = step;
                let numeric = (plain_cost(&set.pairs, &problem.step(&start, &d)) - plain_cost(&set.pairs, &problem.step(&start, &-d))) / (2.0 * step);
                // The cost is Σ r² with r² = (d₁² + d₂²)/2, its gradient Σ (d₁ d₁' + d₂ d₂') = the accumulated one.
                let size = equations.gradient.amax().max(1e-3);
                prop_assert!((numeric - equations.gradient[i]).abs() < 1e-4 * size, "{i}: {numeric} {}", equations.gradient[i]);
            }
        }

        #[test]
        fn matches_beyond_the_cutoff_change_only_the_cost(h in a_homography(), count in 12usize..40, seed: u64) {
            let m = matches(&h, count, 0.5, &mut ChaCha8Rng::seed_from_u64(seed));
            let set = NormalizedMatches::new(&m, 4).unwrap();
            let model = set.second.matrix() * h * set.first.inverse_matrix();
            let model = model / model[(2, 2)];
            let linearize = |pairs: &[[f64; 4]]| {
                let blocks = PairBlocks::new(pairs);
                let problem = TransferProblem { pairs: &blocks, scorer: &TukeyBiweight, threshold: 3.0 * set.first.scale };
                let equations = problem.linearize(&model);
                assert_eq!(problem.cost(&model), equations.cost);
                equations
            };
            let mut pairs = set.pairs.clone();
            let expected = linearize(&pairs);
            // Far away; on the line that maps to infinity (division by zero); behind the camera.
            let line = model.row(2);
            let [a, b, c] = [line[0], line[1], line[2]];
            let norm = a * a + b * b;
            prop_assume!(norm > 1e-6);
            let beyond = [[100.0, 100.0, 0.0, 0.0], [-a * c / norm, -b * c / norm, 0.0, 0.0], [-2.0 * a * c / norm, -2.0 * b * c / norm, 0.0, 0.0]];
            for (i, p) in beyond.iter().enumerate() {
                pairs.insert((7 * i + seed as usize % 5) % pairs.len(), *p);
            }
            let found = linearize(&pairs);
            // Sums of a hundred terms in another order.
            let tolerance = 1e-12;
            prop_assert!((found.cost - expected.cost - beyond.len() as f64).abs() < tolerance * found.cost);
            prop_assert!((found.gradient - expected.gradient).amax() < tolerance * (1.0 + expected.hessian.amax()));
            prop_assert!((found.hessian - expected.hessian).amax() < tolerance * expected.hessian.amax());
        }

        #[test]
        fn simd_residuals_equal_the_scalar_ones(h in a_homography(), seed: u64) {
            let m = matches(&h, 40, 2.0, &mut ChaCha8Rng::seed_from_u64(seed));
            let set = NormalizedMatches::new(&m, 4).unwrap();
            let normalized = set.second.matrix() * h * set.first.inverse_matrix();
            let kernel = TransferKernel::new(&normalized);
            let mut fast: Vec<f32> = set.blocks.iter().flat_map(|b| kernel.squared_residuals(b)).collect();
            fast.truncate(m.len());
            let mut plain: Vec<f64> = m.iter().map(|m| homography_residual(&h, m).powi(2) * set.first.scale.powi(2)).collect();
            // The blocks are shuffled.
            fast.sort_by(f32::total_cmp);
            plain.sort_by(f64::total_cmp);
            for (f, p) in fast.iter().zip(plain) {
                // Coordinates of order one in f32, up to a few units, magnified at most twentyfold by perspective.
                prop_assert!((f64::from(*f).sqrt() - p.sqrt()).abs() < 2e-5, "{f} {p}");
            }
        }
    }
}
