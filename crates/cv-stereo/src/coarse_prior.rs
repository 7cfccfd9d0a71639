//! Priors from a coarser pyramid level for pixels of low texture.
//!
//! In low texture, a window of five pixels has little but noise; at half resolution the noise is halved and the window covers four times
//! the area. So the pair is first matched at half resolution (and before that at a quarter), and disparities far from that result cost
//! more. This is the principle of hierarchical semi-global matching (Rothermel, Wenzel, Fritsch & Haala, "SURE: photogrammetric surface
//! reconstruction from imagery", 2012), which limits the search range of each pixel by the coarser level; here the range stays complete
//! and only pixels of low texture have a prior, so that thin structures are not lost.

use crate::layout::{BLOCK, MAX_VECTORS};
use crate::options::MAX_DISPARITIES;
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch, prelude::*};
use fearless_simd_macros::simd;

/// Radius in px of the window in which texture is measured.
const WINDOW_RADIUS: usize = 2;
/// Sum of the absolute differences of horizontal neighbors (gray levels of 255) in the window of 5×5 pixels, up to which the prior costs at
/// most 3, 2 and 1 census bits: 1.6, 2.3 and 3 levels per pixel. Noise of cameras is 1 to 2 levels.
const MAX_TEXTURE: [u16; PRIOR_CAP as usize] = [40, 58, 75];
/// Maximum cost of a prior, in census bits.
pub(crate) const PRIOR_CAP: u8 = 3;
/// A coarse disparity is used if this many of nine pixels two apart, itself included, are within [`MAX_STEP`] px of it: beside depth
/// discontinuities a coarse map has the disparity of the nearer side.
const MIN_SIMILAR: u8 = 8;
const MAX_STEP: f32 = 2.0;
/// Fraction of low-texture pixels above which a coarser level is matched.
const MIN_LOW_TEXTURE: f64 = 0.1;

/// The prior of a pixel: an expected disparity, in 12 bits, and a cap, in two more.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Prior(u16);

const INDEX_BITS: u32 = MAX_DISPARITIES.ilog2();

impl Prior {
    pub(crate) fn new(index: u16, cap: u8) -> Self {
        Self(u16::from(cap) << INDEX_BITS | index)
    }

    pub(crate) fn from_bits(bits: u16) -> Self {
        Self(bits)
    }

    pub(crate) fn to_bits(self) -> u16 {
        self.0
    }

    /// Returns the index from the smallest disparity.
    #[inline(always)]
    pub(crate) fn index(self) -> u16 {
        self.0 & ((1 << INDEX_BITS) - 1)
    }

    /// Returns the maximum cost, 0 for pixels without a prior: the cost of index `k` is `|k − index| − 1`, clamped from 0 to this. Coarse
    /// disparities are accurate to a pixel: within it the prior must not affect the minimum, above all its sub-pixel position.
    #[inline(always)]
    pub(crate) fn cap(self) -> u8 {
        (self.0 >> INDEX_BITS) as u8
    }
}

/// Index of distance 0 in [`PRIOR_COSTS`]: the largest group, and [`PRIOR_MARGIN`].
pub(crate) const PRIOR_CENTER: i32 = 2 * BLOCK as i32 + PRIOR_MARGIN;
/// Distance outside a group from which on a prior costs its cap at all indices of the group.
pub(crate) const PRIOR_MARGIN: i32 = 8;
/// Number of distances up to the last vector of the largest group, rounded up to a multiple of [`crate::layout::MAX_VECTORS`].
pub(crate) const PRIOR_DISTANCES: usize = 288;

/// Costs of a prior by the distance from it, for groups of 1, 2, 4 and 8 vectors and each cap: distances are split into the phases of
/// [`crate::layout::Layout`], so that those of a vector are contiguous.
pub(crate) static PRIOR_COSTS: [[[u8; PRIOR_DISTANCES]; PRIOR_CAP as usize + 1]; MAX_VECTORS.ilog2() as usize + 1] = {
    let mut costs = [[[0; PRIOR_DISTANCES]; PRIOR_CAP as usize + 1]; MAX_VECTORS.ilog2() as usize + 1];
    let mut log = 0;
    while log < costs.len() {
        let vectors = 1 << log;
        let mut cap = 0;
        while cap <= PRIOR_CAP as usize {
            let mut i = 0;
            while i < PRIOR_DISTANCES {
                let distance = i.abs_diff(PRIOR_CENTER as usize).saturating_sub(1);
                costs[log][cap][i % vectors * (PRIOR_DISTANCES / vectors) + i / vectors] =
                    if distance < cap { distance as u8 } else { cap as u8 };
                i += 1;
            }
            cap += 1;
        }
        log += 1;
    }
    costs
};

