//! Vertical disparity of a nearly rectified pair: estimation as an affine function of the position, and correction of
//! the right image.

use crate::depth::to_rgb8;
use crate::disparity_range::match_pair;
use crate::vertical_matches::vertical_matches;
use crate::{DepthError, Progress, RangeError};
use cv_core::{Correspondence, Image, ImageView, Matrix3, Point2, Vector3};
use cv_imgproc::{Pixel, WarpMap};
use cv_stereo::{DisparityMap, DisparityMatcher, Intensity, RectifyError};

/// Fraction of matched and confirmed pixels below which features estimate the offset if blocks do not: an offset of a
/// pixel removes a third to a half of the matches of aligned pairs, which have 63 to 99 %.
const MIN_MATCHED_FRACTION: f64 = 0.6;
/// Smallest offset in px that is corrected. A quarter of a pixel doubles the disparities that are wrong by half a pixel,
/// about as much as the blur of linear interpolation costs.
const MIN_OFFSET: f64 = 1.0 / 3.0;
/// Largest offset in px that is corrected: with a larger one, the pair is not rectified.
const MAX_OFFSET: f64 = 8.0;
/// Vertical disparity in px above which a feature match is an outlier: 1.5 `MAX_OFFSET`.
const OUTLIER_OFFSET: f64 = 12.0;
/// Largest offset in px that blocks estimate reliably, within their search range.
const MAX_BLOCK_OFFSET: f64 = 1.5;
/// Minimum number of inliers within a pixel.
const MIN_INLIERS: usize = 32;
/// Minimum inlier ratio of feature matches within `OUTLIER_OFFSET`.
const MIN_FEATURE_INLIER_RATIO: f64 = 0.5;
/// Minimum inlier ratio of block matches, of which a third is within a pixel by chance, since their search radius is 3 px.
const MIN_BLOCK_INLIER_RATIO: f64 = 0.75;

/// Vertical disparity in px, right minus left, as an affine function of the position in the right image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VerticalOffset {
    /// At the image center.
    pub at_center: f64,
    /// Difference from the left to the right border.
    pub across: f64,
    /// Difference from the top to the bottom border.
    pub down: f64,
    /// Image width and height in px.
    pub size: (usize, usize),
}

impl VerticalOffset {
    /// Returns the vertical disparity at a position of the right image.
    pub fn at(&self, x: f64, y: f64) -> f64 {
        terms(Point2::new(x, y), self.size).dot(&Vector3::new(self.at_center, self.across, self.down))
    }

    /// Returns the largest absolute value in the image, which is at a corner.
    pub fn largest(&self) -> f64 {
        self.at_center.abs() + 0.5 * (self.across.abs() + self.down.abs())
    }

    /// Returns whether the offset is to be corrected: neither negligible nor that of an unrectified pair.
    fn is_to_correct(&self) -> bool {
        (MIN_OFFSET..=MAX_OFFSET).contains(&self.largest())
    }

    /// Estimates the offset from matches of images with this size; `None` without enough inliers or with an inlier
    /// ratio below `min_inlier_ratio`. Least squares on the matches near the previous estimate, starting at the mode.
    /// O(n log n).
    fn from_matches(matches: &[Correspondence], min_inlier_ratio: f64, size: (usize, usize)) -> Option<Self> {
        let vertical = |m: &Correspondence| m.b.y - m.a.y;
        let candidates: Vec<&Correspondence> = matches.iter().filter(|m| vertical(m).abs() <= OUTLIER_OFFSET).collect();
        let mut sorted: Vec<f64> = candidates.iter().map(|m| vertical(m)).collect();
        sorted.sort_unstable_by(f64::total_cmp);
        // The window of two pixels with most matches.
        let count_within = |i: &usize| sorted.partition_point(|d| *d <= sorted[*i] + 2.0) - i;
        let mode = (0..sorted.len()).max_by_key(|i| (count_within(i), std::cmp::Reverse(*i)))?;
        let mut model = Vector3::new(sorted[mode + count_within(&mode) / 2], 0.0, 0.0);
        let residual = |model: &Vector3<f64>, m: &Correspondence| model.dot(&terms(m.b, size)) - vertical(m);
        for threshold in [4.0, 2.0, 1.0, 1.0] {
            // Regularization: slopes that the matches do not determine are zero.
            let mut normal = Matrix3::from_diagonal(&Vector3::new(1e-9, 0.1, 0.1));
            let mut right_side = Vector3::zeros();
            for m in candidates.iter().filter(|m| residual(&model, m).abs() <= threshold) {
                let terms = terms(m.b, size);
                normal += terms * terms.transpose();
                right_side += terms * vertical(m);
            }
            model = normal.try_inverse()? * right_side;
        }
        let inliers = candidates.iter().filter(|m| residual(&model, m).abs() <= 1.0).count();
        let estimate = Self { at_center: model.x, across: model.y, down: model.z, size };
        (inliers >= MIN_INLIERS && inliers as f64 >= min_inlier_ratio * candidates.len() as f64).then_some(estimate)
    }

