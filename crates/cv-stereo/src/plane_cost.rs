//! The data term of slanted planes: the dissimilarity of both images at sub-pixel correspondences, aggregated by a guided filter.
//!
//! A pixel and its correspondence are compared by the census transform and by their gradients, which are robust to differences in
//! exposure. The costs of a plane are filtered with the left image as the guide (He, Sun & Tang, PAMI 2013), as in Taniai et al.,
//! "Continuous 3D label stereo matching using local expansion moves", PAMI 2018.

use crate::PixelState;
use crate::census::{Gray, MARGIN};
use cv_core::{Cancelled, Stage};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch, prelude::*};
use fearless_simd_macros::simd;

/// Sub-pixel positions per pixel at which the right image is described.
const PHASES: usize = 4;
/// Cost of a differing census bit, and the Hamming distance at which it is truncated.
const BIT_COST: f32 = 1.0 / 24.0;
const MAX_BITS: f32 = 12.0;
/// Quantization of gradients in steps per gray level (of 255) per px; the difference in gray levels per px at which the gradient cost is
/// truncated, and its maximum, of each direction.
const GRADIENT_STEPS: f32 = 4.0;
const MAX_GRADIENT: f32 = 8.0;
const GRADIENT_COST: f32 = 0.15;
/// Costs of out-of-view and of occluded pixels; a match costs 0.1 to 0.4.
const OUT_OF_VIEW_COST: f32 = 0.45;
const OCCLUDED_COST: f32 = 0.55;
/// Cost of a pixel that would occlude a matched surface of the right image, and the difference in px from which a surface is in front.
const OCCLUDING_COST: f32 = 0.8;
const OCCLUSION_STEP: f32 = 2.0;
/// Radius of the guided filter in px, and its regularization in squared gray levels of 255.
const RADIUS: usize = 3;
const REGULARIZATION: f32 = 15.0;
/// Quantization of the known disparities of the right image in steps per px, and their offset in px; 0 is for none.
const KNOWN_STEPS: f32 = 8.0;
const KNOWN_OFFSET: f32 = 32.0;

/// A plane of disparities, `a x + b y + c`.
pub(crate) type Plane = [f32; 3];

/// Returns the disparity of a plane at a pixel.
#[inline(always)]
pub(crate) fn at([a, b, c]: Plane, x: usize, y: usize) -> f32 {
    a * x as f32 + b * y as f32 + c
}

/// A rectangle of pixels, right and bottom exclusive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Rectangle {
    pub(crate) left: usize,
    pub(crate) top: usize,
    pub(crate) right: usize,
    pub(crate) bottom: usize,
}

impl Rectangle {
    pub(crate) fn width(&self) -> usize {
        self.right - self.left
    }

    pub(crate) fn height(&self) -> usize {
        self.bottom - self.top
    }

    /// Returns the rectangle dilated by `by` pixels and cut at the image border.
    pub(crate) fn grown(&self, by: usize, (width, height): (usize, usize)) -> Self {
        Self {
            left: self.left.saturating_sub(by),
            top: self.top.saturating_sub(by),
            right: (self.right + by).min(width),
            bottom: (self.bottom + by).min(height),
        }
    }
}

/// The descriptors of an image pair.
#[derive(Debug)]
pub(crate) struct PlaneCost {
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Bits 0 to 23: census of 5×5 pixels; 24 to 31 and 32 to 39: horizontal and vertical gradient; 48 to 63, of the right image: its known
    /// disparity.
    left: Vec<u64>,
    /// [`PHASES`] per pixel.
    right: Vec<u64>,
    /// Gray levels 0 to 255 of the left image.
    gray: Vec<f32>,
    /// Their mean in the windows of the filter, and 1 / (variance + [`REGULARIZATION`]).
    mean: Vec<f32>,
    inverse_variance: Vec<f32>,
    bits: [f32; 32],
    gradients: [f32; 256],
    lowest: f32,
}

/// Buffers of [`PlaneCost::compute`], reused between planes.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    cost: Vec<f32>,
    product: Vec<f32>,
    sums: Vec<f32>,
    rows: [Vec<f32>; 2],
    /// The costs of the last rectangle, in raster order.
    pub(crate) result: Vec<f32>,
}

impl PlaneCost {
    /// Returns the bytes for images of this size.
    pub(crate) fn bytes(width: usize, height: usize) -> usize {
        width.saturating_mul(height).saturating_mul((1 + PHASES) * size_of::<u64>() + 3 * size_of::<f32>())
    }

