//! The semi-global matcher: from a rectified pair to checked disparities.

mod pyramid;

use crate::border_mask::Borders;
use crate::census::{Gray, describe, describe_mirrored, planes};
use crate::coarse_prior::Prior;
use crate::confidence::{confidence, sigma};
use crate::cost::{Frame, Penalties};
use crate::denoise;
use crate::disparity_map::{DisparityMap, PixelState};
use crate::edge_preserving::{SmoothingBuffers, smooth};
use crate::fill_cost::Pair;
use crate::input::to_gray;
use crate::layout::Layout;
use crate::local_expansion;
use crate::matcher_memory::ROWS_BELOW_STRIP;
use crate::search_window::SearchWindows;
use crate::sequence;
use crate::sgm::Aggregator;
use crate::speckle::{Speckles, remove_speckles};
use crate::surface_filling::{self, Filling, fill};
use crate::winner::Winner;
use crate::winner_checks::check_row;
use crate::{Intensity, IntensityCost, Paths, Search, StereoError, StereoOptions, median, window_sweep};
use cv_core::{Cancelled, GrayF32, ImageView, Mask, Progress, Stage, StageClock};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch};
use pyramid::Coarse;
use std::ops::Range;

/// An image is not halved below this many px of width or height.
const MIN_PYRAMID_SIDE: usize = 16;

/// Fewer disparities than this have no pyramid levels: half of them would agree by chance.
const MIN_PYRAMID_DISPARITIES: usize = 32;

/// Matching is hierarchical by [`Search::Auto`] from this many pixels times disparities on, and by [`Search::Hierarchical`], which is also
/// that of the coarser levels, from the second.
const MIN_AUTO_VOLUME: usize = 1 << 28;
const MIN_HIERARCHICAL_VOLUME: usize = 1 << 25;

/// A semi-global matcher (Hirschmüller, PAMI 2008) that reuses its buffers between pairs.
///
/// ```
/// use cv_core::{Image, Silent};
/// use cv_stereo::{StereoMatcher, StereoOptions};
///
/// // A textured wall with a disparity of 5 px.
/// let texture = |x: usize, y: usize| ((x * 7919 + y * 104_729 + (x * y) % 97 * 31) % 251) as u8;
/// let left = Image::<u8, 1>::from_fn(64, 32, |x, y| [texture(x, y)]);
/// let right = Image::<u8, 1>::from_fn(64, 32, |x, y| [texture(x + 5, y)]);
/// let mut matcher = StereoMatcher::new(StereoOptions { disparities: 16, ..Default::default() })?;
/// let map = matcher.compute(left.view(), right.view(), &Silent)?;
/// assert!((map.disparity.at(30, 16)[0] - 5.0).abs() < 0.1);
/// # Ok::<(), cv_stereo::StereoError>(())
/// ```
#[derive(Debug)]
pub struct StereoMatcher {
    options: StereoOptions,
    level: Level,
    gray: [Gray; 2],
    gray8: Vec<u8>,
    borders: Borders,
    /// Census bits and values of the intensity cost, of both views.
    described: [Vec<u8>; 2],
    aggregator: Aggregator,
    /// Buffers of the aggregation in strips.
    strip: Aggregator,
    speckles: Speckles,
    filling: Filling,
    scratch: Vec<f32>,
    /// The previous frame of both views.
    frames: [sequence::View; 2],
    smoothing: SmoothingBuffers,
    /// Buffers of the threads of hierarchical matching.
    window_sweeps: Vec<window_sweep::Buffers>,
    /// Priors of low-texture pixels; empty without any.
    priors: Vec<Prior>,
    /// Search windows of hierarchical matching.
    windows: SearchWindows,
    /// The matcher at half resolution, which the priors and windows are from.
    coarse: Option<Box<Coarse>>,
    stages: Vec<(&'static str, f64)>,
}

impl StereoMatcher {
    /// Creates a matcher with these options.
    ///
    /// # Errors
    /// [`StereoError::Range`] and [`StereoError::Option`] for options out of range.
    pub fn new(options: StereoOptions) -> Result<Self, StereoError> {
        options.validate()?;
        Ok(Self {
            options,
            level: Level::new(),
            gray: Default::default(),
            gray8: Vec::new(),
            borders: Borders::default(),
            described: Default::default(),
            aggregator: Aggregator::default(),
            strip: Aggregator::default(),
            speckles: Speckles::default(),
            filling: Filling::default(),
            scratch: Vec::new(),
            frames: Default::default(),
            smoothing: SmoothingBuffers::default(),
            window_sweeps: Vec::new(),
            priors: Vec::new(),
            windows: SearchWindows::default(),
            coarse: None,
            stages: Vec::new(),
        })
    }

