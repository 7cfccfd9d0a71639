//! Gradient noise (Perlin 2002), band-limited by the sample width.

use crate::rng::{hash3, unit};
use fearless_simd::{Level, dispatch, f32x8, i32x8, prelude::*, u32x8};
use fearless_simd_macros::simd;
use std::sync::LazyLock;

/// `floor` without a library call.
#[inline]
pub(crate) fn floor(x: f32) -> i32 {
    let i = x as i32;
    i - i32::from(x < i as f32)
}

#[inline]
fn fade(t: f32) -> f32 {
    t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
}

/// Both coordinates of a unit vector along a diagonal.
const DIAGONAL: f32 = std::f32::consts::FRAC_1_SQRT_2;

#[inline]
fn gradient(hash: u32, x: f32, y: f32) -> f32 {
    // Eight directions: four axes, four diagonals, all with the same mean square.
    const D: f32 = DIAGONAL;
    const X: [f32; 8] = [1.0, -1.0, 0.0, 0.0, D, -D, D, -D];
    const Y: [f32; 8] = [0.0, 0.0, 1.0, -1.0, D, D, -D, -D];
    let i = (hash >> 29) as usize;
    X[i] * x + Y[i] * y
}

/// Gradient noise, about −1 to 1, one feature per unit.
#[inline]
pub(crate) fn noise2(x: f32, y: f32, seed: u32) -> f32 {
    let (xi, yi) = (floor(x), floor(y));
    let (fx, fy) = (x - xi as f32, y - yi as f32);
    let (sx, sy) = (fade(fx), fade(fy));
    // A lighter hash than `hash2`: only the top three bits are used.
    let hash = |dx: i32, dy: i32| {
        let h = seed ^ ((xi + dx) as u32).wrapping_mul(0x9E37_79B1) ^ ((yi + dy) as u32).wrapping_mul(0x85EB_CA77);
        (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D)
    };
    let g = |dx: i32, dy: i32| gradient(hash(dx, dy), fx - dx as f32, fy - dy as f32);
    let top = g(0, 0) + sx * (g(1, 0) - g(0, 0));
    let bottom = g(0, 1) + sx * (g(1, 1) - g(0, 1));
    1.6 * (top + sy * (bottom - top))
}

/// Value noise in three dimensions, −1 to 1.
pub(crate) fn noise3(p: [f32; 3], seed: u32) -> f32 {
    let i = p.map(floor);
    let f: [f32; 3] = std::array::from_fn(|a| fade(p[a] - i[a] as f32));
    let v = |dx: i32, dy: i32, dz: i32| 2.0 * unit(hash3(i[0] + dx, i[1] + dy, i[2] + dz, seed)) - 1.0;
    let x = |dy, dz| v(0, dy, dz) + f[0] * (v(1, dy, dz) - v(0, dy, dz));
    let y = |dz| x(0, dz) + f[1] * (x(1, dz) - x(0, dz));
    y(0) + f[2] * (y(1) - y(0))
}

/// Returns the contrast that a pattern of `frequency` (per meter) retains for a sample of `width` (meters): 1 to 0.
#[inline]
pub(crate) fn contrast(frequency: f32, width: f32) -> f32 {
    // Full up to a fifth of a period per sample, zero from half a period on.
    ((0.5 - frequency * width) / 0.3).clamp(0.0, 1.0)
}

/// Maximum number of octaves: all are evaluated in one vector.
const MAX_OCTAVES: usize = 8;

/// Octaves of gradient noise, eight at most.
#[derive(Debug, Clone)]
pub(crate) struct Octaves {
    frequencies: [f32; MAX_OCTAVES],
    /// 0 for missing octaves.
    amplitudes: [f32; MAX_OCTAVES],
}

impl Octaves {
    /// Creates `count` octaves from `frequency` upwards, each with `gain` times the amplitude of the previous one.
    pub(crate) const fn new(frequency: f32, count: usize, gain: f32) -> Self {
        let (mut f, mut a, mut octave) = (frequency, 1.0, 0);
        let mut octaves = Self { frequencies: [f; MAX_OCTAVES], amplitudes: [0.0; MAX_OCTAVES] };
        while octave < count && octave < MAX_OCTAVES {
            octaves.frequencies[octave] = f;
            octaves.amplitudes[octave] = a;
            // Not exactly 2, so that the lattices of the octaves do not line up.
            f *= 2.03;
            a *= gain;
            octave += 1;
        }
        octaves
    }
}

