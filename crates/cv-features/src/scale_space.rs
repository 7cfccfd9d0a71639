//! The Gaussian scale space of an image and its differences, computed in one pass per octave.
//!
//! An octave is worked in tiles. Within a tile, pairs of rows stream through all scales at once: each scale keeps only the rows that are looked back at,
//! so a tile lives in the cache. Scales are made from every second pixel of smoother ones (see `scale_recipes.rs`), and at that resolution they are kept for descriptors,
//! whose samples lie 1.5 pixels of the octave apart or more. Tiles overlap by what the windows reach; results do not depend on how the image is cut.

use crate::dog::{Extremum, Search, find};
use crate::line_buffer::LineBuffer;
use crate::scale_recipes::{Needs, REACH_PAIRS, Recipe, recipes};
use crate::simd;
use cv_core::{Cancelled, GrayF32, Image, ImageView, Progress, Stage};
use cv_imgproc::{mirror_ends, mirror_index};
use fearless_simd::Level;
use rayon::prelude::*;
use std::iter::successors;
use std::ops::Range;

/// Columns of a tile: the rows of all scales it needs (about 170 at the usual settings) then take under a megabyte.
const COLUMNS: usize = 1024;
/// Rows of a strip, at most: each costs some 20 more at its edges.
const ROWS: usize = 512;
/// Pairs of rows of a tile that are worked without asking whether to go on: some milliseconds.
const PAIRS_UNASKED: usize = 32;
/// Octaves end before their shorter side is below this.
const SMALLEST_SIDE: usize = 12;

/// The scales of an octave that descriptors read: 1 to `layers`.
pub(crate) struct Octave {
    /// Every second pixel of every second row of scale `i + 1`: σ = `sigma · 2^((i + 1) / layers) / 2` of its own pixels, 0 to 65535 from the darkest to the brightest
    /// sample of the image.
    pub(crate) scales: Vec<Image<u16, 1>>,
    /// Size of this octave's pixel in input pixels; those of `scales` are twice as large.
    pub(crate) pixel: f32,
}

/// What an octave begins with.
enum Source<'a> {
    /// An image of half its size: pixel `u` of the octave lies at `u / 2`.
    Doubled(ImageView<'a, f32, 1>),
    /// Its scale 0.
    Ready(GrayF32),
}

impl Source<'_> {
    fn size(&self) -> (usize, usize) {
        match self {
            Self::Doubled(view) => (2 * view.width(), 2 * view.height()),
            Self::Ready(image) => image.size(),
        }
    }
}

/// Buffers of a tile that rows pass through.
#[derive(Default)]
struct Buffer {
    padded: [Vec<f32>; 2],
    phases: [Vec<f32>; 3],
}

/// What all tiles of an octave share.
struct Plan<'a> {
    source: &'a Source<'a>,
    search: &'a Search,
    index: usize,
    recipes: Vec<Recipe>,
    needs: Needs,
    width: usize,
    height: usize,
    dark: f32,
    gain: f32,
    level: Level,
}

/// The rows that a strip writes to: every second of its own, which begin at an even one.
struct Strip<'a> {
    y0: usize,
    y1: usize,
    scales: Vec<&'a mut [u16]>,
    /// Those of scale `layers`.
    next: &'a mut [f32],
}

/// Builds all octaves and finds the extrema of their differences of Gaussians, strongest contrast first.
pub(crate) fn scale_space(
    view: ImageView<'_, f32, 1>,
    search: &Search,
    progress: &dyn Progress,
) -> Result<(Vec<Octave>, Vec<Extremum>), Cancelled> {
    let (dark, bright) = range(view);
    // A flat image has nothing to keep.
    let gain = if bright > dark { 65535.0 / (bright - dark) } else { 0.0 };
    let (mut source, mut pixel) = if search.upsample {
        (Source::Doubled(view), 0.5)
    } else {
        (Source::Ready(cv_imgproc::gaussian_blur(view, search.sigma)), 1.0)
    };
    let halved = |&(w, h): &(usize, usize)| Some((w.div_ceil(2), h.div_ceil(2)));
    let sizes = successors(Some(source.size()), halved).take_while(|&(w, h)| w.min(h) >= SMALLEST_SIDE);
    let stage = Stage::new(progress, "scale space", sizes.map(|(w, h)| strips(h) * w.div_ceil(COLUMNS)).sum())?;
    let (mut octaves, mut extrema) = (Vec::new(), Vec::new());
    while source.size().0.min(source.size().1) >= SMALLEST_SIDE {
        let (width, height) = source.size();
        let recipes = recipes(search.layers, search.sigma, matches!(source, Source::Doubled(_)));
        let plan = Plan {
            source: &source,
            search,
            index: octaves.len(),
            needs: Needs::new(&recipes),
            recipes,
            width,
            height,
            dark,
            gain,
            level: simd::level(),
        };
        let (scales, next, found) = octave(&plan, &stage)?;
        extrema.extend(found);
        octaves.push(Octave { scales, pixel });
        source = Source::Ready(next);
        pixel *= 2.0;
    }
    let place = |e: &Extremum| (e.octave, e.layer, e.row, e.column);
    extrema.sort_by(|a, b| b.contrast.total_cmp(&a.contrast).then(place(a).cmp(&place(b))));
    // Two pixels may lead to the same extremum.
    extrema.dedup_by(|a, b| place(a) == place(b));
    Ok((octaves, extrema))
}

