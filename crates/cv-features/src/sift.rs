//! SIFT features: difference-of-Gaussian points with orientation, and gradient histograms around them, as rootSIFT by default.
//!
//! Sources: D. Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 60(2), 2004; R. Arandjelović & A. Zisserman,
//! "Three things everyone should know to improve object retrieval", CVPR 2012 (the square root).
//!
//! Two things differ from Lowe's code. The first octave is made by sampling a Gaussian at half-pixel phases, so positions have no bias of a quarter of a
//! pixel. A descriptor is computed on a grid of 20×20 samples turned and scaled with the point (four to a histogram bin, as in Lowe's
//! figure 7), not on every pixel under the window, so its cost does not depend on scale.

use crate::descriptors::{Described, DescriptorKind, Descriptors, DropReason, Dropped};
use crate::dog::{Extremum, Octave, Search, extrema, scale_space};
use crate::error::{FeatureError, check_image, check_option};
use cv_core::{GrayF32, ImageView, Keypoint, Point2};
use rayon::prelude::*;
use std::f32::consts::{PI, TAU};

/// Settings of [`sift`].
#[derive(Debug, Clone, PartialEq)]
pub struct SiftOptions {
    /// Largest number of features; those with the strongest contrast stay. 1 or more; default 8192 (COLMAP's).
    pub max_features: usize,
    /// Start from an image of twice the size, which about quadruples the number of points and finds the smallest. Default true (Lowe).
    pub upsample: bool,
    /// Scales per octave. 1 to 8; default 3 (Lowe).
    pub layers: usize,
    /// σ of the first scale of an octave, in its pixels. 0.8 to 4; default 1.6 (Lowe).
    pub sigma: f32,
    /// Smallest contrast of a point, times `layers`, for images of 0 to 1. 0 or more; default 0.02 (COLMAP's), half of OpenCV's 0.04.
    pub contrast: f32,
    /// Largest ratio of the two principal curvatures. 1 or more; default 10 (Lowe).
    pub edge: f32,
    /// Take the square root of the L1-normalised histogram (rootSIFT). Default true.
    pub root: bool,
    /// Leave every angle at zero: for images known to be upright. Default false.
    pub upright: bool,
}

impl Default for SiftOptions {
    fn default() -> Self {
        Self {
            max_features: 8192,
            upsample: true,
            layers: 3,
            sigma: 1.6,
            contrast: 0.02,
            edge: 10.0,
            root: true,
            upright: false,
        }
    }
}

/// The smallest image the scale space can be built on.
const SMALLEST: usize = 8;

