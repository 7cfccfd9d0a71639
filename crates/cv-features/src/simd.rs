//! SIMD kernels, compiled for each instruction set and dispatched at run time.
//!
//! All arithmetic is multiplications and additions in a fixed order (never fused), lane by lane, so all instruction
//! sets give identical results; tests compare each with scalar loops.

use crate::ByteScale;
use fearless_simd::{Level, dispatch, f32x16, prelude::*};

/// Returns the widest instruction set of this machine.
#[inline]
pub(crate) fn level() -> Level {
    Level::new()
}

/// Convolves vertically with a symmetric kernel, given as its half: `out[x] = k[0]·rows[r][x] + Σ k[t]·(rows[r−t][x] +
/// rows[r+t][x])`, `t` from 1 to `r = k.len() − 1`.
pub(crate) fn vertical(level: Level, out: &mut [f32], rows: &[&[f32]], kernel: &[f32]) {
    assert!(rows.len() == 2 * kernel.len() - 1 && rows.iter().all(|r| r.len() == out.len()));
    dispatch!(level, simd => symmetric(simd, out, kernel, VerticalTaps { rows }));
}

/// Evaluates two phases of a vertical polyphase filter: `even` at row `r`, as [`vertical`] of all rows but the last,
/// and `odd` half-way between rows `r` and `r + 1`, as `Σ o[t]·(rows[r−t][x] + rows[r+1+t][x])`, `t` from 0 to `r`.
/// Both half-kernels have `r + 1` taps.
pub(crate) fn vertical_phases(
    level: Level,
    [even, odd]: [&mut [f32]; 2],
    rows: &[&[f32]],
    evens: &[f32],
    odds: &[f32],
) {
    assert!(rows.len() == 2 * evens.len() && rows.iter().all(|r| r.len() == even.len()));
    assert!(evens.len() == odds.len() && even.len() == odd.len());
    dispatch!(level, simd => phases(simd, [even, odd], evens, odds, VerticalTaps { rows }));
}

/// Convolves horizontally with a symmetric kernel, given as its half: `out[x] = k[0]·row[x+r] + Σ k[t]·(row[x+r−t] +
/// row[x+r+t])`, `t` from 1 to `r = k.len() − 1`.
pub(crate) fn horizontal(level: Level, out: &mut [f32], row: &[f32], kernel: &[f32]) {
    assert_eq!(row.len(), out.len() + 2 * (kernel.len() - 1));
    dispatch!(level, simd => symmetric(simd, out, kernel, HorizontalTaps { row }));
}

/// Evaluates two phases of a horizontal polyphase filter: `even` at the samples, as [`horizontal`] of all but the last,
/// and `odd` half-way to the next ones, as `Σ o[t]·(row[x+r−t] + row[x+r+1+t])`, `t` from 0 to `r`. Both half-kernels
/// have `r + 1` taps.
pub(crate) fn horizontal_phases(level: Level, [even, odd]: [&mut [f32]; 2], row: &[f32], evens: &[f32], odds: &[f32]) {
    assert!(row.len() + 1 == even.len() + 2 * evens.len());
    assert!(evens.len() == odds.len() && even.len() == odd.len());
    dispatch!(level, simd => phases(simd, [even, odd], evens, odds, HorizontalTaps { row }));
}

/// Access to the samples of a filter tap.
trait Taps: Copy {
    /// Returns the `n` samples of tap `tap` from column `x`.
    fn at(&self, tap: usize, x: usize, n: usize) -> &[f32];
}

/// Taps along a column.
#[derive(Clone, Copy)]
struct VerticalTaps<'a> {
    rows: &'a [&'a [f32]],
}

impl Taps for VerticalTaps<'_> {
    #[inline(always)]
    fn at(&self, tap: usize, x: usize, n: usize) -> &[f32] {
        &self.rows[tap][x..x + n]
    }
}