    /// Describes a pair. `lowest` is the smallest disparity of the search range.
    pub(crate) fn new(
        level: Level,
        [left, right]: [&Gray; 2],
        lowest: f32,
        stage: &Stage<'_>,
    ) -> Result<Self, Cancelled> {
        let (width, height) = (left.width, left.height);
        // Gray levels of a sensor of few bits are stretched, both images by the same factor.
        let (low, high) = left.min_max();
        let span = high.saturating_sub(low);
        let scale = if (1..=u16::MAX / 4).contains(&span) { 255.0 / f32::from(span) } else { 1.0 / 257.0 };
        let float = |gray: &Gray, phase: usize| -> Vec<f32> {
            let mut values = vec![0.0; gray.stride() * height];
            let rows = gray.values.par_chunks(gray.stride());
            values.par_chunks_mut(gray.stride()).zip(rows).for_each(|(to, row)| shift_row(row, phase, scale, to));
            values
        };
        let mut described = vec![0; width * height];
        let values = float(left, 0);
        describe(level, &values, (width, height), 1, 0, &mut described, stage)?;
        let gray: Vec<f32> =
            values.chunks_exact(left.stride()).flat_map(|row| row[MARGIN..MARGIN + width].iter().copied()).collect();
        let mut phases = vec![0; width * height * PHASES];
        for phase in 0..PHASES {
            describe(level, &float(right, phase), (width, height), PHASES, phase, &mut phases, stage)?;
        }
        let (mut mean, mut square) = (gray.clone(), gray.iter().map(|v| v * v).collect::<Vec<_>>());
        let (mut sums, mut rows) = (vec![0.0; 2 * width], [vec![0.0; width], vec![0.0; width]]);
        box_means(&mut mean, &mut square, (width, height), &mut sums, &mut rows);
        for (square, mean) in square.iter_mut().zip(&mean) {
            *square = 1.0 / ((*square - mean * mean).max(0.0) + REGULARIZATION);
        }
        stage.check()?;
        Ok(Self {
            width,
            height,
            left: described,
            right: phases,
            gray,
            mean,
            inverse_variance: square,
            bits: std::array::from_fn(|n| BIT_COST * (n as f32).min(MAX_BITS)),
            gradients: std::array::from_fn(|n| GRADIENT_COST * (n as f32 / (GRADIENT_STEPS * MAX_GRADIENT)).min(1.0)),
            lowest,
        })
    }

    pub(crate) fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// Returns the gray level 0 to 255 of a pixel of the left image.
    pub(crate) fn gray(&self, pixel: usize) -> f32 {
        self.gray[pixel]
    }

    /// Sets the known disparities of the right image: those of the matched pixels, the nearest at each pixel.
    pub(crate) fn set_known(&mut self, disparity: &[f32], states: &[PixelState]) {
        let (width, lowest) = (self.width, self.lowest);
        let rows = disparity.par_chunks(width).zip(states.par_chunks(width));
        self.right.par_chunks_mut(width * PHASES).zip(rows).for_each_init(
            || vec![0u64; width + 1],
            |seen, (right, (disparity, states))| {
                seen.fill(0);
                for (x, (&d, &state)) in disparity.iter().zip(states).enumerate() {
                    let column = x as f32 - d + 0.5;
                    if state == PixelState::Matched && column >= 0.0 && column < width as f32 {
                        let place = &mut seen[column as usize];
                        *place = (*place).max(((d - lowest + KNOWN_OFFSET) * KNOWN_STEPS).clamp(1.0, 65535.0) as u64);
                    }
                }
                for (x, phases) in right.chunks_exact_mut(PHASES).enumerate() {
                    for (phase, described) in phases.iter_mut().enumerate() {
                        let nearest = if phase > PHASES / 2 { (x + 1).min(width - 1) } else { x };
                        *described = (*described & ((1 << 48) - 1)) | (seen[nearest] << 48);
                    }
                }
            },
        );
    }

