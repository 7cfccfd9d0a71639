//! A median filter that knows holes.

use rayon::prelude::*;

/// Median of the valid values in the window of `radius` (1 or 2) around every valid pixel, the lower one of an even
/// count; holes stay holes. Beyond the border there are no values.
pub(crate) fn median(disparity: &[f32], width: usize, height: usize, radius: usize, out: &mut Vec<f32>) {
    out.resize(disparity.len(), f32::NAN);
    if width == 0 || height == 0 {
        return;
    }
    out.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        let (top, bottom) = (y.saturating_sub(radius), (y + radius).min(height - 1));
        for (x, value) in row.iter_mut().enumerate() {
            let centre = disparity[y * width + x];
            if centre.is_nan() {
                *value = f32::NAN;
                continue;
            }
            let (first, last) = (x.saturating_sub(radius), (x + radius).min(width - 1));
            let mut window = [0f32; 25];
            let mut n = 0;
            for j in top..=bottom {
                for &d in &disparity[j * width + first..=j * width + last] {
                    window[n] = d;
                    n += usize::from(!d.is_nan());
                }
            }
            let middle = (n - 1) / 2;
            *value = *window[..n].select_nth_unstable_by(middle, f32::total_cmp).1;
        }
    });
}