/// Taps along a row.
#[derive(Clone, Copy)]
struct HorizontalTaps<'a> {
    row: &'a [f32],
}

impl Taps for HorizontalTaps<'_> {
    #[inline(always)]
    fn at(&self, tap: usize, x: usize, n: usize) -> &[f32] {
        &self.row[x + tap..x + tap + n]
    }
}

/// Convolves with a symmetric kernel centered at the samples.
#[inline(always)]
fn symmetric<S: Simd, T: Taps>(simd: S, out: &mut [f32], kernel: &[f32], taps: T) {
    let n = S::f32s::LEN;
    let width = out.len();
    let r = kernel.len() - 1;
    let mut x = 0;
    // Four vectors at a time, whose sums stay in registers over all taps.
    while x + 4 * n <= width {
        let mut sums = [S::f32s::splat(simd, 0.0); 4];
        let center = taps.at(r, x, 4 * n);
        for i in 0..4 {
            sums[i] = S::f32s::from_slice(simd, &center[i * n..(i + 1) * n]) * kernel[0];
        }
        for (t, &weight) in kernel.iter().enumerate().skip(1) {
            let (before, after) = (taps.at(r - t, x, 4 * n), taps.at(r + t, x, 4 * n));
            for i in 0..4 {
                let a = S::f32s::from_slice(simd, &before[i * n..(i + 1) * n]);
                let b = S::f32s::from_slice(simd, &after[i * n..(i + 1) * n]);
                sums[i] += (a + b) * weight;
            }
        }
        let out = &mut out[x..x + 4 * n];
        for i in 0..4 {
            sums[i].store_slice(&mut out[i * n..(i + 1) * n]);
        }
        x += 4 * n;
    }
    while x < width && width >= n {
        // The last vector overlaps the previous one.
        x = x.min(width - n);
        let mut sum = S::f32s::from_slice(simd, taps.at(r, x, n)) * kernel[0];
        for (t, &weight) in kernel.iter().enumerate().skip(1) {
            let a = S::f32s::from_slice(simd, taps.at(r - t, x, n));
            let b = S::f32s::from_slice(simd, taps.at(r + t, x, n));
            sum += (a + b) * weight;
        }
        sum.store_slice(&mut out[x..x + n]);
        x += n;
    }
    if width < n {
        for (x, o) in out.iter_mut().enumerate() {
            *o = taps.at(r, x, 1)[0] * kernel[0];
            for (t, &weight) in kernel.iter().enumerate().skip(1) {
                *o += (taps.at(r - t, x, 1)[0] + taps.at(r + t, x, 1)[0]) * weight;
            }
        }
    }
}

/// Dispatches to [`phases_of_length`] with compile-time lengths for the common scale spaces.
#[inline(always)]
fn phases<S: Simd, T: Taps>(simd: S, out: [&mut [f32]; 2], evens: &[f32], odds: &[f32], taps: T) {
    match evens.len() {
        4 => phases_of_length::<S, T, 4>(simd, out, evens, odds, taps),
        5 => phases_of_length::<S, T, 5>(simd, out, evens, odds, taps),
        6 => phases_of_length::<S, T, 6>(simd, out, evens, odds, taps),
        _ => phases_of_length::<S, T, 0>(simd, out, evens, odds, taps),
    }
}

