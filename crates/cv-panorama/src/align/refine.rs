//! Sub-pixel refinement of matches by least-squares matching (Gruen 1985, "Adaptive least squares correlation"), and of the alignment with them.
//!
//! Feature positions have errors of some tenths of a pixel, from the scale space they are detected in. Around each inlier a patch of one photograph is registered to the
//! other, with a gain and an offset for exposure differences, which is accurate to some hundredths; the bundle adjustment is then repeated.

use crate::align::{AlignError, AlignOptions, Alignment, Photo, View, align};
use cv_core::{Cancelled, Correspondence, GrayU8, ImageView, Point2, Progress, Stage, Vector2};
use cv_geometry::VerifiedPair;
use cv_imgproc::{SAMPLE_LANES, bicubic_lanes};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch};
use nalgebra::{SMatrix, SVector};
use std::collections::HashSet;

/// Patch radius in pixels.
const RADIUS: usize = 9;
/// Side of a patch.
const SIDE: usize = 2 * RADIUS + 1;
/// Side of a patch with a margin of one pixel for gradients.
const WIDE: usize = SIDE + 2;
/// Pixels of a row whose products are summed at once.
const LANES: usize = 8;
/// Pixels of a row of a patch in whole vectors; those beyond [`SIDE`] are ignored.
const PADDED: usize = SIDE.next_multiple_of(LANES);
/// Row stride of a warped patch: whole vectors and the margin.
const STRIDE: usize = PADDED + 2;
/// Maximum number of patches per pair, and per photograph if it has several pairs.
const MAX_PATCHES: usize = 300;
/// Maximum number of patches in the second pass, side by side: errors of the focal length are inversely proportional to its square root.
const MAX_DENSE_PATCHES: usize = 1200;
/// Scale of the loss relative to that of features, without parallax.
const NARROW_LOSS_RATIO: f64 = 0.25;
/// Scale of the loss relative to the median residual of the refined matches, without parallax: their errors are 0.06 px but for one in ten, which has up to a pixel.
const LOSS_PER_MEDIAN: f64 = 2.5;
/// Minimum scale of that loss in pixels.
const MIN_LOSS_PX: f64 = 0.1;
/// Median error of the features, relative to the scale of the loss, above which there is parallax: features alone are good to a quarter.
const MAX_MEDIAN_RATIO: f64 = 0.4;
/// Minimum number of refined matches of a pair; below, its features are kept.
const MIN_MATCHES: usize = 20;
/// Maximum number of Gauss-Newton iterations.
const MAX_ITERATIONS: usize = 8;
/// Convergence tolerance in pixels.
const TOLERANCE_PX: f64 = 0.01;
/// Maximum correction of a match in pixels.
const MAX_CORRECTION_PX: f64 = 2.0;
/// Minimum correlation of the registered patches.
const MIN_CORRELATION: f64 = 0.7;
/// Maximum standard error of a registered position along either axis, in pixels, estimated from the residuals of the patch.
const MAX_STANDARD_ERROR_PX: f64 = 0.1;
/// Minimum smaller eigenvalue of the structure tensor of a patch: with noise of a gray level the standard error is the maximum.
const MIN_CORNER_STRENGTH: f64 = 1.0;
/// Level from which on a pixel is clipped.
const CLIPPED: u8 = 250;

