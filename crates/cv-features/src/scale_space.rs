//! The Gaussian scale space of an image and its differences, computed in one pass per octave.
//!
//! An octave is processed in tiles. Within a tile, pairs of rows stream through all scales: each scale buffers only the
//! rows that later windows need, so a tile fits the cache. Scales are computed from every second pixel of previous ones
//! (see `scale_recipes.rs`) and stored at half the octave's resolution for the descriptors, whose sample spacing is at
//! least 1.5 octave pixels. Tiles overlap by the window radii; results do not depend on the tiling.

use crate::dog::{DogOptions, Extremum, detect_extrema};
use crate::line_buffer::LineBuffer;
use crate::scale_recipes::{DEPENDENCY_MARGIN_PAIRS, Dependencies, Recipe, recipes};
use crate::simd;
use cv_core::{Cancelled, GrayF32, Image, ImageView, Progress, Stage};
use cv_imgproc::{mirror_ends, mirror_index};
use cv_parallel::prelude::*;
use fearless_simd::Level;
use std::iter::successors;
use std::ops::Range;

/// Columns of a tile: the buffered rows of all scales (about 170 with default options) then take less than a megabyte.
const TILE_COLUMNS: usize = 1024;
/// Maximum rows of a strip: each has about 20 rows of overlap.
const MAX_STRIP_ROWS: usize = 512;
/// Pairs of rows between checks for cancellation: some milliseconds.
const PAIRS_PER_CHECK: usize = 32;
/// Minimum shorter side of an octave in pixels.
const MIN_SIDE: usize = 12;

/// The scales 1 to `layers` of an octave, for the descriptors.
pub(crate) struct Octave {
    /// Scale `i + 1` at half the octave's resolution: σ = `sigma · 2^((i + 1) / layers) / 2` of its pixels, quantized
    /// to 0 to 65535 from the minimum to the maximum intensity of the image.
    pub(crate) scales: Vec<Image<u16, 1>>,
    /// Size of an octave pixel in input pixels; pixels of `scales` are twice as large.
    pub(crate) pixel: f32,
}

/// Source of an octave.
enum Source<'a> {
    /// An image of half the octave's resolution: octave pixel `u` is at `u / 2`.
    Upsampled(ImageView<'a, f32, 1>),
    /// Scale 0 of the octave.
    ScaleZero(GrayF32),
}

impl Source<'_> {
    fn size(&self) -> (usize, usize) {
        match self {
            Self::Upsampled(view) => (2 * view.width(), 2 * view.height()),
            Self::ScaleZero(image) => image.size(),
        }
    }
}

/// Row buffers of a tile.
#[derive(Default)]
struct Buffer {
    padded: [Vec<f32>; 2],
    phases: [Vec<f32>; 3],
}

/// Input and parameters shared by all tiles of an octave.
struct Plan<'a> {
    source: &'a Source<'a>,
    options: &'a DogOptions,
    index: usize,
    recipes: Vec<Recipe>,
    dependencies: Dependencies,
    width: usize,
    height: usize,
    offset: f32,
    gain: f32,
    level: Level,
}

/// The output rows of a strip at half resolution; strips start at an even row.
struct Strip<'a> {
    y0: usize,
    y1: usize,
    scales: Vec<&'a mut [u16]>,
    /// Rows of scale `layers`, the source of the next octave.
    next: &'a mut [f32],
}

