//! From a rectified pair to checked disparities.

use crate::census::{Gray, describe, describe_mirrored, planes};
use crate::coarse_prior::{Prior, find_flat, guide};
use crate::confidence::{confidence, sigma};
use crate::cost::{Frame, Penalties};
use crate::edge_preserving::{self, Planes, smooth};
use crate::input::to_gray;
use crate::layout::Layout;
use crate::local_expansion;
use crate::sgm::Aggregator;
use crate::speckle::{Speckles, remove_speckles};
use crate::surface_filling::{self, Filling, Pair, fill};
use crate::winner::{NO_SUM, Winner};
use crate::{Intensity, IntensityCost, Paths, Smoothing, StereoError, StereoOptions, Subpixel, median};
use cv_core::{Cancelled, GrayF32, Image, ImageView, Progress, Sample, Stage, StageClock};
use fearless_simd::Level;
use rayon::prelude::*;
use std::ops::Range;

/// Rows beyond a strip that its paths start from: what lies farther away hardly matters.
const OVERLAP: usize = 32;

/// A picture is not halved below so many px of width or height.
const LEAST_SIDE: usize = 16;

/// Nor for fewer disparities than so many: half of them would agree by chance.
const LEAST_RANGE: usize = 32;
/// A coarse level guides where this share of it is matched. Of the 24 public pairs every one has 0.65 or more; photographs of different
/// things, and exchanged ones, which would be guided to agree with themselves, mostly have less.
const LEAST_MATCHED: f64 = 0.6;

/// Fewer rows than so many at a time would mostly repeat the overlap.
const MIN_STRIP: usize = 32;

/// How a pixel came by its disparity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u8)]
pub enum PixelState {
    /// Matched and confirmed by every check.
    #[default]
    Matched,
    /// Seen by the left camera only: something nearer hides it from the right one. Filled from the background.
    Occluded,
    /// Its match failed a check, or smoothing found it on the wrong side of an outline of the photograph. Filled from the surfaces around.
    Mismatched,
    /// Its match would lie outside the right image. Filled from the surfaces around.
    OutOfView,
}

impl Sample for PixelState {}

/// Disparities of a left image.
#[derive(Debug, Clone, PartialEq)]
pub struct DisparityMap {
    /// `x_left − x_right` in px, NaN where there is none.
    pub disparity: GrayF32,
    /// Where each disparity comes from; all but [`PixelState::Matched`] are filled in, or NaN without filling.
    pub state: Image<PixelState, 1>,
}

impl DisparityMap {
    /// An empty map, to be handed to [`StereoMatcher::compute_into`].
    pub fn empty() -> Self {
        Self { disparity: GrayF32::new(0, 0, [0.0]), state: Image::new(0, 0, [PixelState::Matched]) }
    }

    fn resize(&mut self, width: usize, height: usize) {
        if self.disparity.size() != (width, height) {
            self.disparity = GrayF32::new(width, height, [f32::NAN]);
            self.state = Image::new(width, height, [PixelState::Matched]);
        }
    }

    /// Share of pixels with a disparity, filled ones included.
    pub fn valid_fraction(&self) -> f64 {
        let d = self.disparity.as_slice();
        d.iter().filter(|v| v.is_finite()).count() as f64 / d.len().max(1) as f64
    }

    /// Share of pixels whose disparity was measured and passed every check.
    pub fn matched_fraction(&self) -> f64 {
        let s = self.state.as_slice();
        s.iter().filter(|&&v| v == PixelState::Matched).count() as f64 / s.len().max(1) as f64
    }
}

/// A semi-global matcher (Hirschmüller, PAMI 2008) that keeps its buffers between pairs.
///
/// ```
/// use cv_core::{Image, Silent};
/// use cv_stereo::{StereoMatcher, StereoOptions};
///
/// // A textured wall seen 5 px further left by the right camera.
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
    /// Census bits and what the intensity_cost compares, of both views.
    described: [Vec<u8>; 2],
    aggregator: Aggregator,
    /// For aggregation in strips.
    strip: Aggregator,
    speckles: Speckles,
    filling: Filling,
    scratch: Vec<f32>,
    planes: Planes,
    /// Where flat pixels are guided to, and the matcher of half the size that says so; none where there is no flat part.
    priors: Vec<Prior>,
    coarse: Option<Box<Coarse>>,
    stages: Vec<(&'static str, f64)>,
}

/// The level of half the size.
#[derive(Debug)]
struct Coarse {
    matcher: StereoMatcher,
    map: DisparityMap,
}

