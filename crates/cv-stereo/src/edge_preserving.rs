//! Edge-preserving smoothing, guided by the left image.
//!
//! The bilateral filter first moves depth discontinuities to image edges: a matching window across a discontinuity matches its nearer
//! side, so that foreground objects become a pixel or two too wide. Then it averages each surface. The other filter is the fast global
//! smoother (Min et al., "Fast global image smoothing based on weighted least squares", TIP 2014), with the valid pixels as weights:
//! OpenCV's WLS filter.

use crate::{PixelState, Smoothing, buffer_pool};
use cv_core::{Cancelled, Stage};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch, prelude::*};
use fearless_simd_macros::simd;

/// Radius of a window in px, and the spacing of its samples: 25 of 81 give the same result as all.
const RADIUS: usize = 4;
const SPACING: usize = 2;
/// Padding of rows: the radius, and on the right also the width of a vector.
const LEFT: usize = RADIUS;
const RIGHT: usize = RADIUS + 16;
/// Rows that are smoothed at a time: their planes stay in the second-level cache.
const BAND: usize = 64;
/// Difference in px from which on neighbors are of different surfaces. On sixteen generated scenes 2 leaves 1.61 % of errors above 1 px and
/// 0.62 % above 2 px; 1 leaves 1.78 and 0.68, 1.5 leaves 1.64 and 0.65, 3 leaves 1.68 and 0.60.
const MAX_STEP: f32 = 2.0;

/// Value of unknown disparities in the planes of the bilateral filter: farther than [`MAX_STEP`] from every disparity.
const UNKNOWN: f32 = 1e9;

/// Buffers of [`smooth`], reused between frames: those of each thread.
#[derive(Debug, Default)]
pub(crate) struct SmoothingBuffers(Vec<Planes>);

/// Padded rows, and rows without disparities above and below.
#[derive(Debug, Default)]
struct Planes {
    /// Disparity; where unknown, [`UNKNOWN`], or 0 for the fast global smoother.
    disparity: Vec<f32>,
    /// With depth discontinuities moved to image edges.
    moved: Vec<f32>,
    /// Gray levels, scaled.
    gray: Vec<f32>,
    /// Of the fast global smoother: 1, or 0 where the disparity is unknown.
    weight: Vec<f32>,
    /// Averages of a row.
    averages: Vec<f32>,
}

/// Returns the bytes of the buffers of [`smooth`].
pub(crate) fn bytes(smoothing: Smoothing, width: usize, height: usize) -> usize {
    let row = size_of::<f32>() * width.saturating_add(LEFT + RIGHT);
    let rows = match smoothing {
        Smoothing::None => 0,
        Smoothing::Bilateral { .. } => {
            let bands = rayon::current_num_threads().min(height.div_ceil(BAND));
            3 * bands.saturating_mul(BAND.min(height) + 4 * RADIUS)
        }
        Smoothing::LeastSquares { .. } => height.saturating_add(2 * RADIUS).saturating_mul(4),
    };
    row.saturating_mul(rows)
}