/// Finds and describes SIFT features, strongest contrast first.
///
/// `scale` of a keypoint is σ of the Gaussian it was found at, in input pixels; `response` is |D|, for images of 0 to 1. A point with several dominant
/// orientations gives a feature for each. A flat image has none: the result is empty.
///
/// # Errors
/// [`FeatureError`] for images below 8×8, samples that are not finite, options out of range.
pub fn sift(view: ImageView<'_, f32, 1>, options: &SiftOptions) -> Result<Described, FeatureError> {
    check_option("max_features", options.max_features as f64, "1 or more", |v| v >= 1.0)?;
    check_option("layers", options.layers as f64, "1 to 8", |v| (1.0..=8.0).contains(&v))?;
    check_option("sigma", options.sigma.into(), "0.8 to 4 px", |v| (0.8..=4.0).contains(&v))?;
    check_option("contrast", options.contrast.into(), "0 or more", |v| v >= 0.0 && v.is_finite())?;
    check_option("edge", options.edge.into(), "1 or more", |v| v >= 1.0 && v.is_finite())?;
    check_image(view, SMALLEST)?;
    let search = Search {
        layers: options.layers,
        sigma: options.sigma,
        upsample: options.upsample,
        // Never zero: rounding noise in flat regions is not a point. 1e-5 is a hundred times the error of the f32 sums.
        contrast: (options.contrast / options.layers as f32).max(1e-5),
        edge: options.edge,
    };
    let octaves = scale_space(view, &search);
    let mut points: Vec<Extremum> =
        octaves.iter().enumerate().flat_map(|(index, octave)| extrema(octave, index, &search)).collect();
    let place = |e: &Extremum| (e.octave, e.layer, e.row, e.column);
    points.sort_by(|a, b| b.contrast.total_cmp(&a.contrast).then(place(a).cmp(&place(b))));
    // Two pixels may lead to the same extremum.
    points.dedup_by(|a, b| place(a) == place(b));

    let kind = if options.root { DescriptorKind::RootSift } else { DescriptorKind::Sift };
    let mut out =
        Described { keypoints: Vec::new(), descriptors: Descriptors::new(kind), dropped: Vec::new(), beyond_limit: 0 };
    // A point gives at least one feature: more points than the limit are never needed.
    out.beyond_limit = points.len().saturating_sub(options.max_features);
    points.truncate(options.max_features);
    let features: Vec<Vec<(Keypoint, [f32; DIMENSION], f32)>> = points
        .par_iter()
        .with_min_len(16)
        .map(|point| {
            let image = &octaves[point.octave].images[point.layer];
            let angles = if options.upright { Angles::default() } else { dominant_angles(image, point) };
            angles
                .iter()
                .map(|angle| {
                    let mut histogram = describe(image, point, angle);
                    let norm = normalize(&mut histogram, options.root);
                    (keypoint(point, &octaves[point.octave], angle), histogram, norm)
                })
                .collect()
        })
        .collect();
    for (index, (keypoint, histogram, norm)) in features.into_iter().flatten().enumerate() {
        if norm <= 0.0 {
            out.dropped.push(Dropped { index, reason: DropReason::Flat { deviation: norm } });
        } else if out.keypoints.len() == options.max_features {
            out.beyond_limit += 1;
        } else {
            out.keypoints.push(keypoint);
            out.descriptors.push(&histogram);
        }
    }
    Ok(out)
}

fn keypoint(point: &Extremum, octave: &Octave, angle: f32) -> Keypoint {
    Keypoint {
        position: Point2::new(point.x * octave.pixel, point.y * octave.pixel),
        response: point.contrast,
        scale: point.sigma * octave.pixel,
        angle,
    }
}

/// Bins of the orientation histogram (Lowe, section 5).
const BINS: usize = 36;
/// Other peaks within this share of the highest give features of their own (Lowe).
const PEAK: f32 = 0.8;
/// No more orientations than this at a point (VLFeat's limit; more are noise).
const MOST_ANGLES: usize = 4;

/// Up to four angles.
#[derive(Debug, Clone, Copy)]
struct Angles {
    values: [f32; MOST_ANGLES],
    len: usize,
}

impl Default for Angles {
    /// Upright.
    fn default() -> Self {
        Self { values: [0.0; MOST_ANGLES], len: 1 }
    }
}

impl Angles {
    fn iter(&self) -> impl Iterator<Item = f32> + '_ {
        self.values[..self.len].iter().copied()
    }
}

