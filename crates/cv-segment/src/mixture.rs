//! Gaussian mixture models, fitted by expectation-maximization.

use cv_core::{Cancelled, Progress, Stage};
use cv_parallel::prelude::*;
use nalgebra::{Matrix3, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use serde::{Deserialize, Serialize};

/// A weighted sample point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WeightedSample {
    /// Coordinates.
    pub point: [f64; 3],
    /// Weight (multiplicity), not negative.
    pub weight: f64,
}

/// A Gaussian component of a mixture.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Component {
    /// Mixing coefficient, 0 to 1.
    pub weight: f64,
    /// Mean.
    pub mean: [f64; 3],
    /// Covariance matrix, row-major.
    pub covariance: [[f64; 3]; 3],
}

/// A Gaussian mixture model with full covariances.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mixture {
    /// The components, by decreasing weight.
    pub components: Vec<Component>,
}

/// Options of [`Mixture::fit`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MixtureOptions {
    /// Number of Gaussians, 1 to 64; default 1. The fit has fewer where there are fewer distinct points.
    pub components: usize,
    /// Covariance regularization: added to each variance, relative to the samples' variance along that axis. Default
    /// 1e-6.
    pub regularization: f64,
    /// Measurement resolution of each coordinate, as a standard deviation; its square is added to the variance. Default
    /// 0.
    pub resolution: [f64; 3],
    /// Maximum number of EM iterations. Default 200.
    pub max_iterations: usize,
    /// Convergence tolerance: EM stops when the mean log-likelihood increases by less. Default 1e-4 (a tenth of
    /// scikit-learn's).
    pub tolerance: f64,
    /// Seed of the k-means++ initialization. Default 1.
    pub seed: u64,
}

impl Default for MixtureOptions {
    fn default() -> Self {
        Self {
            components: 1,
            regularization: 1e-6,
            resolution: [0.0; 3],
            max_iterations: 200,
            tolerance: 1e-4,
            seed: 1,
        }
    }
}

/// Why a mixture could not be fitted or is invalid.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum MixtureError {
    /// No sample has a positive weight.
    #[error("there are no samples to fit a mixture to")]
    NoSamples,
    /// A sample is not finite or has a negative weight.
    #[error("sample {index} is not a finite point with a finite weight of at least 0")]
    BadSample {
        /// Index of the sample.
        index: usize,
    },
    /// Number of components outside 1 to 64.
    #[error("{components} components: between 1 and 64 can be fitted")]
    BadCount {
        /// Requested number of components.
        components: usize,
    },
    /// A covariance is not symmetric positive definite, or a weight or mean is not finite or not positive.
    #[error("component {index} has no positive definite covariance, finite mean and positive weight")]
    BadComponent {
        /// Index of the component.
        index: usize,
    },
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

/// A component with precomputed whitening transform: `log density = constant − ½ |A x + b|²`, `A` (the inverse Cholesky
/// factor) lower triangular.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Whitened {
    pub(crate) constant: f64,
    pub(crate) a: Matrix3<f64>,
    pub(crate) b: Vector3<f64>,
}

impl Whitened {
    fn new(c: &Component) -> Option<Self> {
        let covariance = Matrix3::from_fn(|i, j| c.covariance[i][j]);
        let mean = Vector3::from(c.mean);
        let lower = covariance.cholesky()?.l();
        let a = lower.try_inverse()?;
        let log_det = 2.0 * lower.diagonal().iter().map(|v| v.ln()).sum::<f64>();
        let constant = c.weight.ln() - 0.5 * (log_det + 3.0 * std::f64::consts::TAU.ln());
        let b = -(a * mean);
        (constant.is_finite() && a.iter().chain(b.iter()).all(|v| v.is_finite())).then_some(Self { constant, a, b })
    }

    #[inline]
    fn log_density(&self, x: &Vector3<f64>) -> f64 {
        self.constant - 0.5 * (self.a * x + self.b).norm_squared()
    }
}

