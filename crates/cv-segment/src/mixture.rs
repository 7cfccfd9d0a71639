//! Mixtures of Gaussians, fitted by expectation-maximization.

use cv_core::{Cancelled, Progress, Stage};
use nalgebra::{Matrix3, Vector3};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// A point and how often it was seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WeightedSample {
    /// Coordinates.
    pub point: [f64; 3],
    /// How often; not negative.
    pub weight: f64,
}

/// One Gaussian of a mixture.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Component {
    /// Its share of the mixture, 0 to 1.
    pub weight: f64,
    /// Mean.
    pub mean: [f64; 3],
    /// Covariance, by rows.
    pub covariance: [[f64; 3]; 3],
}

/// A weighted sum of Gaussians.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Mixture {
    /// The Gaussians, largest weight first.
    pub components: Vec<Component>,
}

/// How a mixture is fitted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MixtureOptions {
    /// Gaussians, 1 to 64. Fewer result where there are fewer distinct points.
    pub components: usize,
    /// Added to each variance, in units of the samples' own variance along that axis. Default 1e-6.
    pub regularization: f64,
    /// Standard deviations below which differences between points mean nothing; their squares are added to the variances. Default 0.
    pub resolution: [f64; 3],
    /// Most rounds of expectation and maximization. Default 200.
    pub max_iterations: usize,
    /// Stops when a round raises the mean log density by less. Default 1e-4 (a tenth of scikit-learn's).
    pub tolerance: f64,
    /// Seed of the choice of the first means. Default 1.
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

/// Why no mixture could be fitted or used.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum MixtureError {
    /// There are no samples of positive weight.
    #[error("there are no samples to fit a mixture to")]
    NoSamples,
    /// A sample is not finite or has a negative weight.
    #[error("sample {index} is not a finite point with a weight")]
    BadSample {
        /// Which.
        index: usize,
    },
    /// Number of components outside 1 to 64.
    #[error("{components} components: between 1 and 64 can be fitted")]
    BadCount {
        /// How many were asked for.
        components: usize,
    },
    /// A covariance is not positive definite, or a weight or mean not a number that one can have.
    #[error("component {index} is not a Gaussian with a positive weight")]
    BadComponent {
        /// Which.
        index: usize,
    },
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

/// A component ready to evaluate: `log density = constant − ½ |A x + b|²`, `A` lower triangular.
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
    /// Fits a mixture by expectation-maximization (Dempster, Laird & Rubin 1977) on weighted samples, from a k-means++ start (Arthur & Vassilvitskii 2007) in
    /// coordinates scaled by the samples' standard deviations.
    ///
    /// Samples that are all one point give one Gaussian of the least width the options allow. Time is rounds × samples × components.
    ///
    /// # Errors
    /// [`MixtureError`] for no or bad samples, or a bad count.
    pub fn fit(
        samples: &[WeightedSample],
        options: &MixtureOptions,
        progress: &dyn Progress,
    ) -> Result<Self, MixtureError> {
        let k = options.components;
        if !(1..=64).contains(&k) {
            return Err(MixtureError::BadCount { components: k });
        }
        let bad =
            |s: &WeightedSample| !(s.weight >= 0.0 && s.weight.is_finite() && s.point.iter().all(|v| v.is_finite()));
        if let Some(index) = samples.iter().position(bad) {
            return Err(MixtureError::BadSample { index });
        }
        let total: f64 = samples.iter().map(|s| s.weight).sum();
        if total <= 0.0 {
            return Err(MixtureError::NoSamples);
        }
        let scatter = Scatter::of(samples.iter().map(|s| (s, s.weight)));
        let (mean, spread) = scatter.moments();
        let floor: [f64; 3] = std::array::from_fn(|i| {
            // Were everything one point and no resolution known, what rounding leaves of its size.
            let least = 1e-12 * (1.0 + mean[i] * mean[i]);
            (options.regularization * spread[(i, i)] + options.resolution[i].powi(2)).max(least)
        });
        let mut components = first_components(samples, k, &spread, &floor, options.seed, progress)?;
        let mut last = f64::NEG_INFINITY;
        let stage = Stage::new(progress, "fit", options.max_iterations)?;
        for _ in 0..options.max_iterations {
            let whitened: Vec<Whitened> = components.iter().filter_map(Whitened::new).collect();
            let (scatters, log_density) = expectation(samples, &whitened, &stage)?;
            components = maximization(&scatters, total, &floor);
            stage.add(1)?;
            let now = log_density / total;
            if now - last < options.tolerance {
                break;
            }
            last = now;
        }
        components.sort_by(|a, b| b.weight.total_cmp(&a.weight));
        Ok(Self { components })
    }

    /// The natural logarithm of the density at a point. `−∞` for a mixture without components.
    pub fn log_density(&self, point: [f64; 3]) -> f64 {
        let x = Vector3::from(point);
        let terms: Vec<f64> = self.components.iter().filter_map(Whitened::new).map(|c| c.log_density(&x)).collect();
        log_sum_exp(&terms)
    }

    /// The components ready to evaluate.
    pub(crate) fn whitened(&self) -> Result<Vec<Whitened>, MixtureError> {
        if !(1..=64).contains(&self.components.len()) {
            return Err(MixtureError::BadCount { components: self.components.len() });
        }
        let ready = |(index, c): (usize, &Component)| {
            let symmetric = (0..3).all(|i| {
                (0..3).all(|j| (c.covariance[i][j] - c.covariance[j][i]).abs() <= 1e-9 * c.covariance[i][i].abs())
            });
            Whitened::new(c).filter(|_| symmetric).ok_or(MixtureError::BadComponent { index })
        };
        self.components.iter().enumerate().map(ready).collect()
    }
}

