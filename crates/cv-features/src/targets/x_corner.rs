//! Detection of X-corners, where two black and two white squares meet.
//!
//! Source: S. Bennett & J. Lasenby, "ChESS: quick and robust detection of chess-board features", CVIU 118, 2014. With
//! sixteen samples on a ring: the sums of opposite samples differ from those a quarter turn apart at an X-corner (sum
//! response), opposite samples differ at an edge (difference response), and the means of ring and center differ on a
//! line (mean response). Applied to several octaves of a pyramid. Candidates are verified: the ring must have exactly
//! four transitions between black and white, in two opposite pairs, which define the two edges.

use crate::line_buffer::LineBuffer;
use crate::simd;
use cv_core::{Cancelled, GrayF32, ImageView, Point2, Progress, Stage};
use cv_imgproc::{mirror_ends, mirror_index, pyr_down};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch, prelude::*};

/// The sampling ring: 16 samples, clockwise in the image from the top. The paper's radius is 5; with a pyramid a
/// smaller one suffices, which fits in small squares.
const RING: [(isize, isize); 16] = [
    (0, -3),
    (1, -3),
    (2, -2),
    (3, -1),
    (3, 0),
    (3, 1),
    (2, 2),
    (1, 3),
    (0, 3),
    (-1, 3),
    (-2, 2),
    (-3, 1),
    (-3, 0),
    (-3, -1),
    (-2, -2),
    (-1, -3),
];
/// Radius of the ring in pixels.
const R: usize = 3;
/// The center samples.
const CENTER: [(isize, isize); 5] = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)];

/// Minimum response relative to that of an ideal corner of the same contrast. A corner tilted by 60° has half; noise
/// and blur reduce it further.
const MIN_RELATIVE_RESPONSE: f32 = 0.2;

/// Maximum number of candidates of an octave, the strongest: it bounds the time for highly textured images.
const MAX_CANDIDATES: usize = 4000;

/// An X-corner candidate.
#[derive(Debug, Clone, Copy)]
pub(crate) struct XCorner {
    /// Position in pixels of the image, accurate to about half a pixel of its octave.
    pub(crate) position: Point2<f64>,
    /// Directions of the two edges in radians, clockwise in the image from +x: the first in [0, π), the second up to π
    /// larger. The sector between the first and the second is white.
    pub(crate) axes: [f64; 2],
    /// Difference between white and black, in the unit of the image.
    pub(crate) contrast: f32,
    /// Radius of the ring in pixels of the image.
    pub(crate) radius: f64,
}

/// Detects the X-corners of all octaves, without duplicates; also returns the smoothed image.
pub(crate) fn detect_x_corners(
    view: ImageView<'_, f32, 1>,
    min_contrast: f32,
    progress: &dyn Progress,
) -> Result<(Vec<XCorner>, GrayF32), Cancelled> {
    let level = simd::level();
    let smooth = smoothed(view, level);
    let mut corners = detect_in_octave(&smooth, 1.0, min_contrast, progress)?;
    let mut image = pyr_down(view);
    for scale in [2.0, 4.0, 8.0, 16.0] {
        // Smaller images cannot contain a board at this scale.
        if image.width().min(image.height()) < 30 {
            break;
        }
        corners.extend(detect_in_octave(&image, scale, min_contrast, progress)?);
        image = pyr_down(image.view());
    }
    Ok((remove_duplicates(corners), smooth))
}

/// Smooths with the binomial kernel `[1 2 1]/4` along both axes.
pub(super) fn smoothed(view: ImageView<'_, f32, 1>, level: Level) -> GrayF32 {
    let (w, h) = view.size();
    let mut out = GrayF32::new(w, h, [0.0]);
    let kernel = [0.5, 0.25];
    out.as_mut_slice().par_chunks_mut(w).enumerate().with_min_len(32).for_each_init(
        || vec![0.0f32; w + 2],
        |padded, (y, row)| {
            let rows = [-1, 0, 1].map(|d| view.row(mirror_index(y as isize + d, h)));
            simd::vertical(level, &mut padded[1..=w], &rows, &kernel);
            mirror_ends::<1>(padded, 1, 1);
            simd::horizontal(level, row, padded, &kernel);
        },
    );
    out
}

/// Peaks between checks for cancellation: some milliseconds.
const PEAKS_PER_CHECK: usize = 512;