    /// Computes the costs of a plane over a rectangle, into `scratch.result`.
    pub(crate) fn compute(&self, level: Level, plane: Plane, place: Rectangle, scratch: &mut Scratch) {
        let around = place.grown(2 * RADIUS, self.size());
        let (width, height) = (around.width(), around.height());
        let Scratch { cost, product, sums, rows, result } = scratch;
        for buffer in [&mut *cost, &mut *product] {
            buffer.clear();
            buffer.resize(width * height, 0.0);
        }
        sums.resize(2 * width, 0.0);
        rows.iter_mut().for_each(|row| row.resize(width, 0.0));
        dispatch!(level, simd => raw_costs(simd, self, plane, around, cost, product));
        dispatch!(level, simd => simd_means(simd, cost, product, (width, height), sums, rows));
        for (y, (cost, product)) in cost.chunks_exact_mut(width).zip(product.chunks_exact_mut(width)).enumerate() {
            let first = (around.top + y) * self.width + around.left;
            let guide = self.mean[first..].iter().zip(&self.inverse_variance[first..]);
            for ((c, p), (mean, inverse)) in cost.iter_mut().zip(product).zip(guide) {
                let slope = (*p - mean * *c) * inverse;
                (*p, *c) = (slope, *c - slope * mean);
            }
        }
        dispatch!(level, simd => simd_means(simd, cost, product, (width, height), sums, rows));
        result.clear();
        for y in place.top..place.bottom {
            let first = (y - around.top) * width + place.left - around.left;
            let gray = &self.gray[y * self.width + place.left..][..place.width()];
            let line = cost[first..].iter().zip(&product[first..]).zip(gray);
            result.extend(line.map(|((offset, slope), gray)| slope * gray + offset));
        }
    }
}

/// Interpolates a row at a sub-pixel phase by Catmull-Rom splines, and scales it.
fn shift_row(row: &[u16], phase: usize, scale: f32, to: &mut [f32]) {
    let t = phase as f32 / PHASES as f32;
    let value = |x: usize| f32::from(row[x.min(row.len() - 1)]) * scale;
    for (x, to) in to.iter_mut().enumerate() {
        let [a, b, c, d] = [value(x.saturating_sub(1)), value(x), value(x + 1), value(x + 2)];
        *to = b + 0.5 * t * (c - a + t * (2.0 * a - 5.0 * b + 4.0 * c - d + t * (3.0 * (b - c) + d - a)));
    }
}

/// Describes every pixel of `values` (rows with margins) into every `step`-th element of `out`, from `first` on.
fn describe(
    level: Level,
    values: &[f32],
    (width, height): (usize, usize),
    step: usize,
    first: usize,
    out: &mut [u64],
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    let stride = width + 2 * MARGIN;
    let row = |y: isize| &values[y.clamp(0, height as isize - 1) as usize * stride..][..stride];
    out.par_chunks_mut(width * step).enumerate().try_for_each(|(y, out)| {
        stage.check()?;
        let rows: [&[f32]; 5] = std::array::from_fn(|dy| row(y as isize + dy as isize - 2));
        dispatch!(level, simd => describe_row(simd, rows, step, first, out));
        Ok(())
    })
}

#[simd]
fn describe_row<S: Simd>(_: S, rows: [&[f32]; 5], step: usize, first: usize, out: &mut [u64]) {
    let gradient = |v: f32| (128.5 + GRADIENT_STEPS * v).clamp(0.0, 255.0) as u64;
    for (x, out) in out[first..].iter_mut().step_by(step).enumerate() {
        let center = rows[2][x + MARGIN];
        let mut bits = 0;
        for row in rows {
            for &neighbor in &row[x + MARGIN - 2..x + MARGIN + 3] {
                bits = bits << 1 | u64::from(neighbor < center);
            }
        }
        // Without the bit of the center, bit 12.
        let bits = bits & 0xFFF | bits >> 1 & 0xFF_F000;
        let across = 0.5 * (rows[2][x + MARGIN + 1] - rows[2][x + MARGIN - 1]);
        let down = 0.5 * (rows[3][x + MARGIN] - rows[1][x + MARGIN]);
        *out = bits | gradient(across) << 24 | gradient(down) << 32;
    }
}

/// Computes the unfiltered costs of a plane, and their products with the gray levels.
#[simd]
fn raw_costs<S: Simd>(_: S, pair: &PlaneCost, plane: Plane, place: Rectangle, cost: &mut [f32], product: &mut [f32]) {
    let width = place.width();
    let last = ((pair.width - 1) * PHASES) as i32;
    for (y, (cost, product)) in cost.chunks_exact_mut(width).zip(product.chunks_exact_mut(width)).enumerate() {
        let y = place.top + y;
        let row = &pair.right[y * pair.width * PHASES..][..pair.width * PHASES];
        let first = y * pair.width + place.left;
        let own = pair.left[first..].iter().zip(&pair.gray[first..]);
        for (x, ((cost, product), (left, gray))) in cost.iter_mut().zip(product).zip(own).enumerate() {
            let x = place.left + x;
            let d = at(plane, x, y);
            let position = (x as f32 - d) * PHASES as f32 + 0.5;
            // Positions outside the row, and NaN, are out of view.
            let inside = position >= 0.0 && position < last as f32;
            let right = row[if inside { position as usize } else { 0 }];
            let different = left ^ right;
            let gradient =
                |shift: u32| pair.gradients[usize::from(((left >> shift) as u8).abs_diff((right >> shift) as u8))];
            let dissimilarity =
                pair.bits[((different & 0xFF_FFFF).count_ones() & 31) as usize] + gradient(24) + gradient(32);
            let seen = (right >> 48) as f32;
            let nearer = (d - pair.lowest + KNOWN_OFFSET) * KNOWN_STEPS - seen;
            let known = seen > 0.0;
            let c = if known && nearer > OCCLUSION_STEP * KNOWN_STEPS {
                OCCLUDING_COST
            } else if known && nearer < -OCCLUSION_STEP * KNOWN_STEPS {
                OCCLUDED_COST
            } else {
                dissimilarity
            };
            let c = if inside { c } else { OUT_OF_VIEW_COST };
            (*cost, *product) = (c, c * gray);
        }
    }
}

