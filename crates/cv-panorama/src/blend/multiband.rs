//! Multi-band blending (Burt & Adelson 1983): low frequencies over a wide transition, high ones over a narrow one.
//!
//! Pixels are `[red, green, blue, weight]`, one vector register each. The weight of a photograph is the indicator of its label; its Gaussian pyramid is built
//! along with that of the colors. Outside a photograph its border pixels are replicated (see `warp`), so that no dark border bleeds in.
//!
//! At full resolution each pixel has one photograph `k` of weight one, so its Laplacian band is `p_k − up(G_k)`, with `G_k` the photograph at half resolution.
//! With `C` the blended canvas at half resolution the result is `p_k + up(C − G_k)`: no float image of full resolution is stored.

use crate::bit_depth::{Channel, Sum};
use crate::blend::{Blender, Composition};
use crate::rows::for_each_row_with;
use crate::surface::WarpedPhoto;
use cv_core::{Cancelled, Image, Progress, Stage};
use fearless_simd::dispatch;
use std::ops::RangeInclusive;

type Pixel = [f32; 4];

/// Bands above the coarse levels of [`CoarseLevels`], at most: those take a fiftieth of the memory of the whole pyramid then, and tiles overlap by some
/// hundred pixels.
const FINE_BANDS: usize = 3;

/// The coarse levels of the blended canvas. With them it is blended in tiles, each with the fine bands of its pixels only, to the same values as whole.
pub(crate) struct CoarseLevels {
    pyramid: Pyramid,
    /// Bands above the first level.
    fine: usize,
}

/// Bands that are fine in a pyramid of `bands` bands.
fn fine_bands(bands: usize) -> usize {
    FINE_BANDS.min(bands.max(1) - 1)
}

/// Returns the pixels by which a tile must be larger on each side: twice the support of the kernel, and three pixels for upsampling, at the first of the
/// coarse levels.
pub(crate) fn coarse_margin(bands: usize) -> usize {
    6 << (fine_bands(bands) + 1)
}

impl CoarseLevels {
    /// Creates the levels of a canvas of this size that is blended with `bands` bands.
    pub(crate) fn new(width: usize, height: usize, bands: usize) -> Self {
        let (bands, fine) = (bands.max(1), fine_bands(bands));
        Self { pyramid: Pyramid::new(width, height, fine + 1..=bands, true), fine }
    }

    /// Adds a photograph, in its own coordinates, at a position of the canvas; `labels` are those of its pixels. Photographs must be added in the order of their
    /// labels.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub(crate) fn add<T: Channel>(
        &mut self,
        (left, top): (usize, usize),
        photo: WarpedPhoto<T>,
        labels: &Image<u16, 1>,
        label: u16,
        stage: &Stage<'_>,
    ) -> Result<(), Cancelled> {
        let mut level = halve_photo(&photo, labels, label, stage)?;
        drop(photo);
        for _ in 0..self.fine {
            level = halve(&level, stage)?;
        }
        (level.left, level.top) = (left >> (self.fine + 1), top >> (self.fine + 1));
        self.pyramid.add(&level, stage)
    }

    /// Normalizes and collapses the levels.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub(crate) fn blended(self, stage: &Stage<'_>) -> Result<CoarseCanvas, Cancelled> {
        Ok(CoarseCanvas { level: self.pyramid.collapse(None, stage)?, fine: self.fine })
    }
}

/// The blended canvas without its fine bands.
pub(crate) struct CoarseCanvas {
    level: Level,
    fine: usize,
}