fn log_sum_exp(terms: &[f64]) -> f64 {
    let max = terms.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if max == f64::NEG_INFINITY {
        return max;
    }
    max + terms.iter().map(|t| (t - max).exp()).sum::<f64>().ln()
}

/// Weighted sums of points and of their products.
#[derive(Clone, Copy)]
struct Scatter {
    weight: f64,
    sum: Vector3<f64>,
    products: Matrix3<f64>,
}

impl Scatter {
    const ZERO: Self = Self {
        weight: 0.0,
        sum: Vector3::new(0.0, 0.0, 0.0),
        products: Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    };

    fn of<'a>(samples: impl Iterator<Item = (&'a WeightedSample, f64)>) -> Self {
        let mut scatter = Self::ZERO;
        for (s, weight) in samples {
            scatter.add(&Vector3::from(s.point), weight);
        }
        scatter
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

    /// Mean and covariance.
    fn moments(&self) -> (Vector3<f64>, Matrix3<f64>) {
        let mean = self.sum / self.weight;
        (mean, self.products / self.weight - mean * mean.transpose())
    }

    fn component(&self, total: f64, floor: &[f64; 3]) -> Component {
        let (mean, mut covariance) = self.moments();
        for i in 0..3 {
            // Cancellation can leave a variance a rounding below zero.
            covariance[(i, i)] = covariance[(i, i)].max(0.0) + floor[i];
        }
        let covariance =
            std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (covariance[(i, j)] + covariance[(j, i)])));
        Component { weight: self.weight / total, mean: mean.into(), covariance }
    }
}

/// The first means by k-means++ and ten rounds of k-means, the first covariances those of their clusters.
fn first_components(
    samples: &[WeightedSample],
    k: usize,
    spread: &Matrix3<f64>,
    floor: &[f64; 3],
    seed: u64,
    progress: &dyn Progress,
) -> Result<Vec<Component>, Cancelled> {
    const ROUNDS: usize = 10;
    let stage = Stage::new(progress, "clusters", k + ROUNDS + 1)?;
    let scale = Vector3::from_fn(|i, _| 1.0 / (spread[(i, i)].max(0.0) + floor[i]).sqrt());
    let points: Vec<Vector3<f64>> = samples.iter().map(|s| Vector3::from(s.point).component_mul(&scale)).collect();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut centers: Vec<Vector3<f64>> = Vec::with_capacity(k);
    let mut nearest: Vec<f64> = vec![1.0; samples.len()];
    while centers.len() < k {
        // With no center yet every distance is one: the first is drawn by weight alone.
        let chances = || samples.iter().zip(&nearest).map(|(s, d)| s.weight * d);
        let Some(chosen) = draw(chances, &mut rng) else { break };
        let center = points[chosen];
        for (d, p) in nearest.iter_mut().zip(&points) {
            let distance = (p - center).norm_squared();
            *d = if centers.is_empty() { distance } else { d.min(distance) };
        }
        centers.push(center);
        stage.add(1)?;
    }
    let mut clusters = Vec::new();
    for round in 0..=ROUNDS {
        clusters = vec![Scatter::ZERO; centers.len()];
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
        if round < ROUNDS {
            for (center, cluster) in centers.iter_mut().zip(&clusters) {
                if cluster.weight > 0.0 {
                    *center = (cluster.sum / cluster.weight).component_mul(&scale);
                }
            }
        }
    }
    let total = samples.iter().map(|s| s.weight).sum();
    Ok(maximization(&clusters, total, floor))
}

