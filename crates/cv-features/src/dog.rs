//! Extrema of differences of Gaussians over position and scale.
//!
//! Source: D. Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 60(2), 2004, sections 3 and 4.

use crate::blur::{blur, double, halve};
use cv_core::{GrayF32, ImageView};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

/// Smoothing that the camera is assumed to have done, in input pixels (Lowe, section 3.3).
const CAMERA_SIGMA: f32 = 0.5;
/// Pixels at the border of an octave in which no extremum is looked for: gradients and derivatives need neighbours.
const BORDER: usize = 2;
/// Rows per task.
const ROWS: usize = 32;

/// Gaussian images at `layers + 3` scales; scale `i` has σ = `sigma · 2^(i / layers)` octave pixels.
pub(crate) struct Octave {
    pub(crate) images: Vec<GrayF32>,
    /// Size of this octave's pixel in input pixels.
    pub(crate) pixel: f32,
}

/// An extremum, in pixels of its octave.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Extremum {
    pub(crate) octave: usize,
    /// The Gaussian image nearest in scale.
    pub(crate) layer: usize,
    pub(crate) column: usize,
    pub(crate) row: usize,
    pub(crate) x: f32,
    pub(crate) y: f32,
    /// σ in octave pixels.
    pub(crate) sigma: f32,
    /// |D| at the extremum.
    pub(crate) contrast: f32,
}

/// Parameters of the search.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Search {
    pub(crate) layers: usize,
    pub(crate) sigma: f32,
    pub(crate) upsample: bool,
    pub(crate) contrast: f32,
    pub(crate) edge: f32,
}

/// The whole scale space: octaves until the shorter side is below 8 pixels.
pub(crate) fn scale_space(view: ImageView<'_, f32, 1>, search: &Search) -> Vec<Octave> {
    let missing = |target: f32, has: f32| (target * target - has * has).max(1e-4).sqrt();
    let (mut base, mut pixel) = if search.upsample {
        (double(view, missing(search.sigma * 0.5, CAMERA_SIGMA)), 0.5)
    } else {
        (blur(view, missing(search.sigma, CAMERA_SIGMA)), 1.0)
    };
    let mut octaves = Vec::new();
    loop {
        let scale = |i: usize| search.sigma * 2f32.powf(i as f32 / search.layers as f32);
        let mut images = vec![base];
        for i in 1..search.layers + 3 {
            let next = blur(images[i - 1].view(), missing(scale(i), scale(i - 1)));
            images.push(next);
        }
        base = halve(&images[search.layers]);
        octaves.push(Octave { images, pixel });
        pixel *= 2.0;
        if base.width().min(base.height()) < 8 {
            return octaves;
        }
    }
}

/// The extrema of an octave, refined, in raster order.
pub(crate) fn extrema(octave: &Octave, index: usize, search: &Search) -> Vec<Extremum> {
    let (w, h) = octave.images[0].size();
    if w <= 2 * BORDER || h <= 2 * BORDER {
        return Vec::new();
    }
    let starts: Vec<usize> = (BORDER..h - BORDER).step_by(ROWS).collect();
    let found: Vec<Vec<Extremum>> = starts
        .into_par_iter()
        .map(|start| {
            let mut found = Vec::new();
            for (layer, y, x) in candidates(octave, start..(start + ROWS).min(h - BORDER), search) {
                found.extend(refine(octave, index, search, (layer, y, x)));
            }
            found
        })
        .collect();
    found.into_iter().flatten().collect()
}

