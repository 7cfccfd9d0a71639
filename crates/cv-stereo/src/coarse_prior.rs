//! What a map of half the size says of pixels in flat surroundings.
//!
//! Where a photograph is flat, a window of five pixels holds little but noise, and at half the size the noise is halved and the window
//! covers four times the area. So the pair is matched at half the size first (and before that at a quarter), and disparities far from
//! what was found there cost more. That is the principle of hierarchical semi-global matching (Rothermel, Wenzel, Fritsch & Haala,
//! "SURE: photogrammetric surface reconstruction from imagery", 2012), which limits the range of each pixel to what the coarser level
//! found; here all disparities stay open, and only pixels without texture are guided, so that thin things are not lost.

use fearless_simd::{Level, dispatch, prelude::*};
use fearless_simd_macros::simd;
use rayon::prelude::*;

/// Reach of the window in which texture is measured.
const REACH: usize = 2;
/// Sum of the absolute differences between horizontal neighbors (gray levels of 255) in the window of 5×5 pixels, up to which a
/// pixel is guided by at most 3, 2 and 1 bits of census: 1.6, 2.3 and 3 levels a step. Noise of photographs is 1 to 2 levels.
const FLAT: [u16; PRIOR_CAP as usize] = [40, 58, 75];
/// The most that is added to the cost of a disparity, in bits of census.
pub(crate) const PRIOR_CAP: u8 = 3;
/// A coarse disparity counts where of nine pixels two apart so many, itself among them, lie within [`STEP`] px of it: beside an outline a
/// coarse map is that of the nearer side.
const AGREEING: u8 = 8;
const STEP: f32 = 2.0;
/// Share of the pixels that must be flat for a coarse level to be worth its time.
const WORTH: f64 = 0.1;

/// The disparity that a pixel is guided to.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Prior {
    /// Index from the smallest disparity.
    pub(crate) index: u16,
    /// What is added to the cost of index `k` is `|k − index| − 1`, from 0 to this; 0 for pixels that are not guided. A coarse disparity is right
    /// within a pixel: nearer ones are none of its business, least of all their fractions.
    pub(crate) cap: u8,
}

/// How much each pixel of `gray` may be guided, as [`Prior::cap`], into `priors` (resized). Whether enough of them are.
pub(crate) fn find_flat(level: Level, gray: &[u8], width: usize, priors: &mut Vec<Prior>) -> bool {
    let height = gray.len() / width.max(1);
    priors.resize(gray.len(), Prior::default());
    let flat: usize = priors
        .par_chunks_mut(width.max(1))
        .enumerate()
        .map_init(
            || (vec![0u16; width], vec![0u16; width + 2 * REACH]),
            |(step, column), (y, priors)| {
                let rows = std::array::from_fn(|row| {
                    &gray[(y + row).saturating_sub(REACH).min(height - 1) * width..][..width]
                });
                dispatch!(level, simd => flat_row(simd, rows, step, column, priors))
            },
        )
        .sum();
    flat as f64 > WORTH * gray.len() as f64
}

/// The pixels of a row, the middle one of `rows`, and how many of them are flat. `step` and `column` are scratch.
#[simd]
fn flat_row<S: Simd>(
    _: S,
    rows: [&[u8]; 2 * REACH + 1],
    step: &mut [u16],
    column: &mut [u16],
    priors: &mut [Prior],
) -> usize {
    let width = priors.len();
    let inside = REACH..REACH + width;
    column[inside.clone()].fill(0);
    // The last pixel has no next one.
    step[width - 1] = 0;
    for row in rows {
        for (step, (&a, &b)) in step.iter_mut().zip(row.iter().zip(&row[1..])) {
            *step = u16::from(a.abs_diff(b));
        }
        for (sum, step) in column[inside.clone()].iter_mut().zip(&*step) {
            *sum += step;
        }
    }
    let (first, last) = (column[REACH], column[REACH + width - 1]);
    column[..REACH].fill(first);
    column[REACH + width..].fill(last);
    for (x, sum) in step.iter_mut().enumerate() {
        *sum = column[x] + column[x + 1] + column[x + 2] + column[x + 3] + column[x + 4];
    }
    let mut flat = 0;
    for (prior, &sum) in priors.iter_mut().zip(&*step) {
        let cap = FLAT.iter().map(|&limit| u8::from(sum <= limit)).sum();
        *prior = Prior { index: 0, cap };
        flat += usize::from(cap > 0);
    }
    flat
}