    /// Returns the options.
    pub fn options(&self) -> &StereoOptions {
        &self.options
    }

    /// Sets the pixels of the left and the right image that have data ([`crate::RectifiedView::apply`]), for all following pairs of this
    /// size; `None` detects black borders, as [`StereoOptions::ignore_black_borders`] says.
    pub fn set_masks(&mut self, masks: Option<[&Mask; 2]>) {
        self.borders.set_given(masks);
    }

    /// Computes the disparities of `left`. The images are rectified: a scene point has the same y in both.
    ///
    /// # Errors
    /// [`StereoError`] if the images differ in size, the disparities do not fit the images, or `progress` returns stop.
    pub fn compute<T: Intensity, const C: usize>(
        &mut self,
        left: ImageView<'_, T, C>,
        right: ImageView<'_, T, C>,
        progress: &dyn Progress,
    ) -> Result<DisparityMap, StereoError> {
        let mut map = DisparityMap::empty();
        self.compute_into(left, right, &mut map, progress)?;
        Ok(map)
    }

    /// As [`StereoMatcher::compute`], into a map of any size; its memory is reused if it has the right size.
    ///
    /// # Errors
    /// As [`StereoMatcher::compute`]; `map` is then unchanged, or, if the job was stopped, unspecified.
    pub fn compute_into<T: Intensity, const C: usize>(
        &mut self,
        left: ImageView<'_, T, C>,
        right: ImageView<'_, T, C>,
        map: &mut DisparityMap,
        progress: &dyn Progress,
    ) -> Result<(), StereoError> {
        let (width, height) = left.size();
        if left.size() != right.size() {
            return Err(StereoError::SizeMismatch { left: left.size(), right: right.size() });
        }
        self.check_size(width, height)?;
        let mut clock = StageClock::new();
        progress.report("bits", 0, 1)?;
        self.reclaim_gray();
        for (side, view, gray) in [("left", left, 0), ("right", right, 1)] {
            let count = to_gray(view, &mut self.gray[gray]);
            if count > 0 {
                return Err(StereoError::NotFinite { side, count });
            }
        }
        let is_noisy = self.options.denoise && denoise::is_noisy(&self.gray);
        self.borders.update(&mut self.gray, self.options.ignore_black_borders, &mut self.scratch);
        if is_noisy {
            self.gray.iter_mut().for_each(|gray| denoise::smooth(gray, &mut self.scratch));
        }
        if self.options.sequence {
            for (frame, gray) in self.frames.iter_mut().zip(&mut self.gray) {
                frame.filter(gray);
            }
        }
        clock.lap("gray");
        self.compute_gray(map, clock, progress)
    }

    /// Forgets the previous frame of a sequence.
    pub fn forget_frame(&mut self) {
        self.frames.iter_mut().for_each(sequence::View::forget);
    }

    /// As [`StereoMatcher::compute_into`], of the gray levels in `self.gray`.
    fn compute_gray(
        &mut self,
        map: &mut DisparityMap,
        mut clock: StageClock,
        progress: &dyn Progress,
    ) -> Result<(), StereoError> {
        let (width, height) = (self.gray[0].width, self.gray[0].height);
        progress.report("bits", 0, 1)?;
        self.gray[0].to_bytes(&mut self.gray8);
        clock.lap("gray");
        let coarse = self.match_coarse((width, height), map, progress)?;
        clock.lap("coarse");
        self.describe_pixels();
        clock.lap("bits");
        progress.report("bits", 1, 1)?;
        self.set_priors(coarse, map, (width, height));
        clock.lap("coarse");
        self.aggregate(width, height, progress)?;
        clock.lap("aggregate");
        map.resize(width, height);
        progress.report("check", 0, 1)?;
        self.check(map);
        self.refine(map, progress)?;
        clock.lap("check");
        self.stages = clock.into_stages();
        Ok(())
    }