/// Pixels of differences `1..=layers` that are not below (or not above) any of their 26 neighbours, with at least 0.8 of the contrast asked for
/// (the refined value may be that much larger), in raster order.
fn candidates(octave: &Octave, rows: std::ops::Range<usize>, search: &Search) -> Vec<(usize, usize, usize)> {
    let w = octave.images[0].width();
    let differences = octave.images.len() - 1;
    let floor = 0.8 * search.contrast;
    // Difference l of row y lives in ring[l][y % 3].
    let mut ring = vec![[(); 3].map(|()| vec![0.0f32; w]); differences];
    let difference = |ring: &mut Vec<[Vec<f32>; 3]>, y: usize| {
        for (l, rows) in ring.iter_mut().enumerate() {
            let (a, b) = (octave.images[l].row(y), octave.images[l + 1].row(y));
            rows[y % 3].iter_mut().zip(a.iter().zip(b)).for_each(|(o, (a, b))| *o = b - a);
        }
    };
    let greater = |a: f32, b: f32| if a > b { a } else { b };
    let less = |a: f32, b: f32| if a < b { a } else { b };
    let mut columns = [vec![0.0f32; w], vec![0.0f32; w]];
    let mut extremes = vec![[vec![0.0f32; w], vec![0.0f32; w]]; differences];
    let mut marks = vec![0u8; w];
    let mut found = Vec::new();
    difference(&mut ring, rows.start - 1);
    difference(&mut ring, rows.start);
    for y in rows {
        difference(&mut ring, y + 1);
        for (rows, out) in ring.iter().zip(&mut extremes) {
            let [a, b, c] = rows;
            let [high, low] = &mut columns;
            for x in 0..w {
                high[x] = greater(greater(a[x], b[x]), c[x]);
                low[x] = less(less(a[x], b[x]), c[x]);
            }
            let [max, min] = out;
            for x in 1..w - 1 {
                max[x] = greater(greater(high[x - 1], high[x]), high[x + 1]);
                min[x] = less(less(low[x - 1], low[x]), low[x + 1]);
            }
        }
        for l in 1..=search.layers {
            let here = &ring[l][y % 3];
            let [below, same, above] = [&extremes[l - 1], &extremes[l], &extremes[l + 1]];
            for x in BORDER..w - BORDER {
                let d = here[x];
                let max = greater(greater(below[0][x], same[0][x]), above[0][x]);
                let min = less(less(below[1][x], same[1][x]), above[1][x]);
                marks[x] = u8::from(((d >= max) & (d > floor)) | ((d <= min) & (d < -floor)));
            }
            for (block, eight) in marks.chunks(8).enumerate() {
                if eight.iter().fold(0, |any, m| any | m) != 0 {
                    let hits = eight.iter().enumerate().filter(|(_, m)| **m != 0);
                    found.extend(hits.map(|(i, _)| (l, y, block * 8 + i)));
                }
            }
        }
    }
    found
}

/// Follows the quadratic through the 3×3×3 differences to its extremum; `None` where it runs away, is faint, or lies on an edge.
fn refine(octave: &Octave, index: usize, search: &Search, start: (usize, usize, usize)) -> Option<Extremum> {
    let (w, h) = octave.images[0].size();
    let (mut layer, mut y, mut x) = start;
    // Five steps, as Lowe's and OpenCV's code.
    for _ in 0..5 {
        let d = |dl: isize, dy: isize, dx: isize| {
            let l = layer.wrapping_add_signed(dl);
            let (row, column) = (y.wrapping_add_signed(dy), x.wrapping_add_signed(dx));
            octave.images[l + 1].row(row)[column] - octave.images[l].row(row)[column]
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
            let limit = (search.edge + 1.0) * (search.edge + 1.0) / search.edge;
            if contrast < search.contrast || det <= 0.0 || trace * trace >= limit * det {
                return None;
            }
            return Some(Extremum {
                octave: index,
                layer,
                column: x,
                row: y,
                x: x as f32 + step.x,
                y: y as f32 + step.y,
                sigma: search.sigma * 2f32.powf((layer as f32 + step.z) / search.layers as f32),
                contrast,
            });
        }
        if !step.iter().all(|s| s.abs() < 1e6) {
            return None;
        }
        let moved = |at: usize, by: f32| at.checked_add_signed(by.round() as isize);
        (x, y, layer) = (moved(x, step.x)?, moved(y, step.y)?, moved(layer, step.z)?);
        let inside = |v: usize, n: usize| (BORDER..n - BORDER).contains(&v);
        if !(inside(x, w) && inside(y, h) && (1..=search.layers).contains(&layer)) {
            return None;
        }
    }
    None
}
