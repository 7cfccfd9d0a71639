//! Separable Gaussian smoothing with mirrored borders, and the Gaussian doubling that a scale space starts from.

use crate::simd;
use cv_core::{GrayF32, ImageView};
use rayon::prelude::*;

/// Rows per task: enough to amortise the buffers, few enough to share out.
const ROWS: usize = 32;

/// The half of a sampled Gaussian from its centre outwards to three standard deviations, the whole summing to one.
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

/// Fills the `r` samples on each side of the middle of `padded` with its mirror image.
pub(crate) fn mirror_ends(padded: &mut [f32], r: usize) {
    let w = padded.len() - 2 * r;
    for k in 1..=r {
        padded[r - k] = padded[r + mirror(-(k as isize), w)];
        padded[r + w - 1 + k] = padded[r + mirror((w - 1 + k) as isize, w)];
    }
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
    let level = simd::level();
    out.as_mut_slice().par_chunks_mut(w * ROWS).enumerate().for_each(|(chunk, rows)| {
        let mut padded = vec![0.0f32; w + 2 * r];
        let mut sources: Vec<&[f32]> = Vec::with_capacity(2 * r + 1);
        for (i, out) in rows.chunks_exact_mut(w).enumerate() {
            let y = (chunk * ROWS + i) as isize;
            sources.clear();
            sources.extend((-(r as isize)..=r as isize).map(|d| view.row(mirror(y + d, h))));
            simd::vertical(level, &mut padded[r..r + w], &sources, &kernel);
            mirror_ends(&mut padded, r);
            simd::horizontal(level, out, &padded, &kernel);
        }
    });
    out
}

/// Twice the width and height, smoothed with `sigma` source pixels: pixel `u` of the result lies at `u / 2` of the source.
///
/// The Gaussian is sampled at the two phases 0 and ½, so smoothing is the interpolation: no bilinear step whose own blur differs from pixel to pixel.
pub(crate) fn double(view: ImageView<'_, f32, 1>, sigma: f32) -> GrayF32 {
    let (w, h) = view.size();
    let mut out = GrayF32::new(2 * w, 2 * h, [0.0]);
    if w == 0 || h == 0 {
        return out;
    }
    let even = gaussian_half_kernel(sigma);
    let r = even.len() - 1;
    // Phase ½: the samples at ±½, ±1½, …
    let weight = |i: usize| (-0.5 * ((i as f64 + 0.5) / f64::from(sigma)).powi(2)).exp();
    let sum = 2.0 * (0..=r).map(weight).sum::<f64>();
    let odd: Vec<f32> = (0..=r).map(|i| (weight(i) / sum) as f32).collect();
    let pad = r + 1;
    out.as_mut_slice().par_chunks_mut(2 * w * 2 * ROWS).enumerate().for_each(|(chunk, rows)| {
        let mut padded = vec![0.0f32; w + 2 * pad];
        for (i, out) in rows.chunks_exact_mut(2 * w).enumerate() {
            let y = (chunk * ROWS + i / 2) as isize;
            let middle = &mut padded[pad..pad + w];
            let row = |d: isize| view.row(mirror(y + d, h));
            if i % 2 == 0 {
                middle.iter_mut().zip(row(0)).for_each(|(o, v)| *o = even[0] * v);
                for (t, &k) in even.iter().enumerate().skip(1) {
                    let pair = row(-(t as isize)).iter().zip(row(t as isize));
                    middle.iter_mut().zip(pair).for_each(|(o, (a, b))| *o += k * (a + b));
                }
            } else {
                middle.fill(0.0);
                for (t, &k) in odd.iter().enumerate() {
                    let pair = row(-(t as isize)).iter().zip(row(t as isize + 1));
                    middle.iter_mut().zip(pair).for_each(|(o, (a, b))| *o += k * (a + b));
                }
            }
            mirror_ends(&mut padded, pad);
            for (x, two) in out.chunks_exact_mut(2).enumerate() {
                let x = x + pad;
                let mut sums = [even[0] * padded[x], odd[0] * (padded[x] + padded[x + 1])];
                for t in 1..=r {
                    sums[0] += even[t] * (padded[x - t] + padded[x + t]);
                    sums[1] += odd[t] * (padded[x - t] + padded[x + t + 1]);
                }
                two.copy_from_slice(&sums);
            }
        }
    });
    out
}

/// Every second pixel of every second row, from the top left.
pub(crate) fn halve(image: &GrayF32) -> GrayF32 {
    let (w, h) = (image.width().div_ceil(2), image.height().div_ceil(2));
    let mut out = GrayF32::new(w, h, [0.0]);
    for y in 0..h {
        out.row_mut(y).iter_mut().zip(image.row(2 * y).iter().step_by(2)).for_each(|(o, v)| *o = *v);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wave_keeps_its_phase_and_loses_what_the_gaussian_takes() {
        // exp(−σ²ω²/2) is the gain of a Gaussian; cut off at 3σ it differs by less than its missing mass, 0.3 %.
        let (omega, sigma) = (0.35f32, 1.5f32);
        let gain = (-sigma * sigma * omega * omega / 2.0).exp();
        let image = GrayF32::from_fn(90, 70, |x, y| [(omega * x as f32).sin() + 0.5 * (omega * y as f32).cos()]);
        let smooth = blur(image.view(), sigma);
        let twice = double(image.view(), sigma);
        for (x, y) in [(40, 30), (41, 35), (33, 20)] {
            let (fx, fy) = (x as f32, y as f32);
            let expected = |x: f32, y: f32| gain * ((omega * x).sin() + 0.5 * (omega * y).cos());
            assert!((smooth.at(x, y)[0] - expected(fx, fy)).abs() < 3e-3);
            for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
                let got = twice.at(2 * x + dx, 2 * y + dy)[0];
                assert!((got - expected(fx + dx as f32 / 2.0, fy + dy as f32 / 2.0)).abs() < 3e-3);
            }
        }
        assert_eq!(halve(&twice).size(), image.size());
    }

    #[test]
    fn mirrors_as_often_as_it_takes() {
        let seen: Vec<usize> = (-5..7).map(|i| mirror(i, 3)).collect();
        assert_eq!(seen, [1, 0, 1, 2, 1, 0, 1, 2, 1, 0, 1, 2]);
        assert_eq!((mirror(-3, 1), mirror(4, 1)), (0, 0));
    }
}