/// Refines an alignment of `images`, of the sizes of `photos`, by the pixels around the matches of its pairs. O(matches · patch).
///
/// The matches of the result are those of `alignment`, with their errors by the refined views. Where the refined matches do not register the same photographs, `alignment` is returned.
///
/// # Errors
/// [`Cancelled`].
pub fn refine_alignment(
    images: &[GrayU8],
    photos: &[Photo],
    pairs: &[VerifiedPair],
    alignment: Alignment,
    options: &AlignOptions,
    progress: &dyn Progress,
) -> Result<Alignment, Cancelled> {
    let stage = Stage::new(progress, "align", 0)?;
    let aligned: HashSet<(usize, usize)> = alignment.pairs.iter().map(|p| (p.a, p.b)).collect();
    let pairs: Vec<&VerifiedPair> = pairs.iter().filter(|pair| aligned.contains(&(pair.a, pair.b))).collect();
    let refined: Vec<VerifiedPair> = pairs
        .par_iter()
        .map(|pair| {
            let matches = register_pair(images, &alignment, pair, MAX_PATCHES, &stage)?;
            let are_enough = matches.len() >= MIN_MATCHES;
            Ok(if are_enough { with_matches(pair, matches) } else { (*pair).clone() })
        })
        .try_collect::<_, Cancelled>()?;
    // Without parallax, residuals are those of the registration, and a narrow loss rejects what moved.
    let has_parallax = alignment.median_px > MAX_MEDIAN_RATIO * options.outlier_px;
    let outlier_px = options.outlier_px * if has_parallax { 1.0 } else { NARROW_LOSS_RATIO };
    let options = AlignOptions { motion: alignment.motion, outlier_px, ..*options };
    let solve = |start: &Alignment, pairs: &[VerifiedPair], options: &AlignOptions| {
        // The focal lengths found are where the search for better ones starts.
        let focal = |i: usize| start.views.get(i).and_then(|v| v.as_ref().ok()).map(|v| v.camera.fx);
        let photos: Vec<Photo> =
            photos.iter().enumerate().map(|(i, p)| Photo { focal: focal(i).or(p.focal), ..*p }).collect();
        align(&photos, pairs, options, progress)
    };
    let found = match solve(&alignment, &refined, &options) {
        // Now patches converge at once, and the median residual is known: registrations beyond a few times as far off are false.
        Ok(found) if !has_parallax => {
            let dense: Vec<VerifiedPair> = refined
                .par_iter()
                .map(|pair| {
                    let matches =
                        register_pair(images, &found, &with_matches(pair, Vec::new()), MAX_DENSE_PATCHES, &stage)?;
                    let are_more = matches.len() > pair.matches.len();
                    Ok(if are_more { with_matches(pair, matches) } else { pair.clone() })
                })
                .try_collect::<_, Cancelled>()?;
            let scale = (LOSS_PER_MEDIAN * found.median_px).clamp(MIN_LOSS_PX, options.outlier_px);
            solve(&found, &dense, &AlignOptions { outlier_px: scale, ..options })
        }
        other => other,
    };
    let mut found = match found {
        Ok(found) => found,
        Err(AlignError::Cancelled(stop)) => return Err(stop),
        Err(_) => return Ok(alignment),
    };
    let same = found.views.iter().zip(&alignment.views).all(|(a, b)| a.is_ok() == b.is_ok());
    if !same || found.pairs.len() != alignment.pairs.len() {
        return Ok(alignment);
    }
    (found.reference, found.views) = (alignment.reference, keep_reasons(found.views, &alignment));
    found.pairs = alignment.pairs;
    found.measure();
    Ok(found)
}

/// A pair with other matches.
fn with_matches(pair: &VerifiedPair, matches: Vec<Correspondence>) -> VerifiedPair {
    VerifiedPair { inliers: (0..matches.len()).collect(), matches, ..pair.clone() }
}

/// Registers patches of a pair, at most `most`, and per photograph if it has several pairs.
fn register_pair(
    images: &[GrayU8],
    alignment: &Alignment,
    pair: &VerifiedPair,
    most: usize,
    stage: &Stage<'_>,
) -> Result<Vec<Correspondence>, Cancelled> {
    stage.check()?;
    let view = |i: usize| alignment.views.get(i).and_then(|v| v.as_ref().ok());
    let (Some(from), Some(to)) = (view(pair.a), view(pair.b)) else { return Ok(Vec::new()) };
    let (Some(first), Some(second)) = (images.get(pair.a), images.get(pair.b)) else { return Ok(Vec::new()) };
    let count = (most * alignment.used().count() / alignment.pairs.len().max(1)).min(most);
    let level = Level::new();
    let candidates = candidates(pair, from, to, count);
    Ok(candidates.iter().filter_map(|m| refine_match(level, [first, second], from, to, m)).collect())
}

