//! Samplers of minimal samples.

use crate::match_blocks::random_below;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// A sampling strategy for minimal samples.
pub trait Sampler {
    /// Draws distinct indices of data into `sample`. There are at least `sample.len()` data.
    fn draw(&mut self, sample: &mut [u32]);
}

/// Uniform sampling: every sample is equally likely.
#[derive(Debug, Clone)]
pub struct Uniform {
    rng: ChaCha8Rng,
    n: u32,
}

impl Uniform {
    /// Creates a sampler of `n` data.
    pub fn new(n: usize, seed: u64) -> Self {
        Self { rng: ChaCha8Rng::seed_from_u64(seed), n: n as u32 }
    }
}

/// Draws distinct numbers below `n` into `sample`.
pub(super) fn draw_distinct(rng: &mut ChaCha8Rng, n: u32, sample: &mut [u32]) {
    for i in 0..sample.len() {
        // Rejection sampling: samples are small, so a second draw is rare.
        sample[i] = loop {
            let k = random_below(rng, n);
            if !sample[..i].contains(&k) {
                break k;
            }
        };
    }
}

impl Sampler for Uniform {
    fn draw(&mut self, sample: &mut [u32]) {
        draw_distinct(&mut self.rng, self.n, sample);
    }
}

/// Progressive sampling from a growing set of the highest ranked data (Chum & Matas, "Matching with PROSAC", 2005,
/// §2.2). Data must be sorted by decreasing quality. After `horizon` samples it is equivalent to [`Uniform`].
#[derive(Debug, Clone)]
pub struct Prosac {
    rng: ChaCha8Rng,
    n: u32,
    /// `n`: size of the set from which samples are drawn.
    subset: u32,
    /// `T_n`: expected number of uniform samples that lie entirely in the current set.
    expected_count: f64,
    /// `T'_n`: number of samples after which the set grows.
    grow_at: f64,
    drawn: usize,
    horizon: usize,
}

impl Prosac {
    /// Creates a sampler of samples of size `m` from `n` data. The set has grown to all data after `horizon` draws
    /// (`T_N` of the paper).
    pub fn new(n: usize, m: usize, horizon: usize, seed: u64) -> Self {
        // T_m: the expected number of `horizon` uniform samples that consist of the m highest ranked.
        let mut expected_count = horizon as f64;
        for i in 0..m {
            expected_count *= (m - i) as f64 / (n - i).max(1) as f64;
        }
        Self {
            rng: ChaCha8Rng::seed_from_u64(seed),
            n: n as u32,
            subset: m as u32,
            expected_count,
            grow_at: 1.0,
            drawn: 0,
            horizon,
        }
    }
}

impl Sampler for Prosac {
    fn draw(&mut self, sample: &mut [u32]) {
        let m = sample.len() as u32;
        self.drawn += 1;
        if self.drawn > self.horizon {
            return draw_distinct(&mut self.rng, self.n, sample);
        }
        while self.drawn as f64 > self.grow_at && self.subset < self.n {
            let next = self.expected_count * f64::from(self.subset + 1) / f64::from(self.subset + 1 - m);
            self.subset += 1;
            self.grow_at += (next - self.expected_count).ceil();
            self.expected_count = next;
        }
        if self.drawn as f64 > self.grow_at || self.subset <= m {
            draw_distinct(&mut self.rng, self.subset, sample);
        } else {
            // The newest member of the set, and the rest from the other members.
            let last = sample.len() - 1;
            draw_distinct(&mut self.rng, self.subset - 1, &mut sample[..last]);
            sample[last] = self.subset - 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn are_distinct_and_below(sample: &[u32], n: u32) -> bool {
        sample.iter().enumerate().all(|(i, k)| *k < n && !sample[..i].contains(k))
    }

    #[test]
    fn uniform_samples_are_distinct_and_uniformly_distributed() {
        let mut sampler = Uniform::new(10, 7);
        let mut counts = [0usize; 10];
        for _ in 0..10_000 {
            let mut sample = [0; 4];
            sampler.draw(&mut sample);
            assert!(are_distinct_and_below(&sample, 10));
            sample.iter().for_each(|&k| counts[k as usize] += 1);
        }
        // The expected count is 4000, with a standard deviation of √(10000·0.4·0.6) = 49: five of them.
        assert!(counts.iter().all(|c| c.abs_diff(4000) < 245), "{counts:?}");
    }

    #[test]
    fn a_set_of_the_sample_size_is_drawn_completely() {
        let mut sample = [0; 4];
        Uniform::new(4, 1).draw(&mut sample);
        assert!(are_distinct_and_below(&sample, 4));
        let mut prosac = Prosac::new(4, 4, 100, 1);
        for _ in 0..200 {
            prosac.draw(&mut sample);
            assert!(are_distinct_and_below(&sample, 4));
        }
    }

    #[test]
    fn prosac_starts_with_the_highest_ranked_and_grows_to_all() {
        let mut prosac = Prosac::new(100, 4, 5000, 3);
        let mut sample = [0; 4];
        prosac.draw(&mut sample);
        sample.sort_unstable();
        assert_eq!(sample, [0, 1, 2, 3]);
        let mut largest = 0;
        for i in 0..5000 {
            prosac.draw(&mut sample);
            assert!(are_distinct_and_below(&sample, 100));
            largest = largest.max(*sample.iter().max().unwrap());
            // Uniform samples of 100 data would almost surely include an index above 90 after 50 draws.
            assert!(i > 50 || largest < 60, "{largest} after {i}");
        }
        assert_eq!(largest, 99);
    }
}
