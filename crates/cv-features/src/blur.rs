//! Separable Gaussian smoothing with mirrored borders.

use cv_core::{GrayF32, ImageView};
use rayon::prelude::*;

/// The half of a sampled Gaussian from its centre outwards, the whole summing to one.
pub(crate) fn gaussian_half_kernel(sigma: f32) -> Vec<f32> {
    let radius = (3.0 * sigma).ceil().max(1.0) as usize;
    let weight = |i: usize| (-0.5 * (i as f64 / f64::from(sigma)).powi(2)).exp();
    let sum = weight(0) + 2.0 * (1..=radius).map(weight).sum::<f64>();
    (0..=radius).map(|i| (weight(i) / sum) as f32).collect()
}

/// Index `i` of a row of `n` mirrored about its end samples (`dcb|abcd|cba`, OpenCV's BORDER_REFLECT_101).
#[inline]
pub(crate) fn mirror(i: isize, n: usize) -> usize {
    let n = n as isize;
    if n == 1 {
        return 0;
    }
    let period = 2 * (n - 1);
    let i = i.rem_euclid(period);
    (if i < n { i } else { period - i }) as usize
}

/// Smooths with standard deviation `sigma` pixels.
pub(crate) fn blur(view: ImageView<'_, f32, 1>, sigma: f32) -> GrayF32 {
    let (w, h) = view.size();
    let mut out = GrayF32::new(w, h, [0.0]);
    if w == 0 || h == 0 {
        return out;
    }
    let kernel = gaussian_half_kernel(sigma);
    let r = kernel.len() - 1;
    out.as_mut_slice().par_chunks_mut(w).enumerate().for_each_init(
        || vec![0.0f32; w + 2 * r],
        |column, (y, row)| {
            let middle = &mut column[r..r + w];
            middle.iter_mut().zip(view.row(y)).for_each(|(o, v)| *o = kernel[0] * v);
            for (k, weight) in kernel.iter().enumerate().skip(1) {
                let above = view.row(mirror(y as isize - k as isize, h));
                let below = view.row(mirror(y as isize + k as isize, h));
                middle.iter_mut().zip(above).zip(below).for_each(|((o, a), b)| *o += weight * (a + b));
            }
            for k in 1..=r {
                column[r - k] = column[r + mirror(-(k as isize), w)];
                column[r + w - 1 + k] = column[r + mirror((w - 1 + k) as isize, w)];
            }
            row.iter_mut().zip(&column[r..]).for_each(|(o, v)| *o = kernel[0] * v);
            for (k, weight) in kernel.iter().enumerate().skip(1) {
                let (left, right) = (&column[r - k..], &column[r + k..]);
                row.iter_mut().zip(left).zip(right).for_each(|((o, a), b)| *o += weight * (a + b));
            }
        },
    );
    out
}
