//! Normalized cross-correlation of a small square patch over a search window.

use cv_core::Vector2;
use fearless_simd::{Level, dispatch, f32x16, prelude::*};

/// Search radius, in pixels of the patch: the largest whose displacements along a row fit in two vectors of AVX2.
pub(crate) const SEARCH_RADIUS: usize = 7;
/// Number of displacements along each axis.
pub(crate) const SEARCH_SIDE: usize = 2 * SEARCH_RADIUS + 1;
/// Displacements along a row that are computed in parallel, in whole vectors of every instruction set.
const LANES: usize = 16;
/// Padding after the last sample of a window, read by the lanes beyond [`SEARCH_SIDE`] and ignored.
pub(crate) const PAD: usize = LANES - SEARCH_SIDE;

/// A template: a zero-mean patch, row-major.
pub(crate) struct Template {
    side: usize,
    centered: Vec<f32>,
    energy: f32,
}

impl Template {
    pub(crate) fn new(side: usize, patch: &[f32]) -> Self {
        let mean = sum_of(patch, |v| v) / patch.len() as f32;
        let centered: Vec<f32> = patch.iter().map(|v| v - mean).collect();
        let energy = sum_of(&centered, |v| v * v);
        Self { side, centered, energy }
    }

    /// Returns the sum of squared deviations from the mean.
    pub(crate) fn energy(&self) -> f32 {
        self.energy
    }

    /// Computes the correlation with one patch, given by its rows: −1 to 1; NaN if it contains NaN.
    pub(crate) fn score<'a>(&self, rows: impl Iterator<Item = &'a [f32]>) -> f32 {
        let (mut sum, mut squares, mut product) = (0.0_f32, 0.0_f32, 0.0_f32);
        for (ours, theirs) in self.centered.chunks_exact(self.side).zip(rows) {
            sum += theirs.iter().fold(0.0, |sum, b| sum + b);
            squares += theirs.iter().fold(0.0, |sum, b| sum + b * b);
            for (a, b) in ours.iter().zip(theirs) {
                product += a * b;
            }
        }
        self.normalized(sum, squares, product)
    }

    /// Computes the correlations with all positions of a window of side `side + 2 SEARCH_RADIUS`, followed by [`PAD`] samples, row-major; equal to
    /// [`Self::score`] of each.
    pub(crate) fn scores(&self, window: &[f32]) -> [f32; SEARCH_SIDE * SEARCH_SIDE] {
        dispatch!(Level::new(), simd => self.scores_inner(simd, window))
    }

    #[inline(always)]
    fn scores_inner<S: Simd>(&self, simd: S, window: &[f32]) -> [f32; SEARCH_SIDE * SEARCH_SIDE] {
        let wide = self.side + 2 * SEARCH_RADIUS;
        assert_eq!(window.len(), wide * wide + PAD);
        let row = |r: usize| &window[r * wide..][..self.side - 1 + LANES];
        let zero = f32x16::splat(simd, 0.0);
        // Sums along each row of the window, which all vertical shifts share.
        let mut along = Vec::with_capacity(wide);
        for r in 0..wide {
            let (mut sum, mut squares) = (zero, zero);
            for theirs in row(r).windows(LANES) {
                let theirs = f32x16::from_slice(simd, theirs);
                sum += theirs;
                squares += theirs * theirs;
            }
            along.push((sum, squares));
        }
        let mut scores = [0.0; SEARCH_SIDE * SEARCH_SIDE];
        // Three shifts at a time, whose sums are independent.
        const { assert!(SEARCH_SIDE.is_multiple_of(3)) };
        for start in (0..SEARCH_SIDE).step_by(3) {
            let (mut first, mut second, mut third) = (zero, zero, zero);
            for (r, ours) in self.centered.chunks_exact(self.side).enumerate() {
                let rows = row(r + start).windows(LANES).zip(row(r + start + 1).windows(LANES));
                for (a, ((x, y), z)) in ours.iter().zip(rows.zip(row(r + start + 2).windows(LANES))) {
                    let a = f32x16::splat(simd, *a);
                    first += a * f32x16::from_slice(simd, x);
                    second += a * f32x16::from_slice(simd, y);
                    third += a * f32x16::from_slice(simd, z);
                }
            }
            for (dy, product) in (start..).zip([first, second, third]) {
                let (mut sum, mut squares) = (zero, zero);
                for (row_sum, row_squares) in &along[dy..dy + self.side] {
                    sum += *row_sum;
                    squares += *row_squares;
                }
                let (mut lanes, [mut sums, mut all_squares]) = ([0.0; LANES], [[0.0; LANES]; 2]);
                product.store_slice(&mut lanes);
                sum.store_slice(&mut sums);
                squares.store_slice(&mut all_squares);
                for k in 0..LANES {
                    lanes[k] = self.normalized(sums[k], all_squares[k], lanes[k]);
                }
                scores[dy * SEARCH_SIDE..][..SEARCH_SIDE].copy_from_slice(&lanes[..SEARCH_SIDE]);
            }
        }
        scores
    }

    #[inline(always)]
    fn normalized(&self, sum: f32, squares: f32, product: f32) -> f32 {
        // The variance of rounding to gray levels: less means nothing, and in single precision may be all rounding. (NaN propagates through the product.)
        let count = self.centered.len() as f32;
        product / (self.energy * (squares - sum * sum / count).max(count / 12.0)).sqrt()
    }
}