/// Positions where patches are registered: `count` at most, half of them at features, the others on a grid over the overlap.
fn candidates(pair: &VerifiedPair, from: &View, to: &View, count: usize) -> Vec<Correspondence> {
    let step = pair.matches.len().div_ceil(count / 2).max(1);
    let mut candidates: Vec<Correspondence> = pair.matches.iter().copied().step_by(step).collect();
    let transfer =
        |a: Point2<f64>| Some(Correspondence { a, b: to.project(&from.ray(a)?).filter(|b| to.contains(*b))? });
    let (width, height) = (from.camera.width as f64, from.camera.height as f64);
    // The overlap's area on a coarse grid gives the spacing of the fine one.
    let grid = |spacing: f64| {
        let (across, down) = ((width / spacing) as usize, (height / spacing) as usize);
        let place = move |i: usize| (i as f64 + 0.5) * spacing;
        (0..down).flat_map(move |y| (0..across).map(move |x| Point2::new(place(x), place(y))))
    };
    let coarse = (width * height / 400.0).sqrt().max(1.0);
    let covered = grid(coarse).filter(|a| transfer(*a).is_some()).count() as f64 * coarse * coarse;
    let spacing = (covered / (count - candidates.len().min(count)).max(1) as f64).sqrt().max(SIDE as f64);
    candidates.extend(grid(spacing).filter_map(transfer));
    candidates
}

/// The new views, and the old reasons of photographs without one.
fn keep_reasons(
    views: Vec<Result<View, crate::Unplaced>>,
    alignment: &Alignment,
) -> Vec<Result<View, crate::Unplaced>> {
    views.into_iter().zip(&alignment.views).map(|(new, old)| old.and(new)).collect()
}

/// Registers the patch around `m.a` to the second photograph; `None` where that fails: low texture, clipped pixels, low correlation, no convergence.
fn refine_match(
    level: Level,
    [first, second]: [&GrayU8; 2],
    from: &View,
    to: &View,
    m: &Correspondence,
) -> Option<Correspondence> {
    // At a pixel center, so that the template needs no interpolation.
    let (x, y) = (m.a.x.round(), m.a.y.round());
    let inside = |v: f64, n: usize| v >= RADIUS as f64 && v + RADIUS as f64 <= n as f64 - 1.0;
    if !inside(x, first.width()) || !inside(y, first.height()) {
        return None;
    }
    let a = Point2::new(x, y);
    let transfer = |p: Point2<f64>| to.project(&from.ray(p)?);
    let center = transfer(a)?;
    let warp = Warp::new(|i, j| transfer(a + Vector2::new(i, j)), center)?;
    let pixels = first.view().crop(x as usize - RADIUS, y as usize - RADIUS, SIDE, SIDE)?;
    if (0..SIDE).any(|row| pixels.row(row).iter().any(|v| *v >= CLIPPED)) || !has_texture(pixels) {
        return None;
    }
    let template = Template::new(pixels);
    let start = m.b + (center - transfer(m.a)?);
    let mut b = start;
    let mut patch = [0.0_f32; WIDE * STRIDE];
    for _ in 0..MAX_ITERATIONS {
        if !sample(level, second, b, &warp, &mut patch) {
            return None;
        }
        let step = gauss_newton_step(level, &template, &patch)?;
        b += warp.x * step.x + warp.y * step.y;
        if (b - start).norm() > MAX_CORRECTION_PX {
            return None;
        }
        if step.norm() < TOLERANCE_PX {
            return Some(Correspondence { a, b });
        }
    }
    None
}

/// Returns whether a template has gradients in both directions, before anything is sampled.
fn has_texture(template: ImageView<'_, u8, 1>) -> bool {
    let (mut xx, mut xy, mut yy) = (0, 0, 0);
    for y in 1..SIDE - 1 {
        let [above, row, below] = [y - 1, y, y + 1].map(|y| template.row(y));
        for x in 1..SIDE - 1 {
            let gx = i32::from(row[x + 1]) - i32::from(row[x - 1]);
            let gy = i32::from(below[x]) - i32::from(above[x]);
            (xx, xy, yy) = (xx + gx * gx, xy + gx * gy, yy + gy * gy);
        }
    }
    // Twice the gradient each, in gray levels per pixel.
    let [xx, xy, yy] = [xx, xy, yy].map(|v| f64::from(v) / (4 * (SIDE - 2) * (SIDE - 2)) as f64);
    0.5 * (xx + yy) - (0.25 * (xx - yy).powi(2) + xy * xy).sqrt() >= MIN_CORNER_STRENGTH
}