/// The smallest and the largest sample.
fn range(view: ImageView<'_, f32, 1>) -> (f32, f32) {
    let rows: Vec<(f32, f32)> = (0..view.height())
        .into_par_iter()
        .with_min_len(64)
        .map(|y| {
            let less = |a: f32, b: f32| if b < a { b } else { a };
            let more = |a: f32, b: f32| if b > a { b } else { a };
            let mut low = [f32::INFINITY; 16];
            let mut high = [f32::NEG_INFINITY; 16];
            let (blocks, rest) = view.row(y).as_chunks::<16>();
            for block in blocks {
                for i in 0..16 {
                    low[i] = less(low[i], block[i]);
                    high[i] = more(high[i], block[i]);
                }
            }
            let low = low.into_iter().chain(rest.iter().copied()).fold(f32::INFINITY, less);
            (low, high.into_iter().chain(rest.iter().copied()).fold(f32::NEG_INFINITY, more))
        })
        .collect();
    rows.into_iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), (c, d)| (a.min(c), b.max(d)))
}

/// As many strips for each thread.
fn strips(height: usize) -> usize {
    let threads = rayon::current_num_threads();
    threads * height.div_ceil(threads * ROWS)
}

/// The kept scales of an octave, the image the next one starts from, the extrema.
type Worked = (Vec<Image<u16, 1>>, GrayF32, Vec<Extremum>);

/// Works one octave.
fn octave(plan: &Plan<'_>, stage: &Stage<'_>) -> Result<Worked, Cancelled> {
    let (w, h) = (plan.width, plan.height);
    let (half_w, half_h) = (w.div_ceil(2), h.div_ceil(2));
    let mut scales: Vec<Image<u16, 1>> = (0..plan.search.layers).map(|_| Image::new(half_w, half_h, [0])).collect();
    let mut next = GrayF32::new(half_w, half_h, [0.0]);
    // Of an even number of rows. The result does not depend on where the cuts are.
    let rows = h.div_ceil(strips(h)).next_multiple_of(2).max(2);
    let mut work: Vec<Strip<'_>> = next
        .as_mut_slice()
        .chunks_mut(rows / 2 * half_w)
        .enumerate()
        .map(|(i, next)| Strip { y0: i * rows, y1: ((i + 1) * rows).min(h), scales: Vec::new(), next })
        .collect();
    for image in &mut scales {
        for (strip, part) in work.iter_mut().zip(image.as_mut_slice().chunks_mut(rows / 2 * half_w)) {
            strip.scales.push(part);
        }
    }
    let found: Vec<Vec<Extremum>> = work
        .into_par_iter()
        .map(|mut strip| {
            let mut found = Vec::new();
            let mut tile = Tile::new(plan, &strip);
            for x0 in (0..w).step_by(COLUMNS) {
                tile.run(x0..(x0 + COLUMNS).min(w), &mut strip, &mut found, stage)?;
                stage.add(1)?;
            }
            Ok(found)
        })
        .collect::<Result<_, Cancelled>>()?;
    Ok((scales, next, found.into_iter().flatten().collect()))
}