#[simd]
fn simd_means<S: Simd>(
    _: S,
    a: &mut [f32],
    b: &mut [f32],
    size: (usize, usize),
    sums: &mut [f32],
    rows: &mut [Vec<f32>; 2],
) {
    box_means(a, b, size, sums, rows);
}

/// Computes means of two images over windows of `2 RADIUS + 1` pixels, cut at the borders, in place. `sums` has two rows, `rows` one each.
#[inline(always)]
fn box_means(
    a: &mut [f32],
    b: &mut [f32],
    (width, height): (usize, usize),
    sums: &mut [f32],
    rows: &mut [Vec<f32>; 2],
) {
    // Along the rows, both images at once, since each sum depends on the previous one.
    for (a, b) in a.chunks_exact_mut(width).zip(b.chunks_exact_mut(width)) {
        let [copy_a, copy_b] = rows;
        let (copy_a, copy_b) = (&mut copy_a[..width], &mut copy_b[..width]);
        copy_a.copy_from_slice(a);
        copy_b.copy_from_slice(b);
        let (mut sum_a, mut sum_b) = (0.0, 0.0);
        for x in 0..RADIUS.min(width) {
            sum_a += copy_a[x];
            sum_b += copy_b[x];
        }
        for x in 0..width {
            if x + RADIUS < width {
                sum_a += copy_a[x + RADIUS];
                sum_b += copy_b[x + RADIUS];
            }
            if x > RADIUS {
                sum_a -= copy_a[x - RADIUS - 1];
                sum_b -= copy_b[x - RADIUS - 1];
            }
            let n = ((x + RADIUS).min(width - 1) + 1 - x.saturating_sub(RADIUS)) as f32;
            (a[x], b[x]) = (sum_a / n, sum_b / n);
        }
    }
    let (sum_a, sum_b) = sums.split_at_mut(width);
    for (values, sum) in [(a, sum_a), (b, sum_b)] {
        columns(values, (width, height), &mut sum[..width], &mut rows[0]);
    }
}