    /// Corrects the matches as if the right image had been corrected.
    pub(crate) fn correct(&self, matches: &mut [Correspondence]) {
        for m in matches {
            m.b.y -= self.at(m.b.x, m.b.y);
        }
    }
}

/// Returns the terms of the affine function: one, and the position relative to the center in widths and heights.
fn terms(p: Point2<f64>, (width, height): (usize, usize)) -> Vector3<f64> {
    let from_middle = |at: f64, n: usize| (at + 0.5) / n as f64 - 0.5;
    Vector3::new(1.0, from_middle(p.x, width), from_middle(p.y, height))
}

/// Vertical alignment of a pair, or of all pairs of a film.
#[derive(Debug, Default)]
pub(crate) struct Alignment {
    /// Whether estimation has ended: the offset is known, or cannot be determined.
    is_closed: bool,
    pub(crate) offset: Option<VerticalOffset>,
    map: Option<WarpMap>,
}

impl Alignment {
    /// Creates an alignment that corrects nothing.
    pub(crate) fn off() -> Self {
        Self { is_closed: true, ..Self::default() }
    }

    /// Uses the offset of feature matches if it is larger than blocks can estimate (blocks are more accurate).
    pub(crate) fn update_from_features(
        &mut self,
        matches: &[Correspondence],
        size: (usize, usize),
    ) -> Result<(), DepthError> {
        let estimate = VerticalOffset::from_matches(matches, MIN_FEATURE_INLIER_RATIO, size);
        let large = estimate.filter(|offset| !self.is_closed && offset.largest() > MAX_BLOCK_OFFSET);
        large.map_or(Ok(()), |offset| self.set_offset(offset))
    }

    /// Sets the offset, and creates its warp map if it is to be corrected.
    fn set_offset(&mut self, offset: VerticalOffset) -> Result<(), DepthError> {
        self.is_closed = true;
        if !offset.is_to_correct() {
            return Ok(());
        }
        let size = offset.size;
        let last = (size.1 - 1) as f64;
        let map = WarpMap::new(size, size, |x, y| {
            // The offset is a function of the position in the right image: one fixed-point iteration is enough, since
            // it changes by hundredths of a pixel per pixel.
            let (x, row) = (x as f64, y as f64);
            let y = row + offset.at(x, row);
            Some(Point2::new(x, (row + offset.at(x, y)).clamp(0.0, last)))
        });
        let (width, height) = size;
        self.map = Some(map.map_err(|_| DepthError::Rectify(RectifyError::TooLarge { width, height }))?);
        self.offset = Some(offset);
        Ok(())
    }

    /// Returns the corrected right image; `None` without a correction for this size.
    fn corrected<T: Pixel, const C: usize>(
        &self,
        right: ImageView<'_, T, C>,
    ) -> Result<Option<Image<T, C>>, DepthError> {
        let (width, height) = right.size();
        let map = self.map.as_ref().filter(|map| map.source_size() == (width, height));
        let corrected = map.map(|map| map.compute(right)).transpose();
        corrected.map_err(|_| DepthError::Rectify(RectifyError::TooLarge { width, height }))
    }