/// Smooths the map `source` into `disparity`. Unknown pixels stay unknown; matched pixels across which a discontinuity moves become
/// mismatched.
#[allow(clippy::too_many_arguments)]
pub(crate) fn smooth(
    level: Level,
    smoothing: Smoothing,
    source: &[f32],
    disparity: &mut [f32],
    states: &mut [PixelState],
    gray: &[u8],
    width: usize,
    SmoothingBuffers(buffers): &mut SmoothingBuffers,
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    if width == 0 || source.is_empty() {
        return Ok(());
    }
    let height = source.len() / width;
    let stride = width + LEFT + RIGHT;
    match smoothing {
        Smoothing::None => disparity.copy_from_slice(source),
        Smoothing::Bilateral { sigma } => {
            let bands = disparity.chunks_mut(BAND * width).zip(states.chunks_mut(BAND * width)).enumerate();
            buffer_pool::try_for_each(buffers, bands, |planes, (band, (out, states))| {
                stage.check()?;
                let first = band * BAND;
                let count = out.len() / width;
                // Row `r` of the planes is row `first − 2·RADIUS + r` of the image.
                let from = first as isize - 2 * RADIUS as isize;
                planes.fill(level, source, gray, width, (from, count + 4 * RADIUS), (UNKNOWN, 1.0 / sigma));
                let Planes { disparity: before, moved, gray, averages, .. } = planes;
                let [before, gray] = [before, gray].map(|plane| plane.as_slice());
                for y in first.saturating_sub(RADIUS)..(first + count + RADIUS).min(height) {
                    let y = y + RADIUS - first;
                    let rows = Rows { disparity: before, gray, stride, y };
                    let out = &mut moved[(y + RADIUS) * stride + LEFT..][..width.next_multiple_of(16)];
                    dispatch!(level, simd => move_discontinuities(simd, rows, out));
                }
                for (y, (out, states)) in out.chunks_exact_mut(width).zip(states.chunks_exact_mut(width)).enumerate() {
                    let rows = Rows { disparity: moved, gray, stride, y: y + RADIUS };
                    averages.resize(width.next_multiple_of(16), 0.0);
                    dispatch!(level, simd => average(simd, rows, averages));
                    let pixels = rows.at(0, RADIUS, RADIUS);
                    let pixels = before[pixels..pixels + width].iter().zip(&moved[pixels..pixels + width]);
                    for ((state, (before, moved)), d) in states.iter_mut().zip(pixels).zip(&*out) {
                        // Branch-free: filled and unknown pixels keep their state.
                        let now = if *state == PixelState::Matched { PixelState::Mismatched } else { *state };
                        *state = if (before == moved) | d.is_nan() { *state } else { now };
                    }
                    for (d, &value) in out.iter_mut().zip(&*averages) {
                        *d = if d.is_nan() { f32::NAN } else { value };
                    }
                }
                Ok(())
            })?;
        }
        Smoothing::LeastSquares { lambda, sigma } => {
            buffers.resize_with(1, Planes::default);
            let planes = &mut buffers[0];
            planes.fill(level, source, gray, width, (-(RADIUS as isize), height + 2 * RADIUS), (0.0, 1.0));
            planes.weigh(source, width);
            least_squares(planes, width, height, lambda, sigma, stage)?;
            disparity.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
                let from = (RADIUS + y) * stride + LEFT;
                let (value, weight) = (&planes.disparity[from..][..width], &planes.weight[from..][..width]);
                let source = &source[y * width..][..width];
                for (((d, &before), &v), &w) in out.iter_mut().zip(source).zip(value).zip(weight) {
                    *d = if !before.is_nan() && w > 0.0 { v / w } else { before };
                }
            });
        }
    }
    Ok(())
}

impl Planes {
    /// Copies `count` rows of the image from row `first` on, gray levels times `scale`; disparities outside the image are `unknown`.
    fn fill(
        &mut self,
        level: Level,
        disparity: &[f32],
        gray: &[u8],
        width: usize,
        (first, count): (isize, usize),
        (unknown, scale): (f32, f32),
    ) {
        let stride = width + LEFT + RIGHT;
        for plane in [&mut self.disparity, &mut self.moved, &mut self.gray] {
            plane.resize(stride * count, 0.0);
        }
        let planes = self.disparity.par_chunks_mut(stride).zip(self.moved.par_chunks_mut(stride));
        let planes = planes.zip(self.gray.par_chunks_mut(stride));
        planes.with_min_len(BAND).enumerate().for_each(|(row, ((d, m), g))| {
            let start = usize::try_from(first + row as isize).unwrap_or(usize::MAX).saturating_mul(width);
            if start >= disparity.len() {
                d.fill(unknown);
                m.fill(unknown);
                return;
            }
            let (inside, pixels) = (LEFT..LEFT + width, start..start + width);
            let out = [&mut d[inside.clone()], &mut g[inside]];
            dispatch!(level, simd => fill_row(simd, out, &disparity[pixels.clone()], &gray[pixels], unknown, scale));
            for row in [d, m] {
                row[..LEFT].fill(unknown);
                row[LEFT + width..].fill(unknown);
            }
        });
    }