/// Offsets in the second photograph by offsets in the first, to second order. The affine part alone would be off by some hundredths of a pixel at the border of the patch, all
/// in one direction, which biases the focal length.
struct Warp {
    x: Vector2<f64>,
    y: Vector2<f64>,
    xx: Vector2<f64>,
    yy: Vector2<f64>,
    xy: Vector2<f64>,
}

impl Warp {
    /// From central differences of `transfer` over the patch.
    fn new(transfer: impl Fn(f64, f64) -> Option<Point2<f64>>, center: Point2<f64>) -> Option<Self> {
        let r = RADIUS as f64;
        let at = |i: f64, j: f64| Some(transfer(i * r, j * r)? - center);
        let [left, right, above, below] = [at(-1.0, 0.0)?, at(1.0, 0.0)?, at(0.0, -1.0)?, at(0.0, 1.0)?];
        let corners = at(1.0, 1.0)? + at(-1.0, -1.0)? - at(1.0, -1.0)? - at(-1.0, 1.0)?;
        Some(Self {
            x: (right - left) / (2.0 * r),
            y: (below - above) / (2.0 * r),
            xx: (right + left) / (2.0 * r * r),
            yy: (below + above) / (2.0 * r * r),
            xy: corners / (4.0 * r * r),
        })
    }

    /// Offsets along a row of the patch, `base + i · linear + i² · square`.
    fn row(&self, j: f64) -> [Vector2<f32>; 3] {
        [self.y * j + self.yy * (j * j), self.x + self.xy * j, self.xx].map(|v| v.cast())
    }

    fn at(&self, i: f64, j: f64) -> Vector2<f64> {
        self.x * i + self.y * j + self.xx * (i * i) + self.yy * (j * j) + self.xy * (i * j)
    }
}

/// Samples the warped patch around `b` with a margin of one pixel; false where it leaves the image.
fn sample(level: Level, image: &GrayU8, b: Point2<f64>, warp: &Warp, patch: &mut [f32; WIDE * STRIDE]) -> bool {
    let h = (WIDE / 2) as f64;
    let (right, bottom) = (image.width() as f64 - 2.0, image.height() as f64 - 2.0);
    let is_inside = |p: Point2<f64>| p.x.is_finite() && p.x >= 1.0 && p.y >= 1.0 && p.x <= right && p.y <= bottom;
    if ![(-h, -h), (h, -h), (-h, h), (h, h)].into_iter().all(|(i, j)| is_inside(b + warp.at(i, j))) {
        return false;
    }
    let b = b.coords.cast::<f32>();
    dispatch!(level, _simd => sample_rows(image, b, warp, patch));
    true
}

#[inline(always)]
fn sample_rows(image: &GrayU8, b: Vector2<f32>, warp: &Warp, patch: &mut [f32; WIDE * STRIDE]) {
    let offset = (WIDE / 2) as f32;
    let (mut us, mut vs) = ([0.0_f32; SAMPLE_LANES], [0.0_f32; SAMPLE_LANES]);
    for (j, row) in patch.chunks_exact_mut(STRIDE).enumerate() {
        let [base, linear, square] = warp.row(j as f64 - f64::from(offset));
        let start = b + base;
        for (first, values) in (0..).step_by(SAMPLE_LANES).zip(row[..WIDE].chunks_mut(SAMPLE_LANES)) {
            for k in 0..SAMPLE_LANES {
                let i = (first + k as i32) as f32 - offset;
                us[k] = start.x + linear.x * i + square.x * (i * i);
                vs[k] = start.y + linear.y * i + square.y * (i * i);
            }
            values.copy_from_slice(&bicubic_lanes(image, &us, &vs)[..values.len()]);
        }
    }
}

/// The patch of the first photograph, less its mean, and its sums.
struct Template {
    /// Rows of [`PADDED`] pixels.
    values: [f32; SIDE * PADDED],
    mean: f32,
    /// Sum of the squares of the values.
    squares: f64,
    /// Sums of the values times their column and row, from the center.
    moments: Vector2<f64>,
}