/// Draws an index by chances; `None` where all are zero.
fn draw<I: Iterator<Item = f64>>(chances: impl Fn() -> I, rng: &mut impl Rng) -> Option<usize> {
    let total: f64 = chances().sum();
    let mut left = rng.random::<f64>() * total;
    let mut last = None;
    for (i, chance) in chances().enumerate() {
        if chance > 0.0 {
            last = Some(i);
            left -= chance;
            if left < 0.0 {
                break;
            }
        }
    }
    last
}

/// Samples that are worked on together, and without asking whether to go on.
const CHUNK: usize = 1024;

/// The points' shares in each component, as sums, and the log density of all.
fn expectation(
    samples: &[WeightedSample],
    components: &[Whitened],
    stage: &Stage<'_>,
) -> Result<(Vec<Scatter>, f64), Cancelled> {
    let zero = || (vec![Scatter::ZERO; components.len()], 0.0);
    // Chunks of fixed size, added up in order: the sums do not depend on the number of threads.
    let parts: Vec<(Vec<Scatter>, f64)> = samples
        .par_chunks(CHUNK)
        .map(|chunk| {
            stage.check()?;
            let (mut scatters, mut log_density) = zero();
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
                    // Shares below e^-40 of the largest are lost in f64 anyway.
                    *term = if *term - max > -40.0 { (*term - max).exp() } else { 0.0 };
                    sum += *term;
                }
                log_density += s.weight * (max + sum.ln());
                for (scatter, term) in scatters.iter_mut().zip(&terms) {
                    if *term > 0.0 {
                        scatter.add(&x, s.weight * term / sum);
                    }
                }
            }
            Ok((scatters, log_density))
        })
        .collect::<Result<_, Cancelled>>()?;
    Ok(parts.iter().fold(zero(), |(sums, total), (scatters, log_density)| {
        (sums.iter().zip(scatters).map(|(a, b)| a.plus(b)).collect(), total + log_density)
    }))
}

/// New components; those that hold no points go.
fn maximization(scatters: &[Scatter], total: f64, floor: &[f64; 3]) -> Vec<Component> {
    // A billionth of all points is no component.
    scatters.iter().filter(|s| s.weight > 1e-9 * total).map(|s| s.component(total, floor)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Silent;

    /// Points of a Gaussian with the given mean and standard deviations, drawn by the sum of twelve uniform numbers.
    fn cloud(n: usize, mean: [f64; 3], deviation: [f64; 3], seed: u64) -> Vec<WeightedSample> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut normal = || (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0;
        (0..n)
            .map(|_| WeightedSample { point: std::array::from_fn(|i| mean[i] + deviation[i] * normal()), weight: 1.0 })
            .collect()
    }

    #[test]
    fn one_gaussian_has_the_moments_of_its_points() {
        let samples = cloud(5000, [1.0, -2.0, 0.5], [0.1, 0.2, 0.05], 3);
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
    fn three_clouds_are_found_apart() {
        let truth = [([0.0, 0.0, 0.0], 3000), ([2.0, 0.0, 1.0], 2000), ([0.0, 3.0, -1.0], 1000)];
        let samples: Vec<_> =
            truth.iter().zip(1u64..).flat_map(|(&(mean, n), seed)| cloud(n, mean, [0.2, 0.3, 0.1], seed)).collect();
        for seed in 0..10 {
            let fit =
                Mixture::fit(&samples, &MixtureOptions { components: 3, seed, ..Default::default() }, &Silent).unwrap();
            for (c, (mean, n)) in fit.components.iter().zip(truth) {
                // Ten standard deviations apart: no point is shared. Standard error of a mean 0.3/√1000 = 0.01.
                assert!((c.weight - n as f64 / 6000.0).abs() < 1e-3, "{seed} {fit:?}");
                assert!(c.mean.iter().zip(mean).all(|(a, b)| (a - b).abs() < 0.04));
            }
        }
    }

    #[test]
    fn a_weight_counts_as_that_many_points() {
        let points = cloud(300, [0.0; 3], [1.0, 0.5, 2.0], 8);
        let doubled: Vec<_> = points.iter().flat_map(|&s| [s, s, s]).collect();
        let weighted: Vec<_> = points.iter().map(|s| WeightedSample { weight: 3.0, ..*s }).collect();
        let options = MixtureOptions::default();
        let (a, b) =
            (Mixture::fit(&doubled, &options, &Silent).unwrap(), Mixture::fit(&weighted, &options, &Silent).unwrap());
        // The same sums in another order.
        assert!((a.log_density([0.3, 0.1, 1.0]) - b.log_density([0.3, 0.1, 1.0])).abs() < 1e-9);
    }

    #[test]
    fn the_density_is_the_formula() {
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
    fn degenerate_samples_give_gaussians_all_the_same() {
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
    fn what_cannot_be_fitted_is_said() {
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
