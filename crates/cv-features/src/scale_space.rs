//! The Gaussian scale space of an image and its differences, computed in one pass per octave.
//!
//! An octave is worked in tiles. Within a tile, rows stream through all scales at once: each scale keeps only the rows that the next one's
//! window needs, the differences only those that the search for extrema looks at, so a tile lives in the cache. What is kept of an octave are the
//! scales that descriptors read (as 16-bit numbers) and the image the next octave starts from. Tiles overlap by what the windows
//! reach; results do not depend on how the image is cut.

use crate::dog::{Extremum, REACH, Search, find};
use crate::line_buffer::LineBuffer;
use crate::simd;
use cv_core::{Cancelled, GrayF32, Image, ImageView, Progress, Stage};
use cv_imgproc::{mirror_ends, mirror_index};
use fearless_simd::Level;
use rayon::prelude::*;
use std::iter::successors;
use std::ops::Range;

/// Columns of a tile: the rows of all scales it needs (about 190 at the usual settings) then take under a megabyte.
const COLUMNS: usize = 1024;
/// Rows of a strip, at most: each costs some 30 more at its edges.
const ROWS: usize = 512;
/// Rows of a tile that are worked without asking whether to go on: some milliseconds.
const ROWS_UNASKED: usize = 64;
/// Octaves end before their shorter side is below this.
const SMALLEST_SIDE: usize = 12;

/// The scales of an octave that descriptors read: 1 to `layers`.
pub(crate) struct Octave {
    /// Scale `i + 1`: σ = `sigma · 2^((i + 1) / layers)` octave pixels, 0 to 65535 from the darkest to the brightest sample of the image.
    pub(crate) scales: Vec<Image<u16, 1>>,
    /// Size of this octave's pixel in input pixels.
    pub(crate) pixel: f32,
}

/// The half of a sampled Gaussian from its center outwards to three standard deviations, the whole summing to one.
fn half_kernel(sigma: f32) -> Vec<f32> {
    let radius = (3.0 * sigma).ceil().max(1.0) as usize;
    let weight = |i: usize| (-0.5 * (i as f64 / f64::from(sigma)).powi(2)).exp();
    let sum = weight(0) + 2.0 * (1..=radius).map(weight).sum::<f64>();
    (0..=radius).map(|i| (weight(i) / sum) as f32).collect()
}

/// The half-kernel at phase ½: the samples at ½, 1½, … of each side.
fn half_kernel_between(sigma: f32, len: usize) -> Vec<f32> {
    let weight = |i: usize| (-0.5 * ((i as f64 + 0.5) / f64::from(sigma)).powi(2)).exp();
    let sum = 2.0 * (0..len).map(weight).sum::<f64>();
    (0..len).map(|i| (weight(i) / sum) as f32).collect()
}

/// Where the rows of the first scale of an octave come from.
enum Source<'a> {
    /// Twice the size of this image, smoothed: pixel `u` of the octave lies at `u / 2`. The Gaussian is sampled at the two phases 0 and ½, so
    /// smoothing is the interpolation; no bilinear step blurs one pixel more than the next.
    Doubled { view: ImageView<'a, f32, 1>, even: Vec<f32>, odd: Vec<f32> },
    /// This image.
    Ready(GrayF32),
}