/// Builds all octaves and detects the extrema of their differences of Gaussians, by decreasing contrast.
pub(crate) fn scale_space(
    view: ImageView<'_, f32, 1>,
    options: &DogOptions,
    progress: &dyn Progress,
) -> Result<(Vec<Octave>, Vec<Extremum>), Cancelled> {
    let (min, max) = intensity_range(view);
    let gain = if max > min { 65535.0 / (max - min) } else { 0.0 };
    let (mut source, mut pixel) = if options.upsample {
        (Source::Upsampled(view), 0.5)
    } else {
        (Source::ScaleZero(cv_imgproc::gaussian_blur(view, options.sigma)), 1.0)
    };
    let halved = |&(w, h): &(usize, usize)| Some((w.div_ceil(2), h.div_ceil(2)));
    let sizes = successors(Some(source.size()), halved).take_while(|&(w, h)| w.min(h) >= MIN_SIDE);
    let stage =
        Stage::new(progress, "scale space", sizes.map(|(w, h)| strip_count(h) * w.div_ceil(TILE_COLUMNS)).sum())?;
    let (mut octaves, mut extrema) = (Vec::new(), Vec::new());
    while source.size().0.min(source.size().1) >= MIN_SIDE {
        let (width, height) = source.size();
        let recipes = recipes(options.layers, options.sigma, matches!(source, Source::Upsampled(_)));
        let plan = Plan {
            source: &source,
            options,
            index: octaves.len(),
            dependencies: Dependencies::new(&recipes),
            recipes,
            width,
            height,
            offset: min,
            gain,
            level: simd::level(),
        };
        let (scales, next, found) = process_octave(&plan, &stage)?;
        extrema.extend(found);
        octaves.push(Octave { scales, pixel });
        source = Source::ScaleZero(next);
        pixel *= 2.0;
    }
    let location = |e: &Extremum| (e.octave, e.layer, e.row, e.column);
    extrema.sort_by(|a, b| b.contrast.total_cmp(&a.contrast).then(location(a).cmp(&location(b))));
    // Two candidates may converge to the same extremum.
    extrema.dedup_by(|a, b| location(a) == location(b));
    Ok((octaves, extrema))
}

/// Computes the minimum and maximum intensity.
fn intensity_range(view: ImageView<'_, f32, 1>) -> (f32, f32) {
    let rows: Vec<(f32, f32)> = (0..view.height())
        .into_par_iter()
        .with_min_len(64)
        .map(|y| {
            let min = |a: f32, b: f32| if b < a { b } else { a };
            let max = |a: f32, b: f32| if b > a { b } else { a };
            let mut low = [f32::INFINITY; 16];
            let mut high = [f32::NEG_INFINITY; 16];
            let (blocks, rest) = view.row(y).as_chunks::<16>();
            for block in blocks {
                for i in 0..16 {
                    low[i] = min(low[i], block[i]);
                    high[i] = max(high[i], block[i]);
                }
            }
            let low = low.into_iter().chain(rest.iter().copied()).fold(f32::INFINITY, min);
            (low, high.into_iter().chain(rest.iter().copied()).fold(f32::NEG_INFINITY, max))
        })
        .collect();
    rows.into_iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), (c, d)| (a.min(c), b.max(d)))
}

/// Returns the number of strips, a multiple of the number of threads.
fn strip_count(height: usize) -> usize {
    let threads = rayon::current_num_threads();
    threads * height.div_ceil(threads * MAX_STRIP_ROWS)
}

/// The stored scales of an octave, the source of the next octave, and the extrema.
type OctaveResult = (Vec<Image<u16, 1>>, GrayF32, Vec<Extremum>);