    /// Computes the disparities of a pair into `map`, with its vertical disparity corrected if it is known or can be
    /// estimated from the matches. Returns the corrected right image, if it was corrected.
    pub(crate) fn compute<T: Intensity + Pixel, const C: usize>(
        &mut self,
        matcher: &mut dyn DisparityMatcher<T, C>,
        [left, right]: [ImageView<'_, T, C>; 2],
        map: &mut DisparityMap,
        progress: &dyn Progress,
    ) -> Result<Option<Image<T, C>>, DepthError> {
        let corrected = self.corrected(right)?;
        matcher.compute_into(left, corrected.as_ref().map_or(right, Image::view), map, progress)?;
        if self.is_closed {
            return Ok(corrected);
        }
        let blocks = vertical_matches(left, right, map);
        let estimate = VerticalOffset::from_matches(&blocks, MIN_BLOCK_INLIER_RATIO, left.size());
        if let Some(offset) = estimate.filter(|offset| offset.largest() <= MAX_BLOCK_OFFSET) {
            self.set_offset(offset)?;
        } else if estimate.is_some() || map.matched_fraction() < MIN_MATCHED_FRACTION {
            // Once only: in a film, features would take most of the time.
            self.is_closed = true;
            let [a, b] = [left, right].map(to_rgb8);
            let matches = match match_pair(a.view(), b.view(), progress) {
                Ok(matches) => matches,
                Err(RangeError::Cancelled(stop)) => return Err(stop.into()),
                Err(_) => return Ok(corrected),
            };
            if let Some(offset) = VerticalOffset::from_matches(&matches, MIN_FEATURE_INLIER_RATIO, left.size()) {
                self.set_offset(offset)?;
            }
        }
        let Some(corrected) = self.corrected(right)? else { return Ok(None) };
        matcher.forget_frame();
        matcher.compute_into(left, corrected.view(), map, progress)?;
        Ok(Some(corrected))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (600, 400);

    /// Creates matches all over the image with a vertical disparity of `offset`; every third is an outlier.
    fn matches(offset: impl Fn(f64, f64) -> f64) -> Vec<Correspondence> {
        (0..300)
            .map(|i| {
                let (x, y) = ((i * 37 % 600) as f64, (i * 53 % 400) as f64);
                let error = if i % 3 == 0 { (i * 29 % 200) as f64 - 100.0 } else { 0.0 };
                let a = Point2::new(x + 20.0, y - offset(x, y) + error);
                Correspondence { a, b: Point2::new(x, y) }
            })
            .collect()
    }

    #[test]
    fn an_affine_offset_is_estimated_among_outliers() {
        let truth = |x: f64, y: f64| 2.0 + 0.005 * (x - 299.5) - 0.004 * (y - 199.5);
        let found = VerticalOffset::from_matches(&matches(truth), MIN_FEATURE_INLIER_RATIO, SIZE).unwrap();
        assert!(found.is_to_correct());
        for (x, y) in [(0.0, 0.0), (599.0, 0.0), (0.0, 399.0), (599.0, 399.0), (299.5, 199.5)] {
            // A tenth of a pixel, for outliers that happen to be close.
            assert!((found.at(x, y) - truth(x, y)).abs() < 0.1, "{x} {y}: {found:?}");
        }
        assert!((found.largest() - 4.3).abs() < 0.1, "{found:?}");
        let mut corrected = matches(truth);
        found.correct(&mut corrected);
        assert_eq!(corrected.iter().filter(|m| (m.a.y - m.b.y).abs() < 0.1).count(), 200);
    }

    #[test]
    fn negligible_and_large_offsets_are_not_corrected() {
        for offset in [0.2, 9.5] {
            let found = VerticalOffset::from_matches(&matches(|_, _| offset), MIN_FEATURE_INLIER_RATIO, SIZE).unwrap();
            assert!((found.largest() - offset).abs() < 0.1 && !found.is_to_correct());
        }
        assert_eq!(VerticalOffset::from_matches(&[], MIN_FEATURE_INLIER_RATIO, SIZE), None);
        // Scattered: no offset has half of them.
        let chance = matches(|x, y| (x * 7.0 + y * 13.0) % 20.0 - 10.0);
        assert_eq!(VerticalOffset::from_matches(&chance, MIN_FEATURE_INLIER_RATIO, SIZE), None);
    }
}