/// Offset of the seed of each octave.
const SEED_OFFSETS: [u32; MAX_OCTAVES] = {
    let (mut seeds, mut octave) = ([0u32; MAX_OCTAVES], 0);
    while octave < MAX_OCTAVES {
        seeds[octave] = (octave as u32).wrapping_mul(0x9E37_79B9);
        octave += 1;
    }
    seeds
};

/// The instruction set of the noise.
static LEVEL: LazyLock<Level> = LazyLock::new(Level::new);

/// Returns the sum of the octaves, band-limited to a sample of `width`; about −1 to 1.
pub(crate) fn fbm(u: f32, v: f32, octaves: &Octaves, seed: u32, width: f32) -> f32 {
    let contrast_0 = contrast(octaves.frequencies[0], width);
    if contrast_0 <= 0.0 {
        0.0
    } else if contrast(octaves.frequencies[1], width) <= 0.0 {
        // A sum, so that a zero is positive.
        0.0 + contrast_0 * octaves.amplitudes[0] * noise2(u * octaves.frequencies[0], v * octaves.frequencies[0], seed)
    } else {
        dispatch!(*LEVEL, simd => fbm_impl(simd, u, v, octaves, seed, width))
    }
}

#[simd]
fn fbm_impl<S: Simd>(simd: S, u: f32, v: f32, octaves: &Octaves, seed: u32, width: f32) -> f32 {
    let frequencies = f32x8::from_slice(simd, &octaves.frequencies);
    let contrasts = ((0.5 - frequencies * width) / 0.3).max(0.0).min(1.0);
    let amplitudes = contrasts * f32x8::from_slice(simd, &octaves.amplitudes);
    let noises = noises(simd, frequencies * u, frequencies * v, u32x8::from_slice(simd, &SEED_OFFSETS) + seed);
    // Missing octaves add nothing, not even non-finite values.
    let zero = f32x8::splat(simd, 0.0);
    let terms: [f32; MAX_OCTAVES] = amplitudes.simd_gt(zero).select(amplitudes * noises, zero).into();
    terms.iter().fold(0.0, |sum, term| sum + term)
}

/// As [`noise2`] at eight positions; zeros may differ in sign.
#[inline(always)]
fn noises<S: Simd>(simd: S, x: f32x8<S>, y: f32x8<S>, seeds: u32x8<S>) -> f32x8<S> {
    let (xi, yi) = (floors(x), floors(y));
    let (fx, fy) = (x - xi.to_float::<f32x8<S>>(), y - yi.to_float::<f32x8<S>>());
    let (sx, sy) = (fades(fx), fades(fy));
    let (hx, hy) = (xi.bitcast::<u32x8<S>>() * 0x9E37_79B1, yi.bitcast::<u32x8<S>>() * 0x85EB_CA77);
    let (hx0, hx1) = (seeds ^ hx, seeds ^ (hx + 0x9E37_79B1));
    let (hy0, hy1) = (hy, hy + 0x85EB_CA77);
    let (fx1, fy1) = (fx - 1.0, fy - 1.0);
    let g00 = gradients(simd, hx0 ^ hy0, fx, fy);
    let g10 = gradients(simd, hx1 ^ hy0, fx1, fy);
    let g01 = gradients(simd, hx0 ^ hy1, fx, fy1);
    let g11 = gradients(simd, hx1 ^ hy1, fx1, fy1);
    let top = g00 + sx * (g10 - g00);
    let bottom = g01 + sx * (g11 - g01);
    (top + sy * (bottom - top)) * 1.6
}

#[inline(always)]
fn floors<S: Simd>(x: f32x8<S>) -> i32x8<S> {
    let i: i32x8<S> = x.to_int_precise();
    x.simd_lt(i.to_float::<f32x8<S>>()).select(i - 1, i)
}

#[inline(always)]
fn fades<S: Simd>(t: f32x8<S>) -> f32x8<S> {
    t * t * t * (t * (t * 6.0 - 15.0) + 10.0)
}