    /// Returns the stages of the last pair and their seconds: gray levels, census bits, coarser levels, costs and aggregation,
    /// checks and refinement.
    pub fn stages(&self) -> &[(&'static str, f64)] {
        &self.stages
    }

    /// Returns the confidence of each disparity of the last pair, 0 to 1: the naive peak ratio of its cost and the best one elsewhere;
    /// 0 for filled pixels. `None` without [`StereoOptions::confidence`], and before the first pair.
    pub fn confidence(&self, map: &DisparityMap) -> Option<GrayF32> {
        let known = self.options.confidence && self.aggregator.winners.len() == map.state.as_slice().len();
        known.then(|| self.per_pixel(map, confidence))
    }

    /// Returns the standard deviation in px of each disparity of the last pair: of matched pixels from the sharpness of the minimum, of
    /// filled ones from how far their surface was extrapolated; NaN where there is no disparity.
    /// [`crate::StereoGeometry::depth_uncertainty`] converts it to depth.
    pub fn uncertainty(&self, map: &DisparityMap) -> GrayF32 {
        let width = map.state.width();
        let mut deviations = self.per_pixel(map, sigma);
        let pixels = deviations.as_mut_slice().iter_mut().zip(map.state.as_slice()).zip(map.disparity.as_slice());
        for (i, ((deviation, &state), d)) in pixels.enumerate() {
            if state != PixelState::Matched && !d.is_nan() {
                *deviation = self.filling.sigma(i % width, i / width, width, state);
            }
        }
        deviations
    }

    fn per_pixel(&self, map: &DisparityMap, f: impl Fn(&Winner, PixelState) -> f32) -> GrayF32 {
        let (width, height) = map.state.size();
        let values = self.aggregator.winners.iter().zip(map.state.as_slice()).map(|(winner, &state)| f(winner, state));
        GrayF32::from_vec(width, height, values.collect()).unwrap_or_else(|_| GrayF32::new(0, 0, [0.0]))
    }

    /// Allocates the sums of images of this size, or of a strip of them.
    pub(crate) fn prepare_aggregation(
        &mut self,
        width: usize,
        height: usize,
        progress: &dyn Progress,
    ) -> Result<(), Cancelled> {
        if self.is_hierarchical(width, height) {
            return Ok(());
        }
        let layout = self.layout(width, height);
        match self.strip_rows(width, height, self.coarse_memory(width, height)) {
            None => self.aggregator.prepare(width, height, layout, progress),
            Some(rows) => self.strip.prepare(width, rows, layout, progress),
        }
    }

    /// Returns whether images of this size are matched in search windows from half resolution.
    pub(crate) fn is_hierarchical(&self, width: usize, height: usize) -> bool {
        let StereoOptions { disparities, search, .. } = self.options;
        let volume = width.saturating_mul(height).saturating_mul(disparities);
        let is_large = match search {
            Search::Full => false,
            Search::Auto => volume >= MIN_AUTO_VOLUME && self.hierarchy_fits(width, height),
            Search::Hierarchical => volume >= MIN_HIERARCHICAL_VOLUME,
        };
        is_large && disparities >= MIN_PYRAMID_DISPARITIES && width.min(height) >= 2 * MIN_PYRAMID_SIDE
    }

    /// Returns the memory layout of the disparities of a pixel.
    pub(crate) fn layout(&self, width: usize, height: usize) -> Layout {
        let layout = Layout::new(self.level, self.options.disparities);
        if self.is_hierarchical(width, height) { layout.contiguous() } else { layout }
    }

    /// Computes census bits and values of the intensity cost.
    fn describe_pixels(&mut self) {
        let (level, layout) = (self.level, self.layout(self.gray[0].width, self.gray[0].height));
        let StereoOptions { census, intensity_cost, min_disparity, .. } = self.options;
        let [left, right] = &mut self.described;
        describe(level, &self.gray[0], census, intensity_cost, left);
        describe_mirrored(level, &self.gray[1], census, intensity_cost, i64::from(min_disparity), layout, right);
    }

    /// Aggregates the costs and selects the winners of both views.
    fn aggregate(&mut self, width: usize, height: usize, progress: &dyn Progress) -> Result<(), Cancelled> {
        let options = &self.options;
        let layout = self.layout(width, height);
        let planes = planes(options.census, options.intensity_cost);
        let stride = planes * layout.right_row(width);
        let p2 = Penalties::new(options);
        let rows = self.strip_rows(width, height, self.coarse_memory(width, height));
        let ends = (0..height).step_by(rows.unwrap_or(height).max(1)).skip(1);
        // Each row twice, and once those below a strip.
        let swept = 2 * height + ends.map(|end| (height - end).min(ROWS_BELOW_STRIP)).sum::<usize>();
        let stage = Stage::new(progress, "aggregate", swept)?;
        let frame = |rows: Range<usize>| Frame {
            width,
            height: rows.len(),
            min_disparity: i64::from(options.min_disparity),
            disparities: options.disparities,
            layout,
            planes,
            left: &self.described[0][rows.start * width * planes..rows.end * width * planes],
            right: &self.described[1][rows.start * stride..rows.end * stride],
            given: None,
            priors: self.priors.get(rows.start * width..rows.end * width).unwrap_or(&[]),
            masks: self.borders.masks(rows.start),
            intensity_cap: (options.intensity_cost != IntensityCost::None).then(|| options.intensity_cost.cap()),
            gray: &self.gray8[rows.start * width..rows.end * width],
            above: rows.start.checked_sub(1).map(|y| &self.gray8[y * width..][..width]),
            p1: options.p1,
            p2: &p2,
            second: options.confidence || options.uniqueness > 0,
        };
        let eight = options.paths == Paths::Eight;
        let is_hierarchical = self.is_hierarchical(width, height);
        if is_hierarchical {
            let Aggregator { sums, winners, right, .. } = &mut self.aggregator;
            if !options.quality {
                std::mem::swap(right, &mut self.gray[1].values);
            }
            winners.resize(width * height, Winner::default());
            right.resize(width * height, 0);
            let frame = frame(0..height);
            let (windows, buffers) = (&self.windows, (sums, &mut self.window_sweeps));
            return window_sweep::aggregate(self.level, &frame, windows, buffers, (winners, right), &stage);
        }
        let Some(rows) = rows else {
            return self.aggregator.run(self.level, &frame(0..height), height, eight, &stage);
        };
        let Aggregator { winners, right, .. } = &mut self.aggregator;
        winners.resize(width * height, Winner::default());
        right.resize(width * height, 0);
        for start in (0..height).step_by(rows) {
            let end = (start + rows).min(height);
            let frame = frame(start..(end + ROWS_BELOW_STRIP).min(height));
            self.strip.run(self.level, &frame, end - start, eight, &stage)?;
            winners[start * width..end * width].copy_from_slice(&self.strip.winners);
            right[start * width..end * width].copy_from_slice(&self.strip.right);
        }
        Ok(())
    }

    /// Checks the winners (uniqueness, field of view, left-right consistency) and refines those that pass to sub-pixel accuracy.
    fn check(&self, map: &mut DisparityMap) {
        let width = map.disparity.width();
        let masks = self.borders.masks(0);
        let Aggregator { winners, right, .. } = &self.aggregator;
        map.disparity
            .as_mut_slice()
            .par_chunks_mut(width)
            .zip(map.state.as_mut_slice().par_chunks_mut(width))
            .zip(winners.par_chunks(width).zip(right.par_chunks(width)))
            .enumerate()
            .for_each(|(y, ((disparity, state), (winners, right)))| {
                dispatch!(self.level, simd => check_row(simd, &self.options, winners, right, state, disparity));
                if let Some(masks) = masks.row(y) {
                    masks.check(self.options.min_disparity, winners, state, disparity);
                }
            });
    }

    /// Removes speckles, fills holes, and smooths; in quality mode improves the map by local expansion moves.
    fn refine(&mut self, map: &mut DisparityMap, progress: &dyn Progress) -> Result<(), Cancelled> {
        let stage = Stage::new(progress, "refine", 4)?;
        let width = map.disparity.width();
        let options = &self.options;
        let masks = self.borders.masks(0);
        let (disparity, states) = (map.disparity.as_mut_slice(), map.state.as_mut_slice());
        remove_speckles(disparity, states, width, options.speckle_size, options.speckle_range, &mut self.speckles);
        stage.add(1)?;
        if options.fill || options.quality {
            let pair = Pair {
                width,
                gray: &self.gray8,
                winners: &self.aggregator.winners,
                min_disparity: options.min_disparity,
                described: [&self.described[0], &self.described[1]],
                planes: planes(options.census, options.intensity_cost),
                bits: options.census.bits(),
                layout: self.layout(width, self.gray[0].height),
                masks,
            };
            // One buffer for both: neither is used in the other's stage.
            std::mem::swap(&mut self.filling.right, &mut self.scratch);
            let filled = fill(self.level, disparity, states, pair, &mut self.filling, &stage);
            std::mem::swap(&mut self.filling.right, &mut self.scratch);
            filled?;
            if !options.quality {
                self.borders.clear(disparity, states);
            }
            stage.add(1)?;
        }
        if options.median > 0 {
            median::median(self.level, disparity, width, options.median, &mut self.scratch);
            stage.add(1)?;
        } else {
            self.scratch.clear();
            self.scratch.extend_from_slice(disparity);
        }
        let (source, gray, buffers) = (&self.scratch, &self.gray8, &mut self.smoothing);
        smooth(self.level, options.smoothing, source, disparity, states, gray, width, buffers, &stage)?;
        stage.add(1)?;
        // Without any match there is nothing to improve.
        if options.quality && disparity.iter().all(|d| d.is_finite()) {
            let first = options.min_disparity as f32;
            let range = (first, first + (options.disparities - 1) as f32);
            let gray = [&self.gray[0], &self.gray[1]];
            local_expansion::expand(self.level, gray, range, disparity, states, progress)?;
            surface_filling::classify_unmatched(self.level, disparity, states, width, masks, &mut self.filling);
        }
        self.borders.clear(disparity, states);
        if options.quality && !options.fill {
            let unknown = disparity.iter_mut().zip(states).filter(|(_, state)| **state != PixelState::Matched);
            unknown.for_each(|(d, _)| *d = f32::NAN);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Smoothing;
    use cv_core::{GrayU8, Silent};
    use cv_synth::instruction_sets;

    /// A textured slanted surface in front of a textured wall, with a textureless patch.
    fn pair() -> [GrayU8; 2] {
        let noise = |x: usize, y: usize| (x * 7919 + y * 104_729 + x * y % 97 * 31).wrapping_mul(2_654_435_761) >> 13;
        [0, 1].map(|right| {
            GrayU8::from_fn(150, 150, |x, y| {
                let near = (40..90).contains(&x) && y > 30;
                let shift = if near { 12 + y / 16 } else { 3 };
                let flat = x > 110 && y > 100;
                [if flat { 128 } else { noise(x / 2 + right * shift / 2 + 1000 * usize::from(near), y / 2) as u8 }]
            })
        })
    }

    #[test]
    fn every_instruction_set_and_number_of_threads_gives_the_same_bytes() {
        let [left, right] = pair();
        let smoothings = [Smoothing::None, StereoOptions::default().smoothing];
        let all = smoothings.into_iter().flat_map(|s| [(s, true, false), (s, false, false), (s, true, true)]);
        for (smoothing, fill, quality) in all {
            let options = StereoOptions { disparities: 40, smoothing, fill, quality, median: 2, ..Default::default() };
            let mut first: Option<(Vec<u32>, Vec<PixelState>)> = None;
            for level in instruction_sets() {
                for threads in [1, 2, 4] {
                    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                    let mut matcher = StereoMatcher::new(options.clone()).unwrap();
                    matcher.level = level;
                    let map = pool.install(|| matcher.compute(left.view(), right.view(), &Silent)).unwrap();
                    let bits = map.disparity.as_slice().iter().map(|d| d.to_bits()).collect();
                    let found = (bits, map.state.as_slice().to_vec());
                    let expected = first.get_or_insert_with(|| found.clone());
                    assert!(found == *expected, "{level:?}, {threads} threads, {smoothing:?}");
                }
            }
        }
    }

    #[test]
    fn hierarchical_search_finds_large_steps_with_the_same_bytes_on_every_machine() {
        // Two surfaces, 80 px apart, with a boundary between; the nearer one is slanted.
        let (width, height) = (720, 400);
        let hash =
            |x: usize, y: usize| ((x * 7919 + y * 104_729) as u32).wrapping_mul(2_654_435_761).rotate_left(9) % 97;
        // Texture of two scales: coarse levels have none of the finer one.
        let texture = |x: usize, y: usize| (hash(x / 3, y / 3) + hash(x / 11 + 700, y / 11)) as u8;
        let near = |y: usize| 100 + y / 40;
        let is_near = |x: usize, y: usize| (300..500).contains(&x) && (60..340).contains(&y);
        let surface = |x: usize, y: usize, is_near: bool| [texture(x + 5000 * usize::from(is_near), y)];
        let left = GrayU8::from_fn(width, height, |x, y| surface(x, y, is_near(x, y)));
        let right = GrayU8::from_fn(width, height, |x, y| {
            let from_near = x + near(y);
            if is_near(from_near, y) { surface(from_near, y, true) } else { surface(x + 24, y, false) }
        });
        let options = StereoOptions { disparities: 128, search: Search::Hierarchical, ..Default::default() };
        let mut first: Option<Vec<u32>> = None;
        for level in instruction_sets() {
            for threads in [1, 3] {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                let mut matcher = StereoMatcher::new(options.clone()).unwrap();
                matcher.level = level;
                assert!(matcher.is_hierarchical(width, height));
                let map = pool.install(|| matcher.compute(left.view(), right.view(), &Silent)).unwrap();
                let bits =
                    |map: &DisparityMap| map.disparity.as_slice().iter().map(|d| d.to_bits()).collect::<Vec<_>>();
                let expected = first.get_or_insert_with(|| bits(&map));
                assert!(bits(&map) == *expected, "{level:?}, {threads} threads");
                // Again, after a pair of another size in the same buffers.
                let [other_left, other_right] = pair();
                for (left, right) in [(&other_left, &other_right), (&left, &right), (&left, &right)] {
                    let map = pool.install(|| matcher.compute(left.view(), right.view(), &Silent)).unwrap();
                    assert!(left.width() != width || bits(&map) == *expected, "{level:?}, {threads} threads");
                }
                let pixels = (0..height).flat_map(|y| (128..width).map(move |x| (x, y)));
                let bad = pixels.filter(|&(x, y)| {
                    let truth = if is_near(x, y) { near(y) } else { 24 };
                    // The boundary, and what the near surface occludes.
                    let is_visible = !(200..300).contains(&x) && !(490..510).contains(&x);
                    is_visible && (map.disparity.at(x, y)[0] - truth as f32).abs() > 1.0
                });
                let bad = bad.count();
                // The rim of the matching windows at the horizontal boundaries, of half resolution at most.
                assert!(bad < 2 * 200 * 6, "{bad}");
            }
        }
    }

    #[test]
    fn an_image_of_one_color_matches_nowhere() {
        let gray = GrayU8::new(60, 40, [77]);
        let mut matcher = StereoMatcher::new(StereoOptions { disparities: 24, ..Default::default() }).unwrap();
        let map = matcher.compute(gray.view(), gray.view(), &Silent).unwrap();
        assert_eq!((map.matched_fraction(), map.valid_fraction()), (0.0, 0.0));
    }
}
