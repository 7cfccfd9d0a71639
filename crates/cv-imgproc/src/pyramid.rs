//! Image pyramids (Burt & Adelson 1983).

use crate::mirror::{mirror_ends, mirror_index};
use crate::rows::for_rows_with;
use cv_core::{Image, ImageView};
use fearless_simd::{Level, dispatch};

/// Computes the next coarser pyramid level, half the resolution (rounded up): smoothing by `[1 4 6 4 1]/16` along both axes, then
/// subsampling by two from the top left (OpenCV's `pyrDown`).
///
/// Pixel `(x, y)` of the result is at `(2x, 2y)` of the source. Border mode reflect-101.
pub fn pyr_down<const C: usize>(view: ImageView<'_, f32, C>) -> Image<f32, C> {
    let (w, h) = view.size();
    let mut out = Image::new(w.div_ceil(2), h.div_ceil(2), [0.0; C]);
    let level = Level::new();
    for_rows_with(
        &mut out,
        || vec![0.0f32; (w + 4) * C],
        |padded, y, row| {
            let rows = [-2, -1, 0, 1, 2].map(|d| view.row(mirror_index(2 * y as isize + d, h)));
            dispatch!(level, _simd => smooth_vertically(rows, &mut padded[2 * C..(w + 2) * C]));
            mirror_ends::<C>(padded, 2, 2);
            dispatch!(level, _simd => smooth_and_halve::<C>(padded, row));
        },
    );
    out
}

/// Filters a column of five pixels by `[1 4 6 4 1]`.
#[inline(always)]
fn smooth_vertically(rows: [&[f32]; 5], out: &mut [f32]) {
    let [a, b, c, d, e] = rows.map(|row| &row[..out.len()]);
    for (i, out) in out.iter_mut().enumerate() {
        *out = (a[i] + e[i]) + 4.0 * (b[i] + d[i]) + 6.0 * c[i];
    }
}

/// Filters every other pixel by `[1 4 6 4 1]/256`; `padded` has two more pixels at either end.
#[inline(always)]
fn smooth_and_halve<const C: usize>(padded: &[f32], out: &mut [f32]) {
    for (x, out) in out.chunks_exact_mut(C).enumerate() {
        let p = &padded[2 * x * C..(2 * x + 5) * C];
        for (c, out) in out.iter_mut().enumerate() {
            *out = ((p[c] + p[4 * C + c]) + 4.0 * (p[C + c] + p[3 * C + c]) + 6.0 * p[2 * C + c]) * (1.0 / 256.0);
        }
    }
}

/// Upsamples a pyramid level by two: zeros between the pixels, smoothed by `[1 4 6 4 1]/8` along both axes (OpenCV's `pyrUp`).
///
/// Pixel `(x, y)` of the source is at `(2x, 2y)` of the result, whose `size` (width, height) should be that of the finer level: `2w − 1` or
/// `2w` by `2h − 1` or `2h`. The border mode is reflect-101 at the top and left, replicate at the bottom and right.
pub fn pyr_up<const C: usize>(view: ImageView<'_, f32, C>, size: (usize, usize)) -> Image<f32, C> {
    let (w, h) = view.size();
    let mut out = Image::new(size.0, size.1, [0.0; C]);
    if view.is_empty() {
        return out;
    }
    // Reflect-101 before the first sample, replicate after the last, as OpenCV does.
    let index = |i: isize, n: usize| if i < 0 { mirror_index(i, n) } else { (i as usize).min(n - 1) };
    for_rows_with(
        &mut out,
        || vec![0.0f32; w * C],
        |column, y, row| {
            let center = (y / 2) as isize;
            let b = view.row(index(center, h));
            let c = view.row(index(center + 1, h));
            if y % 2 == 0 {
                let a = view.row(index(center - 1, h));
                for (i, out) in column.iter_mut().enumerate() {
                    *out = (a[i] + 6.0 * b[i] + c[i]) * 0.125;
                }
            } else {
                for (i, out) in column.iter_mut().enumerate() {
                    *out = (b[i] + c[i]) * 0.5;
                }
            }
            let at = |x: isize, c: usize| column[index(x, w) * C + c];
            for (x, out) in row.chunks_exact_mut(C).enumerate() {
                let m = (x / 2) as isize;
                for (c, out) in out.iter_mut().enumerate() {
                    *out = if x % 2 == 0 {
                        (at(m - 1, c) + 6.0 * at(m, c) + at(m + 1, c)) * 0.125
                    } else {
                        (at(m, c) + at(m + 1, c)) * 0.5
                    };
                }
            }
        },
    );
    out
}

