//! Minimal samples.

use crate::match_blocks::below;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// A source of minimal samples.
pub trait Sampler {
    /// Fills `sample` with different indices of data. There are at least as many data as places.
    fn draw(&mut self, sample: &mut [u32]);
}

/// Every sample is equally likely.
#[derive(Debug, Clone)]
pub struct Uniform {
    rng: ChaCha8Rng,
    n: u32,
}

impl Uniform {
    /// Samples of `n` data.
    pub fn new(n: usize, seed: u64) -> Self {
        Self { rng: ChaCha8Rng::seed_from_u64(seed), n: n as u32 }
    }
}

/// Fills `sample` with different numbers below `n`.
pub(super) fn distinct(rng: &mut ChaCha8Rng, n: u32, sample: &mut [u32]) {
    for i in 0..sample.len() {
        // Rejection: samples are small, so it seldom takes two tries.
        sample[i] = loop {
            let k = below(rng, n);
            if !sample[..i].contains(&k) {
                break k;
            }
        };
    }
}

impl Sampler for Uniform {
    fn draw(&mut self, sample: &mut [u32]) {
        distinct(&mut self.rng, self.n, sample);
    }
}

/// Samples from a growing set of the best data, which come sorted, the best first (Chum & Matas, "Matching with
/// PROSAC", 2005, §2.2). After `horizon` samples it draws as [`Uniform`] does.
#[derive(Debug, Clone)]
pub struct Prosac {
    rng: ChaCha8Rng,
    n: u32,
    /// Size of the set that samples are drawn from.
    subset: u32,
    /// `T_n`: samples of uniform sampling that would lie wholly in the current set, on average.
    average: f64,
    /// `T'_n`: the number of samples after which the set grows.
    grow_at: f64,
    drawn: usize,
    horizon: usize,
}

impl Prosac {
    /// Samples of size `m` of `n` data that spread over all of them in `horizon` draws.
    pub fn new(n: usize, m: usize, horizon: usize, seed: u64) -> Self {
        // T_m: of `horizon` uniform samples, how many consist of the m best.
        let mut average = horizon as f64;
        for i in 0..m {
            average *= (m - i) as f64 / (n - i).max(1) as f64;
        }
        Self {
            rng: ChaCha8Rng::seed_from_u64(seed),
            n: n as u32,
            subset: m as u32,
            average,
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
            return distinct(&mut self.rng, self.n, sample);
        }
        while self.drawn as f64 > self.grow_at && self.subset < self.n {
            let next = self.average * f64::from(self.subset + 1) / f64::from(self.subset + 1 - m);
            self.subset += 1;
            self.grow_at += (next - self.average).ceil();
            self.average = next;
        }
        if self.drawn as f64 > self.grow_at || self.subset <= m {
            distinct(&mut self.rng, self.subset, sample);
        } else {
            // The newest member and the rest from those before it.
            let last = sample.len() - 1;
            distinct(&mut self.rng, self.subset - 1, &mut sample[..last]);
            sample[last] = self.subset - 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn all_distinct_and_below(sample: &[u32], n: u32) -> bool {
        sample.iter().enumerate().all(|(i, k)| *k < n && !sample[..i].contains(k))
    }

    #[test]
    fn uniform_samples_are_distinct_and_cover_everything_evenly() {
        let mut sampler = Uniform::new(10, 7);
        let mut counts = [0usize; 10];
        for _ in 0..10_000 {
            let mut sample = [0; 4];
            sampler.draw(&mut sample);
            assert!(all_distinct_and_below(&sample, 10));
            sample.iter().for_each(|&k| counts[k as usize] += 1);
        }
        // Each expects 4000 with a standard deviation of √(10000·0.4·0.6) = 49: five of them.
        assert!(counts.iter().all(|c| c.abs_diff(4000) < 245), "{counts:?}");
    }

    #[test]
    fn the_smallest_set_is_drawn_whole() {
        let mut sample = [0; 4];
        Uniform::new(4, 1).draw(&mut sample);
        assert!(all_distinct_and_below(&sample, 4));
        let mut prosac = Prosac::new(4, 4, 100, 1);
        for _ in 0..200 {
            prosac.draw(&mut sample);
            assert!(all_distinct_and_below(&sample, 4));
        }
    }

    #[test]
    fn prosac_starts_with_the_best_and_reaches_all() {
        let mut prosac = Prosac::new(100, 4, 5000, 3);
        let mut sample = [0; 4];
        prosac.draw(&mut sample);
        sample.sort_unstable();
        assert_eq!(sample, [0, 1, 2, 3]);
        let mut largest = 0;
        for i in 0..5000 {
            prosac.draw(&mut sample);
            assert!(all_distinct_and_below(&sample, 100));
            largest = largest.max(*sample.iter().max().unwrap());
            // Uniform samples of 100 would almost surely have reached 90 by now.
            assert!(i > 50 || largest < 60, "{largest} after {i}");
        }
        assert_eq!(largest, 99);
    }
}
