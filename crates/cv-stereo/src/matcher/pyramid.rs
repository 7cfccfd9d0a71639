//! The pyramid of a matcher: half resolution gives the search windows of large images and the priors of low texture.
//!
//! Where images are large, most of the system's time is that of the page faults of fresh memory. There all levels use the same buffers, and
//! those of the gray levels serve others once every pixel is described.

use super::{MIN_PYRAMID_DISPARITIES, MIN_PYRAMID_SIDE, StereoMatcher};
use crate::coarse_prior::{Prior, classify_texture, set_priors};
use crate::{DisparityMap, Paths, PixelState, Search, Smoothing, StereoError, StereoOptions, window_sweep};
use cv_core::{Progress, StageClock};

/// A coarser level gives priors if this fraction of it is matched. Each of the 24 public pairs has 0.65 or more; images of different
/// scenes, and exchanged ones, which priors would make consistent with themselves, mostly have less.
const MIN_PRIOR_MATCHED: f64 = 0.6;

/// The pyramid level of half resolution.
#[derive(Debug)]
pub(super) struct Coarse {
    matcher: StereoMatcher,
    map: DisparityMap,
}

impl StereoMatcher {
    /// Returns a matcher for half resolution and its bytes; `None` without a further level, and where the memory limit excludes it.
    pub(crate) fn coarser(&self, width: usize, height: usize) -> Option<(Self, usize)> {
        let StereoOptions { min_disparity, disparities, pyramid_levels, max_memory, .. } = self.options;
        let is_hierarchical = self.is_hierarchical(width, height);
        let is_small = width.min(height) < 2 * MIN_PYRAMID_SIDE || disparities < MIN_PYRAMID_DISPARITIES;
        if is_small || !is_hierarchical && pyramid_levels == 0 {
            return None;
        }
        let first = min_disparity.div_euclid(2);
        let last = (min_disparity + disparities as i32 - 1).div_euclid(2);
        let options = StereoOptions {
            min_disparity: first,
            disparities: (last - first + 1) as usize,
            speckle_size: self.options.speckle_size / 4,
            confidence: false,
            quality: false,
            sequence: false,
            ..self.options.clone()
        };
        let options = if is_hierarchical {
            let (search, smoothing) = (Search::Hierarchical, Smoothing::None);
            StereoOptions { search, fill: true, smoothing, max_memory: None, ..options }
        } else {
            StereoOptions {
                search: Search::Full,
                pyramid_levels: pyramid_levels - 1,
                paths: Paths::Four,
                fill: false,
                smoothing: Smoothing::None,
                max_memory: max_memory.map(|bytes| bytes / 4),
                ..options
            }
        };
        let mut coarse = Self::new(options).ok()?;
        coarse.level = self.level;
        let bytes = coarse.memory(width / 2, height / 2);
        coarse.check_memory(width / 2, height / 2, bytes).is_ok().then_some((coarse, bytes))
    }

    /// Matches at half resolution where that determines search windows, or enough of the image has low texture; `None` elsewhere. The
    /// coarse map of hierarchical matching is `map`.
    pub(super) fn match_coarse(
        &mut self,
        (width, height): (usize, usize),
        map: &mut DisparityMap,
        progress: &dyn Progress,
    ) -> Result<Option<Box<Coarse>>, StereoError> {
        let is_hierarchical = self.is_hierarchical(width, height);
        let coarse = self.coarser(width, height);
        let is_matched = coarse.is_some()
            && (is_hierarchical
                || self.options.pyramid_levels > 0
                    && classify_texture(self.level, &self.gray8, width, &mut self.priors));
        let Some((new, _)) = coarse.filter(|_| is_matched) else {
            self.priors.clear();
            return Ok(None);
        };
        // Replaced if the image size gives it other options.
        let coarse = self.coarse.take().filter(|coarse| coarse.matcher.options == new.options);
        let mut coarse = coarse.unwrap_or_else(|| Box::new(Coarse { matcher: new, map: DisparityMap::empty() }));
        let Coarse { matcher, map: own } = &mut *coarse;
        if is_hierarchical {
            // At its final size first: memory that is not touched costs nothing.
            self.aggregator.sums.resize(window_sweep::volume(width, height, rayon::current_num_threads()), 0);
            self.exchange_buffers(matcher);
            matcher.reclaim_gray();
        }
        for (small, large) in matcher.gray.iter_mut().zip(&self.gray) {
            small.halve(large);
        }
        matcher.borders = self.borders.halved();
        let map = if is_hierarchical { map } else { own };
        let matched = matcher.compute_gray(map, StageClock::new(), progress);
        if is_hierarchical {
            self.exchange_buffers(matcher);
        }
        matched?;
        if is_hierarchical {
            let range = (self.options.min_disparity, self.options.disparities);
            self.windows.set(self.level, map.disparity.as_slice(), width / 2, range);
            let unmatched = map.disparity.as_mut_slice().iter_mut().zip(map.state.as_slice());
            unmatched.filter(|(_, state)| **state != PixelState::Matched).for_each(|(d, _)| *d = f32::NAN);
        }
        Ok(Some(coarse))
    }

    /// Sets the priors from the map of half resolution, if there is one: `map` where matching is hierarchical.
    pub(super) fn set_priors(
        &mut self,
        coarse: Option<Box<Coarse>>,
        map: &DisparityMap,
        (width, height): (usize, usize),
    ) {
        let Some(coarse) = coarse else { return };
        let is_hierarchical = self.is_hierarchical(width, height);
        let map = if is_hierarchical { map } else { &coarse.map };
        let is_determined = map.matched_fraction() >= MIN_PRIOR_MATCHED;
        let has_priors = if is_hierarchical && is_determined && self.options.pyramid_levels > 0 {
            if !self.options.quality {
                // Not read any more: all pixels are described.
                self.priors = std::mem::take(&mut self.gray[0].values).into_iter().map(Prior::from_bits).collect();
            }
            classify_texture(self.level, &self.gray8, width, &mut self.priors)
        } else {
            is_determined && !is_hierarchical
        };
        if has_priors {
            let range = (self.options.min_disparity, self.options.disparities);
            set_priors(self.level, map.disparity.as_slice(), width / 2, width, range, &mut self.priors);
        } else {
            self.priors.clear();
        }
        self.coarse = Some(coarse);
    }

    /// Takes the memory of the gray levels back from the priors and the winners of the right view, which have it once the gray levels are not
    /// read any more.
    pub(super) fn reclaim_gray(&mut self) {
        let [left, right] = self.gray.each_mut().map(|gray| &mut gray.values);
        if self.priors.capacity() > left.capacity() {
            *left = std::mem::take(&mut self.priors).into_iter().map(Prior::to_bits).collect();
        }
        if self.aggregator.right.capacity() > right.capacity() {
            std::mem::swap(right, &mut self.aggregator.right);
        }
    }

    /// Exchanges the buffers that this level does not read while the other is matched.
    fn exchange_buffers(&mut self, other: &mut Self) {
        std::mem::swap(&mut self.described, &mut other.described);
        std::mem::swap(&mut self.aggregator, &mut other.aggregator);
        std::mem::swap(&mut self.window_sweeps, &mut other.window_sweeps);
        std::mem::swap(&mut self.speckles, &mut other.speckles);
        std::mem::swap(&mut self.filling, &mut other.filling);
        std::mem::swap(&mut self.smoothing, &mut other.smoothing);
        std::mem::swap(&mut self.scratch, &mut other.scratch);
    }
}
