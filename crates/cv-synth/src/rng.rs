//! Seeded random numbers and hashes: small, stable, and independent of the order of evaluation.

/// SplitMix64 (Steele, Lea & Flood 2014), the generator of scene layouts.
#[derive(Debug, Clone)]
pub(crate) struct Rng(u64);

impl Rng {
    /// Creates the stream of `seed`; `salt` separates the streams of different uses.
    pub(crate) fn new(seed: u64, salt: u64) -> Self {
        let mut rng = Self(seed ^ salt.wrapping_mul(0xD6E8_FEB8_6659_FD93));
        rng.next();
        rng
    }

    pub(crate) fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    pub(crate) fn seed32(&mut self) -> u32 {
        (self.next() >> 32) as u32
    }

    /// Returns a uniform number in `[0, 1)`.
    pub(crate) fn unit(&mut self) -> f64 {
        (self.next() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Returns a uniform number in `[low, high)`.
    pub(crate) fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    pub(crate) fn range32(&mut self, low: f32, high: f32) -> f32 {
        self.range(f64::from(low), f64::from(high)) as f32
    }

    /// Returns a uniform integer in `0..n`; 0 for `n = 0`.
    pub(crate) fn index(&mut self, n: usize) -> usize {
        ((self.unit() * n as f64) as usize).min(n.saturating_sub(1))
    }

    pub(crate) fn chance(&mut self, p: f64) -> bool {
        self.unit() < p
    }

    pub(crate) fn pick<T: Copy, const N: usize>(&mut self, items: [T; N]) -> T {
        items[self.index(N)]
    }
}

/// Returns a well-mixed hash of a lattice point.
#[inline]
pub(crate) fn hash2(x: i32, y: i32, seed: u32) -> u32 {
    finalize_hash(seed ^ (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA77).rotate_left(13))
}

/// Returns a well-mixed hash of a point of a 3-D lattice.
#[inline]
pub(crate) fn hash3(x: i32, y: i32, z: i32, seed: u32) -> u32 {
    hash2(x, y, seed ^ (z as u32).wrapping_mul(0xC2B2_AE3D).rotate_left(7))
}

#[inline]
fn finalize_hash(mut h: u32) -> u32 {
    h ^= h >> 16;
    h = h.wrapping_mul(0x21F0_AAAD);
    h ^= h >> 15;
    h = h.wrapping_mul(0x735A_2D97);
    h ^ (h >> 15)
}

/// Converts a hash to a number in `[0, 1)`.
#[inline]
pub(crate) fn unit(hash: u32) -> f32 {
    (hash >> 8) as f32 * (1.0 / (1 << 24) as f32)
}

/// Returns two independent standard normal numbers for a counter (Box-Muller).
pub(crate) fn normal_pair(seed: u64, counter: u64) -> (f32, f32) {
    let mut rng = Rng(seed ^ counter.wrapping_mul(0xA076_1D64_78BD_642F));
    let radius = (-2.0 * (1.0 - rng.unit()).ln()).sqrt();
    let (sin, cos) = (std::f64::consts::TAU * rng.unit()).sin_cos();
    ((radius * cos) as f32, (radius * sin) as f32)
}