/// Convolves with symmetric kernels centered at a sample and half-way to the next; the samples of both are loaded once.
/// Half-kernels have `LEN` taps, or any number if `LEN` is 0.
#[inline(always)]
fn phases_of_length<S: Simd, T: Taps, const LEN: usize>(
    simd: S,
    [even, odd]: [&mut [f32]; 2],
    evens: &[f32],
    odds: &[f32],
    taps: T,
) {
    let n = S::f32s::LEN;
    let width = even.len();
    let len = if LEN > 0 { LEN } else { evens.len() };
    let (evens, odds) = (&evens[..len], &odds[..len]);
    let mut x = 0;
    while x < width && width >= n {
        if x + 2 * n <= width {
            phases_of::<S, T, 2>(simd, [even, odd], evens, odds, taps, x);
            x += 2 * n;
        } else {
            // The last vector overlaps the previous one.
            phases_of::<S, T, 1>(simd, [even, odd], evens, odds, taps, x.min(width - n));
            x += n;
        }
    }
    let r = len - 1;
    if width < n {
        for x in 0..width {
            let mut sums = [taps.at(r, x, 1)[0] * evens[0], 0.0];
            for t in 0..=r {
                let before = taps.at(r - t, x, 1)[0];
                if t > 0 {
                    sums[0] += (before + taps.at(r + t, x, 1)[0]) * evens[t];
                }
                sums[1] += (before + taps.at(r + 1 + t, x, 1)[0]) * odds[t];
            }
            [even[x], odd[x]] = sums;
        }
    }
}

/// Evaluates [`phases`] for `V` vectors from column `x`.
#[inline(always)]
fn phases_of<S: Simd, T: Taps, const V: usize>(
    simd: S,
    [even, odd]: [&mut [f32]; 2],
    evens: &[f32],
    odds: &[f32],
    taps: T,
    x: usize,
) {
    let n = S::f32s::LEN;
    let r = evens.len() - 1;
    let mut sums = [[S::f32s::splat(simd, 0.0); V]; 2];
    let mut after = [S::f32s::splat(simd, 0.0); V];
    let (middle, next) = (taps.at(r, x, V * n), taps.at(r + 1, x, V * n));
    for i in 0..V {
        let v = S::f32s::from_slice(simd, &middle[i * n..(i + 1) * n]);
        after[i] = S::f32s::from_slice(simd, &next[i * n..(i + 1) * n]);
        sums[0][i] = v * evens[0];
        sums[1][i] += (v + after[i]) * odds[0];
    }
    for t in 1..=r {
        let (before, next) = (taps.at(r - t, x, V * n), taps.at(r + 1 + t, x, V * n));
        for i in 0..V {
            let before = S::f32s::from_slice(simd, &before[i * n..(i + 1) * n]);
            sums[0][i] += (before + after[i]) * evens[t];
            after[i] = S::f32s::from_slice(simd, &next[i * n..(i + 1) * n]);
            sums[1][i] += (before + after[i]) * odds[t];
        }
    }
    let (even, odd) = (&mut even[x..x + V * n], &mut odd[x..x + V * n]);
    for i in 0..V {
        sums[0][i].store_slice(&mut even[i * n..(i + 1) * n]);
        sums[1][i].store_slice(&mut odd[i * n..(i + 1) * n]);
    }
}

/// Interleaves: `out = [a0, b0, a1, b1, …]`, for the length of `out`.
pub(crate) fn interleave(level: Level, out: &mut [f32], a: &[f32], b: &[f32]) {
    dispatch!(level, simd => interleave_impl(simd, out, a, b));
}

#[inline(always)]
fn interleave_impl<S: Simd>(_: S, out: &mut [f32], a: &[f32], b: &[f32]) {
    let (pairs, last) = out.as_chunks_mut::<2>();
    for ((o, a), b) in pairs.iter_mut().zip(a).zip(b) {
        *o = [*a, *b];
    }
    if let ([last], Some(a)) = (last, a.get(pairs.len())) {
        *last = *a;
    }
}

/// Computes `out = a − b`.
pub(crate) fn subtract(level: Level, out: &mut [f32], a: &[f32], b: &[f32]) {
    dispatch!(level, simd => subtract_impl(simd, out, a, b));
}

#[inline(always)]
fn subtract_impl<S: Simd>(_: S, out: &mut [f32], a: &[f32], b: &[f32]) {
    for ((o, a), b) in out.iter_mut().zip(a).zip(b) {
        *o = a - b;
    }
}

