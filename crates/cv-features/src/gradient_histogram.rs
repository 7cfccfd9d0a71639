//! Histograms of gradient orientations around a keypoint: dominant orientations and SIFT descriptors.
//!
//! Source: D. Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 60(2), 2004, sections 5 and 6.

use crate::simd::round;
use cv_core::Image;
use fearless_simd::{Level, dispatch, f32x8, prelude::*};
use std::f32::consts::{FRAC_PI_2, PI, TAU};

/// Bins of the orientation histogram (Lowe, section 5).
const BINS: usize = 36;
/// Minimum height of a secondary peak relative to the highest (Lowe).
const PEAK_RATIO: f32 = 0.8;
/// Maximum number of orientations of a keypoint (VLFeat's limit).
const MAX_ORIENTATIONS: usize = 4;

/// Computes the dominant orientations in radians: the peaks of the histogram of gradient orientations around a
/// keypoint, weighted by magnitude and a Gaussian of 1.5σ. One to four, by decreasing height.
pub(crate) fn dominant_angles(level: Level, image: &Image<u16, 1>, (px, py): (f32, f32), sigma: f32) -> Vec<f32> {
    let mut bins = [0.0f32; BINS];
    dispatch!(level, simd => {
        vote::<_, false>(simd, image, (px, py), 1.5 * sigma, &mut bins);
        vote::<_, true>(simd, image, (px, py), 1.5 * sigma, &mut bins);
    });
    let raw = |i: usize| bins[i % BINS];
    let smooth: [f32; BINS] = std::array::from_fn(|i| {
        let i = i + BINS;
        (raw(i - 2) + raw(i + 2)) / 16.0 + (raw(i - 1) + raw(i + 1)) / 4.0 + raw(i) * 0.375
    });
    let highest = smooth.iter().fold(0.0f32, |m, &v| m.max(v));
    let mut peaks: Vec<(f32, f32)> = (0..BINS)
        .filter_map(|i| {
            let (l, c, r) = (smooth[(i + BINS - 1) % BINS], smooth[i], smooth[(i + 1) % BINS]);
            (c > l && c > r && c >= PEAK_RATIO * highest).then(|| {
                let angle = (i as f32 + 0.5 * (l - r) / (l - 2.0 * c + r)) * (TAU / BINS as f32);
                (c, if angle < 0.0 { angle + TAU } else { angle })
            })
        })
        .collect();
    // A flat or rotationally symmetric neighborhood has no dominant orientation.
    if peaks.is_empty() {
        return vec![0.0];
    }
    peaks.sort_by(|a, b| b.0.total_cmp(&a.0));
    peaks.iter().take(MAX_ORIENTATIONS).map(|p| p.1).collect()
}

/// Maximum window side in pixels: a radius of 4.5σ at σ = 2^(4/3) · 4 / 2, the maximum of the options at half the
/// octave's resolution.
const MAX_WINDOW: usize = 64;