/// A part of a strip, and the rows of its scales that are looked back at.
struct Tile<'a> {
    plan: &'a Plan<'a>,
    columns: Range<usize>,
    /// The strip's pairs of rows.
    pairs: Range<usize>,
    fine: Vec<LineBuffer>,
    /// Every second pixel of every second row; its columns are counted so too.
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

    /// Turns to other columns.
    fn fit(&mut self, columns: Range<usize>) {
        let (w, needs) = (self.plan.width, &self.plan.needs);
        let (left, right) = (columns.start / 2, columns.end.div_ceil(2));
        let coarse = |by: usize| left.saturating_sub(by)..(right + by).min(w.div_ceil(2));
        let fine = |by: usize| 2 * left.saturating_sub(by)..(2 * (right + by)).min(w);
        for i in 0..self.plan.recipes.len() {
            self.fine[i].fit(fine(needs.fine[i]), needs.fine_rows[i]);
            self.coarse[i].fit(coarse(needs.beyond(i)), needs.coarse_rows[i]);
        }
        for (difference, rows) in self.differences.iter_mut().zip(&needs.difference_rows) {
            difference.fit(fine(REACH_PAIRS), *rows);
        }
        self.columns = columns;
    }

    /// Whether pair `pair` lies at most `by` pairs beyond the tile.
    fn within(&self, pair: usize, by: usize) -> bool {
        (self.pairs.start.saturating_sub(by)..self.pairs.end + by).contains(&pair) && 2 * pair < self.plan.height
    }

    /// Streams the rows of these columns through all scales.
    fn run(
        &mut self,
        columns: Range<usize>,
        strip: &mut Strip<'_>,
        found: &mut Vec<Extremum>,
        stage: &Stage<'_>,
    ) -> Result<(), Cancelled> {
        self.fit(columns);
        let Plan { needs, search, .. } = self.plan;
        let (w, h) = (self.plan.width, self.plan.height);
        let beyond = (0..self.plan.recipes.len()).map(|i| needs.beyond(i)).max().unwrap_or(0);
        for step in self.pairs.start.saturating_sub(beyond)..self.pairs.end + needs.search {
            if step.is_multiple_of(PAIRS_UNASKED) {
                stage.check()?;
            }
            for i in 0..self.plan.recipes.len() {
                let Some(pair) = step.checked_sub(needs.delay[i]).filter(|&p| self.within(p, needs.beyond(i))) else {
                    continue;
                };
                let whole = self.within(pair, needs.fine[i]);
                self.make(i, pair, whole);
                if i > 0 && self.within(pair, REACH_PAIRS) {
                    self.subtract(i, pair);
                }
                if (1..=search.layers).contains(&i) && self.pairs.contains(&pair) {
                    self.keep(i, pair, strip);
                }
            }
            // The differences now reach `REACH` rows below this pair, or to the end of the image.
            if let Some(pair) = step.checked_sub(needs.search).filter(|p| self.pairs.contains(p)) {
                for y in 2 * pair..(2 * pair + 2).min(h) {
                    let columns = self.columns.clone();
                    find(&self.differences, self.plan.index, search, (w, h), y, columns, self.plan.level, found);
                }
            }
        }
        Ok(())
    }

    /// A pair of rows of scale `i`: only every second pixel of the first, or `whole`.
    fn make(&mut self, i: usize, pair: usize, whole: bool) {
        let Plan { source, recipes, width: w, height: h, level, .. } = self.plan;
        let (w, h, level) = (*w, *h, *level);
        let (fine_before, fine) = self.fine.split_at_mut(i);
        let (coarse_before, coarse) = self.coarse.split_at_mut(i);
        let (fine, coarse) = (&mut fine[0], &mut coarse[0]);
        let rows = 2 * pair..(2 * pair + 2).min(h);
        match &recipes[i] {
            Recipe::Given => {
                // Only the image of an octave that is not doubled.
                let Source::Ready(image) = source else { return };
                for y in rows {
                    let from = fine.from;
                    let width = fine.width;
                    fine.row_mut(y).copy_from_slice(&image.row(y)[from..from + width]);
                }
                thin(fine, coarse, pair);
            }
            Recipe::Blur(kernel) => {
                let (previous, r) = (&fine_before[i - 1], kernel.len() - 1);
                let (from, to) = (fine.from, fine.from + fine.width);
                // What the window covers, and the part of it there is.
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
                thin(fine, coarse, pair);
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
                    (None, Source::Doubled(view)) => {
                        let row = |d: usize| &view.row(mirror_index(first + d as isize, half_h))[a..b];
                        window.extend((0..2 * r + 2).map(row));
                    }
                    // Only an octave that is doubled has a scale without a source.
                    (None, Source::Ready(_)) => return,
                }
                let Buffer { padded: [upper, lower], phases: [odds, low_evens, low_odds] } = &mut self.buffer;
                let len = to - from + 2 * r + 1;
                upper.resize(len, 0.0);
                let evens = coarse.row_mut(pair);
                if !whole {
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

    /// The difference of scales `i` and `i − 1` in a pair of rows.
    fn subtract(&mut self, i: usize, pair: usize) {
        for y in 2 * pair..(2 * pair + 2).min(self.plan.height) {
            let difference = &mut self.differences[i - 1];
            let from = difference.from;
            let [row, before] = [i, i - 1].map(|i| &self.fine[i].row(y)[from - self.fine[i].from..]);
            simd::subtract(self.plan.level, difference.row_mut(y), row, before);
        }
    }

    /// Keeps every second pixel of the first of two rows of scale `i`.
    fn keep(&self, i: usize, pair: usize, strip: &mut Strip<'_>) {
        let (left, right) = (self.columns.start / 2, self.columns.end.div_ceil(2));
        let own = &self.coarse[i].row(pair)[left - self.coarse[i].from..][..right - left];
        let at = (pair - self.pairs.start) * self.plan.width.div_ceil(2) + left;
        let kept = &mut strip.scales[i - 1][at..at + own.len()];
        simd::quantize(self.plan.level, kept, own, self.plan.dark, self.plan.gain);
        if i == self.plan.search.layers {
            strip.next[at..at + own.len()].copy_from_slice(own);
        }
    }
}

/// Every second pixel of the first row of a pair.
fn thin(fine: &LineBuffer, coarse: &mut LineBuffer, pair: usize) {
    // A scale that is made at full resolution is needed there wherever it is needed at half.
    let skip = 2 * coarse.from - fine.from;
    let row = fine.row(2 * pair)[skip..].iter().step_by(2);
    coarse.row_mut(pair).iter_mut().zip(row).for_each(|(o, v)| *o = *v);
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Silent;

    fn search(upsample: bool) -> Search {
        Search { layers: 3, sigma: 1.6, upsample, contrast: 5e-4, edge: 10.0 }
    }

    /// Noise at several scales, so that there are extrema at several scales.
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

    fn thinned(image: &GrayF32) -> GrayF32 {
        let (w, h) = image.size();
        GrayF32::from_fn(w.div_ceil(2), h.div_ceil(2), |x, y| image.at(2 * x, 2 * y))
    }

    /// The image of size `(w, h)` whose every second pixel of every second row `coarse` is, blurred: the sums as they stand, along columns and then along rows.
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

    /// The scales of the first octave by passes over whole images.
    fn plain(view: &GrayF32, search: &Search) -> Vec<GrayF32> {
        let (w, h) = view.size();
        let size = if search.upsample { (2 * w, 2 * h) } else { (w, h) };
        let mut images: Vec<GrayF32> = Vec::new();
        for recipe in recipes(search.layers, search.sigma, search.upsample) {
            images.push(match recipe {
                Recipe::Given => cv_imgproc::gaussian_blur(view.view(), search.sigma),
                Recipe::Blur(kernel) => cv_imgproc::separable_symmetric(images[images.len() - 1].view(), &kernel),
                Recipe::Polyphase { from, even, odd } => {
                    polyphase(&from.map_or_else(|| view.clone(), |j| thinned(&images[j])), size, &even, &odd)
                }
            });
        }
        images
    }

    #[test]
    fn tiles_add_up_to_whole_images() {
        // Wider than a tile and higher than a strip, and smaller than a window.
        for (w, h, upsample) in [(1100, 530, false), (61, 500, true), (40, 13, false), (13, 41, false), (9, 12, true)] {
            let image = noise(w, h);
            let s = search(upsample);
            let (octaves, _) = scale_space(image.view(), &s, &Silent).unwrap();
            let (dark, bright) = range(image.view());
            for (kept, whole) in octaves[0].scales.iter().zip(&plain(&image, &s)[1..]) {
                let whole = thinned(whole);
                assert_eq!(kept.size(), whole.size());
                for (q, v) in kept.as_slice().iter().zip(whole.as_slice()) {
                    let back = dark + f32::from(*q) * (bright - dark) / 65535.0;
                    // Half a step of the 16-bit numbers, and f32 rounding.
                    assert!((back - v).abs() < 0.51 * (bright - dark) / 65535.0 + 1e-6, "{back} {v}");
                }
            }
        }
    }

    #[test]
    fn extrema_are_those_of_whole_images_by_definition() {
        for (w, h, upsample) in [(1100, 421, false), (520, 90, true), (45, 301, false)] {
            let image = noise(w, h);
            let s = search(upsample);
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
    fn scales_made_from_thinned_ones_are_those_of_long_gaussians() {
        let image = noise(150, 120);
        for upsample in [false, true] {
            let s = search(upsample);
            let images = plain(&image, &s);
            // From the image itself by Gaussians cut off at six standard deviations, whose squares add up; at the pixels of the image where it is doubled.
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
                // A kernel of three standard deviations lacks 0.3 % of its mass, for which it is a little wider; the errors of up to four passes add up.
                assert!((square / signal).sqrt() < 0.01, "scale {i}: {}", (square / signal).sqrt());
            }
        }
    }

    #[test]
    fn doubling_keeps_the_phase_of_a_wave() {
        // exp(−σ²ω²/2) is the gain of a Gaussian; cut off at about 3σ it differs by less than its missing mass, 0.3 %, in each of two passes.
        let omega = 0.35f32;
        let image = GrayF32::from_fn(90, 70, |x, y| [(omega * x as f32).sin() + 0.5 * (omega * y as f32).cos()]);
        let s = search(true);
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
