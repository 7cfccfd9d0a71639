//! Search windows from a coarser pyramid level: the range of disparities of each pixel in hierarchical matching (tSGM; Rothermel, Wenzel,
//! Fritsch & Haala, "SURE: photogrammetric surface reconstruction from imagery", 2012).

use rayon::prelude::*;

/// Number of disparities of a window.
pub(crate) const WINDOW: usize = 32;
/// First indices of windows are multiples of this, so that those of most neighbors are equal. Margins around the coarse disparity are 14 to
/// 17 px.
const STEP: usize = 4;
/// Radius in coarse pixels of the neighborhood whose disparities a window includes, if they fit in it with [`MARGIN`] px on both sides.
const RADIUS: usize = 2;
const MARGIN: f32 = 6.0;

/// The first index of the window of each coarse pixel, which covers 2×2 pixels.
#[derive(Debug, Default)]
pub(crate) struct SearchWindows {
    pub(crate) first: Vec<u16>,
    pub(crate) width: usize,
    /// Minimum and maximum of the neighborhood along the row.
    extremes: Vec<[f32; 2]>,
}

impl SearchWindows {
    /// Sets the windows from a map of half resolution; `range` is the smallest disparity and the number of disparities, at least
    /// [`WINDOW`], of full resolution. Windows of unknown pixels are those of the pixel to the left.
    pub(crate) fn set(&mut self, coarse: &[f32], width: usize, range: (i32, usize)) {
        self.width = width;
        self.first.resize(coarse.len(), 0);
        self.extremes.resize(coarse.len(), [0.0; 2]);
        let join = |a: [f32; 2], b: [f32; 2]| [a[0].min(b[0]), a[1].max(b[1])];
        self.extremes.par_chunks_mut(width).zip(coarse.par_chunks(width)).for_each(|(out, row)| {
            for (x, out) in out.iter_mut().enumerate() {
                let around = &row[x.saturating_sub(RADIUS)..(x + RADIUS + 1).min(width)];
                // Minimum and maximum ignore NaN.
                *out = around.iter().fold([f32::NAN; 2], |ends, &d| join(ends, [d; 2]));
            }
        });
        let last = range.1 - WINDOW;
        let (extremes, height) = (&self.extremes, coarse.len() / width);
        self.first.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
            let mut before = 0;
            for (x, out) in out.iter_mut().enumerate() {
                let rows = y.saturating_sub(RADIUS)..(y + RADIUS + 1).min(height);
                let [low, high] = rows.fold([f32::NAN; 2], |ends, y| join(ends, extremes[y * width + x]));
                let own = coarse[y * width + x];
                let is_narrow = 2.0 * (high - low) <= WINDOW as f32 - 2.0 * MARGIN;
                let center = if is_narrow { low + high } else { 2.0 * own };
                if center.is_finite() {
                    let index = (center - range.0 as f32 + 0.5).max(0.0) as usize;
                    let first = (index + STEP / 2).saturating_sub(WINDOW / 2) / STEP * STEP;
                    before = first.min(last) as u16;
                }
                *out = before;
            }
        });
    }

    /// Returns the windows of row `y` of full resolution, one for two pixels.
    pub(crate) fn row(&self, y: usize) -> &[u16] {
        let y = (y / 2).min(self.first.len() / self.width - 1);
        &self.first[y * self.width..][..self.width]
    }
}