/// Detects the candidates of an octave.
fn detect_in_octave(
    image: &GrayF32,
    scale: f64,
    min_contrast: f32,
    progress: &dyn Progress,
) -> Result<Vec<XCorner>, Cancelled> {
    let (w, h) = image.size();
    if w <= 2 * R + 4 || h <= 2 * R + 4 {
        return Ok(Vec::new());
    }
    let level = simd::level();
    // The response of an ideal corner is eight times the contrast; that of a strongly tilted or blurred one about a
    // third of it.
    let floor = 8.0 * 0.3 * min_contrast.max(1e-4);
    let (first, last) = (R, h - R);
    let rows = (last - first).div_ceil(4 * rayon::current_num_threads()).max(48);
    let stage = Stage::new(progress, "corners", (last - first).div_ceil(rows))?;
    let mut candidates: Vec<(f32, XCorner)> = (0..(last - first).div_ceil(rows))
        .into_par_iter()
        .map(|i| {
            stage.add(1)?;
            let (from, to) = (first + i * rows, (first + (i + 1) * rows).min(last));
            let verify = |&(x, y, dx, dy, response): &(usize, usize, f32, f32, f32)| {
                let corner = verify_ring(image, (x, y), (dx, dy), scale)?;
                let is_corner =
                    corner.contrast >= min_contrast && response >= 8.0 * MIN_RELATIVE_RESPONSE * corner.contrast;
                is_corner.then_some((response, corner))
            };
            let mut candidates = Vec::new();
            // In noise, a strip has tens of thousands of peaks.
            for peaks in response_peaks(image, from..to, floor, level).chunks(PEAKS_PER_CHECK) {
                stage.check()?;
                candidates.extend(peaks.iter().filter_map(verify));
            }
            Ok(candidates)
        })
        .try_collect::<_, Cancelled>()?
        .concat();
    if candidates.len() > MAX_CANDIDATES {
        candidates.sort_by(|a, b| b.0.total_cmp(&a.0));
        candidates.truncate(MAX_CANDIDATES);
    }
    Ok(candidates.into_iter().map(|f| f.1).collect())
}

/// Detects the peaks of the response in a range of rows: column, row, sub-pixel offset, response.
fn response_peaks(
    image: &GrayF32,
    rows: std::ops::Range<usize>,
    floor: f32,
    level: Level,
) -> Vec<(usize, usize, f32, f32, f32)> {
    let (w, h) = image.size();
    let mut response_rows = LineBuffer::new(0..w - 2 * R, 3);
    let (mut columns, mut peaks) = (Vec::new(), Vec::new());
    let (first, last) = (rows.start.saturating_sub(1).max(R), (rows.end + 1).min(h - R));
    for y in first..last {
        let window: [&[f32]; 2 * R + 1] = std::array::from_fn(|i| image.row(y + i - R));
        ring_response(level, window, response_rows.row_mut(y));
        if y < first + 2 {
            continue;
        }
        let [above, here, below] = [y - 2, y - 1, y].map(|y| response_rows.row(y));
        columns.clear();
        simd::peaks(level, [above, here, below], floor, &mut columns);
        for &x in &columns {
            let v = here[x];
            if v > above[x - 1] && v > above[x] && v > above[x + 1] && v > here[x - 1] {
                let (dx, dy) = crate::harris::quadratic_peak([above, here, below].map(|r| [r[x - 1], r[x], r[x + 1]]));
                peaks.push((x + R, y - 1, dx, dy, v));
            }
        }
    }
    peaks
}

/// Computes the response of a row from seven image rows, of which it is the middle one; `out` starts at column 3.
fn ring_response(level: Level, rows: [&[f32]; 2 * R + 1], out: &mut [f32]) {
    dispatch!(level, simd => ring_response_impl(simd, rows, out));
}