impl CoarseCanvas {
    /// Blends a tile that begins at column `left` and row `top` of the canvas; photographs and labels are those of its pixels, in its coordinates. Its sides
    /// must lie on multiples of 2^bands, or on those of the canvas. Pixels closer to them than [`coarse_margin`] are not valid, except at the sides of the canvas.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub(crate) fn tile<T: Channel>(
        &self,
        (left, top): (usize, usize),
        photos: &[Option<WarpedPhoto<T>>],
        labels: &Image<u16, 1>,
        stage: &Stage<'_>,
    ) -> Result<Image<T, 3>, Cancelled> {
        let unit = 1 << (self.fine + 1);
        let columns = left / unit..(left + labels.width()).div_ceil(unit).min(self.level.width);
        let rows = top / unit..(top + labels.height()).div_ceil(unit).min(self.level.height);
        let base = Level {
            left: 0,
            top: 0,
            width: columns.len(),
            height: rows.len(),
            data: rows.flat_map(|y| &self.level.row(y)[columns.clone()]).copied().collect(),
        };
        join(photos, labels, self.fine, Some(base), stage)
    }
}

/// A rectangle of a pyramid level with its top-left corner at `(left, top)` of that level of the canvas.
struct Level {
    left: usize,
    top: usize,
    width: usize,
    height: usize,
    data: Vec<Pixel>,
}

impl Level {
    fn new(left: usize, top: usize, width: usize, height: usize) -> Self {
        Self { left, top, width, height, data: vec![[0.0; 4]; width * height] }
    }

    fn row(&self, y: usize) -> &[Pixel] {
        &self.data[y * self.width..(y + 1) * self.width]
    }
}

/// Multi-band blending with transitions of 1/25 of a photograph in either direction.
pub(crate) struct Multiband;

impl<T: Channel> Blender<T> for Multiband {
    fn pyramid_levels(&self, typical_side: f64) -> usize {
        ((0.04 * typical_side).max(1.0).log2().round() as usize).clamp(1, 8)
    }

    fn blend(&self, composition: &Composition<'_, T>, progress: &dyn Progress) -> Result<Image<T, 3>, Cancelled> {
        let stage = Stage::new(progress, "blend", composition.photos.len() + 1)?;
        let bands = Blender::<T>::pyramid_levels(self, composition.typical_side);
        let image = join(composition.photos, composition.labels, bands.max(1), None, &stage)?;
        stage.add(1)?;
        Ok(image)
    }
}

/// Blends the photographs with `bands` Laplacian bands above the residual; black without a label. The residual is `base`, blended at the level below the
/// bands, or else that of these photographs (with one band or more).
fn join<T: Channel>(
    photos: &[Option<WarpedPhoto<T>>],
    labels: &Image<u16, 1>,
    bands: usize,
    base: Option<Level>,
    stage: &Stage<'_>,
) -> Result<Image<T, 3>, Cancelled> {
    let (width, height) = labels.size();
    let mut pyramid = Pyramid::new(width, height, 1..=bands, base.is_none());
    let mut halves = Vec::with_capacity(photos.len());
    for (label, photo) in photos.iter().enumerate() {
        let half = photo.as_ref().map(|photo| halve_photo(photo, labels, label as u16, stage)).transpose()?;
        if let Some(half) = &half {
            pyramid.add(half, stage)?;
        }
        halves.push(half);
        stage.add(1)?;
    }
    let canvas = pyramid.collapse(base, stage)?;
    for half in halves.iter_mut().flatten() {
        let (left, top, width) = (half.left, half.top, half.width);
        for_each_row_with(
            &mut half.data,
            width,
            stage,
            || (),
            |(), y, row| {
                for (p, c) in row.as_flattened_mut().iter_mut().zip(canvas.row(top + y)[left..].as_flattened()) {
                    *p = c - *p;
                }
            },
        )?;
    }
    drop(canvas);
    let mut image = Image::new(width, height, [T::default(); 3]);
    let level = fearless_simd::Level::new();
    for_each_row_with(image.as_mut_slice(), 3 * width, stage, Vec::new, |buffer, y, row| {
        let (row, labels) = (row.as_chunks_mut::<3>().0, labels.row(y));
        let mut start = 0;
        for run in labels.chunk_by(|a, b| a == b) {
            let range = start..start + run.len();
            start = range.end;
            let label = usize::from(run[0]);
            let (Some(Some(photo)), Some(Some(change))) = (photos.get(label), halves.get(label)) else { continue };
            let source = &photo.pixels.row(y - photo.bounds.top).as_chunks::<4>().0[range.start - photo.bounds.left..];
            let out = &mut row[range.clone()];
            dispatch!(level, _simd => {
                let up = enlarged_row(change, range.start, y, out.len(), buffer);
                for ((out, p), up) in out.iter_mut().zip(source).zip(up) {
                    for c in 0..3 {
                        out[c] = T::from_f32(p[c].to_f32() + up[c]);
                    }
                }
            });
        }
    })?;
    Ok(image)
}