    /// Sets the weights of all rows.
    fn weigh(&mut self, disparity: &[f32], width: usize) {
        let stride = width + LEFT + RIGHT;
        self.weight.clear();
        self.weight.resize(self.disparity.len(), 0.0);
        let rows = self.weight.par_chunks_mut(stride).skip(RADIUS).zip(disparity.par_chunks(width));
        rows.for_each(|(weight, disparity)| {
            for (weight, d) in weight[LEFT..].iter_mut().zip(disparity) {
                *weight = if d.is_nan() { 0.0 } else { 1.0 };
            }
        });
    }
}

/// Copies disparities and gray levels of a row, without padding.
#[simd]
fn fill_row<S: Simd>(_: S, [d, g]: [&mut [f32]; 2], disparity: &[f32], gray: &[u8], unknown: f32, scale: f32) {
    for (out, &value) in d.iter_mut().zip(disparity) {
        *out = if value.is_nan() { unknown } else { value };
    }
    for (out, &value) in g.iter_mut().zip(gray) {
        *out = f32::from(value) * scale;
    }
}

/// A row with those above and below.
#[derive(Clone, Copy)]
struct Rows<'a> {
    disparity: &'a [f32],
    /// Times the decrease of the weight per gray level of difference.
    gray: &'a [f32],
    stride: usize,
    y: usize,
}

impl Rows<'_> {
    /// Returns the index of the pixel at offset `(dx, dy)` from the first of a vector at `x`; both count from −[`RADIUS`].
    #[inline(always)]
    fn at(&self, x: usize, dx: usize, dy: usize) -> usize {
        (self.y + dy) * self.stride + x + dx
    }
}

/// Moves depth discontinuities: a pixel beside a step of more than [`MAX_STEP`] takes the mean disparity of the other side if more of the
/// pixels of similar gray level in its window are on the other side.
#[simd]
fn move_discontinuities<S: Simd>(simd: S, rows: Rows<'_>, out: &mut [f32]) {
    let lanes = S::f32s::LEN;
    let load = |plane: &[f32], at: usize| S::f32s::from_slice(simd, &plane[at..at + lanes]);
    let (zero, limit) = (S::f32s::splat(simd, 0.0), S::f32s::splat(simd, 0.5 * UNKNOWN));
    for x in (0..out.len()).step_by(lanes) {
        let center = rows.at(x, RADIUS, RADIUS);
        let here = load(rows.disparity, center);
        let (mut low, mut high) = (here, here);
        for (dx, dy) in [(2, 4), (3, 4), (5, 4), (6, 4), (4, 2), (4, 3), (4, 5), (4, 6)] {
            let value = load(rows.disparity, rows.at(x, dx, dy));
            let value = value.simd_lt(limit).select(value, here);
            low = low.min(value);
            high = high.max(value);
        }
        let step = (high - low).simd_gt(S::f32s::splat(simd, MAX_STEP)) & here.simd_lt(limit);
        let mut result = here;
        if step.any_true() {
            let middle = (low + high) * 0.5;
            let gray = load(rows.gray, center);
            let [mut near, mut near_sum, mut all, mut all_sum] = [zero; 4];
            for dy in (0..=2 * RADIUS).step_by(SPACING) {
                for dx in (0..=2 * RADIUS).step_by(SPACING) {
                    let at = rows.at(x, dx, dy);
                    let value = load(rows.disparity, at);
                    let alike = (S::f32s::splat(simd, 1.0) - (load(rows.gray, at) - gray).abs()).max(zero);
                    let weight = value.simd_lt(limit).select(alike, zero);
                    let nearer = value.simd_gt(middle).select(weight, zero);
                    all += weight;
                    all_sum += weight * value;
                    near += nearer;
                    near_sum += nearer * value;
                }
            }
            let is_near = here.simd_gt(middle);
            let (far, far_sum) = (all - near, all_sum - near_sum);
            let own = is_near.select(near, far);
            let other = is_near.select(far, near);
            let sum = is_near.select(far_sum, near_sum);
            // At least the weight of half a pixel, as evidence.
            let moves = step & other.simd_gt(own) & other.simd_gt(S::f32s::splat(simd, 0.5));
            result = moves.select(sum / other, here);
        }
        result.store_slice(&mut out[x..x + lanes]);
    }
}