/// Quantizes: `out = (values − offset)·gain`, rounded, 0 to 65535.
pub(crate) fn quantize(level: Level, out: &mut [u16], values: &[f32], offset: f32, gain: f32) {
    dispatch!(level, simd => quantize_impl(simd, out, values, offset, gain));
}

#[inline(always)]
fn quantize_impl<S: Simd>(_: S, out: &mut [u16], values: &[f32], offset: f32, gain: f32) {
    for (o, v) in out.iter_mut().zip(values) {
        let v = (v - offset) * gain;
        let v = if v > 0.0 { v } else { 0.0 };
        let v = if v < 65535.0 { v } else { 65535.0 };
        *o = round(v) as u16;
    }
}

/// Applies [`ByteScale::to_byte`] to each value.
pub(crate) fn to_bytes(level: Level, out: &mut [u8], values: &[f32], scale: ByteScale) {
    dispatch!(level, simd => to_bytes_impl(simd, out, values, scale));
}

#[inline(always)]
fn to_bytes_impl<S: Simd>(_: S, out: &mut [u8], values: &[f32], scale: ByteScale) {
    for (o, v) in out.iter_mut().zip(values) {
        *o = scale.to_byte(*v);
    }
}

/// Rounds to the nearest integer, for 0 ≤ v < 2²² (ties to even), by adding 2²³, beyond which an f32 has no fraction.
/// Unlike `as`, this vectorizes.
#[inline(always)]
pub(crate) fn round(v: f32) -> u32 {
    (v + 8_388_608.0).to_bits() & 0x7F_FFFF
}

/// Appends the columns of `range` with a local extremum in the middle of three differences of Gaussians (three rows
/// each): above `floor` and not below any of the 26 neighbors, or below `−floor` and not above any.
pub(crate) fn extrema(
    level: Level,
    differences: [[&[f32]; 3]; 3],
    range: std::ops::Range<usize>,
    floor: f32,
    found: &mut Vec<usize>,
) {
    dispatch!(level, simd => extrema_impl(simd, differences, range, floor, found));
}

#[inline(always)]
fn extrema_impl<S: Simd>(
    simd: S,
    differences: [[&[f32]; 3]; 3],
    range: std::ops::Range<usize>,
    floor: f32,
    found: &mut Vec<usize>,
) {
    let n = S::f32s::LEN;
    let (above_floor, below_floor) = (S::f32s::splat(simd, floor), S::f32s::splat(simd, -floor));
    let here = differences[1][1];
    let mut x = range.start;
    while x + n <= range.end {
        let v = S::f32s::from_slice(simd, &here[x..x + n]);
        let mut is_maximum = v.simd_gt(above_floor);
        let mut is_minimum = v.simd_lt(below_floor);
        // Most pixels are rejected by the threshold or by the neighbors in their own layer.
        for rows in [differences[1], differences[0], differences[2]] {
            if (is_maximum | is_minimum).to_bitmask() == 0 {
                break;
            }
            let first = S::f32s::from_slice(simd, &rows[1][x - 1..x - 1 + n]);
            let (mut high, mut low) = (first, first);
            for row in rows {
                for at in [x - 1, x, x + 1] {
                    let other = S::f32s::from_slice(simd, &row[at..at + n]);
                    high = high.max(other);
                    low = low.min(other);
                }
            }
            is_maximum &= v.simd_ge(high);
            is_minimum &= v.simd_le(low);
        }
        let mut hits = (is_maximum | is_minimum).to_bitmask();
        while hits != 0 {
            found.push(x + hits.trailing_zeros() as usize);
            hits &= hits - 1;
        }
        x += n;
    }
    for x in x..range.end {
        if is_extremum(differences, x, floor) {
            found.push(x);
        }
    }
}

/// Appends the columns, except the first and the last, with a local maximum in the middle row: above zero, not below
/// `floor`, and not below any of the eight neighbors.
pub(crate) fn peaks(level: Level, rows: [&[f32]; 3], floor: f32, found: &mut Vec<usize>) {
    dispatch!(level, simd => peaks_impl(simd, rows, floor, found));
}