/// A range of levels of a Laplacian pyramid of weighted sums.
struct Pyramid {
    levels: Vec<Level>,
    /// Whether the last level is the residual, not a band.
    has_residual: bool,
}

impl Pyramid {
    /// Creates the levels `range` of the pyramid of a canvas of this (full) size; level 1 has half its resolution.
    fn new(width: usize, height: usize, range: RangeInclusive<usize>, has_residual: bool) -> Self {
        let levels = range.map(|l| Level::new(0, 0, width.div_ceil(1 << l), height.div_ceil(1 << l))).collect();
        Self { levels, has_residual }
    }

    /// Adds a photograph at the resolution of the first level.
    fn add(&mut self, half: &Level, stage: &Stage<'_>) -> Result<(), Cancelled> {
        let count = self.levels.len() - usize::from(self.has_residual);
        let (bands, residual) = self.levels.split_at_mut(count);
        let mut smaller: Option<Level> = None;
        for sum in bands {
            let level = smaller.as_ref().unwrap_or(half);
            let next = halve(level, stage)?;
            add_band(sum, level, Some(&next), stage)?;
            smaller = Some(next);
        }
        match residual.first_mut() {
            Some(last) => add_band(last, smaller.as_ref().unwrap_or(half), None, stage),
            None => Ok(()),
        }
    }

    /// Normalizes and collapses the levels to the blended canvas at the resolution of the first; `base` is the blended canvas at the level after the last
    /// band, where the pyramid has no residual.
    fn collapse(mut self, base: Option<Level>, stage: &Stage<'_>) -> Result<Level, Cancelled> {
        let simd = fearless_simd::Level::new();
        for level in &mut self.levels {
            for_each_row_with(
                &mut level.data,
                level.width,
                stage,
                || (),
                |(), _, row| {
                    for p in row {
                        // Weights below 1/1000 are outside every blending range.
                        let scale = if p[3] > 1e-3 { 1.0 / p[3] } else { 0.0 };
                        *p = [p[0] * scale, p[1] * scale, p[2] * scale, 0.0];
                    }
                },
            )?;
        }
        let mut canvas = base.or_else(|| self.levels.pop()).unwrap_or_else(|| Level::new(0, 0, 0, 0));
        while let Some(mut larger) = self.levels.pop() {
            for_each_row_with(&mut larger.data, larger.width, stage, Vec::new, |buffer, y, row| {
                dispatch!(simd, _simd => {
                    let up = enlarged_row(&canvas, 0, y, row.len(), buffer);
                    for (p, up) in row.as_flattened_mut().iter_mut().zip(up.as_flattened()) {
                        *p += up;
                    }
                });
            })?;
            canvas = larger;
        }
        Ok(canvas)
    }
}

/// Applies Burt's binomial kernel 1 4 6 4 1.
#[inline(always)]
fn kernel(p: [Pixel; 5]) -> Pixel {
    let mut sum = [0.0; 4];
    for (i, sum) in sum.iter_mut().enumerate() {
        *sum = (p[0][i] + p[4][i]) * 0.0625 + (p[1][i] + p[3][i]) * 0.25 + p[2][i] * 0.375;
    }
    sum
}