/// Computes means along the columns. Rows that leave a window have been overwritten: a ring buffer has their old values.
#[inline(always)]
fn columns(values: &mut [f32], (width, height): (usize, usize), sum: &mut [f32], ring: &mut Vec<f32>) {
    ring.clear();
    ring.resize((RADIUS + 1) * width, 0.0);
    sum.fill(0.0);
    for row in values.chunks_exact(width).take(RADIUS) {
        sum.iter_mut().zip(row).for_each(|(sum, v)| *sum += v);
    }
    for y in 0..height {
        if y + RADIUS < height {
            let row = &values[(y + RADIUS) * width..][..width];
            sum.iter_mut().zip(row).for_each(|(sum, v)| *sum += v);
        }
        let slot = &mut ring[y % (RADIUS + 1) * width..][..width];
        if y > RADIUS {
            sum.iter_mut().zip(&*slot).for_each(|(sum, v)| *sum -= v);
        }
        let row = &mut values[y * width..][..width];
        slot.copy_from_slice(row);
        let share = 1.0 / ((y + RADIUS).min(height - 1) + 1 - y.saturating_sub(RADIUS)) as f32;
        row.iter_mut().zip(&*sum).for_each(|(v, sum)| *v = sum * share);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Silent;
    use cv_synth::instruction_sets;

    fn stage() -> Stage<'static> {
        Stage::new(&Silent, "expand", 1).unwrap()
    }

    /// A textured wall with disparity `0.1 x + 3`.
    fn pair() -> ([Gray; 2], (usize, usize)) {
        let (width, height) = (60, 40);
        // Smooth, so that it can be evaluated between pixels.
        let texture = |x: f64, y: f64| 30_000.0 + 9_000.0 * (0.9 * x).sin() + 9_000.0 * (0.7 * y + 0.31 * x).cos();
        let picture = |f: &dyn Fn(f64, f64) -> f64| {
            let stride = width + 2 * MARGIN;
            let values =
                (0..stride * height).map(|i| f((i % stride) as f64 - MARGIN as f64, (i / stride) as f64) as u16);
            Gray { values: values.collect(), width, height }
        };
        // x_right = x − d(x) = 0.9 x − 3.
        let right = picture(&|x, y| texture((x + 3.0) / 0.9, y));
        ([picture(&texture), right], (width, height))
    }

    #[test]
    fn the_true_plane_has_the_lowest_cost() {
        let ([left, right], (width, height)) = pair();
        let cost = PlaneCost::new(Level::new(), [&left, &right], 0.0, &stage()).unwrap();
        let place = Rectangle { left: 20, top: 5, right: width - 5, bottom: height - 5 };
        let mut scratch = Scratch::default();
        let mut mean = |plane: Plane| {
            cost.compute(Level::new(), plane, place, &mut scratch);
            scratch.result.iter().sum::<f32>() / scratch.result.len() as f32
        };
        let there = mean([0.1, 0.0, 3.0]);
        // Half a pixel off, another slope through the middle, and a plane across it.
        for other in [[0.1, 0.0, 3.5], [0.1, 0.0, 2.5], [0.06, 0.0, 4.6], [0.1, 0.05, 2.0]] {
            assert!(mean(other) > there + 0.03, "{other:?}: {} against {there}", mean(other));
        }
        // Out-of-view costs are constant.
        assert!((mean([0.0, 0.0, 100.0]) - OUT_OF_VIEW_COST).abs() < 1e-5);
    }

    #[test]
    fn known_disparities_occlude_farther_planes_and_penalize_nearer_ones() {
        let ([left, right], (width, height)) = pair();
        let mut cost = PlaneCost::new(Level::new(), [&left, &right], 0.0, &stage()).unwrap();
        cost.set_known(&vec![6.0; width * height], &vec![PixelState::Matched; width * height]);
        let place = Rectangle { left: 30, top: 10, right: 36, bottom: 16 };
        let mut scratch = Scratch::default();
        let mut mean = |d: f32| {
            cost.compute(Level::new(), [0.0, 0.0, d], place, &mut scratch);
            scratch.result.iter().sum::<f32>() / scratch.result.len() as f32
        };
        assert!((mean(1.0) - OCCLUDED_COST).abs() < 1e-5 && (mean(11.0) - OCCLUDING_COST).abs() < 1e-5);
        assert!(mean(6.0) < OCCLUDED_COST - 0.1);
    }

    #[test]
    fn means_are_those_of_the_windows_at_every_border() {
        for (width, height) in [(1, 1), (2, 9), (9, 2), (12, 11)] {
            let value = |x: usize, y: usize| ((x * 7 + y * 13) % 11) as f32;
            let all: Vec<f32> = (0..width * height).map(|i| value(i % width, i / width)).collect();
            let (mut a, mut b) = (all.clone(), all.iter().map(|v| -v).collect::<Vec<_>>());
            let (mut sums, mut rows) = (vec![0.0; 2 * width], [vec![0.0; width], vec![0.0; width]]);
            box_means(&mut a, &mut b, (width, height), &mut sums, &mut rows);
            for i in 0..width * height {
                let (x, y) = (i % width, i / width);
                let columns = x.saturating_sub(RADIUS)..(x + RADIUS + 1).min(width);
                let rows = y.saturating_sub(RADIUS)..(y + RADIUS + 1).min(height);
                let n = columns.len() * rows.len();
                let sum: f32 = rows.flat_map(|y| columns.clone().map(move |x| value(x, y))).sum();
                assert!((a[i] - sum / n as f32).abs() < 1e-4 && (a[i] + b[i]).abs() < 1e-4, "{x} {y}");
            }
        }
    }

    #[test]
    fn every_instruction_set_gives_the_same_costs() {
        let ([left, right], (width, height)) = pair();
        let place = Rectangle { left: 0, top: 0, right: width, bottom: height };
        let all = instruction_sets().into_iter().map(|level| {
            let mut scratch = Scratch::default();
            PlaneCost::new(level, [&left, &right], 0.0, &stage()).unwrap().compute(
                level,
                [0.09, 0.01, 3.0],
                place,
                &mut scratch,
            );
            scratch.result.iter().map(|v| v.to_bits()).collect::<Vec<_>>()
        });
        let all: Vec<_> = all.collect();
        assert!(all.windows(2).all(|two| two[0] == two[1]));
    }
}