/// Computes the mean of the pixels of the window within [`MAX_STEP`], weighted by the similarity of their gray levels.
#[simd]
fn average<S: Simd>(simd: S, rows: Rows<'_>, out: &mut [f32]) {
    let lanes = S::f32s::LEN;
    let load = |plane: &[f32], at: usize| S::f32s::from_slice(simd, &plane[at..at + lanes]);
    let zero = S::f32s::splat(simd, 0.0);
    for x in (0..out.len()).step_by(lanes) {
        let center = rows.at(x, RADIUS, RADIUS);
        let (here, gray) = (load(rows.disparity, center), load(rows.gray, center));
        let (mut all, mut sum) = (S::f32s::splat(simd, 1e-6), zero);
        for dy in (0..=2 * RADIUS).step_by(SPACING) {
            for dx in (0..=2 * RADIUS).step_by(SPACING) {
                let at = rows.at(x, dx, dy);
                let off = load(rows.disparity, at) - here;
                let alike = (S::f32s::splat(simd, 1.0) - (load(rows.gray, at) - gray).abs()).max(zero);
                let weight = off.abs().simd_le(S::f32s::splat(simd, MAX_STEP)).select(alike, zero);
                all += weight;
                sum += weight * off;
            }
        }
        (here + sum / all).store_slice(&mut out[x..x + lanes]);
    }
}

