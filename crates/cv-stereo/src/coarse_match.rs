//! Matching of a pair at a fraction of its size: the disparities near which blocks are matched vertically, and the range of disparities.

use crate::{DisparityMap, Intensity, Paths, PixelState, Smoothing, StereoError, StereoMatcher, StereoOptions};
use cv_core::{GrayF32, ImageView, Progress, Stage, quantile};
use cv_imgproc::gaussian_blur;
use cv_parallel::prelude::*;

/// Standard deviation in px of the smoothing of gray levels.
const SIGMA: f32 = 1.2;
/// Smallest factor by which a pair is reduced for its range, and the maximum number of costs (pixels times disparities) then.
const RANGE_SCALE: usize = 4;
const MAX_RANGE_COSTS: usize = 8_000_000;
/// Disparities that are searched for the range, as fractions of the width.
const SEARCHED: [f64; 2] = [-0.1, 0.45];
/// Minimum region that counts for the range, in pixels of the reduced pair.
const MIN_RANGE_REGION: usize = 25;
/// Quantiles of the matched disparities that are the range.
const RANGE_QUANTILES: [f64; 2] = [0.001, 0.999];
/// The lower one below zero, where only offset principal points or converging cameras have disparities: fewer are false matches.
const NEGATIVE_QUANTILE: f64 = 0.01;

/// The disparities of a pair at a fraction of its size.
pub(crate) struct CoarseDisparity {
    pub(crate) map: DisparityMap,
    /// Pixels of the pair per pixel of the map.
    scale: usize,
}

impl CoarseDisparity {
    /// Returns the disparity at a pixel of the pair, in its px; `None` if it is not matched.
    pub(crate) fn at(&self, x: usize, y: usize) -> Option<f32> {
        let (x, y) = (x / self.scale, y / self.scale);
        let (width, height) = self.map.disparity.size();
        let is_matched = x < width && y < height && self.map.state.at(x, y)[0] == PixelState::Matched;
        is_matched.then(|| self.scale as f32 * self.map.disparity.at(x, y)[0])
    }
}

/// Matches a pair reduced by `scale`, or twice or four times as much … if it is so large that there are more than `max_costs` costs (pixels times
/// disparities). The options are valid.
pub(crate) fn match_coarsely(
    gray: [&GrayF32; 2],
    options: &StereoOptions,
    (mut scale, max_costs): (usize, usize),
    progress: &dyn Progress,
) -> Result<CoarseDisparity, StereoError> {
    let (width, height) = gray[0].size();
    while (width / scale) * (height / scale) * (options.disparities / scale) > max_costs {
        scale *= 2;
    }
    let [left, right] = gray.map(|gray| mean_blocks(gray, scale));
    // Halves of 32-bit integers: they fit.
    let first = i64::from(options.min_disparity);
    let [first, last] = [first, first + options.disparities as i64 - 1].map(|d| d.div_euclid(scale as i64));
    let options = StereoOptions {
        min_disparity: first as i32,
        disparities: (last - first) as usize + 2,
        pyramid_levels: 0,
        paths: Paths::Four,
        smoothing: Smoothing::None,
        fill: false,
        quality: false,
        denoise: false,
        sequence: false,
        confidence: false,
        ..options.clone()
    };
    let map = StereoMatcher::new(options)?.compute(left.view(), right.view(), progress)?;
    Ok(CoarseDisparity { map, scale })
}

/// Downsamples by a factor: each pixel is the mean of a block, without incomplete ones.
fn mean_blocks(image: &GrayF32, scale: usize) -> GrayF32 {
    let factor = 1.0 / (scale * scale) as f32;
    let mut small = GrayF32::new(image.width() / scale, image.height() / scale, [0.0]);
    for y in 0..small.height() {
        for row in scale * y..scale * (y + 1) {
            for (mean, block) in small.row_mut(y).iter_mut().zip(image.row(row).chunks_exact(scale)) {
                *mean += factor * block.iter().sum::<f32>();
            }
        }
    }
    small
}