#[inline(always)]
fn peaks_impl<S: Simd>(simd: S, rows: [&[f32]; 3], floor: f32, found: &mut Vec<usize>) {
    let n = S::f32s::LEN;
    let [above, here, below] = rows;
    let end = here.len() - 1;
    let (zero, floor_lanes) = (S::f32s::splat(simd, 0.0), S::f32s::splat(simd, floor));
    let mut x = 1;
    while x + n <= end {
        let load = |row: &[f32], x: usize| S::f32s::from_slice(simd, &row[x..x + n]);
        let v = load(here, x);
        let mut high = v.simd_gt(zero) & v.simd_ge(floor_lanes);
        if high.to_bitmask() != 0 {
            high &= v.simd_ge(load(here, x - 1).max(load(here, x + 1)));
            for row in [above, below] {
                high &= v.simd_ge(load(row, x - 1).max(load(row, x)).max(load(row, x + 1)));
            }
            let mut hits = high.to_bitmask();
            while hits != 0 {
                found.push(x + hits.trailing_zeros() as usize);
                hits &= hits - 1;
            }
        }
        x += n;
    }
    found.extend((x..end).filter(|&x| {
        let v = here[x];
        v > 0.0 && v >= floor && rows.iter().all(|row| row[x - 1..x + 2].iter().all(|&o| v >= o))
    }));
}

/// Returns whether no sample is NaN or infinite.
pub(crate) fn all_finite(level: Level, row: &[f32]) -> bool {
    dispatch!(level, simd => all_finite_impl(simd, row))
}

#[inline(always)]
fn all_finite_impl<S: Simd>(simd: S, row: &[f32]) -> bool {
    // v·0 is 0 for finite v and NaN otherwise.
    let mut sum = f32x16::splat(simd, 0.0);
    let (blocks, rest) = row.as_chunks::<16>();
    for block in blocks {
        sum += f32x16::from_slice(simd, block) * 0.0;
    }
    sum.simd_eq(f32x16::splat(simd, 0.0)).all_true() && rest.iter().all(|v| v.is_finite())
}

/// Returns the maximum of `row` and `initial`.
pub(crate) fn maximum(level: Level, row: &[f32], initial: f32) -> f32 {
    dispatch!(level, simd => maximum_impl(simd, row, initial))
}

#[inline(always)]
fn maximum_impl<S: Simd>(_: S, row: &[f32], initial: f32) -> f32 {
    let max = |a: f32, b: f32| if b > a { b } else { a };
    let (blocks, rest) = row.as_chunks::<32>();
    let mut lanes = [initial; 32];
    for block in blocks {
        for i in 0..32 {
            lanes[i] = max(lanes[i], block[i]);
        }
    }
    lanes.into_iter().chain(rest.iter().copied()).fold(initial, max)
}

