//! Memory of a matcher: how many bytes an image size takes, and in how many rows at a time costs are aggregated under a limit.

use crate::census::planes;
use crate::coarse_prior::Prior;
use crate::sgm::Aggregator;
use crate::winner::Winner;
use crate::{
    DisparityMap, Search, StereoError, StereoMatcher, StereoOptions, edge_preserving, local_expansion, surface_filling,
    window_sweep,
};
use cv_core::Progress;

/// Rows below a strip at which its paths upwards start: those that start farther away hardly change the sums. (The paths downwards go on from strip to strip.)
pub(crate) const ROWS_BELOW_STRIP: usize = 64;

/// Limits that are tried until one suffices; each has room for one more of the coarser levels than the last.
const MAX_LIMIT_TRIALS: usize = 8;

/// Fewest rows of a strip: lower ones would mostly repeat the rows below.
const MIN_STRIP_ROWS: usize = 32;

impl StereoMatcher {
    /// Returns the bytes that matching images of this size takes, outputs included: about one byte per pixel and disparity for the
    /// sums (hierarchical: some megabytes per thread), and fifty per pixel, in quality mode a hundred more (gray levels 5, census bits 3 to 8
    /// of each view, winners 12, labels up to 8, priors 2, surfaces 7, outputs and scratch 9), and for the pyramid levels an eighth of the
    /// sums and a third of the rest. Under [`StereoOptions::max_memory`](crate::StereoOptions::max_memory) the sums are those of a strip.
    pub fn memory(&self, width: usize, height: usize) -> usize {
        let coarse = self.coarse_memory(width, height);
        let rows = self.strip_rows(width, height, coarse).unwrap_or(height);
        self.memory_of(width, height, rows, coarse)
    }

    /// Returns the bytes of the coarser pyramid levels.
    pub(crate) fn coarse_memory(&self, width: usize, height: usize) -> usize {
        self.coarser(width, height).map_or(0, |(_, bytes)| bytes)
    }

    /// Returns the bytes where `rows` rows at a time are aggregated and the coarser levels take `coarse`.
    fn memory_of(&self, width: usize, height: usize, rows: usize, coarse: usize) -> usize {
        let options = self.options();
        let pixels = width.saturating_mul(height);
        let planes = planes(options.census, options.intensity_cost);
        let strip = if rows < height { rows } else { 0 };
        let whole = if rows < height { 0 } else { height };
        // Gray of both views in 16 bits, of one in 8; winners of both views; labels, scratch and outputs.
        let fixed = 5 + planes + size_of::<Winner>() + size_of::<u16>() + 8 + 4 + 5 + size_of::<Prior>();
        // The previous frame of both views.
        let fixed = fixed + if options.sequence { 2 * size_of::<u16>() } else { 0 };
        let layout = self.layout(width, height);
        let stride = layout.right_row(width);
        let aggregation = if self.is_hierarchical(width, height) {
            // Winners of both views, and windows of coarse pixels.
            let winners = pixels.saturating_mul(size_of::<Winner>() + size_of::<u16>());
            let strips = window_sweep::bytes(width, height, rayon::current_num_threads());
            winners.saturating_add(strips).saturating_add(pixels / 2)
        } else {
            Aggregator::bytes(width, strip.max(whole), layout)
        };
        aggregation
            .saturating_add(strip.saturating_mul(width).saturating_mul(size_of::<Winner>() + size_of::<u16>()))
            .saturating_add(pixels.saturating_mul(fixed))
            .saturating_add(edge_preserving::bytes(options.smoothing, width, height))
            .saturating_add(if options.fill || options.quality { surface_filling::bytes(width, height) } else { 0 })
            .saturating_add(if options.quality { local_expansion::bytes(width, height) } else { 0 })
            .saturating_add(coarse)
            .saturating_add(stride.saturating_mul(height).saturating_mul(planes))
    }