/// Accumulates the gradients of the window, at the pixels or (`AT_CENTERS`) at the centers of 2×2 pixels, with linear
/// interpolation between the two nearest bins. At half the octave's resolution there are few pixels: with only one of
/// the two grids, or without interpolation, secondary peaks would depend on the sampling.
#[inline(always)]
fn vote<S: Simd, const AT_CENTERS: bool>(
    _: S,
    image: &Image<u16, 1>,
    (px, py): (f32, f32),
    sigma: f32,
    bins: &mut [f32; BINS],
) {
    let radius = ((3.0 * sigma + 0.5) as isize).min(MAX_WINDOW as isize / 2 - 1);
    let (w, h) = image.size();
    let (shift, border) = if AT_CENTERS { (0.5, 0) } else { (0.0, 1) };
    let range = |p: f32, n: usize| {
        let c = (p + 0.5 - shift) as isize;
        ((c - radius).max(border) as usize, (c + radius + 1).min(n as isize - 1).max(border) as usize)
    };
    let ((x0, x1), (y0, y1)) = (range(px, w), range(py, h));
    if x1 <= x0 {
        return;
    }
    let n = x1 - x0;
    let falloff = -0.5 / (sigma * sigma);
    let mut weights = [0.0f32; MAX_WINDOW];
    for (i, weight) in weights[..n].iter_mut().enumerate() {
        let d = (x0 + i) as f32 + shift - px;
        *weight = (falloff * d * d).exp();
    }
    let (mut votes, mut bin_indices, mut upper_votes) =
        ([0.0f32; MAX_WINDOW], [0u32; MAX_WINDOW], [0.0f32; MAX_WINDOW]);
    // Separate sums for the lower and the upper bin, for independent additions; the last bin is for a full turn.
    let mut sums = [[0.0f32; BINS + 1]; 2];
    for y in y0..y1 {
        let d = y as f32 + shift - py;
        let weight = (falloff * d * d).exp();
        let (up, down) = if AT_CENTERS { (y, y + 1) } else { (y - 1, y + 1) };
        let (above, below) = (&image.row(up)[x0..x1 + 1], &image.row(down)[x0..x1 + 1]);
        let here = if AT_CENTERS { above } else { &image.row(y)[x0 - 1..x1 + 1] };
        for i in 0..n {
            // Twice the derivatives: central differences, or the sum of two forward differences.
            let (gx, gy) = if AT_CENTERS {
                let (a, b) = (below[i + 1] as f32 - above[i] as f32, below[i] as f32 - above[i + 1] as f32);
                (a - b, a + b)
            } else {
                (here[i + 2] as f32 - here[i] as f32, below[i] as f32 - above[i] as f32)
            };
            votes[i] = weight * weights[i] * (gx * gx + gy * gy).sqrt();
            let position = direction_in_turns(gy, gx) * BINS as f32;
            bin_indices[i] = position as u32;
            upper_votes[i] = votes[i] * (position - bin_indices[i] as f32);
        }
        for i in 0..n {
            let at = (bin_indices[i] as usize).min(BINS);
            sums[0][at] += votes[i] - upper_votes[i];
            sums[1][at] += upper_votes[i];
        }
    }
    for (i, bin) in bins.iter_mut().enumerate() {
        *bin += sums[0][i] + sums[1][(i + BINS - 1) % BINS];
    }
    bins[0] += sums[0][BINS];
    bins[1] += sums[1][BINS];
}

/// Histogram cells along a side.
const CELLS: usize = 4;
/// Orientation bins of a cell.
const DIRECTIONS: usize = 8;
/// Dimension of a descriptor.
pub(crate) const DIMENSION: usize = CELLS * CELLS * DIRECTIONS;
/// Samples along a side of a cell.
const PER_CELL: usize = 4;
/// Samples along a side of the window: the cells and a margin of half a cell, which contributes to the outer cells by
/// interpolation.
const GRID: usize = (CELLS + 1) * PER_CELL;
/// With a margin of one sample, for central differences.
const PADDED: usize = GRID + 2;
/// Width of a cell in σ (Lowe's code and OpenCV's).
const CELL_SIGMAS: f32 = 3.0;

/// Returns the cell index and the interpolation weight of sample `i`; the origin is half a cell before the center of
/// the first cell.
const fn cell(i: usize) -> (usize, f32) {
    (i / PER_CELL, (i % PER_CELL) as f32 / PER_CELL as f32 + 0.5 / PER_CELL as f32)
}

/// Computes the Gaussian weights of the samples, with σ half the descriptor window (Lowe, section 6.1).
fn window_weights() -> [f32; GRID] {
    std::array::from_fn(|i| {
        let d = ((i as f32 + 0.5) / PER_CELL as f32 - (CELLS as f32 + 1.0) / 2.0) / (CELLS as f32 / 2.0);
        (-0.5 * d * d).exp()
    })
}

/// Computes the (not normalized) gradient histograms of the window rotated by `angle`. Samples outside the image have
/// weight zero.
pub(crate) fn describe(
    level: Level,
    image: &Image<u16, 1>,
    center: (f32, f32),
    sigma: f32,
    angle: f32,
) -> [f32; DIMENSION] {
    dispatch!(level, simd => describe_impl(simd, image, center, sigma, angle))
}