/// How many of nine pixels two apart, those of `rows`, lie within [`STEP`] of the middle one; rows have [`REACH`] columns of NaN on both sides.
#[simd]
fn count_agreeing<S: Simd>(_: S, rows: [&[f32]; 3], agreeing: &mut [u8]) {
    agreeing.fill(0);
    for row in rows {
        for shift in [0, REACH, 2 * REACH] {
            for ((count, d), other) in agreeing.iter_mut().zip(&rows[1][REACH..]).zip(&row[shift..]) {
                // NaN compares false.
                *count += u8::from((d - other).abs() <= STEP);
            }
        }
    }
}

/// Gives the pixels that may be guided the disparities of a map of half the size (NaN where nothing was matched), and frees those it
/// says nothing of. `range` is the smallest disparity and their number.
pub(crate) fn guide(
    level: Level,
    coarse: &[f32],
    coarse_width: usize,
    width: usize,
    range: (i32, usize),
    priors: &mut [Prior],
) {
    let coarse_height = coarse.len() / coarse_width;
    let last = range.1 as i32 - 1;
    priors.par_chunks_mut(2 * width).enumerate().for_each_init(
        || {
            (
                vec![0u8; coarse_width],
                vec![0u16; coarse_width],
                [0; 3].map(|_| vec![f32::NAN; coarse_width + 2 * REACH]),
            )
        },
        |(agreeing, indices, rows), (y, priors)| {
            let y = y.min(coarse_height - 1);
            let here = &coarse[y * coarse_width..][..coarse_width];
            for (row, y) in rows.iter_mut().zip([y.saturating_sub(REACH), y, (y + REACH).min(coarse_height - 1)]) {
                row[REACH..REACH + coarse_width].copy_from_slice(&coarse[y * coarse_width..][..coarse_width]);
            }
            dispatch!(level, simd => count_agreeing(simd, [&*rows[0], &*rows[1], &*rows[2]], agreeing));
            for ((index, &d), &agreeing) in indices.iter_mut().zip(here).zip(&*agreeing) {
                let guided = ((2.0 * (d - range.0 as f32 / 2.0) + 0.5) as i32).clamp(0, last) as u16;
                *index = if agreeing < AGREEING { u16::MAX } else { guided };
            }
            for priors in priors.chunks_mut(width) {
                // The last column of an odd width is of the last coarse one.
                let columns = indices.iter().chain(indices.last());
                for (&index, priors) in columns.zip(priors.chunks_mut(2)) {
                    for prior in priors {
                        let cap = if index == u16::MAX { 0 } else { prior.cap };
                        *prior = Prior { index, cap };
                    }
                }
            }
        },
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_flat_is_guided_and_only_by_what_agrees_around() {
        let (width, height) = (40, 24);
        // Flat on the left, steps of 20 levels on the right.
        let gray: Vec<u8> = (0..width * height).map(|i| if i % width < 20 { 90 } else { (i % 2 * 20) as u8 }).collect();
        let mut priors = Vec::new();
        assert!(find_flat(Level::new(), &gray, width, &mut priors));
        assert!(priors.iter().enumerate().all(|(i, p)| match i % width {
            0..17 => p.cap == PRIOR_CAP,
            22.. => p.cap == 0,
            _ => true,
        }));
        // A map that jumps from 3 to 9 px in its column 5, and knows nothing in its lower half.
        let coarse: Vec<f32> = (0..20 * 12)
            .map(|i| match (i % 20, i / 20) {
                (_, 6..) => f32::NAN,
                (0..5, _) => 3.0,
                _ => 9.0,
            })
            .collect();
        guide(Level::new(), &coarse, 20, width, (-4, 32), &mut priors);
        let at = |x: usize, y: usize| priors[y * width + x];
        // Twice the coarse disparity, counted from −4.
        assert_eq!((at(5, 2).index, at(5, 2).cap), (10, PRIOR_CAP));
        assert_eq!(at(15, 2).index, 22);
        assert_eq!((at(9, 2).cap, at(10, 2).cap, at(5, 20).cap), (0, 0, 0));
    }

    #[test]
    fn a_textured_photograph_needs_no_coarse_level() {
        let gray: Vec<u8> = (0..64 * 64).map(|i: u32| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
        assert!(!find_flat(Level::new(), &gray, 64, &mut Vec::new()));
    }
}
