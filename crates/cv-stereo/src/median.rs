//! A median filter that knows holes.

use fearless_simd::{Level, dispatch, prelude::*};
use fearless_simd_macros::simd;
use rayon::prelude::*;

/// Median of the valid values in the window of `radius` (1 or 2) around every valid pixel, the lower one of an even
/// count; holes stay holes. Beyond the border there are no values.
pub(crate) fn median(level: Level, disparity: &[f32], width: usize, radius: usize, out: &mut Vec<f32>) {
    out.resize(disparity.len(), f32::NAN);
    if width == 0 || disparity.is_empty() {
        return;
    }
    let height = disparity.len() / width;
    out.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        let inner = radius == 1 && y > 0 && y + 1 < height && width > 2;
        if inner {
            let rows = &disparity[(y - 1) * width..(y + 2) * width];
            dispatch!(level, simd => median_of_nine(simd, rows, width, row));
        }
        for (x, value) in row.iter_mut().enumerate() {
            // A NaN of the fast path says that one of the nine was NaN.
            if !inner || x == 0 || x + 1 == width || value.is_nan() {
                *value = median_at(disparity, width, height, radius, x, y);
            }
        }
    });
}

/// The definition.
fn median_at(disparity: &[f32], width: usize, height: usize, radius: usize, x: usize, y: usize) -> f32 {
    let centre = disparity[y * width + x];
    if centre.is_nan() {
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

/// Columns 1 to `width − 2` of the middle one of three rows; NaN where one of the nine values is.
#[simd]
fn median_of_nine<S: Simd>(simd: S, rows: &[f32], width: usize, out: &mut [f32]) {
    // Devillard's network of nineteen exchanges ("Fast median search", 1998).
    const NETWORK: [(usize, usize); 19] = [
        (1, 2),
        (4, 5),
        (7, 8),
        (0, 1),
        (3, 4),
        (6, 7),
        (1, 2),
        (4, 5),
        (7, 8),
        (0, 3),
        (5, 8),
        (4, 7),
        (3, 6),
        (1, 4),
        (2, 5),
        (4, 7),
        (4, 2),
        (6, 4),
        (4, 2),
    ];
    let lanes = S::f32s::LEN;
    let n = width - 2;
    let mut start = 0;
    while start < n {
        // The last vector overlaps the one before; rows narrower than a vector are left to the definition.
        let x = if start + lanes <= n { start } else { n.saturating_sub(lanes) };
        if x + lanes > n {
            out[1..=n].fill(f32::NAN);
            return;
        }
        let mut v: [S::f32s; 9] =
            std::array::from_fn(|i| S::f32s::from_slice(simd, &rows[(i / 3) * width + x + i % 3..][..lanes]));
        let mut sum = v[0];
        for value in &v[1..] {
            sum += *value;
        }
        for (i, j) in NETWORK {
            (v[i], v[j]) = (v[i].min(v[j]), v[i].max(v[j]));
        }
        sum.is_nan().select(sum, v[4]).store_slice(&mut out[1 + x..][..lanes]);
        start = x + lanes;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_network_is_the_definition(
            width in 1usize..40,
            values in proptest::collection::vec(prop_oneof![9 => -9f32..9.0, 1 => Just(f32::NAN)], 0..400),
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