impl Template {
    fn new(pixels: ImageView<'_, u8, 1>) -> Self {
        let sum: u32 = (0..SIDE).flat_map(|j| pixels.row(j)).map(|v| u32::from(*v)).sum();
        let mean = sum as f32 / (SIDE * SIDE) as f32;
        let mut values = [0.0; SIDE * PADDED];
        let (mut squares, mut moments) = (0.0, Vector2::zeros());
        for (j, row) in values.chunks_exact_mut(PADDED).enumerate() {
            for (i, (value, pixel)) in row.iter_mut().zip(pixels.row(j)).enumerate() {
                *value = f32::from(*pixel) - mean;
                let t = f64::from(*value);
                squares += t * t;
                moments += Vector2::new(offset(i), offset(j)) * t;
            }
        }
        Self { values, mean, squares, moments }
    }
}

/// Offset of a row or column of a patch from its center.
fn offset(k: usize) -> f64 {
    k as f64 - RADIUS as f64
}

/// Sums over a patch of products of its gradients `gx` and `gy`, its values `s` and those `t` of the template, both less the template's mean; and row offsets `j`.
#[derive(Clone, Copy)]
enum Product {
    GxGx,
    GxGy,
    GxS,
    GyGy,
    GyS,
    SS,
    TGx,
    TGy,
    TS,
    Gx,
    Gy,
    S,
    JGx,
    JGy,
    JS,
}

/// Displacement, gain, offset and its slopes.
const UNKNOWNS: usize = 6;
/// Number of [`Product`]s.
const PRODUCTS: usize = Product::JS as usize + 1;

/// Sums every product over the columns of a patch, one sum per row position; `None` where a pixel is clipped.
#[inline(always)]
fn column_sums(template: &Template, patch: &[f32; WIDE * STRIDE], sums: &mut [[f32; PADDED]; PRODUCTS]) -> bool {
    let mut greatest = [f32::MIN; PADDED];
    for left in (0..PADDED).step_by(LANES) {
        let mut sum = [[0.0_f32; LANES]; PRODUCTS];
        let mut most = [f32::MIN; LANES];
        for j in 0..SIDE {
            let take = |start: usize| -> [f32; LANES] { std::array::from_fn(|k| patch[start + k]) };
            let start = (j + 1) * STRIDE + left + 1;
            let (before, row, after) = (take(start - 1), take(start), take(start + 1));
            let (above, below) = (take(start - STRIDE), take(start + STRIDE));
            let t: [f32; LANES] = std::array::from_fn(|k| template.values[j * PADDED + left + k]);
            let down = j as f32 - RADIUS as f32;
            for k in 0..LANES {
                let (gx, gy, s) = (0.5 * (after[k] - before[k]), 0.5 * (below[k] - above[k]), row[k] - template.mean);
                let of = [
                    gx * gx,
                    gx * gy,
                    gx * s,
                    gy * gy,
                    gy * s,
                    s * s,
                    t[k] * gx,
                    t[k] * gy,
                    t[k] * s,
                    gx,
                    gy,
                    s,
                    down * gx,
                    down * gy,
                    down * s,
                ];
                for (sum, value) in sum.iter_mut().zip(of) {
                    sum[k] += value;
                }
                most[k] = most[k].max(row[k]);
            }
        }
        for (all, sum) in sums.iter_mut().zip(sum) {
            all[left..left + LANES].copy_from_slice(&sum);
        }
        greatest[left..left + LANES].copy_from_slice(&most);
    }
    greatest[..SIDE].iter().all(|v| *v < f32::from(CLIPPED))
}