#[inline(always)]
fn describe_impl<S: Simd>(
    simd: S,
    image: &Image<u16, 1>,
    (px, py): (f32, f32),
    sigma: f32,
    angle: f32,
) -> [f32; DIMENSION] {
    let step = CELL_SIGMAS * sigma / PER_CELL as f32;
    let (sin, cos) = angle.sin_cos();
    let (ux, uy) = (cos * step, sin * step);
    let (w, h) = image.size();
    let center = (PADDED - 1) as f32 / 2.0;
    let radius = center * (ux.abs() + uy.abs());
    let (right, bottom) = ((w - 1) as f32, (h - 1) as f32);
    let all_inside = px - radius >= 0.0 && py - radius >= 0.0 && px + radius < right && py + radius < bottom;

    let mut samples = [0.0f32; PADDED * PADDED];
    let mut inside = [1.0f32; PADDED * PADDED];
    let pixels = image.as_slice();
    for j in 0..PADDED {
        let v = j as f32 - center;
        let (mut fx, mut fy) = ([0.0f32; PADDED], [0.0f32; PADDED]);
        let mut starts = [0u32; PADDED];
        let (x0, y0) = (px - v * uy - center * ux, py + v * ux - center * uy);
        for i in 0..PADDED {
            let (mut x, mut y) = (x0 + i as f32 * ux, y0 + i as f32 * uy);
            if !all_inside {
                let (cx, cy) = (x.max(0.0).min(right), y.max(0.0).min(bottom));
                inside[j * PADDED + i] = if cx == x && cy == y { 1.0 } else { 0.0 };
                (x, y) = (cx, cy);
            }
            // The surrounding 2×2 pixels.
            let (column, row) =
                (round((x - 0.5).max(0.0)).min(w as u32 - 2), round((y - 0.5).max(0.0)).min(h as u32 - 2));
            fx[i] = x - column as f32;
            fy[i] = y - row as f32;
            starts[i] = row * w as u32 + column;
        }
        // Two horizontal neighbors in one word: gathering dominates the time.
        let (mut tops, mut bottoms) = ([0u32; PADDED], [0u32; PADDED]);
        for i in 0..PADDED {
            let square = &pixels[starts[i] as usize..][..w + 2];
            tops[i] = square[0] as u32 | (square[1] as u32) << 16;
            bottoms[i] = square[w] as u32 | (square[w + 1] as u32) << 16;
        }
        let samples = &mut samples[j * PADDED..(j + 1) * PADDED];
        for i in 0..PADDED {
            let (a, b) = ((tops[i] & 0xFFFF) as f32, (tops[i] >> 16) as f32);
            let (c, d) = ((bottoms[i] & 0xFFFF) as f32, (bottoms[i] >> 16) as f32);
            let (top, bottom) = (a + fx[i] * (b - a), c + fx[i] * (d - c));
            samples[i] = top + fy[i] * (bottom - top);
        }
    }

    let weights = window_weights();
    let lanes: [f32; DIRECTIONS] = std::array::from_fn(|i| i as f32);
    let lanes = f32x8::from_slice(simd, &lanes);
    let mut histogram = [[f32x8::splat(simd, 0.0); CELLS + 2]; CELLS + 2];
    for j in 0..GRID {
        let here = &samples[(j + 1) * PADDED..(j + 2) * PADDED];
        let above = &samples[j * PADDED + 1..][..GRID];
        let below = &samples[(j + 2) * PADDED + 1..][..GRID];
        let valid = &inside[(j + 1) * PADDED + 1..][..GRID];
        let (mut magnitudes, mut directions) = ([0.0f32; GRID], [0.0f32; GRID]);
        for i in 0..GRID {
            let (gx, gy) = (here[i + 2] - here[i], below[i] - above[i]);
            magnitudes[i] = valid[i] * weights[j] * weights[i] * (gx * gx + gy * gy).sqrt();
            directions[i] = direction_in_turns(gy, gx) * DIRECTIONS as f32;
        }
        // Linear interpolation between two columns of cells and two orientation bins: all eight bins at once, with
        // weight zero for those farther than one bin.
        let mut row = [f32x8::splat(simd, 0.0); CELLS + 2];
        for i in 0..GRID {
            let (column, fraction) = cell(i);
            let distance = (f32x8::splat(simd, directions[i]) - lanes).abs();
            let distance = distance.min(f32x8::splat(simd, DIRECTIONS as f32) - distance);
            let vote = (f32x8::splat(simd, 1.0) - distance).max(f32x8::splat(simd, 0.0)) * magnitudes[i];
            row[column] += vote * (1.0 - fraction);
            row[column + 1] += vote * fraction;
        }
        let (line, fraction) = cell(j);
        for c in 0..CELLS + 2 {
            histogram[line][c] += row[c] * (1.0 - fraction);
            histogram[line + 1][c] += row[c] * fraction;
        }
    }
    let mut out = [0.0; DIMENSION];
    for (i, o) in out.chunks_exact_mut(DIRECTIONS).enumerate() {
        histogram[1 + i / CELLS][1 + i % CELLS].store_slice(o);
    }
    out
}

