//! Median filters with small windows.

use crate::rows::for_rows_with;
use cv_core::{GrayF32, ImageView};

/// Computes the median of each 3×3 window, border mode replicate (as OpenCV's `medianBlur`).
///
/// A NaN counts as larger than every number.
pub fn median_filter_3x3(view: ImageView<'_, f32, 1>) -> GrayF32 {
    median::<3, 9>(view)
}

/// Computes the median of each 5×5 window, border mode replicate (as OpenCV's `medianBlur`).
///
/// A NaN counts as larger than every number.
pub fn median_filter_5x5(view: ImageView<'_, f32, 1>) -> GrayF32 {
    median::<5, 25>(view)
}

fn median<const K: usize, const N: usize>(view: ImageView<'_, f32, 1>) -> GrayF32 {
    let (w, h) = view.size();
    let mut out = GrayF32::new(w, h, [0.0]);
    let r = K / 2;
    let buffers = || vec![vec![0.0f32; w + 2 * r]; K];
    for_rows_with(&mut out, buffers, |padded, y, row| {
        for (j, line) in padded.iter_mut().enumerate() {
            let source = view.row((y + j).saturating_sub(r).min(h - 1));
            line[r..r + w].copy_from_slice(source);
            line[..r].fill(source[0]);
            line[r + w..].fill(source[w - 1]);
        }
        for (x, out) in row.iter_mut().enumerate() {
            let mut window: [f32; N] = std::array::from_fn(|i| padded[i / K][x + i % K]);
            *out = *window.select_nth_unstable_by(N / 2, |a, b| total_order_key(*a).cmp(&total_order_key(*b))).1;
        }
    });
    out
}

/// Maps a float to an integer key of the same order, every NaN last.
#[inline(always)]
fn total_order_key(v: f32) -> i32 {
    if v.is_nan() {
        return i32::MAX;
    }
    let bits = v.to_bits() as i32;
    bits ^ (((bits >> 31) as u32) >> 1) as i32
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn reference(image: &GrayF32, r: isize) -> GrayF32 {
        let (w, h) = (image.width() as isize, image.height() as isize);
        GrayF32::from_fn(image.width(), image.height(), |x, y| {
            let mut window = Vec::new();
            for j in -r..=r {
                for i in -r..=r {
                    let (x, y) = ((x as isize + i).clamp(0, w - 1), (y as isize + j).clamp(0, h - 1));
                    window.push(image.at(x as usize, y as usize)[0]);
                }
            }
            window.sort_by(|a, b| a.partial_cmp(b).unwrap_or_else(|| a.is_nan().cmp(&b.is_nan())));
            [window[window.len() / 2]]
        })
    }

    proptest! {
        #[test]
        fn the_median_is_the_middle_of_the_sorted_window(w in 1usize..40, h in 1usize..9, seed in any::<u32>(), nan_percent in 0u32..30) {
            let mut state = seed | 1;
            let image = GrayF32::from_fn(w, h, |_, _| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let v = (state >> 8) % 1000;
                [if v < nan_percent * 10 { f32::NAN } else { v as f32 - 500.0 }]
            });
            let bits = |i: &GrayF32| i.as_slice().iter().map(|v| if v.is_nan() { None } else { Some(v.to_bits()) }).collect::<Vec<_>>();
            prop_assert_eq!(bits(&median_filter_3x3(image.view())), bits(&reference(&image, 1)));
            prop_assert_eq!(bits(&median_filter_5x5(image.view())), bits(&reference(&image, 2)));
        }
    }

    #[test]
    fn empty_and_single_pixel_images() {
        assert!(median_filter_3x3(GrayF32::new(0, 5, [0.0]).view()).is_empty());
        assert_eq!(median_filter_5x5(GrayF32::new(1, 1, [2.0]).view()).at(0, 0), [2.0]);
    }
}