/// As [`smoothed_gray`], both images of a pair.
pub(crate) fn smoothed_pair<T: Intensity, const C: usize>(
    [left, right]: [ImageView<'_, T, C>; 2],
    stage: &Stage<'_>,
) -> Result<[GrayF32; 2], StereoError> {
    if left.size() != right.size() {
        return Err(StereoError::SizeMismatch { left: left.size(), right: right.size() });
    }
    let [left, right] = [left, right].map(|image| {
        let gray = smoothed_gray(image);
        stage.add(1).map(|()| gray)
    });
    Ok([left?, right?])
}

/// Converts an image to gray levels of 0 to 1, smoothed for the interpolation of blocks: without, bilinear interpolation smooths between
/// pixels and moves minima there.
fn smoothed_gray<T: Intensity, const C: usize>(view: ImageView<'_, T, C>) -> GrayF32 {
    let mut gray = GrayF32::new(view.width(), view.height(), [0.0]);
    let rows = gray.as_mut_slice().par_chunks_mut(view.width().max(1)).enumerate();
    rows.for_each_init(
        || vec![0; view.width()],
        |levels, (y, row)| {
            T::gray_row(view.row(y), C, levels);
            row.iter_mut().zip(levels).for_each(|(gray, level)| *gray = f32::from(*level) / 65535.0);
        },
    );
    gaussian_blur(gray.view(), SIGMA)
}

/// The range of the disparities of a pair that was matched at a fraction of its size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CoarseRange {
    /// Smallest and largest disparity in px: the 0.1 % and 99.9 % quantiles of the matched pixels; below zero the 1 % quantile.
    pub range: (f64, f64),
    /// Fraction of matched and confirmed pixels.
    pub matched_fraction: f64,
    /// Pixels of the pair per pixel of the reduced one.
    pub scale: usize,
}

impl CoarseRange {
    /// Estimates the range of a rectified pair by matching it at a quarter of its size, smaller if it is large, with these options but their range:
    /// from `min`, or a tenth of the width below zero, to 0.45 of the width. `None` where nothing is matched. Some milliseconds.
    ///
    /// # Errors
    /// [`StereoError`] as [`crate::StereoMatcher::compute`].
    pub fn estimate<T: Intensity, const C: usize>(
        [left, right]: [ImageView<'_, T, C>; 2],
        min: Option<i32>,
        options: &StereoOptions,
        progress: &dyn Progress,
    ) -> Result<Option<Self>, StereoError> {
        let stage = Stage::new(progress, "range", 3)?;
        let gray = smoothed_pair([left, right], &stage)?;
        let [first, last] = SEARCHED.map(|fraction| (fraction * left.width() as f64) as i64);
        let first = min.map_or(first, i64::from);
        let options = StereoOptions {
            min_disparity: first as i32,
            disparities: (last - first).clamp(1, crate::options::MAX_DISPARITIES as i64) as usize,
            speckle_size: MIN_RANGE_REGION,
            max_memory: None,
            ..options.clone()
        };
        options.validate()?;
        let coarse = match_coarsely(gray.each_ref(), &options, (RANGE_SCALE, MAX_RANGE_COSTS), progress)?;
        stage.add(1)?;
        let pixels = coarse.map.disparity.as_slice().iter().zip(coarse.map.state.as_slice());
        let mut matched: Vec<f64> = pixels
            .filter(|(_, state)| **state == PixelState::Matched)
            .map(|(d, _)| f64::from(*d) * coarse.scale as f64)
            .collect();
        let [low, high] = RANGE_QUANTILES.map(|fraction| quantile(&mut matched, fraction));
        let negative = quantile(&mut matched, NEGATIVE_QUANTILE);
        let (Some(low), Some(high), Some(negative)) = (low, high, negative) else { return Ok(None) };
        Ok(Some(Self {
            range: (low.max(negative.min(0.0)), high),
            matched_fraction: coarse.map.matched_fraction(),
            scale: coarse.scale,
        }))
    }
}