/// The peaks of the histogram of gradient directions around a point, weighted by magnitude and a Gaussian of 1.5σ.
fn dominant_angles(image: &GrayF32, point: &Extremum) -> Angles {
    let sigma = 1.5 * point.sigma;
    let radius = (3.0 * sigma).round() as isize;
    let (w, h) = image.size();
    let reach = |c: usize, n: usize| {
        let c = c as isize;
        ((c - radius).max(1) as usize, (c + radius + 1).min(n as isize - 1).max(1) as usize)
    };
    let ((x0, x1), (y0, y1)) = (reach(point.column, w), reach(point.row, h));
    let falloff = -0.5 / (sigma * sigma);
    let weights: Vec<f32> = (x0..x1).map(|x| (falloff * (x as f32 - point.x).powi(2)).exp()).collect();
    let mut bins = [0.0f32; BINS + 1];
    for y in y0..y1 {
        let weight = (falloff * (y as f32 - point.y).powi(2)).exp();
        let [above, here, below] = [image.row(y - 1), image.row(y), image.row(y + 1)];
        for (x, wx) in (x0..x1).zip(&weights) {
            let (gx, gy) = (here[x + 1] - here[x - 1], below[x] - above[x]);
            let turn = atan2_turn(gy, gx);
            bins[(turn * BINS as f32 + 0.5) as usize] += weight * wx * (gx * gx + gy * gy).sqrt();
        }
    }
    bins[0] += bins[BINS];
    let raw = |i: isize| bins[i.rem_euclid(BINS as isize) as usize];
    let smooth: [f32; BINS] = std::array::from_fn(|i| {
        let i = i as isize;
        (raw(i - 2) + raw(i + 2)) / 16.0 + (raw(i - 1) + raw(i + 1)) / 4.0 + raw(i) * 0.375
    });
    let highest = smooth.iter().fold(0.0f32, |m, &v| m.max(v));
    let mut peaks: Vec<(f32, f32)> = (0..BINS)
        .filter_map(|i| {
            let (l, c, r) = (smooth[(i + BINS - 1) % BINS], smooth[i], smooth[(i + 1) % BINS]);
            (c > l && c > r && c >= PEAK * highest).then(|| {
                let angle = (i as f32 + 0.5 * (l - r) / (l - 2.0 * c + r)) * (TAU / BINS as f32);
                (c, if angle < 0.0 { angle + TAU } else { angle })
            })
        })
        .collect();
    // No peak: a flat or perfectly round neighbourhood has no direction of its own.
    if peaks.is_empty() {
        return Angles::default();
    }
    peaks.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut angles = Angles { values: [0.0; MOST_ANGLES], len: peaks.len().min(MOST_ANGLES) };
    angles.values.iter_mut().zip(&peaks).for_each(|(v, p)| *v = p.1);
    angles
}

/// Histogram cells on a side.
const CELLS: usize = 4;
/// Directions in a cell.
const DIRECTIONS: usize = 8;
/// Numbers in a descriptor.
const DIMENSION: usize = CELLS * CELLS * DIRECTIONS;
/// Samples across a cell.
const PER_CELL: usize = 4;
/// Samples across the window: the cells and half a cell around them, whose gradients reach into the outermost cells.
const GRID: usize = (CELLS + 1) * PER_CELL;
/// With one more on each side, for the differences.
const PADDED: usize = GRID + 2;
/// Width of a cell in σ (Lowe's code and OpenCV's).
const CELL_SIGMAS: f32 = 3.0;