#[inline(always)]
fn is_extremum(differences: [[&[f32]; 3]; 3], x: usize, floor: f32) -> bool {
    let v = differences[1][1][x];
    let around = |test: fn(f32, f32) -> bool| {
        differences.iter().all(|rows| rows.iter().all(|row| row[x - 1..x + 2].iter().all(|&d| test(v, d))))
    };
    (v > floor && around(|v, d| v >= d)) || (v < -floor && around(|v, d| v <= d))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_synth::instruction_sets;
    use proptest::prelude::*;

    #[test]
    fn one_sample_that_is_not_finite_is_detected_anywhere() {
        for width in 0..50 {
            // The largest finite values: their sum would overflow.
            let mut row: Vec<f32> = (0..width).map(|i| if i % 2 == 0 { f32::MAX } else { -f32::MAX }).collect();
            for level in instruction_sets() {
                assert!(all_finite(level, &row));
                for x in 0..width {
                    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
                        let finite = std::mem::replace(&mut row[x], value);
                        assert!(!all_finite(level, &row), "{value} at {x} of {width}");
                        row[x] = finite;
                    }
                }
            }
        }
    }

    proptest! {
        #[test]
        fn simd_kernels_equal_the_scalar_loops(width in 1usize..200, r in 0usize..12, seed in any::<u32>()) {
            let mut state = seed | 1;
            let mut random = || {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 8) as f32 / (1 << 24) as f32
            };
            let kernel: Vec<f32> = (0..=r).map(|_| random()).collect();
            let data: Vec<Vec<f32>> =
                (0..2 * r + 2).map(|_| (0..width + 2 * r + 1).map(|_| random() - 0.5).collect()).collect();
            let rows: Vec<&[f32]> = data.iter().map(|v| &v[..width]).collect();
            let scalar = |at: &dyn Fn(usize, usize) -> f32, gap: usize| -> Vec<f32> {
                (0..width)
                    .map(|x| {
                        let mut sum = if gap == 0 { at(x, r) * kernel[0] } else { 0.0 };
                        for (t, weight) in kernel.iter().enumerate().skip(1 - gap) {
                            sum += (at(x, r - t) + at(x, r + gap + t)) * weight;
                        }
                        sum
                    })
                    .collect()
            };
            let expected = [0, 1].map(|gap| [scalar(&|x, t| rows[t][x], gap), scalar(&|x, t| data[0][x + t], gap)]);
            // Coarse values, so that ties occur; larger ones in the middle rows, so that extrema occur.
            let coarse: Vec<Vec<f32>> = (0..9)
                .map(|i| (0..width + 2).map(|_| ((random() - 0.5) * if i == 4 { 40.0 } else { 20.0 }).round()).collect())
                .collect();
            let nine = [0, 3, 6].map(|i| [&coarse[i][..], &coarse[i + 1][..], &coarse[i + 2][..]]);
            let extremum: Vec<usize> = (1..width + 1).filter(|&x| is_extremum(nine, x, 4.0)).collect();
            for level in instruction_sets() {
                let mut out = vec![0.0; width];
                vertical(level, &mut out, &rows[..2 * r + 1], &kernel);
                prop_assert_eq!(&out, &expected[0][0], "{:?}", level);
                horizontal(level, &mut out, &data[0][..width + 2 * r], &kernel);
                prop_assert_eq!(&out, &expected[0][1], "{:?}", level);
                let mut odd = vec![0.0; width];
                vertical_phases(level, [&mut out, &mut odd], &rows, &kernel, &kernel);
                prop_assert_eq!([&out, &odd], [&expected[0][0], &expected[1][0]], "{:?}", level);
                horizontal_phases(level, [&mut out, &mut odd], &data[0], &kernel, &kernel);
                prop_assert_eq!([&out, &odd], [&expected[0][1], &expected[1][1]], "{:?}", level);
                let mut found = Vec::new();
                extrema(level, nine, 1..width + 1, 4.0, &mut found);
                prop_assert_eq!(&found, &extremum, "{:?}", level);
                let mut twice = vec![0.0; 2 * width];
                interleave(level, &mut twice, rows[0], rows[1]);
                let mut uneven = vec![0.0; 2 * width - 1];
                interleave(level, &mut uneven, rows[0], rows[1]);
                prop_assert_eq!(&uneven, &twice[..2 * width - 1]);
                subtract(level, &mut out, rows[0], rows[1]);
                let mut small = vec![0u16; width];
                quantize(level, &mut small, rows[0], -0.25, 120_000.0);
                for x in 0..width {
                    prop_assert_eq!((twice[2 * x], twice[2 * x + 1]), (rows[0][x], rows[1][x]));
                    prop_assert_eq!(out[x], rows[0][x] - rows[1][x]);
                    prop_assert_eq!(small[x], ((rows[0][x] + 0.25) * 120_000.0).clamp(0.0, 65535.0).round_ties_even() as u16);
                }
            }
        }
    }
}