/// Processes an octave.
fn process_octave(plan: &Plan<'_>, stage: &Stage<'_>) -> Result<OctaveResult, Cancelled> {
    let (w, h) = (plan.width, plan.height);
    let (half_w, half_h) = (w.div_ceil(2), h.div_ceil(2));
    let mut scales: Vec<Image<u16, 1>> = (0..plan.options.layers).map(|_| Image::new(half_w, half_h, [0])).collect();
    let mut next = GrayF32::new(half_w, half_h, [0.0]);
    // An even number of rows. The result does not depend on it.
    let rows = h.div_ceil(strip_count(h)).next_multiple_of(2).max(2);
    let mut strips: Vec<Strip<'_>> = next
        .as_mut_slice()
        .chunks_mut(rows / 2 * half_w)
        .enumerate()
        .map(|(i, next)| Strip { y0: i * rows, y1: ((i + 1) * rows).min(h), scales: Vec::new(), next })
        .collect();
    for image in &mut scales {
        for (strip, part) in strips.iter_mut().zip(image.as_mut_slice().chunks_mut(rows / 2 * half_w)) {
            strip.scales.push(part);
        }
    }
    let extrema: Vec<Vec<Extremum>> = strips
        .into_par_iter()
        .map(|mut strip| {
            let mut extrema = Vec::new();
            let mut tile = Tile::new(plan, &strip);
            for x0 in (0..w).step_by(TILE_COLUMNS) {
                tile.run(x0..(x0 + TILE_COLUMNS).min(w), &mut strip, &mut extrema, stage)?;
                stage.add(1)?;
            }
            Ok(extrema)
        })
        .try_collect::<_, Cancelled>()?;
    Ok((scales, next, extrema.into_iter().flatten().collect()))
}

/// A range of columns of a strip, and its line buffers.
struct Tile<'a> {
    plan: &'a Plan<'a>,
    columns: Range<usize>,
    /// Pairs of rows of the strip.
    pairs: Range<usize>,
    /// The scales at full resolution.
    fine: Vec<LineBuffer>,
    /// The scales at half resolution (every second pixel of every second row), also in the column indices.
    coarse: Vec<LineBuffer>,
    differences: Vec<LineBuffer>,
    buffer: Buffer,
}

impl<'a> Tile<'a> {
    fn new(plan: &'a Plan<'a>, strip: &Strip<'_>) -> Self {
        let buffers = |n: usize| (0..n).map(|_| LineBuffer::new(0..0, 1)).collect::<Vec<_>>();
        let scales = plan.recipes.len();
        Self {
            plan,
            columns: 0..0,
            pairs: strip.y0 / 2..strip.y1.div_ceil(2),
            fine: buffers(scales),
            coarse: buffers(scales),
            differences: buffers(scales - 1),
            buffer: Buffer::default(),
        }
    }

    /// Resizes the buffers for another range of columns.
    fn set_columns(&mut self, columns: Range<usize>) {
        let (w, dependencies) = (self.plan.width, &self.plan.dependencies);
        let (left, right) = (columns.start / 2, columns.end.div_ceil(2));
        let coarse = |by: usize| left.saturating_sub(by)..(right + by).min(w.div_ceil(2));
        let fine = |by: usize| 2 * left.saturating_sub(by)..(2 * (right + by)).min(w);
        for i in 0..self.plan.recipes.len() {
            self.fine[i].resize(fine(dependencies.fine[i]), dependencies.fine_rows[i]);
            self.coarse[i].resize(coarse(dependencies.margin(i)), dependencies.coarse_rows[i]);
        }
        for (difference, rows) in self.differences.iter_mut().zip(&dependencies.difference_rows) {
            difference.resize(fine(DEPENDENCY_MARGIN_PAIRS), *rows);
        }
        self.columns = columns;
    }

    /// Returns whether `pair` is in the tile extended by `margin` pairs.
    fn is_within(&self, pair: usize, margin: usize) -> bool {
        (self.pairs.start.saturating_sub(margin)..self.pairs.end + margin).contains(&pair)
            && 2 * pair < self.plan.height
    }