/// Computes the displacement `d` of the template in the patch by linear least squares, `T = g (S + ∇S · d) + o(u)`, with an offset `o` that is linear over the patch (vignetting, and
/// exposure differences); `None` for a low correlation, a large standard error, or clipped pixels.
fn gauss_newton_step(level: Level, template: &Template, patch: &[f32; WIDE * STRIDE]) -> Option<Vector2<f64>> {
    let mut columns = [[0.0; PADDED]; PRODUCTS];
    if !dispatch!(level, _simd => column_sums(template, patch, &mut columns)) {
        return None;
    }
    let sum = |p: Product| columns[p as usize][..SIDE].iter().map(|v| f64::from(*v)).sum::<f64>();
    // The same with column offsets.
    let across = |p: Product| {
        columns[p as usize][..SIDE].iter().enumerate().map(|(i, v)| offset(i) * f64::from(*v)).sum::<f64>()
    };
    use Product::{Gx, GxGx, GxGy, GxS, Gy, GyGy, GyS, JGx, JGy, JS, S, SS, TGx, TGy, TS};
    let n = (SIDE * SIDE) as f64;
    // Sum of the squares of the offsets along an axis.
    let spread = SIDE as f64 * (0..SIDE).map(|k| offset(k).powi(2)).sum::<f64>();
    // The lower triangle of the normal equations: gradients, values, 1, offsets of columns and rows.
    let rows: [&[f64]; UNKNOWNS] = [
        &[sum(GxGx)],
        &[sum(GxGy), sum(GyGy)],
        &[sum(GxS), sum(GyS), sum(SS)],
        &[sum(Gx), sum(Gy), sum(S), n],
        &[across(Gx), across(Gy), across(S), 0.0, spread],
        &[sum(JGx), sum(JGy), sum(JS), 0.0, 0.0, spread],
    ];
    let normal = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::from_fn(|r, c| rows[r.max(c)][r.min(c)]);
    // The template has a mean of zero.
    let (t_i, t_j) = (template.moments.x, template.moments.y);
    let right = SVector::<f64, UNKNOWNS>::from([sum(TGx), sum(TGy), sum(TS), 0.0, t_i, t_j]);
    let inverse = normal.cholesky()?.inverse();
    let solution = inverse * right;
    let gain = solution[2];
    // The residual of a linear fit: squares less what it explains.
    let residual = template.squares - solution.dot(&right);
    if !(0.1..10.0).contains(&gain) || residual > (1.0 - MIN_CORRELATION * MIN_CORRELATION) * template.squares {
        return None;
    }
    let variance = residual.max(0.0) / (n - UNKNOWNS as f64) / (gain * gain);
    let [along, down] = [inverse[(0, 0)], inverse[(1, 1)]].map(|v| v * variance);
    if (along + down).is_nan() || along.max(down) >= MAX_STANDARD_ERROR_PX * MAX_STANDARD_ERROR_PX {
        return None;
    }
    let step = Vector2::new(solution[0], solution[1]) / gain;
    // The linearization holds for a pixel or so.
    (step.norm() < MAX_CORRECTION_PX).then_some(step)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{inexact_matches as matches, lumas as images, three_views as views};

    #[test]
    fn registered_matches_have_the_accepted_standard_error_across_exposures_and_rotations() {
        let views = views();
        let images = images(&views);
        for (i, j) in [(0, 1), (1, 0), (1, 2)] {
            let (from, to) = (&views[i], &views[j]);
            let mut off = Vec::new();
            for m in matches(from, to, 0.7) {
                if let Some(found) = refine_match(Level::new(), [&images[i], &images[j]], from, to, &m) {
                    assert_eq!((found.a - m.a).map(|v| v.abs() <= 0.5), Vector2::new(true, true));
                    off.push((found.b - to.project(&from.ray(found.a).unwrap()).unwrap()).norm());
                }
            }
            off.sort_by(f64::total_cmp);
            // Waves of 30 px are longer than the patch, so that displacement, gain and offset are nearly collinear: the errors are those of the accepted standard error along both axes
            // (Rayleigh distribution: median 1.18 σ, 95 % 2.45 σ).
            let sigma = MAX_STANDARD_ERROR_PX;
            let (median, most) = (off[off.len() / 2], off[off.len() * 95 / 100]);
            assert!(off.len() > 60 && median < 1.18 * sigma && most < 2.45 * sigma, "{} {median} {most}", off.len());
        }
    }

    #[test]
    fn low_texture_clipped_and_foreign_patches_are_rejected() {
        let views = views();
        let images = images(&views);
        let m = matches(&views[0], &views[1], 0.0)[120];
        let refine = |second: &GrayU8| refine_match(Level::new(), [&images[0], second], &views[0], &views[1], &m);
        assert!(refine(&images[1]).is_some());
        assert_eq!(refine(&GrayU8::new(320, 240, [90])), None);
        assert_eq!(refine(&GrayU8::new(320, 240, [255])), None);
        let foreign = GrayU8::from_fn(320, 240, |x, y| [(((x / 3) * 7919 + (y / 3) * 104_729) % 200) as u8]);
        assert_eq!(refine(&foreign), None);
        // Off by more than a correction may be.
        let far = Correspondence { b: m.b + Vector2::new(6.0, 0.0), ..m };
        assert_eq!(refine_match(Level::new(), [&images[0], &images[1]], &views[0], &views[1], &far), None);
    }
}