/// Sets the [`Prior::cap`] of each pixel by the texture of `gray`, into `priors` (resized). Returns whether enough pixels have low texture.
pub(crate) fn classify_texture(level: Level, gray: &[u8], width: usize, priors: &mut Vec<Prior>) -> bool {
    let height = gray.len() / width.max(1);
    priors.resize(gray.len(), Prior::default());
    let low_texture = priors
        .par_chunks_mut(width.max(1))
        .enumerate()
        .map_init(
            || (vec![0u16; width], vec![0u16; width + 2 * WINDOW_RADIUS]),
            |(step, column), (y, priors)| {
                let rows = std::array::from_fn(|row| {
                    &gray[(y + row).saturating_sub(WINDOW_RADIUS).min(height - 1) * width..][..width]
                });
                dispatch!(level, simd => classify_row(simd, rows, step, column, priors))
            },
        )
        .collect();
    low_texture.iter().sum::<usize>() as f64 > MIN_LOW_TEXTURE * gray.len() as f64
}

/// Classifies the pixels of the middle one of `rows` and returns the number of those of low texture. `step` and `column` are scratch.
#[simd]
fn classify_row<S: Simd>(
    _: S,
    rows: [&[u8]; 2 * WINDOW_RADIUS + 1],
    step: &mut [u16],
    column: &mut [u16],
    priors: &mut [Prior],
) -> usize {
    let width = priors.len();
    let inside = WINDOW_RADIUS..WINDOW_RADIUS + width;
    column[inside.clone()].fill(0);
    // The last pixel has no right neighbor.
    step[width - 1] = 0;
    for row in rows {
        for (step, (&a, &b)) in step.iter_mut().zip(row.iter().zip(&row[1..])) {
            *step = u16::from(a.abs_diff(b));
        }
        for (sum, step) in column[inside.clone()].iter_mut().zip(&*step) {
            *sum += step;
        }
    }
    let (first, last) = (column[WINDOW_RADIUS], column[WINDOW_RADIUS + width - 1]);
    column[..WINDOW_RADIUS].fill(first);
    column[WINDOW_RADIUS + width..].fill(last);
    for (x, sum) in step.iter_mut().enumerate() {
        *sum = column[x] + column[x + 1] + column[x + 2] + column[x + 3] + column[x + 4];
    }
    let mut low_texture = 0;
    for (prior, &sum) in priors.iter_mut().zip(&*step) {
        let cap = MAX_TEXTURE.iter().map(|&limit| u8::from(sum <= limit)).sum();
        *prior = Prior::new(0, cap);
        low_texture += usize::from(cap > 0);
    }
    low_texture
}

/// Counts, of nine pixels two apart of `rows`, those within [`MAX_STEP`] of the middle one; rows have [`WINDOW_RADIUS`] columns of NaN on both
/// sides.
#[simd]
fn count_similar<S: Simd>(_: S, rows: [&[f32]; 3], similar: &mut [u8]) {
    similar.fill(0);
    for row in rows {
        for shift in [0, WINDOW_RADIUS, 2 * WINDOW_RADIUS] {
            for ((count, d), other) in similar.iter_mut().zip(&rows[1][WINDOW_RADIUS..]).zip(&row[shift..]) {
                // NaN compares false.
                *count += u8::from((d - other).abs() <= MAX_STEP);
            }
        }
    }
}

/// The index of pixels whose disparity is not determined.
const NONE: u16 = u16::MAX;

