//! The inner loops, compiled for each instruction set of the machine and chosen at run time.
//!
//! All arithmetic is plain multiplications and additions in a fixed order (never fused), lane by lane, so every instruction set gives the
//! same bytes; the tests hold each one to the plain loops beside them.

use fearless_simd::{Level, dispatch, prelude::*};

/// The widest instruction set of this machine.
#[inline]
pub(crate) fn level() -> Level {
    Level::new()
}

/// `out[x] = k[0]·rows[r][x] + Σ k[t]·(rows[r−t][x] + rows[r+t][x])` with `r = k.len() − 1` and `2r + 1` rows.
pub(crate) fn vertical(level: Level, out: &mut [f32], rows: &[&[f32]], kernel: &[f32]) {
    debug_assert!(rows.len() == 2 * kernel.len() - 1 && rows.iter().all(|r| r.len() == out.len()));
    dispatch!(level, simd => vertical_impl(simd, out, rows, kernel));
}

#[inline(always)]
fn vertical_impl<S: Simd>(simd: S, out: &mut [f32], rows: &[&[f32]], kernel: &[f32]) {
    let n = S::f32s::LEN;
    let r = kernel.len() - 1;
    let width = out.len();
    let at = |row: usize, x: usize| S::f32s::from_slice(simd, &rows[row][x..x + n]);
    let mut x = 0;
    while x + 4 * n <= width {
        let mut sums: [S::f32s; 4] = std::array::from_fn(|i| at(r, x + i * n) * kernel[0]);
        for (t, &weight) in kernel.iter().enumerate().skip(1) {
            for (i, sum) in sums.iter_mut().enumerate() {
                *sum += (at(r - t, x + i * n) + at(r + t, x + i * n)) * weight;
            }
        }
        for (i, sum) in sums.iter().enumerate() {
            sum.store_slice(&mut out[x + i * n..x + (i + 1) * n]);
        }
        x += 4 * n;
    }
    while x < width {
        if x + n > width {
            if width < n {
                break;
            }
            // The last columns again, as a whole vector.
            x = width - n;
        }
        let mut sum = at(r, x) * kernel[0];
        for (t, &weight) in kernel.iter().enumerate().skip(1) {
            sum += (at(r - t, x) + at(r + t, x)) * weight;
        }
        sum.store_slice(&mut out[x..x + n]);
        x += n;
    }
    if width < n {
        for (x, o) in out.iter_mut().enumerate() {
            let mut sum = rows[r][x] * kernel[0];
            for (t, &weight) in kernel.iter().enumerate().skip(1) {
                sum += (rows[r - t][x] + rows[r + t][x]) * weight;
            }
            *o = sum;
        }
    }
}

/// `out[x] = k[0]·row[x+r] + Σ k[t]·(row[x+r−t] + row[x+r+t])` with `r = k.len() − 1`; `row` has `2r` more samples than `out`.
pub(crate) fn horizontal(level: Level, out: &mut [f32], row: &[f32], kernel: &[f32]) {
    debug_assert_eq!(row.len(), out.len() + 2 * (kernel.len() - 1));
    dispatch!(level, simd => horizontal_impl(simd, out, row, kernel));
}

#[inline(always)]
fn horizontal_impl<S: Simd>(simd: S, out: &mut [f32], row: &[f32], kernel: &[f32]) {
    let n = S::f32s::LEN;
    let r = kernel.len() - 1;
    let width = out.len();
    let at = |x: usize| S::f32s::from_slice(simd, &row[x..x + n]);
    let mut x = 0;
    while x + 4 * n <= width {
        let mut sums: [S::f32s; 4] = std::array::from_fn(|i| at(x + r + i * n) * kernel[0]);
        for (t, &weight) in kernel.iter().enumerate().skip(1) {
            for (i, sum) in sums.iter_mut().enumerate() {
                *sum += (at(x + r - t + i * n) + at(x + r + t + i * n)) * weight;
            }
        }
        for (i, sum) in sums.iter().enumerate() {
            sum.store_slice(&mut out[x + i * n..x + (i + 1) * n]);
        }
        x += 4 * n;
    }
    while x < width {
        if x + n > width {
            if width < n {
                break;
            }
            x = width - n;
        }
        let mut sum = at(x + r) * kernel[0];
        for (t, &weight) in kernel.iter().enumerate().skip(1) {
            sum += (at(x + r - t) + at(x + r + t)) * weight;
        }
        sum.store_slice(&mut out[x..x + n]);
        x += n;
    }
    if width < n {
        for (x, o) in out.iter_mut().enumerate() {
            let mut sum = row[x + r] * kernel[0];
            for (t, &weight) in kernel.iter().enumerate().skip(1) {
                sum += (row[x + r - t] + row[x + r + t]) * weight;
            }
            *o = sum;
        }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Every instruction set this machine has; the missing ones are named on stderr.
    pub(crate) fn levels() -> Vec<Level> {
        let mut found = vec![Level::baseline()];
        #[cfg(target_arch = "x86_64")]
        {
            let widest = Level::new();
            let mut add = |name: &str, level: Option<Level>| match level {
                Some(level) => found.push(level),
                None => eprintln!("ignored: this machine has no {name}"),
            };
            add("SSE4.2", widest.as_sse4_2().map(Level::Sse4_2));
            add("AVX2", widest.as_avx2().map(Level::Avx2));
            add("AVX-512", widest.as_avx512().map(Level::Avx512));
        }
        found
    }

    proptest! {
        #[test]
        fn both_passes_equal_the_plain_loops(width in 1usize..200, r in 0usize..12, seed in any::<u32>()) {
            let mut state = seed | 1;
            let mut random = || {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 8) as f32 / (1 << 24) as f32
            };
            let kernel: Vec<f32> = (0..=r).map(|_| random()).collect();
            let data: Vec<Vec<f32>> = (0..2 * r + 1).map(|_| (0..width + 2 * r).map(|_| random()).collect()).collect();
            let rows: Vec<&[f32]> = data.iter().map(|v| &v[..width]).collect();
            let plain = |at: &dyn Fn(usize, usize) -> f32| -> Vec<f32> {
                (0..width)
                    .map(|x| {
                        let mut sum = at(x, r) * kernel[0];
                        for (t, weight) in kernel.iter().enumerate().skip(1) {
                            sum += (at(x, r - t) + at(x, r + t)) * weight;
                        }
                        sum
                    })
                    .collect()
            };
            let down = plain(&|x, t| rows[t][x]);
            let along = plain(&|x, t| data[0][x + t]);
            for level in levels() {
                let mut out = vec![0.0; width];
                vertical(level, &mut out, &rows, &kernel);
                prop_assert_eq!(&out, &down, "{:?}", level);
                horizontal(level, &mut out, &data[0], &kernel);
                prop_assert_eq!(&out, &along, "{:?}", level);
            }
        }
    }
}