impl Mixture {
    /// Fits a mixture to weighted samples by expectation-maximization (Dempster, Laird & Rubin 1977), initialized by
    /// k-means++ (Arthur & Vassilvitskii 2007) in coordinates scaled by the samples' standard deviations.
    ///
    /// Coincident samples give one Gaussian with the minimum variance of the options. Time is O(iterations × samples ×
    /// components).
    ///
    /// # Errors
    /// [`MixtureError`]: no samples of positive weight, an invalid sample, a number of components out of range,
    /// cancellation.
    pub fn fit(
        samples: &[WeightedSample],
        options: &MixtureOptions,
        progress: &dyn Progress,
    ) -> Result<Self, MixtureError> {
        let k = options.components;
        if !(1..=64).contains(&k) {
            return Err(MixtureError::BadCount { components: k });
        }
        let is_invalid =
            |s: &WeightedSample| !(s.weight >= 0.0 && s.weight.is_finite() && s.point.iter().all(|v| v.is_finite()));
        if let Some(index) = samples.iter().position(is_invalid) {
            return Err(MixtureError::BadSample { index });
        }
        let total: f64 = samples.iter().map(|s| s.weight).sum();
        if total <= 0.0 {
            return Err(MixtureError::NoSamples);
        }
        let moments = RawMoments::of(samples.iter().map(|s| (s, s.weight)));
        let (mean, covariance) = moments.mean_and_covariance();
        let variance_floor: [f64; 3] = std::array::from_fn(|i| {
            // The rounding error of a variance, for coincident samples without a resolution.
            let rounding = 1e-12 * (1.0 + mean[i] * mean[i]);
            (options.regularization * covariance[(i, i)] + options.resolution[i].powi(2)).max(rounding)
        });
        let mut components = initial_components(samples, k, &covariance, &variance_floor, options.seed, progress)?;
        let mut previous = f64::NEG_INFINITY;
        let stage = Stage::new(progress, "fit", options.max_iterations)?;
        for _ in 0..options.max_iterations {
            let whitened: Vec<Whitened> = components.iter().filter_map(Whitened::new).collect();
            let (moments, log_likelihood) = expectation(samples, &whitened, &stage)?;
            components = maximization(&moments, total, &variance_floor);
            stage.add(1)?;
            let mean_log_likelihood = log_likelihood / total;
            if mean_log_likelihood - previous < options.tolerance {
                break;
            }
            previous = mean_log_likelihood;
        }
        components.sort_by(|a, b| b.weight.total_cmp(&a.weight));
        Ok(Self { components })
    }

    /// Computes the natural logarithm of the density at a point; `−∞` for a mixture without components.
    pub fn log_density(&self, point: [f64; 3]) -> f64 {
        let x = Vector3::from(point);
        let terms: Vec<f64> = self.components.iter().filter_map(Whitened::new).map(|c| c.log_density(&x)).collect();
        log_sum_exp(&terms)
    }

    /// Precomputes the whitening transform of each component.
    pub(crate) fn whitened(&self) -> Result<Vec<Whitened>, MixtureError> {
        if !(1..=64).contains(&self.components.len()) {
            return Err(MixtureError::BadCount { components: self.components.len() });
        }
        let whiten = |(index, c): (usize, &Component)| {
            let is_symmetric = (0..3).all(|i| {
                (0..3).all(|j| (c.covariance[i][j] - c.covariance[j][i]).abs() <= 1e-9 * c.covariance[i][i].abs())
            });
            Whitened::new(c).filter(|_| is_symmetric).ok_or(MixtureError::BadComponent { index })
        };
        self.components.iter().enumerate().map(whiten).collect()
    }
}

fn log_sum_exp(terms: &[f64]) -> f64 {
    let max = terms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if max == f64::NEG_INFINITY {
        return max;
    }
    max + terms.iter().map(|t| (t - max).exp()).sum::<f64>().ln()
}

/// Weighted raw moments of order 0, 1 and 2.
#[derive(Clone, Copy)]
struct RawMoments {
    weight: f64,
    sum: Vector3<f64>,
    products: Matrix3<f64>,
}

impl RawMoments {
    const ZERO: Self = Self {
        weight: 0.0,
        sum: Vector3::new(0.0, 0.0, 0.0),
        products: Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    };