/// Sums a term of all values, in eight partial sums: additions to one sum wait for each other.
#[inline]
fn sum_of(values: &[f32], term: impl Fn(f32) -> f32) -> f32 {
    let mut sums = [0.0_f32; 8];
    let (chunks, rest) = values.as_chunks::<8>();
    for chunk in chunks {
        for k in 0..8 {
            sums[k] += term(chunk[k]);
        }
    }
    for (sum, v) in sums.iter_mut().zip(rest) {
        *sum += term(*v);
    }
    sums.iter().sum()
}

/// Correlations within this of the maximum make it ambiguous.
pub(super) const AMBIGUITY: f32 = 0.05;

/// Returns the displacement of the maximum of the correlations at all displacements of a square (row-major, `side` odd) from its middle, with parabolic sub-pixel interpolation; `None` below
/// `min_correlation`, on the border of the square, and for an ambiguous maximum.
pub(crate) fn score_maximum(scores: &[f32], side: usize, min_correlation: f32) -> Option<Vector2<f64>> {
    let (best, &score) = scores.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1))?;
    let (y, x) = (best / side, best % side);
    if score < min_correlation || x == 0 || y == 0 || x == side - 1 || y == side - 1 {
        return None;
    }
    // Repeated structure: a second maximum that is nearly as high.
    let is_ambiguous = scores.iter().enumerate().any(|(i, s)| {
        let far = (i / side).abs_diff(y).max((i % side).abs_diff(x)) > 2;
        far && *s > score - AMBIGUITY
    });
    if is_ambiguous {
        return None;
    }
    let fx = parabola_peak(scores[best - 1], score, scores[best + 1]);
    let fy = parabola_peak(scores[best - side], score, scores[best + side]);
    let middle = (side / 2) as f64;
    Some(Vector2::new(x as f64 + fx - middle, y as f64 + fy - middle))
}

/// Returns the offset of the maximum of the parabola through three neighboring scores from the middle one.
pub(crate) fn parabola_peak(a: f32, b: f32, c: f32) -> f64 {
    let curvature = a - 2.0 * b + c;
    if curvature < 0.0 { f64::from(0.5 * (a - c) / curvature).clamp(-0.5, 0.5) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Random gray levels, 0 to 256.
    fn gray_levels(mut state: u32) -> impl FnMut() -> f32 {
        move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 16) as f32
        }
    }

    proptest! {
        #[test]
        fn the_correlation_at_all_shifts_equals_that_at_single_shifts(half in 1_usize..9, seed in any::<u32>(), hole in 0_usize..2000) {
            let side = 2 * half + 1;
            let wide = side + 2 * SEARCH_RADIUS;
            let mut random = gray_levels(seed);
            let patch: Vec<f32> = (0..side * side).map(|_| random()).collect();
            let mut window: Vec<f32> = (0..wide * wide).map(|_| random()).collect();
            if let Some(v) = window.get_mut(hole) {
                *v = f32::NAN;
            }
            window.resize(wide * wide + PAD, 0.0);
            let template = Template::new(side, &patch);
            let scores = template.scores(&window);
            for (i, found) in scores.iter().enumerate() {
                let (y, x) = (i / SEARCH_SIDE, i % SEARCH_SIDE);
                let one = template.score((0..side).map(|r| &window[(y + r) * wide + x..][..side]));
                prop_assert_eq!(found.to_bits(), one.to_bits());
                prop_assert!(one.is_nan() || one.abs() < 1.0001);
            }
        }

        #[test]
        fn a_constant_window_correlates_with_nothing(level in 0_u8..=255, seed in any::<u32>()) {
            let (side, wide) = (17, 17 + 2 * SEARCH_RADIUS);
            let mut random = gray_levels(seed);
            let patch: Vec<f32> = (0..side * side).map(|_| random()).collect();
            let scores = Template::new(side, &patch).scores(&vec![f32::from(level); wide * wide + PAD]);
            // Rounding of 289 products of up to 128 · 255 levels², beside deviations of 74 and 0.3 levels.
            prop_assert!(scores.iter().all(|score| score.abs() < 0.01), "{scores:?}");
        }
    }

    #[test]
    fn a_patch_has_its_maximum_correlation_at_its_position() {
        let (side, wide) = (9, 9 + 2 * SEARCH_RADIUS);
        let mut window: Vec<f32> = (0..wide * wide)
            .map(|i| (i as u32).wrapping_mul(2_654_435_761).rotate_left(13).wrapping_mul(1_664_525) >> 24)
            .map(|v| v as f32)
            .collect();
        window.resize(wide * wide + PAD, 0.0);
        let (x, y) = (10, 3);
        // Brighter and of less contrast: the correlation does not mind.
        let patch: Vec<f32> =
            (0..side * side).map(|i| 0.5 * window[(y + i / side) * wide + x + i % side] + 40.0).collect();
        let scores = Template::new(side, &patch).scores(&window);
        let best = (0..scores.len()).max_by(|a, b| scores[*a].total_cmp(&scores[*b]));
        assert_eq!(best, Some(y * SEARCH_SIDE + x));
        // Rounding of some eighty sums.
        assert!((scores[y * SEARCH_SIDE + x] - 1.0).abs() < 1e-4);
    }
}