/// Computes the direction of `(x, y)` in turns, 0 ≤ t ≤ 1 (0 for a zero vector).
///
/// Abramowitz & Stegun 4.4.49, with an error below 2e-6 turns: about 1e-4 of a histogram bin.
#[inline(always)]
fn direction_in_turns(y: f32, x: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    let (small, large) = if ax < ay { (ax, ay) } else { (ay, ax) };
    let t = small / (large + f32::MIN_POSITIVE);
    let t2 = t * t;
    let p = ((((0.020_835_1 * t2 - 0.085_133) * t2 + 0.180_141) * t2 - 0.330_299_5) * t2 + 0.999_866) * t;
    let p = if ax < ay { FRAC_PI_2 - p } else { p };
    let p = if x < 0.0 { PI - p } else { p };
    let p = if y < 0.0 { TAU - p } else { p };
    p * (1.0 / TAU)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_synth::instruction_sets;

    #[test]
    fn directions_equal_atan2() {
        for i in 0..4000 {
            let a = i as f32 * 0.01 - 20.0;
            let (y, x) = (a.sin() * 3.0, a.cos() * 3.0);
            let expected = f64::from(y).atan2(f64::from(x)).rem_euclid(std::f64::consts::TAU) / std::f64::consts::TAU;
            let d = (f64::from(direction_in_turns(y, x)) - expected).abs();
            // The error of the polynomial, and f32 rounding.
            assert!(d.min(1.0 - d) < 2.5e-6, "{a}: {d}");
        }
        assert_eq!(direction_in_turns(0.0, 0.0), 0.0);
        assert!((0.0..=1.0).contains(&direction_in_turns(-0.0, -1.0)) && direction_in_turns(-1e-30, 1.0) <= 1.0);
    }

    /// An intensity ramp with a known gradient direction.
    fn ramp(angle: f32) -> Image<u16, 1> {
        let (sin, cos) = angle.sin_cos();
        Image::from_fn(
            120,
            110,
            |x, y| [(30000.0 + 200.0 * (cos * (x as f32 - 60.0) + sin * (y as f32 - 55.0))) as u16],
        )
    }

    #[test]
    fn the_orientation_of_a_ramp_is_its_gradient_direction() {
        for k in 0..24 {
            let angle = k as f32 * TAU / 24.0 + 0.03;
            let image = ramp(angle);
            for level in instruction_sets() {
                let found = dominant_angles(level, &image, (60.3, 54.8), 2.2);
                let error = (found[0] - angle).abs();
                // All votes are in one or two bins of 10°: the error is at most half a bin.
                assert!(found.len() == 1 && error.min(TAU - error) <= TAU / 72.0 + 1e-3, "{angle}: {found:?}");
            }
        }
    }

    /// Reference: the descriptor by Lowe's definition, with trilinear interpolation.
    fn plain(image: &Image<u16, 1>, (px, py): (f32, f32), sigma: f32, angle: f32) -> Vec<f64> {
        let (w, h) = image.size();
        let step = f64::from(CELL_SIGMAS * sigma) / PER_CELL as f64;
        let (sin, cos) = f64::from(angle).sin_cos();
        let center = (PADDED - 1) as f64 / 2.0;
        let position = |i: usize, j: usize| {
            let (u, v) = ((i as f64 - center) * step, (j as f64 - center) * step);
            (f64::from(px) + u * cos - v * sin, f64::from(py) + u * sin + v * cos)
        };
        let inside = |(x, y): (f64, f64)| x >= 0.0 && y >= 0.0 && x <= w as f64 - 1.0 && y <= h as f64 - 1.0;
        let sample = |i: usize, j: usize| {
            let (x, y) = position(i, j);
            let (x, y) = (x.clamp(0.0, w as f64 - 1.0), y.clamp(0.0, h as f64 - 1.0));
            let (c, r) = ((x as usize).min(w - 2), (y as usize).min(h - 2));
            let at = |dx: usize, dy: usize| f64::from(image.at(c + dx, r + dy)[0]);
            let (fx, fy) = (x - c as f64, y - r as f64);
            (at(0, 0) * (1.0 - fx) + at(1, 0) * fx) * (1.0 - fy) + (at(0, 1) * (1.0 - fx) + at(1, 1) * fx) * fy
        };
        let mut out = vec![0.0f64; DIMENSION];
        for j in 1..=GRID {
            for i in 1..=GRID {
                if !inside(position(i, j)) {
                    continue;
                }
                let (gx, gy) = (sample(i + 1, j) - sample(i - 1, j), sample(i, j + 1) - sample(i, j - 1));
                let at = |i: usize| (i as f64 - 0.5) / PER_CELL as f64 - 1.0;
                let d2 = (at(i) - 1.5).powi(2) + (at(j) - 1.5).powi(2);
                let magnitude = gx.hypot(gy) * (-0.5 * d2 / 4.0).exp();
                let direction = gy.atan2(gx).rem_euclid(std::f64::consts::TAU) * 8.0 / std::f64::consts::TAU;
                for (k, o) in out.iter_mut().enumerate() {
                    let (r, c, b) = (k / 32, k / 8 % 4, k % 8);
                    let weight = |a: f64, b: f64| (1.0 - (a - b).abs()).max(0.0);
                    let distance = (direction - b as f64).abs();
                    let bin_weight = (1.0 - distance.min(8.0 - distance)).max(0.0);
                    *o += magnitude * weight(at(i), c as f64) * weight(at(j), r as f64) * bin_weight;
                }
            }
        }
        out
    }

    #[test]
    fn descriptors_equal_the_reference() {
        let mut state = 5u32;
        let image = Image::<u16, 1>::from_fn(120, 100, |x, y| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let wave = (x as f32 * 0.3).sin() + (y as f32 * 0.23 + x as f32 * 0.05).cos();
            [(30000.0 + 9000.0 * wave + (state >> 20) as f32) as u16]
        });
        // In the image center, and with windows partly outside.
        for (at, sigma, angle) in [((60.2, 50.7), 2.1, 0.7), ((8.1, 90.2), 3.0, 4.0), ((117.0, 5.0), 1.7, 2.5)] {
            let expected = plain(&image, at, sigma, angle);
            let norm = expected.iter().map(|v| v * v).sum::<f64>().sqrt();
            for level in instruction_sets() {
                let got = describe(level, &image, at, sigma, angle);
                for (g, e) in got.iter().zip(&expected) {
                    // About twenty f32 operations on positions of up to 120 pixels, times the gradient.
                    assert!((f64::from(*g) - e).abs() < 1e-3 * norm, "{level:?}: {g} not {e}");
                }
                assert_eq!(got, describe(Level::baseline(), &image, at, sigma, angle), "{level:?}");
            }
        }
    }
}
