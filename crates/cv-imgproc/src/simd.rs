//! Inner loops of the filters, compiled for several instruction sets and dispatched at run time.
//!
//! Multiplications and additions are in a fixed order and never fused, so that every instruction set gives the same bytes; the tests compare
//! each one with scalar loops.

use fearless_simd::{Level, dispatch, prelude::*};

/// Detects the widest instruction set of this machine.
#[inline]
pub(crate) fn level() -> Level {
    Level::new()
}

/// Filters vertically: `out[x] = half[0]·rows[r][x] + Σ half[t]·(rows[r−t][x] + rows[r+t][x])`, kernel radius `r = half.len() − 1`, `2r + 1` rows as
/// long as `out`.
pub(crate) fn filter_columns(level: Level, out: &mut [f32], rows: &[&[f32]], half: &[f32]) {
    assert!(rows.len() == 2 * half.len() - 1 && rows.iter().all(|r| r.len() == out.len()));
    let r = half.len() - 1;
    dispatch!(level, simd => filter(simd, out, half, #[inline(always)] |t, x, n| (&rows[r - t][x..x + n], &rows[r + t][x..x + n])));
}

/// Filters horizontally: `out[x] = half[0]·row[x + r c] + Σ half[t]·(row[x + (r−t) c] + row[x + (r+t) c])`, `c` channels; `row` has `2 r c` more
/// samples than `out`.
pub(crate) fn filter_rows(level: Level, out: &mut [f32], row: &[f32], half: &[f32], c: usize) {
    assert_eq!(row.len(), out.len() + 2 * (half.len() - 1) * c);
    let r = half.len() - 1;
    dispatch!(level, simd => filter(simd, out, half, #[inline(always)] |t, x, n| {
        let (a, b) = (x + (r - t) * c, x + (r + t) * c);
        (&row[a..a + n], &row[b..b + n])
    }));
}

/// Computes `out[x] = half[0]·a₀ + Σ half[t]·(aₜ + bₜ)`, where `pair(t, x, n)` returns the samples `aₜ[x..x+n]`, `bₜ[x..x+n]`.
#[inline(always)]
fn filter<'a, S: Simd>(
    simd: S,
    out: &mut [f32],
    half: &[f32],
    pair: impl Fn(usize, usize, usize) -> (&'a [f32], &'a [f32]),
) {
    let n = S::f32s::LEN;
    let width = out.len();
    let load = |s: &[f32]| S::f32s::from_slice(simd, s);
    let mut x = 0;
    // Four independent vectors hide the latency of additions.
    while x + 4 * n <= width {
        let (a, _) = pair(0, x, 4 * n);
        let mut sums: [S::f32s; 4] = std::array::from_fn(|i| load(&a[i * n..(i + 1) * n]) * half[0]);
        for (t, &weight) in half.iter().enumerate().skip(1) {
            let (a, b) = pair(t, x, 4 * n);
            for (i, sum) in sums.iter_mut().enumerate() {
                *sum += (load(&a[i * n..(i + 1) * n]) + load(&b[i * n..(i + 1) * n])) * weight;
            }
        }
        for (i, sum) in sums.iter().enumerate() {
            sum.store_slice(&mut out[x + i * n..x + (i + 1) * n]);
        }
        x += 4 * n;
    }
    while x < width && width >= n {
        // The last vector overlaps the one before.
        x = x.min(width - n);
        let mut sum = load(pair(0, x, n).0) * half[0];
        for (t, &weight) in half.iter().enumerate().skip(1) {
            let (a, b) = pair(t, x, n);
            sum += (load(a) + load(b)) * weight;
        }
        sum.store_slice(&mut out[x..x + n]);
        x += n;
    }
    for (x, out) in out.iter_mut().enumerate().skip(x) {
        let mut sum = pair(0, x, 1).0[0] * half[0];
        for (t, &weight) in half.iter().enumerate().skip(1) {
            let (a, b) = pair(t, x, 1);
            sum += (a[0] + b[0]) * weight;
        }
        *out = sum;
    }
}

/// Computes the Sobel derivatives of the middle one of three rows, border mode reflect-101.
pub(crate) fn sobel(level: Level, rows: [&[f32]; 3], dx: &mut [f32], dy: &mut [f32]) {
    let w = dx.len();
    // Under reflect-101 both neighbors of an end sample are equal: the x derivative is zero, and the y derivative counts them twice.
    let end = |x: usize, inner: usize| 2.0 * ((rows[2][x] - rows[0][x]) + (rows[2][inner] - rows[0][inner]));
    for (x, inner) in [(0, 1.min(w - 1)), (w - 1, w.saturating_sub(2))] {
        dx[x] = 0.0;
        dy[x] = end(x, inner);
    }
    if w > 2 {
        dispatch!(level, _simd => sobel_interior(rows, &mut dx[1..w - 1], &mut dy[1..w - 1]));
    }
}

#[inline(always)]
fn sobel_interior([a, b, c]: [&[f32]; 3], dx: &mut [f32], dy: &mut [f32]) {
    let w = dx.len();
    let (a0, a1, a2) = (&a[..w], &a[1..=w], &a[2..w + 2]);
    let (b0, b2) = (&b[..w], &b[2..w + 2]);
    let (c0, c1, c2) = (&c[..w], &c[1..=w], &c[2..w + 2]);
    let dy = &mut dy[..w];
    for x in 0..w {
        dx[x] = (a2[x] - a0[x]) + 2.0 * (b2[x] - b0[x]) + (c2[x] - c0[x]);
        dy[x] = (c0[x] - a0[x]) + 2.0 * (c1[x] - a1[x]) + (c2[x] - a2[x]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_synth::instruction_sets;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_instruction_set_equals_the_scalar_reference(width in 1usize..200, r in 0usize..12, c in 1usize..4, seed in any::<u32>()) {
            let mut state = seed | 1;
            let mut random = || {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 8) as f32 / (1 << 24) as f32
            };
            let half: Vec<f32> = (0..=r).map(|_| random()).collect();
            let data: Vec<Vec<f32>> = (0..2 * r + 1).map(|_| (0..width + 2 * r * c).map(|_| random()).collect()).collect();
            let rows: Vec<&[f32]> = data.iter().map(|v| &v[..width]).collect();
            let reference = |at: &dyn Fn(usize, usize) -> f32| -> Vec<f32> {
                let sum = |x| (1..=r).fold(at(x, r) * half[0], |sum, t| sum + (at(x, r - t) + at(x, r + t)) * half[t]);
                (0..width).map(sum).collect()
            };
            let vertical = reference(&|x, t| rows[t][x]);
            let horizontal = reference(&|x, t| data[0][x + t * c]);
            let mut derivatives = Vec::new();
            for level in instruction_sets() {
                let mut out = vec![0.0; width];
                filter_columns(level, &mut out, &rows, &half);
                prop_assert_eq!(&out, &vertical, "{:?}", level);
                filter_rows(level, &mut out, &data[0], &half, c);
                prop_assert_eq!(&out, &horizontal, "{:?}", level);
                let (mut dx, mut dy) = (out.clone(), out);
                let three = [rows[0], rows[r], rows[2 * r]];
                sobel(level, three, &mut dx, &mut dy);
                derivatives.push((dx, dy));
            }
            prop_assert!(derivatives.iter().all(|d| *d == derivatives[0]));
        }
    }
}