#[inline(always)]
fn ring_response_impl<S: Simd>(simd: S, rows: [&[f32]; 2 * R + 1], out: &mut [f32]) {
    let n = S::f32s::LEN;
    let width = out.len();
    // The row of each sample, shifted so that index x is its value for out[x].
    let mut samples: [&[f32]; 21] = [&[]; 21];
    for (sample, &(dx, dy)) in samples.iter_mut().zip(RING.iter().chain(&CENTER)) {
        *sample = &rows[(R as isize + dy) as usize][(R as isize + dx) as usize..][..width];
    }
    if width < n {
        for x in 0..width {
            out[x] = response_at(std::array::from_fn(|i| samples[i][x]));
        }
        return;
    }
    let zero = S::f32s::splat(simd, 0.0);
    let mut x = 0;
    while x < width {
        // The last vector overlaps the previous one.
        x = x.min(width - n);
        let (mut sum, mut difference, mut mean) = (zero, zero, zero);
        for i in 0..4 {
            let a = S::f32s::from_slice(simd, &samples[i][x..x + n]);
            let b = S::f32s::from_slice(simd, &samples[i + 4][x..x + n]);
            let c = S::f32s::from_slice(simd, &samples[i + 8][x..x + n]);
            let d = S::f32s::from_slice(simd, &samples[i + 12][x..x + n]);
            let (one, other, across, down) = (a + c, b + d, a - c, b - d);
            let quarter_turn = one - other;
            sum += quarter_turn.max(zero - quarter_turn);
            mean += one + other;
            difference += across.max(zero - across) + down.max(zero - down);
        }
        let mut local = S::f32s::from_slice(simd, &samples[16][x..x + n]);
        for sample in &samples[17..] {
            local += S::f32s::from_slice(simd, &sample[x..x + n]);
        }
        let mean_difference = mean - local * 3.2;
        let response = sum - difference - mean_difference.max(zero - mean_difference);
        response.store_slice(&mut out[x..x + n]);
        x += n;
    }
}

/// Computes the response from the sixteen ring samples and the five center samples, in the order of the vectorized
/// loop.
fn response_at(v: [f32; 21]) -> f32 {
    let (mut sum, mut difference, mut mean) = (0.0f32, 0.0f32, 0.0f32);
    for i in 0..4 {
        let [a, b, c, d] = [v[i], v[i + 4], v[i + 8], v[i + 12]];
        let (one, other) = (a + c, b + d);
        sum += (one - other).abs();
        mean += one + other;
        difference += (a - c).abs() + (b - d).abs();
    }
    let local = (((v[16] + v[17]) + v[18]) + v[19]) + v[20];
    sum - difference - (mean - local * 3.2).abs()
}

/// Verifies a peak of the response: the corner, if the ring has two straight edges.
fn verify_ring(image: &GrayF32, (x, y): (usize, usize), (dx, dy): (f32, f32), scale: f64) -> Option<XCorner> {
    let values = RING.map(|(i, j)| image.at((x as isize + i) as usize, (y as isize + j) as usize)[0]);
    let angle = |k: usize| (RING[k].1 as f64 - f64::from(dy)).atan2(RING[k].0 as f64 - f64::from(dx));
    let (axes, contrast) = edge_directions(&values, angle)?;
    Some(XCorner {
        position: Point2::new(x as f64 + f64::from(dx), y as f64 + f64::from(dy)) * scale,
        axes,
        contrast,
        radius: R as f64 * scale,
    })
}

/// Estimates the directions of the two edges through the center of a ring of samples, and the difference between white
/// and black; `None` unless the samples cross the threshold exactly four times, in opposite pairs. `angle` of a sample
/// increases along the ring.
pub(crate) fn edge_directions(values: &[f32; 16], angle: impl Fn(usize) -> f64) -> Option<([f64; 2], f32)> {
    use std::f64::consts::{PI, TAU};
    let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
    for i in 0..16 {
        // Means of three samples, for robustness.
        let mean = (values[i] + values[(i + 1) & 15] + values[(i + 15) & 15]) * (1.0 / 3.0);
        (low, high) = (low.min(mean), high.max(mean));
    }
    let threshold = 0.5 * (low + high);
    let mut crossings = [(0usize, 0.0f32); 4];
    let mut count = 0;
    for i in 0..16 {
        let (a, b) = (values[i] - threshold, values[(i + 1) & 15] - threshold);
        if (a < 0.0) != (b < 0.0) {
            if count == 4 {
                return None;
            }
            crossings[count] = (i, a / (a - b));
            count += 1;
        }
    }
    if count != 4 {
        return None;
    }
    let is_rising = values[crossings[0].0] < threshold;
    let crossings = crossings.map(|(i, fraction)| {
        let (a, b) = (angle(i), angle((i + 1) & 15));
        a + (b - a).rem_euclid(TAU) * f64::from(fraction)
    });
    // Opposite crossings are half a turn apart, up to the error of the center. 40° is half a pixel on a ring of radius
    // 3, with a margin for blur.
    let is_opposite = |a: f64, b: f64| ((b - a).rem_euclid(TAU) - PI).abs() < 0.7;
    if !is_opposite(crossings[0], crossings[2]) || !is_opposite(crossings[1], crossings[3]) {
        return None;
    }
    let axis = |i: usize| {
        let (a, b) = (crossings[i], crossings[i + 2]);
        (a + 0.5 * ((b - a).rem_euclid(TAU) - PI)).rem_euclid(PI)
    };
    // The first edge is the transition from black to white with increasing angle.
    let (a, b) = if is_rising { (axis(0), axis(1)) } else { (axis(1), axis(0)) };
    let b = if b < a { b + PI } else { b };
    // Nearly coincident edges are a line.
    (0.2..PI - 0.2).contains(&(b - a)).then_some(([a, b], high - low))
}