/// As [`gradient`], from an unfinished hash.
#[inline(always)]
fn gradients<S: Simd>(simd: S, h: u32x8<S>, x: f32x8<S>, y: f32x8<S>) -> f32x8<S> {
    let h = (h ^ (h >> 15)) * 0x2C1B_3C6D;
    // The highest bit: a diagonal or an axis. The second: the sign of y, or which axis. The third: the sign of x, or of
    // the only nonzero coordinate.
    let (diagonal, second, third) = (h.bitcast::<i32x8<S>>().simd_lt(0), h << 1, h << 2);
    let along = second.bitcast::<i32x8<S>>().simd_lt(0).select(y, x);
    let first = diagonal.select(x * DIAGONAL, along).bitcast::<u32x8<S>>() ^ (third & SIGN);
    let other = (y * DIAGONAL).bitcast::<u32x8<S>>() ^ (second & SIGN);
    first.bitcast::<f32x8<S>>() + diagonal.select(other.bitcast(), f32x8::splat(simd, 0.0))
}

/// The sign bit.
const SIGN: u32 = 1 << 31;

/// As [`fbm`], in three dimensions.
pub(crate) fn fbm3(p: [f32; 3], frequency: f32, octaves: u32, gain: f32, seed: u32, width: f32) -> f32 {
    let (mut f, mut a, mut sum) = (frequency, 1.0, 0.0);
    for octave in 0..octaves {
        let contrast_here = contrast(f, width);
        if contrast_here <= 0.0 {
            break;
        }
        sum += contrast_here * a * noise3(p.map(|c| c * f), seed.wrapping_add(octave.wrapping_mul(0x9E37_79B9)));
        f *= 2.03;
        a *= gain;
    }
    sum
}

/// Returns the coverage of the half plane `distance > 0` by a sample of `width`, a box filter.
#[inline]
pub(crate) fn edge(distance: f32, width: f32) -> f32 {
    (0.5 + distance / width.max(1e-6)).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::instruction_sets;
    use crate::rng::Rng;

    /// Returns the sum octave by octave.
    fn fbm_reference(u: f32, v: f32, (frequency, count, gain): (f32, usize, f32), seed: u32, width: f32) -> f32 {
        let (mut f, mut a, mut sum) = (frequency, 1.0, 0.0);
        for octave in 0..count as u32 {
            let contrast_here = contrast(f, width);
            if contrast_here <= 0.0 {
                break;
            }
            sum += contrast_here * a * noise2(u * f, v * f, seed.wrapping_add(octave.wrapping_mul(0x9E37_79B9)));
            (f, a) = (f * 2.03, a * gain);
        }
        sum
    }

    #[test]
    fn vectorized_octaves_equal_the_reference_on_every_instruction_set() {
        let mut rng = Rng::new(1, 2);
        for i in 0..30_000 {
            // Up to values that are no longer finite.
            let range = [1.0, 30.0, 1e9, 1e35][i % 4];
            let (mut u, v, seed) = (rng.range32(-range, range), rng.range32(-range, range), rng.seed32());
            let mut f = rng.range32(0.6, 100.0);
            if i % 7 == 0 {
                // On the lattice.
                (u, f) = (u.round(), f.round());
            }
            let count = 1 + rng.index(8);
            let width = if i % 5 == 0 { 0.0 } else { rng.range32(0.0, 0.6) / f };
            let parameters = (f, count, rng.range32(0.4, 0.9));
            let octaves = Octaves::new(parameters.0, parameters.1, parameters.2);
            let expected = fbm_reference(u, v, parameters, seed, width);
            let is_same = |found: f32| found.to_bits() == expected.to_bits() || found.is_nan() && expected.is_nan();
            assert!(is_same(fbm(u, v, &octaves, seed, width)), "{u} {v} {parameters:?} {seed} {width}");
            for level in instruction_sets() {
                let found = dispatch!(level, simd => fbm_impl(simd, u, v, &octaves, seed, width));
                assert!(is_same(found), "{level:?} {u} {v} {parameters:?} {seed} {width}: {found} {expected}");
            }
        }
    }
}