    fn of<'a>(samples: impl Iterator<Item = (&'a WeightedSample, f64)>) -> Self {
        let mut moments = Self::ZERO;
        for (s, weight) in samples {
            moments.add(&Vector3::from(s.point), weight);
        }
        moments
    }

    #[inline]
    fn add(&mut self, x: &Vector3<f64>, weight: f64) {
        let wx = x * weight;
        self.weight += weight;
        self.sum += wx;
        self.products += wx * x.transpose();
    }

    fn plus(&self, other: &Self) -> Self {
        Self { weight: self.weight + other.weight, sum: self.sum + other.sum, products: self.products + other.products }
    }

    /// Returns mean and covariance.
    fn mean_and_covariance(&self) -> (Vector3<f64>, Matrix3<f64>) {
        let mean = self.sum / self.weight;
        (mean, self.products / self.weight - mean * mean.transpose())
    }

    /// Returns the component of these moments, with `variance_floor` added to the variances.
    fn component(&self, total: f64, variance_floor: &[f64; 3]) -> Component {
        let (mean, mut covariance) = self.mean_and_covariance();
        for i in 0..3 {
            // Cancellation can make a variance slightly negative.
            covariance[(i, i)] = covariance[(i, i)].max(0.0) + variance_floor[i];
        }
        let covariance =
            std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (covariance[(i, j)] + covariance[(j, i)])));
        Component { weight: self.weight / total, mean: mean.into(), covariance }
    }
}

/// Initializes the components by k-means++ and ten iterations of Lloyd's k-means; the covariances are those of the
/// clusters.
fn initial_components(
    samples: &[WeightedSample],
    k: usize,
    covariance: &Matrix3<f64>,
    variance_floor: &[f64; 3],
    seed: u64,
    progress: &dyn Progress,
) -> Result<Vec<Component>, Cancelled> {
    const LLOYD_ITERATIONS: usize = 10;
    let stage = Stage::new(progress, "clusters", k + LLOYD_ITERATIONS + 1)?;
    let scale = Vector3::from_fn(|i, _| 1.0 / (covariance[(i, i)].max(0.0) + variance_floor[i]).sqrt());
    let points: Vec<Vector3<f64>> = samples.iter().map(|s| Vector3::from(s.point).component_mul(&scale)).collect();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut centers: Vec<Vector3<f64>> = Vec::with_capacity(k);
    let mut squared_distances: Vec<f64> = vec![1.0; samples.len()];
    while centers.len() < k {
        // All distances are 1 before the first center, which is drawn by weight alone.
        let probabilities = || samples.iter().zip(&squared_distances).map(|(s, d)| s.weight * d);
        let Some(chosen) = draw(probabilities, &mut rng) else { break };
        let center = points[chosen];
        for (d, p) in squared_distances.iter_mut().zip(&points) {
            let distance = (p - center).norm_squared();
            *d = if centers.is_empty() { distance } else { d.min(distance) };
        }
        centers.push(center);
        stage.add(1)?;
    }
    let mut clusters = Vec::new();
    for iteration in 0..=LLOYD_ITERATIONS {
        clusters = vec![RawMoments::ZERO; centers.len()];
        for (i, (s, p)) in samples.iter().zip(&points).enumerate() {
            if i.is_multiple_of(CHUNK) {
                stage.check()?;
            }
            let mut best = (0, f64::INFINITY);
            for (i, center) in centers.iter().enumerate() {
                let d = (p - center).norm_squared();
                if d < best.1 {
                    best = (i, d);
                }
            }
            clusters[best.0].add(&Vector3::from(s.point), s.weight);
        }
        stage.add(1)?;
        if iteration < LLOYD_ITERATIONS {
            for (center, cluster) in centers.iter_mut().zip(&clusters) {
                if cluster.weight > 0.0 {
                    *center = (cluster.sum / cluster.weight).component_mul(&scale);
                }
            }
        }
    }
    let total = samples.iter().map(|s| s.weight).sum();
    Ok(maximization(&clusters, total, variance_floor))
}

/// Draws a number uniformly from [0, 1), of 53 random bits.
fn uniform(rng: &mut impl Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 / (1u64 << 53) as f64
}

/// Draws an index with the given unnormalized probabilities; `None` where all are zero.
fn draw<I: Iterator<Item = f64>>(probabilities: impl Fn() -> I, rng: &mut impl Rng) -> Option<usize> {
    let total: f64 = probabilities().sum();
    let mut remaining = uniform(rng) * total;
    let mut last = None;
    for (i, probability) in probabilities().enumerate() {
        if probability > 0.0 {
            last = Some(i);
            remaining -= probability;
            if remaining < 0.0 {
                break;
            }
        }
    }
    last
}

/// Samples per parallel task, between checks for cancellation.
const CHUNK: usize = 1024;