/// Computes the first pyramid level of a photograph and of the indicator of its label, with replicated borders; exact in integers.
fn halve_photo<T: Channel>(
    photo: &WarpedPhoto<T>,
    labels: &Image<u16, 1>,
    label: u16,
    stage: &Stage<'_>,
) -> Result<Level, Cancelled> {
    let b = photo.bounds;
    let (w, h) = (b.width(), b.height());
    let mut half = Level::new(b.left / 2, b.top / 2, w.div_ceil(2), h.div_ceil(2));
    let (width, level) = (half.width, fearless_simd::Level::new());
    for_each_row_with(
        &mut half.data,
        width,
        stage,
        || (vec![[T::Sum::default(); 4]; w], vec![0_u16; w]),
        |(colors, weights), y, row| {
            let line = |dy: usize| (2 * y + dy).saturating_sub(2).min(h - 1);
            let pixels: [&[T]; 5] = std::array::from_fn(|k| photo.pixels.row(line(k)));
            let names: [&[u16]; 5] = std::array::from_fn(|k| &labels.row(b.top + line(k))[b.left..b.right]);
            dispatch!(level, _simd => {
                down_the_columns(pixels, colors.as_flattened_mut(), #[inline(always)] |v: T| v.widened());
                down_the_columns(names, weights, #[inline(always)] |v| u16::from(v == label));
                along_the_row(colors, weights, row);
            });
        },
    )?;
    Ok(half)
}

/// Vertical pass of the binomial filter, scaled by 16.
#[inline(always)]
fn down_the_columns<T: Copy, S: Sum>(rows: [&[T]; 5], out: &mut [S], value: impl Fn(T) -> S) {
    let n = out.len();
    let [a, b, c, d, e] = rows.map(|row| &row[..n]);
    for (i, out) in out.iter_mut().enumerate() {
        *out = value(a[i]) + value(e[i]) + S::from(4_u8) * (value(b[i]) + value(d[i])) + S::from(6_u8) * value(c[i]);
    }
}

/// Horizontal pass of the binomial filter and decimation by two; sums are at most 256 times white.
#[inline(always)]
fn along_the_row<S: Sum>(colors: &[[S; 4]], weights: &[u16], out: &mut [Pixel]) {
    let last = colors.len() - 1;
    for (x, out) in out.iter_mut().enumerate() {
        let x = 2 * x;
        if x >= 2 && x + 2 <= last {
            *out = blurred(colors, weights, [x - 2, x - 1, x, x + 1, x + 2]);
        } else {
            *out = blurred(colors, weights, [0, 1, 2, 3, 4].map(|k: usize| (x + k).saturating_sub(2).min(last)));
        }
    }
}

#[inline(always)]
fn blurred<S: Sum>(colors: &[[S; 4]], weights: &[u16], k: [usize; 5]) -> Pixel {
    let mut pixel = [0.0; 4];
    let [p, q, r, s, t] = k.map(|k| colors[k]);
    for (c, v) in pixel.iter_mut().enumerate() {
        *v = (p[c] + t[c] + S::from(4_u8) * (q[c] + s[c]) + S::from(6_u8) * r[c]).to_f32() * (1.0 / 256.0);
    }
    let sum = weights[k[0]] + weights[k[4]] + 4 * (weights[k[1]] + weights[k[3]]) + 6 * weights[k[2]];
    pixel[3] = f32::from(sum) * (1.0 / 256.0);
    pixel
}

/// Computes the next pyramid level: binomial filter and decimation by two, with replicated borders.
fn halve(level: &Level, stage: &Stage<'_>) -> Result<Level, Cancelled> {
    let (w, h) = (level.width, level.height);
    let mut half = Level::new(level.left / 2, level.top / 2, w.div_ceil(2), h.div_ceil(2));
    let (width, simd) = (half.width, fearless_simd::Level::new());
    for_each_row_with(
        &mut half.data,
        width,
        stage,
        || vec![[0.0; 4]; w],
        |column, y, row| {
            let rows: [&[f32]; 5] =
                std::array::from_fn(|k| level.row((2 * y + k).saturating_sub(2).min(h - 1)).as_flattened());
            dispatch!(simd, _simd => halved_row(rows, column, row));
        },
    )?;
    Ok(half)
}

#[inline(always)]
fn halved_row(rows: [&[f32]; 5], column: &mut [Pixel], out: &mut [Pixel]) {
    let n = 4 * column.len();
    let [a, b, c, d, e] = rows.map(|row| &row[..n]);
    for (i, out) in column.as_flattened_mut().iter_mut().enumerate() {
        *out = (a[i] + e[i]) * 0.0625 + (b[i] + d[i]) * 0.25 + c[i] * 0.375;
    }
    let last = column.len() - 1;
    for (x, out) in out.iter_mut().enumerate() {
        let x = 2 * x;
        *out = if x >= 2 && x + 2 <= last {
            kernel([column[x - 2], column[x - 1], column[x], column[x + 1], column[x + 2]])
        } else {
            kernel([0, 1, 2, 3, 4].map(|k: usize| column[(x + k).saturating_sub(2).min(last)]))
        };
    }
}

/// Upsamples pixels `left` to `left + width` of row `y` of the next finer level into the buffer.
#[inline(always)]
fn enlarged_row<'b>(small: &Level, left: usize, y: usize, width: usize, buffer: &'b mut Vec<Pixel>) -> &'b [Pixel] {
    let (w, h) = (small.width, small.height);
    let (y, left) = (y - 2 * small.top, left - 2 * small.left);
    // Required columns with one more on either side, replicated at the border.
    let (first, last) = (left / 2, (left + width).div_ceil(2));
    let columns = last + 2 - first;
    buffer.clear();
    buffer.resize(columns + 2 * (last - first), [0.0; 4]);
    let (column, up) = buffer.split_at_mut(columns);
    let line = |y: usize| small.row(y.min(h - 1)).as_flattened();
    // Range of the coarse level that is copied.
    let (from, to) = (first.saturating_sub(1), (last + 1).min(w));
    let inner = &mut column[from + 1 - first..][..to - from];
    let part = 4 * from..4 * to;
    let inner = inner.as_flattened_mut();
    if y.is_multiple_of(2) {
        let (a, b, c) =
            (&line((y / 2).saturating_sub(1))[part.clone()], &line(y / 2)[part.clone()], &line(y / 2 + 1)[part]);
        for (i, out) in inner.iter_mut().enumerate() {
            *out = (a[i] + c[i]) * 0.125 + b[i] * 0.75;
        }
    } else {
        let (a, b) = (&line(y / 2)[part.clone()], &line(y / 2 + 1)[part]);
        for (i, out) in inner.iter_mut().enumerate() {
            *out = (a[i] + b[i]) * 0.5;
        }
    }
    if first == 0 {
        column[0] = column[1];
    }
    if last + 1 > w {
        column[columns - 1] = column[columns - 2];
    }
    for (pair, c) in up.as_chunks_mut::<2>().0.iter_mut().zip(column.windows(3)) {
        for i in 0..4 {
            pair[0][i] = (c[0][i] + c[2][i]) * 0.125 + c[1][i] * 0.75;
            pair[1][i] = (c[1][i] + c[2][i]) * 0.5;
        }
    }
    &up[left - 2 * first..][..width]
}