/// Gradient histograms of the window turned by `angle`.
fn describe(image: &GrayF32, point: &Extremum, angle: f32) -> [f32; DIMENSION] {
    let step = CELL_SIGMAS * point.sigma / PER_CELL as f32;
    let (sin, cos) = angle.sin_cos();
    let (ux, uy) = (cos * step, sin * step);
    let (w, h) = image.size();
    let middle = (PADDED - 1) as f32 / 2.0;
    let mut samples = [[0.0f32; PADDED]; PADDED];
    let mut inside = [[true; PADDED]; PADDED];
    let reach = middle * (ux.abs() + uy.abs());
    let all_inside = point.x - reach >= 0.0
        && point.y - reach >= 0.0
        && point.x + reach < (w - 1) as f32
        && point.y + reach < (h - 1) as f32;
    for (j, (samples, inside)) in samples.iter_mut().zip(&mut inside).enumerate() {
        let v = j as f32 - middle;
        for (i, (sample, inside)) in samples.iter_mut().zip(inside).enumerate() {
            let u = i as f32 - middle;
            let (mut x, mut y) = (point.x + u * ux - v * uy, point.y + u * uy + v * ux);
            if !all_inside {
                let (cx, cy) = (x.clamp(0.0, (w - 1) as f32), y.clamp(0.0, (h - 1) as f32));
                *inside = (cx, cy) == (x, y);
                (x, y) = (cx, cy);
            }
            let (column, row) = ((x as usize).min(w - 2), (y as usize).min(h - 2));
            let (fx, fy) = (x - column as f32, y - row as f32);
            let (top, bottom) = (&image.row(row)[column..column + 2], &image.row(row + 1)[column..column + 2]);
            let a = top[0] + fx * (top[1] - top[0]);
            let b = bottom[0] + fx * (bottom[1] - bottom[0]);
            *sample = a + fy * (b - a);
        }
    }
    // Position of a sample in cells, from the middle of the first cell; its Gaussian weight, σ half the window (Lowe, section 6.1).
    let cell = |i: usize| (i as f32 + 0.5) / PER_CELL as f32 - 1.0;
    let weight = |i: usize| {
        let d = (cell(i) - (CELLS as f32 - 1.0) / 2.0) / (CELLS as f32 / 2.0);
        (-0.5 * d * d).exp()
    };
    // Two cells more on each axis and one direction more catch what falls outside, without tests.
    let mut histogram = [[[0.0f32; DIRECTIONS + 1]; CELLS + 2]; CELLS + 2];
    for j in 0..GRID {
        let (cy, wy) = (cell(j) + 1.0, weight(j));
        let (row, fy) = (cy as usize, cy - cy.floor());
        for i in 0..GRID {
            if !inside[j + 1][i + 1] {
                continue;
            }
            let gx = samples[j + 1][i + 2] - samples[j + 1][i];
            let gy = samples[j + 2][i + 1] - samples[j][i + 1];
            let (cx, wx) = (cell(i) + 1.0, weight(i));
            let (column, fx) = (cx as usize, cx - cx.floor());
            let magnitude = wx * wy * (gx * gx + gy * gy).sqrt();
            let direction = atan2_turn(gy, gx) * DIRECTIONS as f32;
            let (bin, fd) = ((direction as usize).min(DIRECTIONS - 1), direction - direction.floor());
            for (r, wr) in [(row, 1.0 - fy), (row + 1, fy)] {
                for (c, wc) in [(column, 1.0 - fx), (column + 1, fx)] {
                    let m = magnitude * wr * wc;
                    histogram[r][c][bin] += m * (1.0 - fd);
                    histogram[r][c][bin + 1] += m * fd;
                }
            }
        }
    }
    let mut out = [0.0; DIMENSION];
    for (i, o) in out.chunks_exact_mut(DIRECTIONS).enumerate() {
        let cell = &histogram[1 + i / CELLS][1 + i % CELLS];
        o.copy_from_slice(&cell[..DIRECTIONS]);
        o[0] += cell[DIRECTIONS];
    }
    out
}

/// Unit length, no entry above 0.2, unit length again; for rootSIFT then the root of each share. Gives back the first length.
fn normalize(v: &mut [f32; DIMENSION], root: bool) -> f32 {
    let length = |v: &[f32; DIMENSION]| v.iter().map(|a| a * a).sum::<f32>().sqrt();
    let norm = length(v);
    if norm <= 0.0 {
        return 0.0;
    }
    v.iter_mut().for_each(|a| *a = (*a / norm).min(0.2));
    if root {
        let sum: f32 = v.iter().sum();
        v.iter_mut().for_each(|a| *a = (*a / sum).sqrt());
    } else {
        let clipped = length(v);
        v.iter_mut().for_each(|a| *a /= clipped);
    }
    norm
}