impl StereoMatcher {
    /// A matcher with these options.
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
            described: Default::default(),
            aggregator: Aggregator::default(),
            strip: Aggregator::default(),
            speckles: Speckles::default(),
            filling: Filling::default(),
            scratch: Vec::new(),
            planes: Planes::default(),
            priors: Vec::new(),
            coarse: None,
            stages: Vec::new(),
        })
    }

    /// The options.
    pub fn options(&self) -> &StereoOptions {
        &self.options
    }

    /// Bytes that matching images of this size takes, outputs included: about one byte per pixel and disparity for the
    /// sums, and seventy per pixel, in quality mode a hundred more (gray values 6, bits 3 to 8 of each view, winners 12, labels up to 8, priors 4, surfaces 7, the planes of the
    /// smoothing 16, outputs and scratch 9), and for the coarser levels an eighth of the sums and a third of the rest. Under [`StereoOptions::max_memory`] the sums are those of a strip.
    pub fn memory(&self, width: usize, height: usize) -> usize {
        let coarse = self.coarse_memory(width, height);
        let rows = self.strip_rows(width, height, coarse).unwrap_or(height);
        self.memory_of(width, height, rows, coarse)
    }

    /// Bytes of the coarser levels.
    fn coarse_memory(&self, width: usize, height: usize) -> usize {
        self.coarser(width, height).map_or(0, |(_, bytes)| bytes)
    }

    /// Bytes where `rows` rows at a time are aggregated and the coarser levels take `coarse`.
    fn memory_of(&self, width: usize, height: usize, rows: usize, coarse: usize) -> usize {
        let options = &self.options;
        let pixels = width.saturating_mul(height);
        let planes = planes(options.census, options.intensity_cost);
        let strip = if rows < height { (rows + 2 * OVERLAP).min(height) } else { 0 };
        let whole = if rows < height { 0 } else { height };
        // Gray of both views in 16 bits, of one in 8; winners of both views; labels, scratch and outputs.
        let fixed = 5 + planes + size_of::<Winner>() + size_of::<u16>() + 8 + 4 + 5 + size_of::<Prior>();
        let stride = self.layout().right_row(width);
        Aggregator::bytes(width, strip.max(whole), self.layout())
            .saturating_add(strip.saturating_mul(width).saturating_mul(size_of::<Winner>() + size_of::<u16>()))
            .saturating_add(pixels.saturating_mul(fixed))
            .saturating_add(edge_preserving::bytes(options.smoothing, width, height))
            .saturating_add(if options.fill || options.quality { surface_filling::bytes(width, height) } else { 0 })
            .saturating_add(if options.quality { local_expansion::bytes(width, height) } else { 0 })
            .saturating_add(coarse)
            .saturating_add(stride.saturating_mul(height).saturating_mul(planes))
    }

    /// How many rows at a time are aggregated under [`StereoOptions::max_memory`]: `None` for all, or where not even few
    /// would do.
    fn strip_rows(&self, width: usize, height: usize, coarse: usize) -> Option<usize> {
        let allowed = self.options.max_memory?;
        if self.memory_of(width, height, height, coarse) <= allowed {
            return None;
        }
        // The more rows, the less is done twice.
        let fits = |rows: &usize| self.memory_of(width, height, *rows, coarse) <= allowed;
        (MIN_STRIP..height).step_by(MIN_STRIP).take_while(fits).last()
    }

    /// Disparities of `left`. The images are rectified: a scene point has the same y in both.
    ///
    /// # Errors
    /// [`StereoError`] where the images do not fit together or the disparities do not fit the images, and where `progress` says stop.
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

    /// As [`StereoMatcher::compute`], into a map of any size, whose memory is used again where it has the right one.
    ///
    /// # Errors
    /// As [`StereoMatcher::compute`]; `map` is then unchanged, or, where the job was stopped, of no use.
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
        for (side, view, gray) in [("left", left, 0), ("right", right, 1)] {
            let count = to_gray(self.level, view, &mut self.gray[gray]);
            if count > 0 {
                return Err(StereoError::NotFinite { side, count });
            }
        }
        clock.lap("gray");
        self.compute_gray(map, clock, progress)
    }

    /// As [`StereoMatcher::compute_into`], of the gray values at hand.
    fn compute_gray(
        &mut self,
        map: &mut DisparityMap,
        mut clock: StageClock,
        progress: &dyn Progress,
    ) -> Result<(), StereoError> {
        let (width, height) = (self.gray[0].width, self.gray[0].height);
        progress.report("bits", 0, 1)?;
        self.bits();
        clock.lap("bits");
        self.match_coarse(width, height, progress)?;
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

    /// What the last pair took in seconds, stage by stage: gray values, description of the pixels, costs and path sums,
    /// checks and refinement.
    pub fn stages(&self) -> &[(&'static str, f64)] {
        &self.stages
    }

    /// How sure each disparity of the last pair is, 0 to 1: how far its cost lies below the best one elsewhere; 0 where it
    /// was filled. `None` without [`StereoOptions::confidence`], and before the first pair.
    pub fn confidence(&self, map: &DisparityMap) -> Option<GrayF32> {
        let known = self.options.confidence && self.aggregator.winners.len() == map.state.as_slice().len();
        known.then(|| self.per_pixel(map, confidence))
    }

    /// Standard deviation in px of each disparity of the last pair, from how sharp its minimum is; NaN where it was
    /// filled. [`crate::StereoGeometry::depth_uncertainty`] makes error bars of depth from it.
    pub fn uncertainty(&self, map: &DisparityMap) -> GrayF32 {
        self.per_pixel(map, sigma)
    }

    fn per_pixel(&self, map: &DisparityMap, f: impl Fn(&Winner, PixelState) -> f32) -> GrayF32 {
        let (width, height) = map.state.size();
        let values = self.aggregator.winners.iter().zip(map.state.as_slice()).map(|(winner, &state)| f(winner, state));
        GrayF32::from_vec(width, height, values.collect()).unwrap_or_else(|_| GrayF32::new(0, 0, [0.0]))
    }

    /// Refuses image sizes that these options cannot work on.
    fn check_size(&self, width: usize, height: usize) -> Result<(), StereoError> {
        self.check_memory(width, height, self.memory(width, height))
    }

    /// As `check_size`, where `bytes` are what these images take.
    fn check_memory(&self, width: usize, height: usize, bytes: usize) -> Result<(), StereoError> {
        let (window_width, window_height) = self.options.census.size();
        if width < window_width || height < window_height {
            return Err(StereoError::TooSmall { width, height, window_width, window_height });
        }
        let min = i64::from(self.options.min_disparity);
        let max = min + self.options.disparities as i64 - 1;
        if min >= width as i64 || max <= -(width as i64) {
            return Err(StereoError::RangeOutsideImage { min, max, width });
        }
        let allowed = self.options.max_memory.unwrap_or(isize::MAX as usize);
        if bytes > allowed {
            let coarse = self.coarse_memory(width, height);
            let of = |rows| self.memory_of(width, height, rows, coarse);
            let needed = of(MIN_STRIP).min(of(height));
            return Err(StereoError::Memory { needed, allowed });
        }
        Ok(())
    }

    /// Asks for the memory that images of this size need, so that the first frame takes no longer than the next.
    ///
    /// # Errors
    /// [`StereoError`] where the disparities do not fit the images, or the memory is more than allowed.
    pub fn prepare(
        &mut self,
        width: usize,
        height: usize,
        map: &mut DisparityMap,
        progress: &dyn Progress,
    ) -> Result<(), StereoError> {
        self.check_size(width, height)?;
        match self.strip_rows(width, height, self.coarse_memory(width, height)) {
            None => self.aggregator.prepare(width, height, self.layout(), progress)?,
            Some(rows) => {
                self.strip.prepare(width, (rows + 2 * OVERLAP).min(height), self.layout(), progress)?;
            }
        }
        map.resize(width, height);
        Ok(())
    }

    /// In which order the disparities of a pixel lie in memory.
    fn layout(&self) -> Layout {
        Layout::new(self.level, self.options.disparities)
    }

    /// What costs are made of.
    fn bits(&mut self) {
        let (level, layout) = (self.level, self.layout());
        let StereoOptions { census, intensity_cost, min_disparity, .. } = self.options;
        let [left, right] = &mut self.described;
        describe(level, &self.gray[0], census, intensity_cost, left);
        describe_mirrored(level, &self.gray[1], census, intensity_cost, i64::from(min_disparity), layout, right);
        self.gray[0].to_bytes(&mut self.gray8);
    }

    /// A matcher of half the size and its bytes, where there is to be one and it has the memory.
    fn coarser(&self, width: usize, height: usize) -> Option<(Self, usize)> {
        let StereoOptions { min_disparity, disparities, pyramid_levels, max_memory, .. } = self.options;
        if pyramid_levels == 0 || width.min(height) < 2 * LEAST_SIDE || disparities < LEAST_RANGE {
            return None;
        }
        let first = min_disparity.div_euclid(2);
        let last = (min_disparity + disparities as i32 - 1).div_euclid(2);
        let options = StereoOptions {
            min_disparity: first,
            disparities: (last - first + 1) as usize,
            pyramid_levels: pyramid_levels - 1,
            speckle_size: self.options.speckle_size / 4,
            paths: Paths::Four,
            confidence: false,
            fill: false,
            quality: false,
            smoothing: Smoothing::None,
            max_memory: max_memory.map(|bytes| bytes / 4),
            ..self.options.clone()
        };
        let mut coarse = Self::new(options).ok()?;
        coarse.level = self.level;
        let bytes = coarse.memory(width / 2, height / 2);
        coarse.check_memory(width / 2, height / 2, bytes).is_ok().then_some((coarse, bytes))
    }

    /// Matches at half the size where the photograph is flat, for `priors`.
    fn match_coarse(&mut self, width: usize, height: usize, progress: &dyn Progress) -> Result<(), StereoError> {
        let coarse = self.coarser(width, height);
        let Some((new, _)) = coarse.filter(|_| find_flat(self.level, &self.gray8, width, &mut self.priors)) else {
            self.priors.clear();
            return Ok(());
        };
        // Made anew where the size of the pictures leaves it other options.
        let coarse = self.coarse.take().filter(|coarse| coarse.matcher.options == new.options);
        let mut coarse = coarse.unwrap_or_else(|| Box::new(Coarse { matcher: new, map: DisparityMap::empty() }));
        let Coarse { matcher, map } = &mut *coarse;
        for (small, large) in matcher.gray.iter_mut().zip(&self.gray) {
            small.halve(large);
        }
        matcher.compute_gray(map, StageClock::new(), progress)?;
        if map.matched_fraction() < LEAST_MATCHED {
            self.priors.clear();
        } else {
            let range = (self.options.min_disparity, self.options.disparities);
            guide(self.level, map.disparity.as_slice(), width / 2, width, range, &mut self.priors);
        }
        self.coarse = Some(coarse);
        Ok(())
    }

    /// Costs and path sums; winners of both views.
    fn aggregate(&mut self, width: usize, height: usize, progress: &dyn Progress) -> Result<(), Cancelled> {
        let options = &self.options;
        let layout = self.layout();
        let planes = planes(options.census, options.intensity_cost);
        let stride = planes * layout.right_row(width);
        let p2 = Penalties::new(options);
        let rows = self.strip_rows(width, height, self.coarse_memory(width, height));
        let strips = rows.map_or(1, |rows| height.div_ceil(rows));
        // Each row twice, and some more where strips overlap.
        let stage = Stage::new(progress, "aggregate", 2 * (height + 2 * OVERLAP * (strips - 1)))?;
        let run = |aggregator: &mut Aggregator, rows: Range<usize>| -> Result<(), Cancelled> {
            let frame = Frame {
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
                intensity_cap: (options.intensity_cost != IntensityCost::None).then(|| options.intensity_cost.cap()),
                gray: &self.gray8[rows.start * width..rows.end * width],
                p1: options.p1,
                p2: &p2,
                second: options.confidence || options.uniqueness > 0,
            };
            aggregator.run(self.level, &frame, options.paths == Paths::Eight, &stage)
        };
        let Some(rows) = rows else { return run(&mut self.aggregator, 0..height) };
        let Aggregator { winners, right, .. } = &mut self.aggregator;
        winners.resize(width * height, Winner::default());
        right.resize(width * height, 0);
        for start in (0..height).step_by(rows) {
            let end = (start + rows).min(height);
            let from = start.saturating_sub(OVERLAP);
            run(&mut self.strip, from..(end + OVERLAP).min(height))?;
            let inside = (start - from) * width..(end - from) * width;
            winners[start * width..end * width].copy_from_slice(&self.strip.winners[inside.clone()]);
            right[start * width..end * width].copy_from_slice(&self.strip.right[inside]);
        }
        Ok(())
    }

    /// Uniqueness, view, left-right consistency; sub-pixel place of what passes.
    fn check(&self, map: &mut DisparityMap) {
        let width = map.disparity.width();
        let Aggregator { winners, right, .. } = &self.aggregator;
        let options = &self.options;
        map.disparity
            .as_mut_slice()
            .par_chunks_mut(width)
            .zip(map.state.as_mut_slice().par_chunks_mut(width))
            .zip(winners.par_chunks(width).zip(right.par_chunks(width)))
            .for_each(|((disparity, state), (winners, right))| {
                for (x, ((winner, state), d)) in winners.iter().zip(state).zip(disparity).enumerate() {
                    *state = judge(options, x, winner, right);
                    let whole = (options.min_disparity + i32::from(winner.index)) as f32;
                    // Computed in any case: a branch would be guessed wrong where matched and lost pixels mix.
                    let value = whole + subpixel(options.subpixel, winner);
                    *d = if *state == PixelState::Matched { value } else { f32::NAN };
                }
            });
    }

    /// Speckles, holes, median.
    fn refine(&mut self, map: &mut DisparityMap, progress: &dyn Progress) -> Result<(), Cancelled> {
        let stage = Stage::new(progress, "refine", 4)?;
        let width = map.disparity.width();
        let options = &self.options;
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
                layout: Layout::new(self.level, options.disparities),
            };
            fill(self.level, disparity, states, pair, &mut self.filling, &stage)?;
            stage.add(1)?;
        }
        if options.median > 0 {
            median::median(self.level, disparity, width, options.median, &mut self.scratch);
            disparity
                .par_chunks_mut(1 << 16)
                .zip(self.scratch.par_chunks(1 << 16))
                .for_each(|(d, s)| d.copy_from_slice(s));
            stage.add(1)?;
        }
        smooth(self.level, options.smoothing, disparity, states, &self.gray8, width, &mut self.planes, &stage)?;
        stage.add(1)?;
        // Where nothing at all was matched there is nothing to improve.
        if options.quality && disparity.iter().all(|d| d.is_finite()) {
            let first = options.min_disparity as f32;
            let range = (first, first + (options.disparities - 1) as f32);
            let gray = [&self.gray[0], &self.gray[1]];
            local_expansion::expand(self.level, gray, range, disparity, states, progress)?;
            surface_filling::name_causes(disparity, states, width, &mut self.filling);
        }
        if options.quality && !options.fill {
            let unknown = disparity.iter_mut().zip(states).filter(|(_, state)| **state != PixelState::Matched);
            unknown.for_each(|(d, _)| *d = f32::NAN);
        }
        Ok(())
    }
}