/// Adds `weight · (level − enlarged(smaller))` and the weight.
fn add_band(sum: &mut Level, level: &Level, smaller: Option<&Level>, stage: &Stage<'_>) -> Result<(), Cancelled> {
    let (left, width, row_width) = (level.left, level.width, sum.width);
    let simd = fearless_simd::Level::new();
    let rows = &mut sum.data[level.top * row_width..][..level.height * row_width];
    for_each_row_with(rows, row_width, stage, Vec::new, |buffer, y, row| {
        let source = level.row(y);
        let row = &mut row[left..left + width];
        let Some(smaller) = smaller else {
            for (out, p) in row.iter_mut().zip(source) {
                *out = [out[0] + p[3] * p[0], out[1] + p[3] * p[1], out[2] + p[3] * p[2], out[3] + p[3]];
            }
            return;
        };
        dispatch!(simd, _simd => {
            let up = enlarged_row(smaller, left, level.top + y, width, buffer);
            for ((out, p), up) in row.iter_mut().zip(source).zip(up) {
                let w = p[3];
                *out =
                    [out[0] + w * (p[0] - up[0]), out[1] + w * (p[1] - up[1]), out[2] + w * (p[2] - up[2]), out[3] + w];
            }
        });
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::blend::NO_PHOTO;
    use crate::surface::Bounds;
    use crate::testing::{drawn, stage};

    /// Photographs of the whole canvas joined with so many bands.
    fn joined(photos: &[WarpedPhoto], labels: &Image<u16, 1>, bands: usize) -> Image<u8, 3> {
        let photos: Vec<_> = photos.iter().cloned().map(Some).collect();
        join(&photos, labels, bands, None, &stage()).unwrap()
    }

    fn scene(x: usize, y: usize) -> [u8; 3] {
        [((x * 7 + y * 3) % 251) as u8, ((x * y) % 241) as u8, if (x / 5 + y / 7).is_multiple_of(2) { 30 } else { 220 }]
    }

    #[test]
    fn photographs_of_one_picture_give_that_picture_back_at_any_size_and_depth() {
        for (w, h) in [(97, 61), (64, 64), (33, 18), (5, 3), (1, 1)] {
            for bands in 1..6 {
                let labels = Image::from_fn(w, h, |x, _| [u16::from(x > w / 2)]);
                let whole = Bounds { left: 0, top: 0, right: w, bottom: h };
                let result = joined(&[drawn(whole, scene), drawn(whole, scene)], &labels, bands);
                for y in 0..h {
                    for x in 0..w {
                        // Bands are taken off and put back in f32: exact but for rounding, far from half a level.
                        assert_eq!(result.at(x, y), scene(x, y), "{w}x{h} {bands}: {x} {y}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_photograph_that_ends_at_its_margin_still_gives_the_picture_back() {
        let (w, h, bands) = (300, 40, 3);
        let labels = Image::from_fn(w, h, |x, _| [u16::from(x >= 150)]);
        let halves =
            [Bounds { left: 0, top: 0, right: 150, bottom: h }, Bounds { left: 150, top: 0, right: w, bottom: h }];
        let photos = halves.map(|b| {
            let region = b.for_pyramid(bands, w, h);
            assert!(region.width() < 200);
            drawn(region, scene)
        });
        let result = joined(&photos, &labels, bands);
        for y in 0..h {
            for x in 0..w {
                for (got, want) in result.at(x, y).into_iter().zip(scene(x, y)) {
                    // Beyond the margin a photograph repeats its edge; the weights there are the tail of the kernel.
                    assert!(got.abs_diff(want) <= 1, "{x} {y}: {got} {want}");
                }
            }
        }
    }

    #[test]
    fn a_step_in_brightness_becomes_a_slope_and_stays_between_its_sides() {
        let (w, h, bands) = (256, 32, 4);
        let labels = Image::from_fn(w, h, |x, _| [u16::from(x >= 128)]);
        let whole = Bounds { left: 0, top: 0, right: w, bottom: h };
        let result = joined(&[drawn(whole, |_, _| [100; 3]), drawn(whole, |_, _| [140; 3])], &labels, bands);
        let row: Vec<u8> = (0..w).map(|x| result.at(x, 16)[0]).collect();
        assert_eq!((row[0], row[255]), (100, 140));
        assert!(row.windows(2).all(|p| p[1] >= p[0] && p[1] - p[0] <= 3), "{row:?}");
        assert!((118..=122).contains(&row[128]));
    }

    #[test]
    fn what_nobody_covers_is_black_and_darkens_nothing() {
        let (w, h, bands) = (120, 60, 4);
        let inside = |x: usize, y: usize| (21..100).contains(&x) && (10..50).contains(&y);
        let labels = Image::from_fn(w, h, |x, y| [if inside(x, y) { 0 } else { NO_PHOTO }]);
        let whole = Bounds { left: 0, top: 0, right: w, bottom: h };
        let result = joined(&[drawn(whole, |_, _| [90, 180, 45])], &labels, bands);
        for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
            assert_eq!(result.at(x, y), if inside(x, y) { [90, 180, 45] } else { [0; 3] });
        }
    }
}