/// The direction of `(x, y)` as a share of a full turn, 0 ≤ t ≤ 1 (0 for a zero vector).
///
/// Abramowitz & Stegun 4.4.49, error below 2e-6 of a turn: a tenth of a thousandth of a histogram bin.
#[inline]
pub(crate) fn atan2_turn(y: f32, x: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    let (small, large) = if ax < ay { (ax, ay) } else { (ay, ax) };
    let t = small / (large + f32::MIN_POSITIVE);
    let t2 = t * t;
    let p = ((((0.020_835_1 * t2 - 0.085_133) * t2 + 0.180_141) * t2 - 0.330_299_5) * t2 + 0.999_866) * t;
    let p = if ax < ay { PI / 2.0 - p } else { p };
    let p = if x < 0.0 { PI - p } else { p };
    let p = if y < 0.0 { TAU - p } else { p };
    p * (1.0 / TAU)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image_of(w: usize, h: usize, f: impl Fn(f32, f32) -> f32) -> GrayF32 {
        GrayF32::from_fn(w, h, |x, y| [f(x as f32, y as f32)])
    }

    #[test]
    fn angles_are_those_of_the_library() {
        for i in 0..4000 {
            let a = i as f32 * 0.01 - 20.0;
            let (y, x) = (a.sin() * 3.0, a.cos() * 3.0);
            let expected = f64::from(y).atan2(f64::from(x)).rem_euclid(std::f64::consts::TAU) / std::f64::consts::TAU;
            let d = (f64::from(atan2_turn(y, x)) - expected).abs();
            // The polynomial's stated error, and f32 rounding.
            assert!(d.min(1.0 - d) < 2.5e-6, "{a}: {d}");
        }
        assert_eq!(atan2_turn(0.0, 0.0), 0.0);
        assert!((0.0..=1.0).contains(&atan2_turn(-0.0, -1.0)) && atan2_turn(-1e-30, 1.0) <= 1.0);
    }

    #[test]
    fn a_gaussian_blob_is_found_where_and_as_large_as_it_is() {
        // The normalised Laplacian of a Gaussian blob of σ0 peaks at σ = σ0; the difference of Gaussians with k = 2^(1/3) peaks where the two
        // scales it compares bracket that, and a point takes the smaller of the two: σ0 = σ·2^(1/6) to first order. The camera's 0.5 is
        // already counted in the image.
        for (x0, y0, s0) in [(60.3f32, 50.7f32, 4.0f32), (70.0, 60.5, 6.0), (64.25, 61.0, 2.5)] {
            let blob =
                image_of(130, 120, |x, y| 0.1 + 0.8 * (-((x - x0).powi(2) + (y - y0).powi(2)) / (2.0 * s0 * s0)).exp());
            let found = sift(blob.view(), &SiftOptions::default()).unwrap();
            let best = found.keypoints.iter().min_by(|a, b| {
                let off = |k: &Keypoint| (k.scale / s0).ln().abs();
                off(a).total_cmp(&off(b))
            });
            let k = best.unwrap();
            assert!((k.position.x - x0).abs() < 0.05 && (k.position.y - y0).abs() < 0.05, "{k:?} not ({x0}, {y0})");
            // Quadratic interpolation over three scales of a curve that is not a parabola: a tenth of a scale step, 3 %, and the step itself is
            // known to the first order only.
            assert!((k.scale * 2f32.powf(1.0 / 6.0) / s0 - 1.0).abs() < 0.06, "{k:?} not σ {s0}");
        }
    }

    #[test]
    fn nothing_to_find_and_nothing_to_look_at() {
        let options = SiftOptions::default();
        let flat = sift(GrayF32::new(64, 48, [0.7]).view(), &options).unwrap();
        assert!(flat.keypoints.is_empty() && flat.dropped.is_empty() && flat.beyond_limit == 0);
        for (w, h) in [(0, 0), (1, 1), (7, 100)] {
            let error = sift(GrayF32::new(w, h, [0.7]).view(), &options).unwrap_err();
            assert_eq!(error, FeatureError::ImageTooSmall { width: w, height: h, needed: 8 });
        }
        let mut image = GrayF32::new(64, 48, [0.7]);
        image.set(3, 4, [f32::NAN]);
        assert_eq!(sift(image.view(), &options), Err(FeatureError::NotFinite { x: 3, y: 4 }));
        let bad = SiftOptions { layers: 0, ..options };
        assert!(matches!(sift(image.view(), &bad), Err(FeatureError::BadOption { name: "layers", .. })));
    }
}