/// E step: returns the responsibility-weighted raw moments of each component, and the log-likelihood of all samples.
fn expectation(
    samples: &[WeightedSample],
    components: &[Whitened],
    stage: &Stage<'_>,
) -> Result<(Vec<RawMoments>, f64), Cancelled> {
    let zero = || (vec![RawMoments::ZERO; components.len()], 0.0);
    // Chunks of fixed size are summed in order, so the result does not depend on the number of threads.
    let parts: Vec<(Vec<RawMoments>, f64)> = samples
        .par_chunks(CHUNK)
        .map(|chunk| {
            stage.check()?;
            let (mut moments, mut log_likelihood) = zero();
            let mut terms = vec![0.0; components.len()];
            for s in chunk {
                let x = Vector3::from(s.point);
                let mut max = f64::NEG_INFINITY;
                for (term, c) in terms.iter_mut().zip(components) {
                    *term = c.log_density(&x);
                    max = max.max(*term);
                }
                let mut sum = 0.0;
                for term in &mut terms {
                    // Responsibilities below e^-40 of the largest are below f64's precision.
                    *term = if *term - max > -40.0 { (*term - max).exp() } else { 0.0 };
                    sum += *term;
                }
                log_likelihood += s.weight * (max + sum.ln());
                for (component, term) in moments.iter_mut().zip(&terms) {
                    if *term > 0.0 {
                        component.add(&x, s.weight * term / sum);
                    }
                }
            }
            Ok((moments, log_likelihood))
        })
        .try_collect::<_, Cancelled>()?;
    Ok(parts.iter().fold(zero(), |(sums, total), (moments, log_likelihood)| {
        (sums.iter().zip(moments).map(|(a, b)| a.plus(b)).collect(), total + log_likelihood)
    }))
}