/// Removes duplicates of several octaves: keeps the corner with the highest contrast, with a preference for finer
/// octaves, which are more accurate.
fn remove_duplicates(corners: Vec<XCorner>) -> Vec<XCorner> {
    // A preference of 15 % per octave.
    let priority = |c: &XCorner| c.contrast * (c.radius as f32).powf(-0.23);
    let mut corners: Vec<(f32, XCorner)> = corners.into_iter().map(|c| (priority(&c), c)).collect();
    corners.sort_by(|(p, a), (q, b)| {
        let by = q.total_cmp(p).then(a.position.y.total_cmp(&b.position.y));
        by.then(a.position.x.total_cmp(&b.position.x))
    });
    let mut unique: Vec<XCorner> = Vec::new();
    let mut cells: std::collections::HashMap<(i64, i64), Vec<usize>> = std::collections::HashMap::new();
    const CELL: f64 = 24.0;
    for (_, corner) in corners {
        let cell = |v: f64| (v / CELL).floor() as i64;
        let (x, y) = (cell(corner.position.x), cell(corner.position.y));
        // Squares are larger than the smaller ring, and the position of the larger one is less accurate.
        let is_duplicate = |other: &XCorner| {
            let (small, large) = (other.radius.min(corner.radius), other.radius.max(corner.radius));
            (other.position - corner.position).norm() < (0.6 * small).max(0.12 * large).max(2.0)
        };
        let has_duplicate = (y - 1..=y + 1).any(|j| {
            (x - 1..=x + 1).any(|i| cells.get(&(i, j)).is_some_and(|c| c.iter().any(|&k| is_duplicate(&unique[k]))))
        });
        if !has_duplicate {
            cells.entry((x, y)).or_default().push(unique.len());
            unique.push(corner);
        }
    }
    unique
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Silent;
    use cv_synth::instruction_sets;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn simd_responses_equal_the_scalar_ones(width in 1usize..70, seed in any::<u32>()) {
            let mut state = seed | 1;
            let rows: Vec<Vec<f32>> = (0..7)
                .map(|_| {
                    (0..width + 6)
                        .map(|_| {
                            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                            (state >> 8) as f32 / (1 << 24) as f32
                        })
                        .collect()
                })
                .collect();
            let around: [&[f32]; 7] = std::array::from_fn(|i| &rows[i][..]);
            let sample = |(dx, dy): (isize, isize), x: usize| rows[(3 + dy) as usize][(3 + x as isize + dx) as usize];
            let plain: Vec<f32> = (0..width)
                .map(|x| response_at(std::array::from_fn(|i| if i < 16 { sample(RING[i], x) } else { sample(CENTER[i - 16], x) })))
                .collect();
            for level in instruction_sets() {
                let mut out = vec![0.0; width];
                ring_response(level, around, &mut out);
                prop_assert_eq!(&out, &plain, "{:?}", level);
            }
        }
    }

    #[test]
    fn edge_directions_of_an_x_corner_and_rejection_of_a_line() {
        // White between 0.3 and 1.5 radians, clockwise in the image, and in the opposite sector.
        let at = |x: usize, y: usize| {
            let angle = (y as f64 - 20.0).atan2(x as f64 - 20.0).rem_euclid(std::f64::consts::PI);
            [if (0.3..1.5).contains(&angle) { 0.8 } else { 0.1 }]
        };
        let image = GrayF32::from_fn(41, 41, at);
        let (found, _) = detect_x_corners(image.view(), 0.03, &Silent).unwrap();
        let best = found.iter().min_by(|a, b| {
            let to = |c: &XCorner| (c.position - Point2::new(20.0, 20.0)).norm();
            to(a).total_cmp(&to(b))
        });
        let best = best.unwrap();
        // Sixteen samples on a ring of radius 3: an error of a fifth of the sampling step of 22°, and as much by
        // aliasing.
        assert!((best.axes[0] - 0.3).abs() < 0.15 && (best.axes[1] - 1.5).abs() < 0.15, "{best:?}");
        let line = GrayF32::from_fn(41, 41, |x, _| [(x == 20) as u8 as f32]);
        assert!(detect_x_corners(line.view(), 0.03, &Silent).unwrap().0.is_empty());
    }
}