/// Sets the indices of a row of pixels from a row of half resolution; the last column of an odd width uses the last coarse one.
#[simd]
fn set_indices<S: Simd>(_: S, coarse: &[f32], similar: &[u8], range: (i32, usize), indices: &mut [u16]) {
    let (first, last) = (range.0 as f32 / 2.0, (range.1 - 1) as f32);
    let (pairs, rest) = indices.as_chunks_mut::<2>();
    for ((pair, &d), &similar) in pairs.iter_mut().zip(coarse).zip(similar) {
        let index = 2.0 * (d - first) + 0.5;
        // NaN compares false, and is determined nowhere.
        let index = if index < last { index } else { last };
        let index = if index > 0.0 { index } else { 0.0 };
        *pair = [if similar < MIN_SIMILAR { NONE } else { index as u16 }; 2];
    }
    if let (Some(one), Some(pair)) = (rest.first_mut(), pairs.last()) {
        *one = pair[1];
    }
}

/// Sets the [`Prior::index`] of a row of pixels, and removes the priors of those without one.
#[simd]
fn set_row<S: Simd>(_: S, indices: &[u16], priors: &mut [Prior]) {
    for (&index, prior) in indices.iter().zip(priors) {
        *prior = if index == NONE { Prior::default() } else { Prior::new(index, prior.cap()) };
    }
}

/// Sets the [`Prior::index`] of pixels of low texture from a map of half resolution (NaN where unmatched), and removes the priors of pixels
/// that it does not determine. `range` is the smallest disparity and the number of disparities.
pub(crate) fn set_priors(
    level: Level,
    coarse: &[f32],
    coarse_width: usize,
    width: usize,
    range: (i32, usize),
    priors: &mut [Prior],
) {
    let coarse_height = coarse.len() / coarse_width;
    priors.par_chunks_mut(2 * width).enumerate().for_each_init(
        || {
            (
                vec![0u8; coarse_width],
                vec![0u16; width],
                [0; 3].map(|_| vec![f32::NAN; coarse_width + 2 * WINDOW_RADIUS]),
            )
        },
        |(similar, indices, rows), (y, priors)| {
            let y = y.min(coarse_height - 1);
            let here = &coarse[y * coarse_width..][..coarse_width];
            for (row, y) in
                rows.iter_mut().zip([y.saturating_sub(WINDOW_RADIUS), y, (y + WINDOW_RADIUS).min(coarse_height - 1)])
            {
                row[WINDOW_RADIUS..WINDOW_RADIUS + coarse_width]
                    .copy_from_slice(&coarse[y * coarse_width..][..coarse_width]);
            }
            let rows = [&*rows[0], &*rows[1], &*rows[2]];
            dispatch!(level, simd => {
                count_similar(simd, rows, similar);
                set_indices(simd, here, similar, range, indices);
                priors.chunks_mut(width).for_each(|priors| set_row(simd, indices, priors));
            });
        },
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_low_texture_has_priors_and_only_from_smooth_parts() {
        let (width, height) = (40, 24);
        // Constant on the left, steps of 20 levels on the right.
        let gray: Vec<u8> = (0..width * height).map(|i| if i % width < 20 { 90 } else { (i % 2 * 20) as u8 }).collect();
        let mut priors = Vec::new();
        assert!(classify_texture(Level::new(), &gray, width, &mut priors));
        assert!(priors.iter().enumerate().all(|(i, p)| match i % width {
            0..17 => p.cap() == PRIOR_CAP,
            22.. => p.cap() == 0,
            _ => true,
        }));
        // A map that steps from 3 to 9 px in column 5, unmatched in the lower half.
        let coarse: Vec<f32> = (0..20 * 12)
            .map(|i| match (i % 20, i / 20) {
                (_, 6..) => f32::NAN,
                (0..5, _) => 3.0,
                _ => 9.0,
            })
            .collect();
        set_priors(Level::new(), &coarse, 20, width, (-4, 32), &mut priors);
        let at = |x: usize, y: usize| priors[y * width + x];
        // Twice the coarse disparity, counted from −4.
        assert_eq!((at(5, 2).index(), at(5, 2).cap()), (10, PRIOR_CAP));
        assert_eq!(at(15, 2).index(), 22);
        assert_eq!((at(9, 2).cap(), at(10, 2).cap(), at(5, 20).cap()), (0, 0, 0));
    }

    #[test]
    fn a_textured_image_needs_no_coarser_level() {
        let gray: Vec<u8> = (0..64 * 64).map(|i: u32| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
        assert!(!classify_texture(Level::new(), &gray, 64, &mut Vec::new()));
    }
}