/// M step: returns the updated components, without those of negligible weight (below 1e-9).
fn maximization(moments: &[RawMoments], total: f64, variance_floor: &[f64; 3]) -> Vec<Component> {
    moments.iter().filter(|m| m.weight > 1e-9 * total).map(|m| m.component(total, variance_floor)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Silent;

    /// Samples of an axis-aligned Gaussian with the given mean and standard deviations (Irwin–Hall approximation,
    /// twelve uniform variates).
    fn gaussian_samples(n: usize, mean: [f64; 3], deviation: [f64; 3], seed: u64) -> Vec<WeightedSample> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || (0..12).map(|_| uniform(&mut rng)).sum::<f64>() - 6.0;
        (0..n)
            .map(|_| WeightedSample { point: std::array::from_fn(|i| mean[i] + deviation[i] * normal()), weight: 1.0 })
            .collect()
    }

    #[test]
    fn one_gaussian_has_the_moments_of_its_points() {
        let samples = gaussian_samples(5000, [1.0, -2.0, 0.5], [0.1, 0.2, 0.05], 3);
        let fit = Mixture::fit(&samples, &MixtureOptions::default(), &Silent).unwrap();
        let n = samples.len() as f64;
        let mean = |i: usize| samples.iter().map(|s| s.point[i]).sum::<f64>() / n;
        let c = &fit.components[0];
        assert_eq!((fit.components.len(), c.weight), (1, 1.0));
        for i in 0..3 {
            assert!((c.mean[i] - mean(i)).abs() < 1e-12);
            for j in 0..3 {
                let covariance =
                    samples.iter().map(|s| (s.point[i] - mean(i)) * (s.point[j] - mean(j))).sum::<f64>() / n;
                // The regularization is a millionth of the variance, at most 4e-8.
                assert!((c.covariance[i][j] - covariance).abs() < 5e-8);
            }
        }
    }

    #[test]
    fn three_separated_clusters_are_recovered() {
        let truth = [([0.0, 0.0, 0.0], 3000), ([2.0, 0.0, 1.0], 2000), ([0.0, 3.0, -1.0], 1000)];
        let samples: Vec<_> = truth
            .iter()
            .zip(1u64..)
            .flat_map(|(&(mean, n), seed)| gaussian_samples(n, mean, [0.2, 0.3, 0.1], seed))
            .collect();
        for seed in 0..10 {
            let fit =
                Mixture::fit(&samples, &MixtureOptions { components: 3, seed, ..Default::default() }, &Silent).unwrap();
            for (c, (mean, n)) in fit.components.iter().zip(truth) {
                // The means are ten standard deviations apart: no overlap. Standard error of a mean 0.3/√1000 = 0.01.
                assert!((c.weight - n as f64 / 6000.0).abs() < 1e-3, "{seed} {fit:?}");
                assert!(c.mean.iter().zip(mean).all(|(a, b)| (a - b).abs() < 0.04));
            }
        }
    }

    #[test]
    fn a_weight_equals_repetition_of_the_sample() {
        let points = gaussian_samples(300, [0.0; 3], [1.0, 0.5, 2.0], 8);
        let doubled: Vec<_> = points.iter().flat_map(|&s| [s, s, s]).collect();
        let weighted: Vec<_> = points.iter().map(|s| WeightedSample { weight: 3.0, ..*s }).collect();
        let options = MixtureOptions::default();
        let (a, b) =
            (Mixture::fit(&doubled, &options, &Silent).unwrap(), Mixture::fit(&weighted, &options, &Silent).unwrap());
        // The same sums in another order.
        assert!((a.log_density([0.3, 0.1, 1.0]) - b.log_density([0.3, 0.1, 1.0])).abs() < 1e-9);
    }

    #[test]
    fn the_log_density_equals_the_closed_form() {
        let c = Component {
            weight: 1.0,
            mean: [1.0, 2.0, 3.0],
            covariance: [[4.0, 0.0, 0.0], [0.0, 9.0, 0.0], [0.0, 0.0, 0.25]],
        };
        let m = Mixture { components: vec![Component { weight: 0.25, ..c }, Component { weight: 0.75, ..c }] };
        let one = |x: f64, mean: f64, sigma: f64| {
            (-0.5 * ((x - mean) / sigma).powi(2)).exp() / (sigma * std::f64::consts::TAU.sqrt())
        };
        let expected = (one(0.0, 1.0, 2.0) * one(1.0, 2.0, 3.0) * one(3.5, 3.0, 0.5)).ln();
        assert!((m.log_density([0.0, 1.0, 3.5]) - expected).abs() < 1e-12);
    }

    #[test]
    fn coincident_and_collinear_samples_give_valid_gaussians() {
        let at = |point| WeightedSample { point, weight: 2.0 };
        let point = vec![at([0.5; 3]); 40];
        let pair: Vec<_> = point.iter().copied().chain(vec![at([0.5, 0.5, 0.75]); 10]).collect();
        let line: Vec<_> = (0..50).map(|i| at([f64::from(i), 2.0 * f64::from(i), 1.0])).collect();
        for (samples, distinct) in [(&point, 1), (&pair, 2), (&line, 50)] {
            for components in [1, 5] {
                let fit = Mixture::fit(samples, &MixtureOptions { components, ..Default::default() }, &Silent).unwrap();
                assert!(!fit.components.is_empty() && fit.components.len() <= components.min(distinct));
                assert!(fit.whitened().is_ok() && fit.log_density(samples[0].point).is_finite());
                assert!((fit.components.iter().map(|c| c.weight).sum::<f64>() - 1.0).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn invalid_samples_and_options_are_errors() {
        let good = WeightedSample { point: [0.0; 3], weight: 1.0 };
        let fit = |samples: &[WeightedSample], components| {
            Mixture::fit(samples, &MixtureOptions { components, ..Default::default() }, &Silent).unwrap_err()
        };
        assert_eq!(fit(&[], 1), MixtureError::NoSamples);
        assert_eq!(fit(&[WeightedSample { weight: 0.0, ..good }], 1), MixtureError::NoSamples);
        assert_eq!(fit(&[good, WeightedSample { weight: -1.0, ..good }], 1), MixtureError::BadSample { index: 1 });
        assert_eq!(
            fit(&[WeightedSample { point: [f64::NAN; 3], weight: 1.0 }], 1),
            MixtureError::BadSample { index: 0 }
        );
        assert_eq!(fit(&[good], 0), MixtureError::BadCount { components: 0 });
        assert_eq!(fit(&[good], 65), MixtureError::BadCount { components: 65 });
        let c =
            Component { weight: 1.0, mean: [0.0; 3], covariance: [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]] };
        assert_eq!(Mixture { components: vec![c] }.whitened().unwrap_err(), MixtureError::BadComponent { index: 0 });
        assert_eq!(Mixture { components: vec![] }.whitened().unwrap_err(), MixtureError::BadCount { components: 0 });
    }
}