/// What the checks say of a pixel's winner. Without branches on what pixels hold: they would be guessed wrong where matched and
/// lost pixels mix.
#[inline(always)]
fn judge(options: &StereoOptions, x: usize, winner: &Winner, right: &[u16]) -> PixelState {
    let xr = x as i64 - i64::from(options.min_disparity) - i64::from(winner.index);
    let inside = xr >= 0 && xr < right.len() as i64;
    let seen = right[xr.clamp(0, right.len() as i64 - 1) as usize];
    let differs = options.left_right.is_some_and(|tolerance| seen.abs_diff(winner.index) > tolerance);
    // Nothing tells one disparity from the next, nor what hides the pixel.
    let flat = winner.below == winner.cost;
    let unsure = u32::from(winner.second) * u32::from(100 - options.uniqueness) < u32::from(winner.cost) * 100;
    let unsure = flat | (unsure & (options.uniqueness > 0));
    let mut state = if unsure { PixelState::Mismatched } else { PixelState::Matched };
    // What the right camera sees there is nearer: it hides this pixel.
    let hidden = if seen > winner.index { PixelState::Occluded } else { PixelState::Mismatched };
    state = if differs { hidden } else { state };
    state = if inside { state } else { PixelState::OutOfView };
    if flat { PixelState::Mismatched } else { state }
}