/// Runs three rounds of exact one-dimensional smoothing along rows and columns, of the weighted disparities and of the weights.
fn least_squares(
    planes: &mut Planes,
    width: usize,
    height: usize,
    lambda: f32,
    sigma: f32,
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    const ROUNDS: i32 = 3;
    let stride = width + LEFT + RIGHT;
    let Planes { disparity, moved, gray, weight, .. } = planes;
    for (d, &w) in disparity.iter_mut().zip(weight.iter()) {
        *d *= w;
    }
    let similarity = |a: f32, b: f32| (-(a - b).abs() / sigma).exp();
    for round in 1..=ROUNDS {
        // Decreases by four each round (equation 13 of the paper).
        let strength = 1.5 * 4f32.powi(ROUNDS - round) / (4f32.powi(ROUNDS) - 1.0) * lambda;
        let rows = disparity.par_chunks_mut(stride).zip(weight.par_chunks_mut(stride)).zip(gray.par_chunks(stride));
        rows.skip(RADIUS).take(height).try_for_each_init(
            || vec![0.0; width],
            |factors, ((d, w), g)| {
                stage.check()?;
                let (d, w, g) = (&mut d[LEFT..LEFT + width], &mut w[LEFT..LEFT + width], &g[LEFT..LEFT + width]);
                // Thomas algorithm for the system 1 + A, with both right-hand sides at once.
                let mut before = 0.0;
                for x in 0..width {
                    let after = if x + 1 < width { -strength * similarity(g[x], g[x + 1]) } else { 0.0 };
                    let diagonal = 1.0 - before - after;
                    let scale = if x > 0 { 1.0 / (diagonal - before * factors[x - 1]) } else { 1.0 / diagonal };
                    factors[x] = after * scale;
                    let (d_before, w_before) = if x > 0 { (d[x - 1], w[x - 1]) } else { (0.0, 0.0) };
                    d[x] = (d[x] - before * d_before) * scale;
                    w[x] = (w[x] - before * w_before) * scale;
                    before = after;
                }
                for x in (0..width.saturating_sub(1)).rev() {
                    d[x] -= factors[x] * d[x + 1];
                    w[x] -= factors[x] * w[x + 1];
                }
                Ok(())
            },
        )?;
        // Along the columns, row by row.
        let row = |y: usize| (RADIUS + y) * stride + LEFT;
        let factors = &mut moved[..];
        for y in 0..height {
            stage.check()?;
            for x in 0..width {
                let at = row(y) + x;
                let g = gray[at];
                let before = if y > 0 { -strength * similarity(gray[at - stride], g) } else { 0.0 };
                let after = if y + 1 < height { -strength * similarity(g, gray[at + stride]) } else { 0.0 };
                let up = if y > 0 {
                    (factors[at - stride], disparity[at - stride], weight[at - stride])
                } else {
                    (0.0, 0.0, 0.0)
                };
                let scale = 1.0 / (1.0 - before - after - before * up.0);
                factors[at] = after * scale;
                disparity[at] = (disparity[at] - before * up.1) * scale;
                weight[at] = (weight[at] - before * up.2) * scale;
            }
        }
        for y in (0..height.saturating_sub(1)).rev() {
            stage.check()?;
            for at in row(y)..row(y) + width {
                disparity[at] -= factors[at] * disparity[at + stride];
                weight[at] -= factors[at] * weight[at + stride];
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Silent;
    use cv_synth::instruction_sets;
    use proptest::prelude::*;

    /// The two passes of the bilateral smoother, pixel by pixel.
    fn plain(d: &[f32], states: &[PixelState], gray: &[u8], width: usize, sigma: f32) -> (Vec<f32>, Vec<PixelState>) {
        let height = d.len() / width;
        let at = |x: i64, y: i64| {
            (x >= 0 && y >= 0 && x < width as i64 && y < height as i64).then(|| y as usize * width + x as usize)
        };
        let weight = |i: usize, j: usize| {
            let known = if d[j].is_nan() { 0.0 } else { 1.0 };
            let [a, b] = [gray[i], gray[j]].map(|gray| f32::from(gray) * (1.0 / sigma));
            (1.0 - (b - a).abs()).max(0.0) * known
        };
        let around = |i: usize| {
            let (x, y) = ((i % width) as i64, (i / width) as i64);
            let offsets = (-4..=4).step_by(2).flat_map(|dy| (-4..=4).step_by(2).map(move |dx| (dx, dy)));
            offsets.filter_map(|(dx, dy)| at(x + dx, y + dy)).collect::<Vec<_>>()
        };
        let moved: Vec<f32> = (0..d.len())
            .map(|i| {
                if d[i].is_nan() {
                    return 0.0;
                }
                let (x, y) = ((i % width) as i64, (i / width) as i64);
                let cross = [(-2, 0), (-1, 0), (1, 0), (2, 0), (0, -2), (0, -1), (0, 1), (0, 2), (0, 0)];
                let near: Vec<f32> = cross
                    .into_iter()
                    .filter_map(|(dx, dy)| at(x + dx, y + dy).map(|j| d[j]).filter(|v| !v.is_nan()))
                    .collect();
                let low = near.iter().copied().fold(f32::INFINITY, f32::min);
                let high = near.iter().copied().fold(f32::NEG_INFINITY, f32::max);
                if high - low <= MAX_STEP {
                    return d[i];
                }
                let middle = (low + high) * 0.5;
                let [mut near, mut near_sum, mut all, mut all_sum] = [0.0f32; 4];
                for j in around(i) {
                    let value = if d[j].is_nan() { 0.0 } else { d[j] };
                    let w = weight(i, j);
                    let nearer = if value > middle { w } else { 0.0 };
                    all += w;
                    all_sum += w * value;
                    near += nearer;
                    near_sum += nearer * value;
                }
                let (far, far_sum) = (all - near, all_sum - near_sum);
                let (own, other, sum) = if d[i] > middle { (near, far, far_sum) } else { (far, near, near_sum) };
                if other > own && other > 0.5 { sum / other } else { d[i] }
            })
            .collect();
        let after = |i: usize| match states[i] {
            PixelState::Matched if !d[i].is_nan() && moved[i] != d[i] => PixelState::Mismatched,
            state => state,
        };
        let smoothed = (0..d.len())
            .map(|i| {
                let (mut all, mut sum) = (1e-6f32, 0.0f32);
                for j in around(i) {
                    let off = moved[j] - moved[i];
                    let w = if off.abs() <= MAX_STEP { weight(i, j) } else { 0.0 };
                    all += w;
                    sum += w * off;
                }
                if d[i].is_nan() { f32::NAN } else { moved[i] + sum / all }
            })
            .collect();
        (smoothed, (0..d.len()).map(after).collect())
    }

    fn state(n: u8) -> PixelState {
        [PixelState::Matched, PixelState::Matched, PixelState::Occluded, PixelState::Mismatched][usize::from(n % 4)]
    }

    proptest! {
        #[test]
        fn every_instruction_set_gives_the_bits_of_the_definition(
            width in 1usize..45,
            pixels in proptest::collection::vec(
                (prop_oneof![6 => 0f32..3.0, 3 => 6f32..7.0, 1 => Just(f32::NAN)], 0u8..40, any::<u8>()), 45..400),
            sigma in 1f32..60.0,
        ) {
            let pixels = &pixels[..pixels.len() / width * width];
            let d: Vec<f32> = pixels.iter().map(|p| p.0).collect();
            let gray: Vec<u8> = pixels.iter().map(|p| p.1).collect();
            let states: Vec<PixelState> = pixels.iter().map(|p| state(p.2)).collect();
            let (expected, after) = plain(&d, &states, &gray, width, sigma);
            let expected: Vec<u32> = expected.iter().map(|v| v.to_bits()).collect();
            for level in instruction_sets() {
                let mut planes = SmoothingBuffers::default();
                // Twice, so that what a frame leaves behind would show.
                for _ in 0..2 {
                    let mut out = d.clone();
                    let mut found = states.clone();
                    smooth(level, Smoothing::Bilateral { sigma }, &d, &mut out, &mut found, &gray, width, &mut planes, &Stage::new(&Silent, "", 0).unwrap()).unwrap();
                    prop_assert_eq!(&found, &after, "{:?}", level);
                    let bits: Vec<u32> = out.iter().map(|v| v.to_bits()).collect();
                    prop_assert_eq!(&bits, &expected, "{:?}", level);
                }
            }
        }
    }

    #[test]
    fn a_depth_discontinuity_moves_to_the_image_edge() {
        // A near object from column 20 on, matched two pixels too wide.
        let (width, height) = (40, 30);
        let gray: Vec<u8> = (0..width * height).map(|i| if i % width < 20 { 60 } else { 180 }).collect();
        let mut d: Vec<f32> = (0..width * height).map(|i| if i % width < 18 { 5.0 } else { 12.0 }).collect();
        let mut states = vec![PixelState::Matched; d.len()];
        let options = Smoothing::Bilateral { sigma: 24.0 };
        smooth(
            Level::new(),
            options,
            &d.clone(),
            &mut d,
            &mut states,
            &gray,
            width,
            &mut SmoothingBuffers::default(),
            &Stage::new(&Silent, "", 0).unwrap(),
        )
        .unwrap();
        for (i, d) in d.iter().enumerate() {
            let truth = if i % width < 20 { 5.0 } else { 12.0 };
            // Sums of 25 terms in f32.
            assert!((d - truth).abs() < 1e-4, "column {}: {d}", i % width);
            let moved = (18..20).contains(&(i % width));
            assert_eq!(states[i] == PixelState::Mismatched, moved, "column {}", i % width);
        }
    }

    #[test]
    fn least_squares_smooths_a_surface_and_keeps_a_step_at_an_image_edge() {
        let (width, height) = (48, 32);
        let gray: Vec<u8> = (0..width * height).map(|i| if i % width < 24 { 60 } else { 180 }).collect();
        let truth = |i: usize| if i % width < 24 { 5.0 } else { 12.0 };
        let noisy = |i: usize| truth(i) + if (i * 7919 / 13).is_multiple_of(2) { 0.5 } else { -0.5 };
        let mut d: Vec<f32> = (0..width * height).map(noisy).collect();
        d[5 * width + 5] = f32::NAN;
        let mut states = vec![PixelState::Matched; d.len()];
        let options = Smoothing::LeastSquares { lambda: 100.0, sigma: 4.0 };
        smooth(
            Level::new(),
            options,
            &d.clone(),
            &mut d,
            &mut states,
            &gray,
            width,
            &mut SmoothingBuffers::default(),
            &Stage::new(&Silent, "", 0).unwrap(),
        )
        .unwrap();
        assert!(d[5 * width + 5].is_nan());
        for (i, d) in d.iter().enumerate().filter(|(_, d)| !d.is_nan()) {
            // Noise of 0.5 px averaged over some 60 pixels (twice the square root of lambda along both axes), and
            // exp(−30) of the other side's 7 px.
            assert!((d - truth(i)).abs() < 0.25, "pixel {i}: {d}");
        }
    }
}
