//! Search windows from a coarser pyramid level: the range of disparities of each pixel in hierarchical matching (tSGM; Rothermel, Wenzel,
//! Fritsch & Haala, "SURE: photogrammetric surface reconstruction from imagery", 2012).

use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch, prelude::*};
use fearless_simd_macros::simd;

/// Number of disparities of a window.
pub(crate) const WINDOW: usize = 32;
/// First indices of windows are multiples of this, so that those of most neighbors are equal. Margins around the coarse disparity are 14 to
/// 17 px.
const STEP: usize = 4;
/// Radius in coarse pixels of the neighborhood whose disparities a window includes, if they fit in it with [`MARGIN`] px on both sides.
const RADIUS: usize = 2;
const MARGIN: f32 = 6.0;
/// Rows of a task.
const MIN_ROWS: usize = 16;

/// The first index of the window of each coarse pixel, which covers 2×2 pixels.
#[derive(Debug, Default)]
pub(crate) struct SearchWindows {
    pub(crate) first: Vec<u16>,
    pub(crate) width: usize,
}

impl SearchWindows {
    /// Sets the windows from a map of half resolution; `range` is the smallest disparity and the number of disparities, at least
    /// [`WINDOW`], of full resolution. Windows of unknown pixels are those of the pixel to the left.
    pub(crate) fn set(&mut self, level: Level, coarse: &[f32], width: usize, range: (i32, usize)) {
        self.width = width;
        self.first.resize(coarse.len(), 0);
        let height = coarse.len() / width;
        self.first.par_chunks_mut(width).with_min_len(MIN_ROWS).enumerate().for_each_init(
            || [0; 4].map(|_| vec![0.0; width]),
            |buffers, (y, out)| {
                let row = |y: usize| &coarse[y * width..][..width];
                let rows = std::array::from_fn(|dy| row((y + dy).saturating_sub(RADIUS).min(height - 1)));
                dispatch!(level, simd => set_row(simd, row(y), rows, range, buffers, out));
            },
        );
    }

    /// Returns the windows of row `y` of full resolution, one for two pixels.
    pub(crate) fn row(&self, y: usize) -> &[u16] {
        let y = (y / 2).min(self.first.len() / self.width - 1);
        &self.first[y * self.width..][..self.width]
    }
}

/// Sets the windows of a row, from the row itself and the rows of its neighborhood. `buffers` is scratch.
#[simd]
fn set_row<S: Simd>(
    _: S,
    own: &[f32],
    rows: [&[f32]; 2 * RADIUS + 1],
    (min, disparities): (i32, usize),
    [low, high, least, most]: &mut [Vec<f32>; 4],
    out: &mut [u16],
) {
    let width = own.len();
    // Comparisons with NaN are false: unknown pixels have no effect.
    least.fill(f32::INFINITY);
    most.fill(f32::NEG_INFINITY);
    for row in rows {
        for ((least, most), &d) in least.iter_mut().zip(&mut *most).zip(row) {
            *least = if d < *least { d } else { *least };
            *most = if d > *most { d } else { *most };
        }
    }
    low.copy_from_slice(least);
    high.copy_from_slice(most);
    for shift in 1..=RADIUS.min(width - 1) {
        for (to, from) in [(shift..width, 0..width - shift), (0..width - shift, shift..width)] {
            for (low, &d) in low[to.clone()].iter_mut().zip(&least[from.clone()]) {
                *low = if d < *low { d } else { *low };
            }
            for (high, &d) in high[to].iter_mut().zip(&most[from]) {
                *high = if d > *high { d } else { *high };
            }
        }
    }
    let last = (disparities - WINDOW) as i32;
    let max_width = WINDOW as f32 - 2.0 * MARGIN;
    for ((center, &high), &own) in low.iter_mut().zip(&*high).zip(own) {
        let both = *center + high;
        *center = if 2.0 * (high - *center) <= max_width { both } else { 2.0 * own };
    }
    let mut before = 0;
    for (out, &center) in out.iter_mut().zip(&*low) {
        if center.is_finite() {
            let first = (center - min as f32 + 0.5) as i32 + (STEP / 2) as i32 - (WINDOW / 2) as i32;
            before = (first.clamp(0, last) / STEP as i32 * STEP as i32) as u16;
        }
        *out = before;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_synth::instruction_sets;

    #[test]
    fn windows_include_both_sides_of_a_small_step_and_the_own_side_of_a_large_one() {
        // Steps from 20 to 24 in column 10 and to 60 in column 30 of half resolution; unknown in column 40.
        let row: Vec<f32> = (0..50)
            .map(|x| match x {
                40 => f32::NAN,
                0..10 => 20.0,
                10..30 => 24.0,
                _ => 60.0,
            })
            .collect();
        let coarse = row.repeat(8);
        for level in instruction_sets() {
            let mut windows = SearchWindows::default();
            windows.set(level, &coarse, 50, (-8, 256));
            for y in 0..16 {
                for (x, &first) in windows.row(y).iter().enumerate() {
                    let includes = |d: f32| {
                        let index = (2.0 * d) as i32 + 8 - i32::from(first);
                        (MARGIN as i32..WINDOW as i32 - MARGIN as i32).contains(&index)
                    };
                    if !row[x].is_nan() {
                        assert!(includes(row[x]), "{level:?} {x} {first}");
                    }
                    if (8..12).contains(&x) {
                        assert!(includes(20.0) && includes(24.0), "{level:?} {x} {first}");
                    }
                    assert!((first as usize).is_multiple_of(STEP) && usize::from(first) + WINDOW <= 256);
                }
            }
        }
    }
}