/// Offset of the minimum from the winning index, −0.5 to 0.5; without branches on sums, as above.
#[inline(always)]
fn subpixel(method: Subpixel, winner: &Winner) -> f32 {
    let [below, above, cost] = [winner.below, winner.above, winner.cost].map(f32::from);
    let slope = below.max(above) - cost;
    // Rise on the lower side as a share of that on the higher: 1 in the middle, 0 half a pixel away.
    let ratio = (below.min(above) - cost) / slope;
    let rest = match method {
        Subpixel::CorrectedVFit => 0.5 * ratio * (1.0 + ratio),
        Subpixel::None | Subpixel::VFit => ratio,
    };
    let offset = (0.5 * (1.0 - rest)).copysign(below - above);
    let none = (method == Subpixel::None) | (winner.below == NO_SUM) | (winner.above == NO_SUM) | (slope <= 0.0);
    if none { 0.0 } else { offset }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{GrayU8, Silent};
    use cv_synth::instruction_sets;

    /// A textured slope before a textured wall, with a patch without texture.
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
    fn a_picture_of_one_color_matches_nowhere() {
        let gray = GrayU8::new(60, 40, [77]);
        let mut matcher = StereoMatcher::new(StereoOptions { disparities: 24, ..Default::default() }).unwrap();
        let map = matcher.compute(gray.view(), gray.view(), &Silent).unwrap();
        assert_eq!((map.matched_fraction(), map.valid_fraction()), (0.0, 0.0));
    }
}