    /// Streams the rows of a range of columns through all scales.
    fn run(
        &mut self,
        columns: Range<usize>,
        strip: &mut Strip<'_>,
        found: &mut Vec<Extremum>,
        stage: &Stage<'_>,
    ) -> Result<(), Cancelled> {
        self.set_columns(columns);
        let Plan { dependencies, options, .. } = self.plan;
        let (w, h) = (self.plan.width, self.plan.height);
        let margin = (0..self.plan.recipes.len()).map(|i| dependencies.margin(i)).max().unwrap_or(0);
        for step in self.pairs.start.saturating_sub(margin)..self.pairs.end + dependencies.detection_delay {
            if step.is_multiple_of(PAIRS_PER_CHECK) {
                stage.check()?;
            }
            for i in 0..self.plan.recipes.len() {
                let Some(pair) =
                    step.checked_sub(dependencies.delay[i]).filter(|&p| self.is_within(p, dependencies.margin(i)))
                else {
                    continue;
                };
                let is_full_resolution = self.is_within(pair, dependencies.fine[i]);
                self.compute_scale(i, pair, is_full_resolution);
                if i > 0 && self.is_within(pair, DEPENDENCY_MARGIN_PAIRS) {
                    self.subtract(i, pair);
                }
                if (1..=options.layers).contains(&i) && self.pairs.contains(&pair) {
                    self.store(i, pair, strip);
                }
            }
            // The differences are now available `WINDOW_RADIUS` rows below this pair, or to the end of the image.
            if let Some(pair) = step.checked_sub(dependencies.detection_delay).filter(|p| self.pairs.contains(p)) {
                for y in 2 * pair..(2 * pair + 2).min(h) {
                    let columns = self.columns.clone();
                    detect_extrema(
                        &self.differences,
                        self.plan.index,
                        options,
                        (w, h),
                        y,
                        columns,
                        self.plan.level,
                        found,
                    );
                }
            }
        }
        Ok(())
    }

    /// Computes a pair of rows of scale `i`: at half resolution only, or also at full resolution.
    fn compute_scale(&mut self, i: usize, pair: usize, is_full_resolution: bool) {
        let Plan { source, recipes, width: w, height: h, level, .. } = self.plan;
        let (w, h, level) = (*w, *h, *level);
        let (fine_before, fine) = self.fine.split_at_mut(i);
        let (coarse_before, coarse) = self.coarse.split_at_mut(i);
        let (fine, coarse) = (&mut fine[0], &mut coarse[0]);
        let rows = 2 * pair..(2 * pair + 2).min(h);
        match &recipes[i] {
            Recipe::Source => {
                // Scale 0 of an octave that is not upsampled.
                let Source::ScaleZero(image) = source else { return };
                for y in rows {
                    let from = fine.from;
                    let width = fine.width;
                    fine.row_mut(y).copy_from_slice(&image.row(y)[from..from + width]);
                }
                subsample(fine, coarse, pair);
            }
            Recipe::Blur(kernel) => {
                let (previous, r) = (&fine_before[i - 1], kernel.len() - 1);
                let (from, to) = (fine.from, fine.from + fine.width);
                // The columns of the window, clipped to the image.
                let (a, b) = (from.saturating_sub(r), (to + r).min(w));
                let (left, right) = (a + r - from, to + r - b);
                let padded = &mut self.buffer.padded[0];
                padded.resize(to - from + 2 * r, 0.0);
                let mut window = Vec::with_capacity(2 * r + 1);
                for y in rows {
                    previous.window(y as isize - r as isize, 2 * r + 1, h, &(a..b), &mut window);
                    simd::vertical(level, &mut padded[left..left + b - a], &window, kernel);
                    mirror_ends::<1>(padded, left, right);
                    simd::horizontal(level, fine.row_mut(y), padded, kernel);
                }
                subsample(fine, coarse, pair);
            }
            Recipe::Polyphase { from: source_scale, even, odd } => {
                let r = even.len() - 1;
                let (half_w, half_h) = (w.div_ceil(2), h.div_ceil(2));
                let (from, to) = (coarse.from, coarse.from + coarse.width);
                let (a, b) = (from.saturating_sub(r), (to + r + 1).min(half_w));
                let (left, right) = (a + r - from, to + r + 1 - b);
                let mut window = Vec::with_capacity(2 * r + 2);
                let first = pair as isize - r as isize;
                match (source_scale, source) {
                    (Some(j), _) => coarse_before[*j].window(first, 2 * r + 2, half_h, &(a..b), &mut window),
                    (None, Source::Upsampled(view)) => {
                        let row = |d: usize| &view.row(mirror_index(first + d as isize, half_h))[a..b];
                        window.extend((0..2 * r + 2).map(row));
                    }
                    // Only an upsampled octave has a scale without a source scale.
                    (None, Source::ScaleZero(_)) => return,
                }
                let Buffer { padded: [upper, lower], phases: [odds, low_evens, low_odds] } = &mut self.buffer;
                let len = to - from + 2 * r + 1;
                upper.resize(len, 0.0);
                let evens = coarse.row_mut(pair);
                if !is_full_resolution {
                    simd::vertical(level, &mut upper[left..left + b - a], &window[..2 * r + 1], even);
                    mirror_ends::<1>(upper, left, right);
                    simd::horizontal(level, evens, &upper[..len - 1], even);
                    return;
                }
                lower.resize(len, 0.0);
                let middles = [&mut upper[left..left + b - a], &mut lower[left..left + b - a]];
                simd::vertical_phases(level, middles, &window, even, odd);
                for phase in [&mut *odds, &mut *low_evens, &mut *low_odds] {
                    phase.resize(to - from, 0.0);
                }
                let skip = fine.from / 2 - from;
                mirror_ends::<1>(upper, left, right);
                simd::horizontal_phases(level, [&mut *evens, &mut *odds], upper, even, odd);
                simd::interleave(level, fine.row_mut(2 * pair), &evens[skip..], &odds[skip..]);
                if rows.len() == 2 {
                    mirror_ends::<1>(lower, left, right);
                    simd::horizontal_phases(level, [&mut *low_evens, &mut *low_odds], lower, even, odd);
                    simd::interleave(level, fine.row_mut(2 * pair + 1), &low_evens[skip..], &low_odds[skip..]);
                }
            }
        }
    }