impl Source<'_> {
    fn size(&self) -> (usize, usize) {
        match self {
            Self::Doubled { view, .. } => (2 * view.width(), 2 * view.height()),
            Self::Ready(image) => image.size(),
        }
    }

    /// Columns `from..from + out.len()` of row `y`.
    fn row(&self, level: Level, y: usize, from: usize, out: &mut [f32], buffer: &mut Buffer) {
        match self {
            Self::Ready(image) => out.copy_from_slice(&image.row(y)[from..from + out.len()]),
            Self::Doubled { view, even, odd } => {
                let (w, h) = view.size();
                let to = from + out.len();
                // The source columns that the window reaches, and those of them there are.
                let pad = even.len();
                let (first, last) = (from / 2, (to - 1) / 2 + 1);
                let (a, b) = (first.saturating_sub(pad), (last + pad).min(w));
                let (left, right) = (a + pad - first, last + pad - b);
                let count = last - first;
                let Buffer { padded, phases: [evens, odds, both] } = buffer;
                padded.resize(count + 2 * pad, 0.0);
                let middle = &mut padded[left..left + b - a];
                let row = |d: isize| &view.row(mirror_index((y / 2) as isize + d, h))[a..b];
                let mut rows: Vec<&[f32]> = Vec::with_capacity(2 * pad);
                let r = pad as isize - 1;
                if y.is_multiple_of(2) {
                    rows.extend((-r..=r).map(row));
                    simd::vertical(level, middle, &rows, even);
                } else {
                    rows.extend((-r..=r + 1).map(row));
                    simd::vertical_between(level, middle, &rows, odd);
                }
                mirror_ends::<1>(padded, left, right);
                evens.resize(count, 0.0);
                odds.resize(count, 0.0);
                both.resize(2 * count, 0.0);
                simd::horizontal(level, evens, &padded[1..count + 2 * pad - 1], even);
                simd::horizontal_between(level, odds, &padded[1..], odd);
                simd::interleave(level, both, evens, odds);
                out.copy_from_slice(&both[from % 2..from % 2 + out.len()]);
            }
        }
    }
}

/// Buffers of a tile that rows pass through.
#[derive(Default)]
struct Buffer {
    padded: Vec<f32>,
    phases: [Vec<f32>; 3],
}

impl Buffer {
    fn padded(&mut self, len: usize) -> &mut [f32] {
        self.padded.resize(len, 0.0);
        &mut self.padded
    }
}

/// What all tiles of an octave share.
struct Plan<'a> {
    source: &'a Source<'a>,
    search: &'a Search,
    index: usize,
    /// Half-kernel from each scale to the next.
    kernels: &'a [Vec<f32>],
    width: usize,
    height: usize,
    dark: f32,
    gain: f32,
    level: Level,
}

