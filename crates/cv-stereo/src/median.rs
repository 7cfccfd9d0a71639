//! Median filter of maps with holes.

use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch, prelude::*};
use fearless_simd_macros::simd;

/// Computes the median of the valid values in the window of `radius` (1 or 2) around every valid pixel, the lower one of an even
/// count; holes stay holes. Windows are cut at the image border.
pub(crate) fn median(level: Level, disparity: &[f32], width: usize, radius: usize, out: &mut Vec<f32>) {
    out.resize(disparity.len(), f32::NAN);
    if width == 0 || disparity.is_empty() {
        return;
    }
    let height = disparity.len() / width;
    out.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        let inner = y >= radius && y + radius < height && width > 2 * radius;
        let done = inner && {
            let rows = &disparity[(y - radius) * width..(y + radius + 1) * width];
            dispatch!(level, simd => median_row(simd, rows, width, radius, row))
        };
        let border = if done { radius } else { width };
        for x in (0..border).chain(width.saturating_sub(radius).max(border)..width) {
            row[x] = median_at(disparity, width, height, radius, x, y);
        }
    });
}

/// Computes the median at a pixel by sorting.
fn median_at(disparity: &[f32], width: usize, height: usize, radius: usize, x: usize, y: usize) -> f32 {
    let center = disparity[y * width + x];
    if center.is_nan() {
        return f32::NAN;
    }
    let (top, bottom) = (y.saturating_sub(radius), (y + radius).min(height - 1));
    let (first, last) = (x.saturating_sub(radius), (x + radius).min(width - 1));
    let mut window = [0f32; 25];
    let mut n = 0;
    for j in top..=bottom {
        for &d in &disparity[j * width + first..=j * width + last] {
            window[n] = d;
            n += usize::from(!d.is_nan());
        }
    }
    *window[..n].select_nth_unstable_by((n - 1) / 2, f32::total_cmp).1
}

/// Compare-exchange steps of a sorting network, unrolled: a loop over a table of indices would keep the vectors in memory.
macro_rules! exchange {
    ($v:ident: $($i:literal $j:literal),*) => {
        $(($v[$i], $v[$j]) = ($v[$i].min($v[$j]), $v[$i].max($v[$j]));)*
    };
}

/// Returns the median of nine (Devillard, "Fast median search", 1998).
#[inline(always)]
#[rustfmt::skip]
fn of_nine<S: Simd>(mut v: [S::f32s; 9]) -> S::f32s {
    exchange!(v:
        1 2, 4 5, 7 8, 0 1, 3 4, 6 7, 1 2, 4 5, 7 8, 0 3, 5 8, 4 7, 3 6, 1 4, 2 5, 4 7,
        4 2, 6 4, 4 2
    );
    v[4]
}

/// Returns the median of twenty-five (same source).
#[inline(always)]
#[rustfmt::skip]
fn of_twenty_five<S: Simd>(mut v: [S::f32s; 25]) -> S::f32s {
    exchange!(v:
        0 1, 3 4, 2 4, 2 3, 6 7, 5 7, 5 6, 9 10, 8 10, 8 9, 12 13, 11 13, 11 12, 15 16, 14 16, 14 15,
        18 19, 17 19, 17 18, 21 22, 20 22, 20 21, 23 24, 2 5, 3 6, 0 6, 0 3, 4 7, 1 7, 1 4, 11 14, 8 14,
        8 11, 12 15, 9 15, 9 12, 13 16, 10 16, 10 13, 20 23, 17 23, 17 20, 21 24, 18 24, 18 21, 19 22, 8 17, 9 18,
        0 18, 0 9, 10 19, 1 19, 1 10, 11 20, 2 20, 2 11, 12 21, 3 21, 3 12, 13 22, 4 22, 4 13, 14 23, 5 23,
        5 14, 15 24, 6 24, 6 15, 7 16, 7 19, 13 21, 15 23, 7 13, 7 15, 1 9, 3 11, 5 17, 11 17, 9 17, 4 10,
        6 12, 7 14, 4 6, 4 7, 12 14, 10 14, 6 7, 10 12, 6 10, 6 17, 12 17, 7 17, 7 10, 12 18, 7 12, 10 18,
        12 20, 10 20, 10 12
    );
    v[12]
}

/// Computes the medians of columns `radius` to `width − 1 − radius` of the middle one of `2 radius + 1` rows; returns false if they are
/// narrower than a vector.
#[simd]
fn median_row<S: Simd>(simd: S, rows: &[f32], width: usize, radius: usize, out: &mut [f32]) -> bool {
    if radius == 1 {
        windows(simd, rows, width, out, of_nine::<S>)
    } else {
        windows(simd, rows, width, out, of_twenty_five::<S>)
    }
}

#[inline(always)]
fn windows<S: Simd, const N: usize>(
    simd: S,
    rows: &[f32],
    width: usize,
    out: &mut [f32],
    median: impl Fn([S::f32s; N]) -> S::f32s,
) -> bool {
    let side = N.isqrt();
    let radius = side / 2;
    let lanes = S::f32s::LEN;
    let n = width - 2 * radius;
    if n < lanes {
        return false;
    }
    let mut start = 0;
    while start < n {
        // The last vector overlaps the one before.
        let x = start.min(n - lanes);
        let mut v = [S::f32s::splat(simd, 0.0); N];
        let mut sum = v[0];
        for (i, value) in v.iter_mut().enumerate() {
            *value = S::f32s::from_slice(simd, &rows[(i / side) * width + x + i % side..][..lanes]);
            sum += *value;
        }
        let center = v[N / 2].is_nan();
        if sum.is_nan().any_true() {
            // Holes become −∞ and +∞ in turn: the median of the window is then the lower median of the valid values.
            let mut end = S::f32s::splat(simd, f32::NEG_INFINITY);
            for value in &mut v {
                let hole = value.is_nan();
                *value = hole.select(end, *value);
                end = hole.select(-end, end);
            }
        }
        center.select(S::f32s::splat(simd, f32::NAN), median(v)).store_slice(&mut out[radius + x..][..lanes]);
        start = x + lanes;
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_network_is_the_definition(
            width in 1usize..140,
            values in proptest::collection::vec(prop_oneof![9 => -9f32..9.0, 1 => Just(f32::NAN)], 0..900),
            radius in 1usize..3,
        ) {
            let height = values.len() / width;
            let d = &values[..height * width];
            let mut out = Vec::new();
            median(Level::new(), d, width, radius, &mut out);
            for y in 0..height {
                for x in 0..width {
                    let expected = median_at(d, width, height, radius, x, y);
                    prop_assert_eq!(out[y * width + x].to_bits(), expected.to_bits());
                }
            }
        }
    }
}
