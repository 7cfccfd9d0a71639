//! Extrema of the difference of Gaussians (DoG) over position and scale.
//!
//! Source: D. Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 60(2), 2004, sections 3 and 4.

use crate::line_buffer::LineBuffer;
use crate::simd;
use fearless_simd::Level;
use nalgebra::{Matrix3, Vector3};
use std::ops::Range;

/// Width in pixels of the border of an octave without extrema (OpenCV's value): mirroring causes spurious ones.
const BORDER: usize = 5;
/// Maximum displacement in pixels of an extremum during refinement.
const MAX_DISPLACEMENT: usize = 2;
/// Radius of the differences that the refinement reads.
pub(crate) const WINDOW_RADIUS: usize = MAX_DISPLACEMENT + 1;

/// An extremum of the difference of Gaussians, in octave pixels.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Extremum {
    pub(crate) octave: usize,
    /// Index of the nearest layer, 1 to `layers`.
    pub(crate) layer: usize,
    pub(crate) column: usize,
    pub(crate) row: usize,
    pub(crate) x: f32,
    pub(crate) y: f32,
    /// σ in octave pixels.
    pub(crate) sigma: f32,
    /// Contrast |D| at the extremum.
    pub(crate) contrast: f32,
}

/// Parameters of the detector.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DogOptions {
    pub(crate) layers: usize,
    pub(crate) sigma: f32,
    pub(crate) upsample: bool,
    pub(crate) contrast: f32,
    pub(crate) edge: f32,
}

/// Detects the extrema of row `y` and the columns of a tile.
///
/// A pixel is a candidate if its difference is positive and not below any of its 26 neighbors, or negative and not
/// above any, with at least 0.8 of the contrast threshold (the refined value may be larger by as much).
#[allow(clippy::too_many_arguments)]
pub(crate) fn detect_extrema(
    differences: &[LineBuffer],
    octave: usize,
    options: &DogOptions,
    (w, h): (usize, usize),
    y: usize,
    columns: Range<usize>,
    level: Level,
    found: &mut Vec<Extremum>,
) {
    if y < BORDER || y + BORDER >= h {
        return;
    }
    let columns = columns.start.max(BORDER)..columns.end.min(w.saturating_sub(BORDER));
    let floor = 0.8 * options.contrast;
    let mut candidates = Vec::new();
    for layer in 1..=options.layers {
        // All differences have the same columns.
        let from = differences[layer].from;
        let local = columns.start.saturating_sub(from)..columns.end.saturating_sub(from);
        if local.is_empty() {
            continue;
        }
        let rows = [layer - 1, layer, layer + 1].map(|l| [y - 1, y, y + 1].map(|y| differences[l].row(y)));
        candidates.clear();
        simd::extrema(level, rows, local, floor, &mut candidates);
        for &x in &candidates {
            let at = |l: usize, y: usize, x: usize| differences[l].row(y)[x - from];
            found.extend(refine(at, octave, options, (w, h), (layer, y, x + from)));
        }
    }
}

/// Refines an extremum by fitting a quadratic to 3×3×3 differences (Lowe, section 4); `None` if it diverges, has low
/// contrast, or is on an edge.
fn refine(
    at: impl Fn(usize, usize, usize) -> f32,
    octave: usize,
    options: &DogOptions,
    (w, h): (usize, usize),
    start: (usize, usize, usize),
) -> Option<Extremum> {
    let (mut layer, mut y, mut x) = start;
    // At most five steps, as in Lowe's and OpenCV's code.
    for _ in 0..5 {
        let d = |dl: isize, dy: isize, dx: isize| {
            at(layer.wrapping_add_signed(dl), y.wrapping_add_signed(dy), x.wrapping_add_signed(dx))
        };
        let v = d(0, 0, 0);
        let gradient = Vector3::new(d(0, 0, 1) - d(0, 0, -1), d(0, 1, 0) - d(0, -1, 0), d(1, 0, 0) - d(-1, 0, 0)) * 0.5;
        let (xx, yy) = (d(0, 0, 1) + d(0, 0, -1) - 2.0 * v, d(0, 1, 0) + d(0, -1, 0) - 2.0 * v);
        let ss = d(1, 0, 0) + d(-1, 0, 0) - 2.0 * v;
        let xy = 0.25 * (d(0, 1, 1) - d(0, 1, -1) - d(0, -1, 1) + d(0, -1, -1));
        let xs = 0.25 * (d(1, 0, 1) - d(1, 0, -1) - d(-1, 0, 1) + d(-1, 0, -1));
        let ys = 0.25 * (d(1, 1, 0) - d(1, -1, 0) - d(-1, 1, 0) + d(-1, -1, 0));
        let hessian = Matrix3::new(xx, xy, xs, xy, yy, ys, xs, ys, ss);
        let step = -(hessian.try_inverse()? * gradient);
        if step.abs().max() < 0.5 {
            let contrast = (v + 0.5 * gradient.dot(&step)).abs();
            let (trace, det) = (xx + yy, xx * yy - xy * xy);
            let edge_limit = (options.edge + 1.0) * (options.edge + 1.0) / options.edge;
            if contrast < options.contrast || det <= 0.0 || trace * trace >= edge_limit * det {
                return None;
            }
            return Some(Extremum {
                octave,
                layer,
                column: x,
                row: y,
                x: x as f32 + step.x,
                y: y as f32 + step.y,
                sigma: options.sigma * 2f32.powf((layer as f32 + step.z) / options.layers as f32),
                contrast,
            });
        }
        if !step.iter().all(|s| s.abs() < 1e6) {
            return None;
        }
        let displaced = |at: usize, by: f32| at.checked_add_signed(by.round() as isize);
        (x, y, layer) = (displaced(x, step.x)?, displaced(y, step.y)?, displaced(layer, step.z)?);
        let inside = |v: usize, n: usize| (BORDER..n - BORDER).contains(&v);
        let is_near = x.abs_diff(start.2).max(y.abs_diff(start.1)) <= MAX_DISPLACEMENT;
        if !(is_near && inside(x, w) && inside(y, h) && (1..=options.layers).contains(&layer)) {
            return None;
        }
    }
    None
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use cv_core::GrayF32;

    /// Reference: the extrema of an octave by the definition; layer, row and column, sorted.
    pub(crate) fn plain(images: &[GrayF32], octave: usize, options: &DogOptions) -> Vec<(usize, usize, usize)> {
        let (w, h) = images[0].size();
        let at = |l: usize, y: usize, x: usize| images[l + 1].at(x, y)[0] - images[l].at(x, y)[0];
        let mut found = Vec::new();
        for layer in 1..=options.layers {
            for y in BORDER..h.saturating_sub(BORDER) {
                for x in BORDER..w.saturating_sub(BORDER) {
                    let v = at(layer, y, x);
                    let all = (layer - 1..=layer + 1)
                        .flat_map(|l| (y - 1..=y + 1).flat_map(move |y| (x - 1..=x + 1).map(move |x| (l, y, x))));
                    let mut around = all.map(|(l, y, x)| at(l, y, x));
                    let strong = v.abs() > 0.8 * options.contrast;
                    if strong && around.all(|d| if v > 0.0 { v >= d } else { v <= d }) {
                        found.extend(refine(at, octave, options, (w, h), (layer, y, x)));
                    }
                }
            }
        }
        let mut locations: Vec<_> = found.iter().map(|e| (e.layer, e.row, e.column)).collect();
        locations.sort_unstable();
        locations.dedup();
        locations
    }
}