    /// Returns how many rows at a time are aggregated under the memory limit; `None` for all, and where even the lowest strips
    /// exceed it.
    pub(crate) fn strip_rows(&self, width: usize, height: usize, coarse: usize) -> Option<usize> {
        let allowed = self.options().max_memory.filter(|_| !self.is_hierarchical(width, height))?;
        if self.memory_of(width, height, height, coarse) <= allowed {
            return None;
        }
        // The more rows, the fewer are computed twice.
        let fits = |rows: &usize| self.memory_of(width, height, *rows, coarse) <= allowed;
        (MIN_STRIP_ROWS..height).step_by(MIN_STRIP_ROWS).take_while(fits).last()
    }

    /// Returns whether hierarchical matching is within the memory limit. Strips of the whole range may be where it is not.
    pub(crate) fn hierarchy_fits(&self, width: usize, height: usize) -> bool {
        let Some(allowed) = self.options().max_memory else { return true };
        let options = StereoOptions { search: Search::Hierarchical, max_memory: None, ..self.options().clone() };
        Self::new(options).is_ok_and(|matcher| matcher.memory(width, height) <= allowed)
    }

    /// Returns a memory limit under which images of this size can be matched, close to the smallest one.
    fn smallest_limit(&self, width: usize, height: usize) -> usize {
        let in_low_strips = |matcher: &Self| {
            let coarse = matcher.coarse_memory(width, height);
            let of = |rows| matcher.memory_of(width, height, rows, coarse);
            of(MIN_STRIP_ROWS).min(of(height))
        };
        let mut limit = in_low_strips(self);
        // The limit decides on the coarser levels too: a larger one has room for them, and needs more.
        for _ in 0..MAX_LIMIT_TRIALS {
            let options = StereoOptions { max_memory: Some(limit), ..self.options().clone() };
            let Ok(matcher) = Self::new(options) else { break };
            if matcher.memory(width, height) <= limit {
                break;
            }
            limit = limit.max(in_low_strips(&matcher));
        }
        limit
    }

    /// Refuses image sizes that are not possible with these options.
    pub(crate) fn check_size(&self, width: usize, height: usize) -> Result<(), StereoError> {
        self.check_memory(width, height, self.memory(width, height))
    }

    /// As `check_size`, where these images take `bytes`.
    pub(crate) fn check_memory(&self, width: usize, height: usize, bytes: usize) -> Result<(), StereoError> {
        let options = self.options();
        let (window_width, window_height) = options.census.size();
        if width < window_width || height < window_height {
            return Err(StereoError::TooSmall { width, height, window_width, window_height });
        }
        let min = i64::from(options.min_disparity);
        let max = min + options.disparities as i64 - 1;
        if min >= width as i64 || max <= -(width as i64) {
            return Err(StereoError::RangeOutsideImage { min, max, width });
        }
        let allowed = options.max_memory.unwrap_or(isize::MAX as usize);
        if bytes > allowed {
            return Err(StereoError::Memory { needed: self.smallest_limit(width, height), allowed });
        }
        Ok(())
    }

    /// Allocates the memory that images of this size need, so that the first frame takes no longer than the next.
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
        self.prepare_aggregation(width, height, progress)?;
        map.resize(width, height);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_names_a_limit_that_suffices() {
        for (width, height, disparities, search) in [
            (320, 240, 64, Search::Auto),
            (1600, 1200, 128, Search::Full),
            // From here on hierarchical, where the limit allows.
            (2000, 1500, 128, Search::Auto),
            (4000, 3000, 128, Search::Auto),
            (1600, 1200, 256, Search::Hierarchical),
        ] {
            let matcher = |max_memory| {
                StereoMatcher::new(StereoOptions { disparities, search, max_memory, ..Default::default() }).unwrap()
            };
            let whole = matcher(None).memory(width, height);
            for percent in [1, 20, 40, 60, 80, 99] {
                let allowed = whole / 100 * percent;
                let Err(error) = matcher(Some(allowed)).check_size(width, height) else { continue };
                let StereoError::Memory { needed, allowed: reported } = error else { panic!("{error}") };
                assert!(reported == allowed && needed > allowed, "{width} {percent}: {needed}");
                matcher(Some(needed)).check_size(width, height).unwrap();
            }
            assert!(matcher(Some(whole)).check_size(width, height).is_ok());
        }
    }
}