/// Computes a Gaussian pyramid of at most `levels` levels, the image first, without levels that have a side below `min_side` pixels.
///
/// An empty image gives no levels.
pub fn gaussian_pyramid<const C: usize>(
    view: ImageView<'_, f32, C>,
    levels: usize,
    min_side: usize,
) -> Vec<Image<f32, C>> {
    let mut pyramid: Vec<Image<f32, C>> = Vec::new();
    if view.is_empty() || levels == 0 {
        return pyramid;
    }
    pyramid.push(view.to_image());
    while pyramid.len() < levels {
        let Some(last) = pyramid.last() else { break };
        let (w, h) = last.size();
        if (w, h) == (1, 1) || w.div_ceil(2) < min_side || h.div_ceil(2) < min_side {
            break;
        }
        let next = pyr_down(last.view());
        pyramid.push(next);
    }
    pyramid
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::separable_symmetric;
    use cv_core::GrayF32;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn pyr_down_is_smoothing_then_subsampling(w in 1usize..20, h in 1usize..20) {
            let image = Image::<f32, 3>::from_fn(w, h, |x, y| [((x * 31 + y * 17) % 23) as f32, x as f32, y as f32]);
            let smooth = separable_symmetric(image.view(), &[6.0 / 16.0, 4.0 / 16.0, 1.0 / 16.0]);
            let down = pyr_down(image.view());
            prop_assert_eq!(down.size(), (w.div_ceil(2), h.div_ceil(2)));
            for y in 0..down.height() {
                for x in 0..down.width() {
                    for (a, b) in down.at(x, y).into_iter().zip(smooth.at(2 * x, 2 * y)) {
                        // Values up to 23, ten roundings.
                        prop_assert!((a - b).abs() < 2e-5);
                    }
                }
            }
        }

        #[test]
        fn pyr_up_is_zero_insertion_then_smoothing(w in 1usize..12, h in 1usize..12) {
            let image = Image::<f32, 2>::from_fn(w, h, |x, y| [((x * 31 + y * 17) % 23) as f32, (x + y) as f32]);
            let size = (2 * w - 1, 2 * h - 1);
            let spread = Image::<f32, 2>::from_fn(size.0, size.1, |x, y| if x % 2 == 0 && y % 2 == 0 { image.at(x / 2, y / 2) } else { [0.0; 2] });
            let smooth = separable_symmetric(spread.view(), &[6.0 / 8.0, 4.0 / 8.0, 1.0 / 8.0]);
            let up = pyr_up(image.view(), size);
            for y in 0..size.1.saturating_sub(2) {
                for x in 0..size.0.saturating_sub(2) {
                    for (a, b) in up.at(x, y).into_iter().zip(smooth.at(x, y)) {
                        prop_assert!((a - b).abs() < 2e-5, "{} {} {} {}", x, y, a, b);
                    }
                }
            }
        }
    }

    #[test]
    fn constant_images_stay_constant() {
        for (w, h) in [(1, 1), (2, 1), (1, 5), (7, 4)] {
            let image = GrayF32::new(w, h, [0.625]);
            let down = pyr_down(image.view());
            assert!(down.as_slice().iter().all(|&v| v == 0.625));
            let up = pyr_up(down.view(), (w, h));
            assert!(up.as_slice().iter().all(|&v| v == 0.625) && up.size() == (w, h));
        }
    }

    #[test]
    fn a_pyramid_stops_at_the_minimum_side() {
        let image = GrayF32::new(100, 60, [0.0]);
        let sizes: Vec<_> = gaussian_pyramid(image.view(), 99, 10).iter().map(Image::size).collect();
        assert_eq!(sizes, [(100, 60), (50, 30), (25, 15)]);
        assert_eq!(gaussian_pyramid(image.view(), 99, 0).len(), 8);
        assert!(gaussian_pyramid(GrayF32::new(0, 0, [0.0]).view(), 3, 1).is_empty());
    }
}