/// The rows that a strip writes to.
struct Strip<'a> {
    y0: usize,
    y1: usize,
    scales: Vec<&'a mut [u16]>,
    /// Every second pixel of every second row of scale `layers`.
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
    let scale = |i: usize| search.sigma * 2f32.powf(i as f32 / search.layers as f32);
    let kernels: Vec<Vec<f32>> = (1..search.layers + 3)
        .map(|i| half_kernel((scale(i) * scale(i) - scale(i - 1) * scale(i - 1)).sqrt()))
        .collect();
    let (mut source, mut pixel) = if search.upsample {
        let even = half_kernel(search.sigma * 0.5);
        let odd = half_kernel_between(search.sigma * 0.5, even.len());
        (Source::Doubled { view, even, odd }, 0.5)
    } else {
        (Source::Ready(cv_imgproc::gaussian_blur(view, search.sigma)), 1.0)
    };
    let halved = |&(w, h): &(usize, usize)| Some((w.div_ceil(2), h.div_ceil(2)));
    let sizes = successors(Some(source.size()), halved).take_while(|&(w, h)| w.min(h) >= SMALLEST_SIDE);
    let stage = Stage::new(progress, "scale space", sizes.map(|(w, h)| strips(h) * w.div_ceil(COLUMNS)).sum())?;
    let (mut octaves, mut extrema) = (Vec::new(), Vec::new());
    while source.size().0.min(source.size().1) >= SMALLEST_SIDE {
        let (width, height) = source.size();
        let plan = Plan {
            source: &source,
            search,
            index: octaves.len(),
            kernels: &kernels,
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
    let mut scales: Vec<Image<u16, 1>> = (0..plan.search.layers).map(|_| Image::new(w, h, [0])).collect();
    let mut next = GrayF32::new(w.div_ceil(2), h.div_ceil(2), [0.0]);
    // Of an even number of rows. The result does not depend on where the cuts are.
    let rows = h.div_ceil(strips(h)).next_multiple_of(2).max(2);
    let mut work: Vec<Strip<'_>> = next
        .as_mut_slice()
        .chunks_mut(rows / 2 * w.div_ceil(2))
        .enumerate()
        .map(|(i, next)| Strip { y0: i * rows, y1: ((i + 1) * rows).min(h), scales: Vec::new(), next })
        .collect();
    for image in &mut scales {
        for (strip, part) in work.iter_mut().zip(image.as_mut_slice().chunks_mut(rows * w)) {
            strip.scales.push(part);
        }
    }
    let found: Vec<Vec<Extremum>> = work
        .into_par_iter()
        .map(|mut strip| {
            let mut found = Vec::new();
            for x0 in (0..w).step_by(COLUMNS) {
                tile(plan, &mut strip, x0..(x0 + COLUMNS).min(w), &mut found, stage)?;
                stage.add(1)?;
            }
            Ok(found)
        })
        .collect::<Result<_, Cancelled>>()?;
    Ok((scales, next, found.into_iter().flatten().collect()))
}

/// Streams the rows of a tile through all scales.
fn tile(
    plan: &Plan<'_>,
    strip: &mut Strip<'_>,
    columns: Range<usize>,
    found: &mut Vec<Extremum>,
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    let (w, h) = (plan.width, plan.height);
    let last = plan.kernels.len();
    let radius = |scale: usize| plan.kernels[scale - 1].len() - 1;
    // Scale i is needed this far beyond the tile, and runs this many rows behind scale 0.
    let halo: Vec<usize> = (0..=last).map(|i| REACH + (i + 1..=last).map(radius).sum::<usize>()).collect();
    let delay: Vec<usize> = (0..=last).map(|i| (1..=i).map(radius).sum()).collect();
    let part = |by: usize| columns.start.saturating_sub(by)..(columns.end + by).min(w);
    let mut scales: Vec<LineBuffer> =
        (0..=last).map(|i| LineBuffer::new(part(halo[i]), if i < last { 2 * radius(i + 1) + 1 } else { 1 })).collect();
    let mut differences: Vec<LineBuffer> =
        (0..last).map(|i| LineBuffer::new(part(REACH), 2 * REACH + 1 + delay[last] - delay[i + 1])).collect();
    let mut buffer = Buffer::default();
    let end = strip.y1 + REACH + delay[last];
    for step in strip.y0.saturating_sub(halo[0])..end {
        if step.is_multiple_of(ROWS_UNASKED) {
            stage.check()?;
        }
        for i in 0..=last {
            let wanted = strip.y0.saturating_sub(halo[i])..(strip.y1 + halo[i]).min(h);
            let Some(y) = step.checked_sub(delay[i]).filter(|y| wanted.contains(y)) else { continue };
            if i == 0 {
                let ring = &mut scales[0];
                let from = ring.from;
                plan.source.row(plan.level, y, from, ring.row_mut(y), &mut buffer);
                continue;
            }
            let (before, after) = scales.split_at_mut(i);
            let (previous, ring) = (&before[i - 1], &mut after[0]);
            let kernel = &plan.kernels[i - 1];
            let r = kernel.len() - 1;
            // What the horizontal window of this scale's columns covers, and the part of it there is.
            let (from, to) = (ring.from, ring.from + ring.width);
            let (a, b) = (from.saturating_sub(r), (to + r).min(w));
            let padded = buffer.padded(to - from + 2 * r);
            let (left, right) = (a + r - from, to + r - b);
            let mut rows = Vec::with_capacity(2 * r + 1);
            previous.window(y, r, h, &(a..b), &mut rows);
            simd::vertical(plan.level, &mut padded[left..left + b - a], &rows, kernel);
            mirror_ends::<1>(padded, left, right);
            simd::horizontal(plan.level, ring.row_mut(y), padded, kernel);

            let difference = &mut differences[i - 1];
            if (strip.y0.saturating_sub(REACH)..strip.y1 + REACH).contains(&y) {
                let from = difference.from;
                simd::subtract(
                    plan.level,
                    difference.row_mut(y),
                    &ring.row(y)[from - ring.from..],
                    &previous.row(y)[from - previous.from..],
                );
            }
            if i <= plan.search.layers && (strip.y0..strip.y1).contains(&y) {
                let own = &ring.row(y)[columns.start - ring.from..][..columns.len()];
                let at = (y - strip.y0) * w + columns.start;
                simd::quantize(plan.level, &mut strip.scales[i - 1][at..at + columns.len()], own, plan.dark, plan.gain);
                if i == plan.search.layers && y % 2 == 0 {
                    // Tiles start at even columns.
                    let at = (y - strip.y0) / 2 * w.div_ceil(2) + columns.start / 2;
                    strip.next[at..].iter_mut().zip(own.iter().step_by(2)).for_each(|(o, v)| *o = *v);
                }
            }
        }
        // The differences now reach `REACH` rows below this one, or to the end of the image.
        if let Some(y) = step.checked_sub(delay[last] + REACH).filter(|y| (strip.y0..strip.y1).contains(y)) {
            find(&differences, plan.index, plan.search, (w, h), y, columns.clone(), plan.level, found);
        }
    }
    Ok(())
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

    /// The scales by whole-image blurs, one after the other.
    fn plain(first: GrayF32, search: &Search) -> Vec<GrayF32> {
        let scale = |i: usize| search.sigma * 2f32.powf(i as f32 / search.layers as f32);
        let mut images = vec![first];
        for i in 1..search.layers + 3 {
            let kernel = half_kernel((scale(i) * scale(i) - scale(i - 1) * scale(i - 1)).sqrt());
            images.push(cv_imgproc::separable_symmetric(images[i - 1].view(), &kernel));
        }
        images
    }

    #[test]
    fn tiles_add_up_to_whole_images() {
        // Wider than a tile and higher than a strip, and smaller than a window.
        for (w, h) in [(1100, 430), (61, 500), (40, 13), (13, 40)] {
            let image = noise(w, h);
            let s = search(false);
            let (octaves, _) = scale_space(image.view(), &s, &Silent).unwrap();
            let images = plain(cv_imgproc::gaussian_blur(image.view(), s.sigma), &s);
            let (dark, bright) = range(image.view());
            for (kept, whole) in octaves[0].scales.iter().zip(&images[1..]) {
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
        for (w, h, upsample) in [(1100, 420, false), (520, 90, true), (45, 300, false)] {
            let image = noise(w, h);
            let s = search(upsample);
            let (octaves, extrema) = scale_space(image.view(), &s, &Silent).unwrap();
            let first = if upsample {
                let source = {
                    let even = half_kernel(s.sigma * 0.5);
                    let odd = half_kernel_between(s.sigma * 0.5, even.len());
                    Source::Doubled { view: image.view(), even, odd }
                };
                let mut whole = GrayF32::new(2 * w, 2 * h, [0.0]);
                for y in 0..2 * h {
                    source.row(simd::level(), y, 0, whole.row_mut(y), &mut Buffer::default());
                }
                whole
            } else {
                cv_imgproc::gaussian_blur(image.view(), s.sigma)
            };
            assert!(!octaves.is_empty());
            let images = plain(first, &s);
            let expected = crate::dog::tests::plain(&images, 0, &s);
            let mut got: Vec<_> =
                extrema.iter().filter(|e| e.octave == 0).map(|e| (e.layer, e.row, e.column)).collect();
            got.sort_unstable();
            assert!(got.len() > 20, "{w}x{h}: {} {}", got.len(), expected.len());
            assert_eq!(got, expected);
        }
    }

    #[test]
    fn doubling_keeps_the_phase_of_a_wave() {
        // exp(−σ²ω²/2) is the gain of a Gaussian; cut off at 3σ it differs by less than its missing mass, 0.3 %.
        let (omega, sigma) = (0.35f32, 0.8f32);
        let gain = (-sigma * sigma * omega * omega / 2.0).exp();
        let image = GrayF32::from_fn(90, 70, |x, y| [(omega * x as f32).sin() + 0.5 * (omega * y as f32).cos()]);
        let even = half_kernel(sigma);
        let odd = half_kernel_between(sigma, even.len());
        let source = Source::Doubled { view: image.view(), even, odd };
        for (y, from, len) in [(60, 0, 180), (61, 7, 100), (62, 100, 80), (63, 121, 1)] {
            let mut out = vec![0.0; len];
            source.row(simd::level(), y, from, &mut out, &mut Buffer::default());
            for (i, v) in out.iter().enumerate().filter(|(i, _)| (8..172).contains(&(from + i))) {
                let (x, y) = ((from + i) as f32 / 2.0, y as f32 / 2.0);
                let expected = gain * ((omega * x).sin() + 0.5 * (omega * y).cos());
                assert!((v - expected).abs() < 5e-3, "({x}, {y}): {v} not {expected}");
            }
        }
    }
}