    /// Computes the difference of scales `i` and `i − 1` in a pair of rows.
    fn subtract(&mut self, i: usize, pair: usize) {
        for y in 2 * pair..(2 * pair + 2).min(self.plan.height) {
            let difference = &mut self.differences[i - 1];
            let from = difference.from;
            let [row, before] = [i, i - 1].map(|i| &self.fine[i].row(y)[from - self.fine[i].from..]);
            simd::subtract(self.plan.level, difference.row_mut(y), row, before);
        }
    }

    /// Stores a pair of rows of scale `i` at half resolution.
    fn store(&self, i: usize, pair: usize, strip: &mut Strip<'_>) {
        let (left, right) = (self.columns.start / 2, self.columns.end.div_ceil(2));
        let row = &self.coarse[i].row(pair)[left - self.coarse[i].from..][..right - left];
        let at = (pair - self.pairs.start) * self.plan.width.div_ceil(2) + left;
        let stored = &mut strip.scales[i - 1][at..at + row.len()];
        simd::quantize(self.plan.level, stored, row, self.plan.offset, self.plan.gain);
        if i == self.plan.options.layers {
            strip.next[at..at + row.len()].copy_from_slice(row);
        }
    }
}

/// Copies every second pixel of the first row of a pair.
fn subsample(fine: &LineBuffer, coarse: &mut LineBuffer, pair: usize) {
    // A scale that is computed at full resolution has a fine margin at least as large as the coarse one.
    let skip = 2 * coarse.from - fine.from;
    let row = fine.row(2 * pair)[skip..].iter().step_by(2);
    coarse.row_mut(pair).iter_mut().zip(row).for_each(|(o, v)| *o = *v);
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Silent;

    fn dog_options(upsample: bool) -> DogOptions {
        DogOptions { layers: 3, sigma: 1.6, upsample, contrast: 5e-4, edge: 10.0 }
    }

    /// Noise at several scales, for extrema at several scales.
    fn noise(w: usize, h: usize) -> GrayF32 {
        let cell = |x: usize, y: usize, size: usize| {
            let mut v = ((x / size) as u32).wrapping_mul(0x9E37_79B9)
                ^ ((y / size) as u32 + size as u32).wrapping_mul(0x85EB_CA6B);
            v = (v ^ (v >> 15)).wrapping_mul(0x2C1B_3C6D);
            v = (v ^ (v >> 12)).wrapping_mul(0x297A_2D39);
            ((v ^ (v >> 15)) >> 8) as f32 / (1 << 24) as f32
        };
        GrayF32::from_fn(w, h, |x, y| [[1, 3, 7, 13].map(|size| cell(x, y, size)).iter().sum::<f32>() / 4.0])
    }

    fn subsampled(image: &GrayF32) -> GrayF32 {
        let (w, h) = image.size();
        GrayF32::from_fn(w.div_ceil(2), h.div_ceil(2), |x, y| image.at(2 * x, 2 * y))
    }

    /// Reference: the polyphase filter of a half-resolution image, by the definition; vertical, then horizontal.
    fn polyphase(coarse: &GrayF32, (w, h): (usize, usize), even: &[f32], odd: &[f32]) -> GrayF32 {
        let sum = |at: &dyn Fn(isize) -> f32, u: usize| {
            let x = (u / 2) as isize;
            let (kernel, gap) = if u.is_multiple_of(2) { (even, 0) } else { (odd, 1) };
            let mut sum = if gap == 0 { at(x) * kernel[0] } else { 0.0 };
            for (t, weight) in kernel.iter().enumerate().skip(1 - gap) {
                sum += (at(x - t as isize) + at(x + (gap + t) as isize)) * weight;
            }
            sum
        };
        let (cw, ch) = coarse.size();
        let columns = GrayF32::from_fn(cw, h, |x, v| [sum(&|y| coarse.at(x, mirror_index(y, ch))[0], v)]);
        GrayF32::from_fn(w, h, |u, v| [sum(&|x| columns.at(mirror_index(x, cw), v)[0], u)])
    }

    /// Reference: the scales of the first octave by whole-image passes.
    fn plain(view: &GrayF32, options: &DogOptions) -> Vec<GrayF32> {
        let (w, h) = view.size();
        let size = if options.upsample { (2 * w, 2 * h) } else { (w, h) };
        let mut images: Vec<GrayF32> = Vec::new();
        for recipe in recipes(options.layers, options.sigma, options.upsample) {
            images.push(match recipe {
                Recipe::Source => cv_imgproc::gaussian_blur(view.view(), options.sigma),
                Recipe::Blur(kernel) => cv_imgproc::separable_symmetric(images[images.len() - 1].view(), &kernel),
                Recipe::Polyphase { from, even, odd } => {
                    polyphase(&from.map_or_else(|| view.clone(), |j| subsampled(&images[j])), size, &even, &odd)
                }
            });
        }
        images
    }

    #[test]
    fn tiled_scales_equal_whole_image_passes() {
        // Larger than a tile and a strip, and smaller than a window.
        for (w, h, upsample) in [(1100, 530, false), (61, 500, true), (40, 13, false), (13, 41, false), (9, 12, true)] {
            let image = noise(w, h);
            let s = dog_options(upsample);
            let (octaves, _) = scale_space(image.view(), &s, &Silent).unwrap();
            let (min, max) = intensity_range(image.view());
            for (kept, reference) in octaves[0].scales.iter().zip(&plain(&image, &s)[1..]) {
                let reference = subsampled(reference);
                assert_eq!(kept.size(), reference.size());
                for (q, v) in kept.as_slice().iter().zip(reference.as_slice()) {
                    let dequantized = min + f32::from(*q) * (max - min) / 65535.0;
                    // Half a 16-bit quantization step, and f32 rounding.
                    assert!((dequantized - v).abs() < 0.51 * (max - min) / 65535.0 + 1e-6, "{dequantized} {v}");
                }
            }
        }
    }

    #[test]
    fn extrema_equal_the_definition_on_whole_images() {
        for (w, h, upsample) in [(1100, 421, false), (520, 90, true), (45, 301, false)] {
            let image = noise(w, h);
            let s = dog_options(upsample);
            let (octaves, extrema) = scale_space(image.view(), &s, &Silent).unwrap();
            assert!(!octaves.is_empty());
            let expected = crate::dog::tests::plain(&plain(&image, &s), 0, &s);
            let mut got: Vec<_> =
                extrema.iter().filter(|e| e.octave == 0).map(|e| (e.layer, e.row, e.column)).collect();
            got.sort_unstable();
            assert!(got.len() > 20, "{w}x{h}: {} {}", got.len(), expected.len());
            assert_eq!(got, expected);
        }
    }

    #[test]
    fn scales_from_subsampled_sources_approximate_direct_gaussians() {
        let image = noise(150, 120);
        for upsample in [false, true] {
            let s = dog_options(upsample);
            let images = plain(&image, &s);
            // Reference: direct Gaussians truncated at six sigma; at the input pixels if upsampled.
            let step = if upsample { 2 } else { 1 };
            let edge = 20;
            for (i, made) in images.iter().enumerate() {
                let sigma = s.sigma * 2f32.powf(i as f32 / 3.0) / step as f32;
                let radius = (6.0 * sigma) as usize;
                let weights: Vec<f32> = (0..=radius).map(|k| (-0.5 * (k as f32 / sigma).powi(2)).exp()).collect();
                let sum = 2.0 * weights.iter().sum::<f32>() - weights[0];
                let kernel: Vec<f32> = weights.iter().map(|w| w / sum).collect();
                let truth = cv_imgproc::separable_symmetric(image.view(), &kernel);
                let (mut square, mut signal, mut count) = (0.0f64, 0.0f64, 0);
                let mean = truth.as_slice().iter().sum::<f32>() / truth.as_slice().len() as f32;
                for y in edge..120 - edge {
                    for x in edge..150 - edge {
                        let d = made.at(step * x, step * y)[0] - truth.at(x, y)[0];
                        square += f64::from(d * d);
                        signal += f64::from(truth.at(x, y)[0] - mean).powi(2);
                        count += 1;
                    }
                }
                assert!(count > 0);
                // A kernel truncated at three sigma lacks 0.3 % of its mass (and is slightly wider to compensate); the
                // errors of up to four passes add up.
                assert!((square / signal).sqrt() < 0.01, "scale {i}: {}", (square / signal).sqrt());
            }
        }
    }

    #[test]
    fn upsampling_preserves_the_phase_of_a_wave() {
        // The gain of a Gaussian is exp(−σ²ω²/2); truncation at about 3σ changes it by less than the missing mass, 0.3
        // %, in each of two passes.
        let omega = 0.35f32;
        let image = GrayF32::from_fn(90, 70, |x, y| [(omega * x as f32).sin() + 0.5 * (omega * y as f32).cos()]);
        let s = dog_options(true);
        for (i, made) in plain(&image, &s).iter().enumerate() {
            let sigma = 0.8 * 2f32.powf(i as f32 / 3.0);
            let gain = (-sigma * sigma * omega * omega / 2.0).exp();
            for (u, v) in [(60, 61), (61, 60), (62, 62), (63, 63), (100, 77)] {
                let (x, y) = (u as f32 / 2.0, v as f32 / 2.0);
                let expected = gain * ((omega * x).sin() + 0.5 * (omega * y).cos());
                let got = made.at(u, v)[0];
                assert!((got - expected).abs() < 6e-3, "scale {i} ({x}, {y}): {got} not {expected}");
            }
        }
    }
}
