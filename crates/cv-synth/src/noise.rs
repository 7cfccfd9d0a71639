//! Gradient noise (Perlin 2002) whose fine octaves fade out where the sampling could not show them.

use crate::rng::{hash3, unit};

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

#[inline]
fn gradient(hash: u32, x: f32, y: f32) -> f32 {
    // Eight directions: four axes, four diagonals, all with the same mean square.
    const D: f32 = std::f32::consts::FRAC_1_SQRT_2;
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

/// How much of a pattern with `frequency` (per meter) a sample of `width` (meters) still shows: 1 to 0.
#[inline]
pub(crate) fn visible(frequency: f32, width: f32) -> f32 {
    // Full up to a fifth of a period per sample, gone at half of one.
    ((0.5 - frequency * width) / 0.3).clamp(0.0, 1.0)
}

/// Octaves from `frequency` upwards, each with `gain` times the amplitude of the one before; about −1 to 1.
pub(crate) fn fbm(u: f32, v: f32, frequency: f32, octaves: u32, gain: f32, seed: u32, width: f32) -> f32 {
    let (mut f, mut a, mut sum) = (frequency, 1.0, 0.0);
    for octave in 0..octaves {
        let shown = visible(f, width);
        if shown <= 0.0 {
            break;
        }
        sum += shown * a * noise2(u * f, v * f, seed.wrapping_add(octave.wrapping_mul(0x9E37_79B9)));
        // Not exactly 2, so that the lattices of the octaves do not line up.
        f *= 2.03;
        a *= gain;
    }
    sum
}

/// The same in three dimensions.
pub(crate) fn fbm3(p: [f32; 3], frequency: f32, octaves: u32, gain: f32, seed: u32, width: f32) -> f32 {
    let (mut f, mut a, mut sum) = (frequency, 1.0, 0.0);
    for octave in 0..octaves {
        let shown = visible(f, width);
        if shown <= 0.0 {
            break;
        }
        sum += shown * a * noise3(p.map(|c| c * f), seed.wrapping_add(octave.wrapping_mul(0x9E37_79B9)));
        f *= 2.03;
        a *= gain;
    }
    sum
}

/// Coverage of the half plane `distance > 0` by a sample of `width`, a box filter.
#[inline]
pub(crate) fn edge(distance: f32, width: f32) -> f32 {
    (0.5 + distance / width.max(1e-6)).clamp(0.0, 1.0)
}
