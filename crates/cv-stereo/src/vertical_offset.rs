//! Vertical disparity of a nearly rectified pair as a function of the position, estimated from matches.

use crate::coarse_match::{match_coarsely, smoothed_pair};
use crate::vertical_matches::{VerticalMatch, vertical_matches};
use crate::{Intensity, StereoError, StereoOptions};
use cv_core::{Correspondence, Image, ImageError, ImageView, Point2, Progress, Stage};
use cv_imgproc::{Pixel, remap_vertical};
use nalgebra::{Matrix6, Vector6};
use std::ops::Add;

/// Maximum number of costs (pixels times disparities) of the coarse images, which are half the size or smaller. With 10⁶ to 2·10⁸ the offsets of
/// public pairs differ by hundredths of a pixel.
const MAX_COARSE_COSTS: usize = 2_000_000;
/// Smallest offset in px that is corrected: pairs of Middlebury with offsets of 0.2 px have a fifth fewer errors of half a pixel when corrected,
/// with 0.1 px as many.
const MIN_OFFSET: f64 = 0.1;
/// Smallest offset in px that users are told of: the cameras have moved.
const MIN_NOTABLE_OFFSET: f64 = 1.0 / 3.0;
/// Largest offset in px that is corrected: with a larger one, the pair is not rectified.
const MAX_OFFSET: f64 = 8.0;
/// Vertical disparity in px above which a match is an outlier: 1.5 `MAX_OFFSET`.
const OUTLIER_OFFSET: f64 = 12.0;
/// Minimum inlier ratio of block matches, of which a third is within a pixel by chance, since their search radius is 3 px.
const MIN_BLOCK_INLIER_RATIO: f64 = 0.75;
/// Minimum number of inliers within a pixel.
const MIN_INLIERS: usize = 32;
/// Thresholds in px of the fits, each relative to the previous one; from which of them on squares and products are fitted.
const THRESHOLDS: [f64; 6] = [4.0, 2.0, 1.0, 1.0, 0.7, 0.5];
const FIRST_QUADRATIC: usize = 3;
/// Numbers of coefficients of the models: none, a constant, an affine and a quadratic function.
const MODELS: [usize; 4] = [0, 1, 3, 6];
/// Largest cost of a model in cross-validation, as a ratio of that without offset. Public pairs with an offset have 0.86 or less, those without one, and
/// pairs of a calibrated rig, mostly 0.93 or more.
const MAX_COST: f64 = 0.9;
/// Of the models with up to this ratio of the smallest cost, the simplest is taken.
const MAX_EXCESS: f64 = 1.02;
/// Fields of the image across and down, of which every other one is left out in cross-validation.
const FIELDS: f64 = 8.0;
/// Weight of the squared coefficients other than the constant, in matches of average weight: what the matches do not determine becomes zero.
const REGULARIZATION: f64 = 0.1;

/// Vertical disparity in px, right minus left, as a quadratic function of the position in the right image: errors of the
/// rotation, the focal lengths and the principal points give such a function, up to higher orders.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VerticalOffset {
    /// At the image center.
    pub at_center: f64,
    /// Difference from the left to the right border, of the linear term.
    pub across: f64,
    /// Difference from the top to the bottom border, of the linear term.
    pub down: f64,
    /// Coefficients of x², xy and y², where x and y are relative to the center, in widths and heights.
    pub curvature: [f64; 3],
    /// Image width and height in px.
    pub size: (usize, usize),
}

impl VerticalOffset {
    /// Returns the vertical disparity at a position of the right image.
    pub fn at(&self, x: f64, y: f64) -> f64 {
        terms(Point2::new(x, y), self.size).dot(&Vector6::from(self.coefficients()))
    }

    /// Returns the coefficients of 1, x, y, x², xy and y².
    pub fn coefficients(&self) -> [f64; 6] {
        let [xx, xy, yy] = self.curvature;
        [self.at_center, self.across, self.down, xx, xy, yy]
    }

    /// Returns the largest absolute value on a grid of 17×17 positions from border to border.
    pub fn largest(&self) -> f64 {
        let along = |n: usize| (0..17).map(move |i| (n - 1) as f64 * f64::from(i) / 16.0);
        let positions = along(self.size.1).flat_map(|y| along(self.size.0).map(move |x| (x, y)));
        positions.map(|(x, y)| self.at(x, y).abs()).fold(0.0, f64::max)
    }

    /// Returns whether the offset is large enough that the cameras should be calibrated again: a third of a pixel or more.
    pub fn is_notable(&self) -> bool {
        self.largest() >= MIN_NOTABLE_OFFSET
    }

    /// Returns whether the offset is to be corrected: neither negligible nor that of an unrectified pair.
    pub fn is_to_correct(&self) -> bool {
        (MIN_OFFSET..=MAX_OFFSET).contains(&self.largest())
    }

    /// Returns the coefficients of 1, x and x² of the vertical disparity in row `y`, x in px.
    fn along_row(&self, y: usize) -> [f32; 3] {
        let width = self.size.0 as f64;
        let [first, middle, last] = [0.0, 0.5, 1.0].map(|x| self.at(x * width, y as f64));
        let (slope, square) = (4.0 * middle - last - 3.0 * first, 2.0 * (first + last) - 4.0 * middle);
        [first, slope / width, square / (width * width)].map(|c| c as f32)
    }

    /// Estimates the offset of a pair by matching it at half its size (smaller if it is large) with these options, and blocks of it near these
    /// disparities. Offsets up to 1.5 px are estimated reliably, up to 3 px at all. `None` without enough blocks that agree. Takes a tenth to a quarter
    /// of the time of matching the pair.
    ///
    /// # Errors
    /// [`StereoError`] as [`crate::StereoMatcher::compute`].
    pub fn estimate<T: Intensity, const C: usize>(
        [left, right]: [ImageView<'_, T, C>; 2],
        options: &StereoOptions,
        progress: &dyn Progress,
    ) -> Result<Option<Self>, StereoError> {
        options.validate()?;
        let stage = Stage::new(progress, "align", 2)?;
        let gray = smoothed_pair([left, right], &stage)?;
        let coarse = match_coarsely(gray.each_ref(), options, (2, MAX_COARSE_COSTS), progress)?;
        let matches = vertical_matches(gray.each_ref(), &coarse);
        Ok(Self::from_matches(&matches, MIN_BLOCK_INLIER_RATIO, left.size()))
    }

    /// Estimates the offset from feature matches of images with this size (width, height); `None` without 32 inliers or with an inlier ratio below
    /// `min_inlier_ratio`, of the matches with a vertical disparity of up to 12 px. O(n log n).
    pub fn from_correspondences(
        matches: &[Correspondence],
        min_inlier_ratio: f64,
        size: (usize, usize),
    ) -> Option<Self> {
        let vertical = |m: &Correspondence| VerticalMatch { position: m.b, offset: m.b.y - m.a.y, weight: 1.0 };
        Self::from_matches(&matches.iter().map(vertical).collect::<Vec<_>>(), min_inlier_ratio, size)
    }

    /// As [`VerticalOffset::from_correspondences`]. The model is selected by cross-validation, so that few or
    /// erroneous matches give no offset.
    fn from_matches(matches: &[VerticalMatch], min_inlier_ratio: f64, size: (usize, usize)) -> Option<Self> {
        let candidates: Vec<VerticalMatch> =
            matches.iter().copied().filter(|m| m.offset.abs() <= OUTLIER_OFFSET).collect();
        // Cross-validation: errors of neighboring matches are alike, so that fields are left out, not matches.
        let field = |m: &VerticalMatch| {
            let terms = terms(m.position, size);
            ((FIELDS * (terms[1] + 0.5)).floor() + (FIELDS * (terms[2] + 0.5)).floor()) as i64 & 1
        };
        let folds = [0, 1].map(|fold| candidates.iter().copied().filter(|m| field(m) == fold).collect::<Vec<_>>());
        let held_out_cost = |coefficients: usize| -> f64 {
            let cost = |(fitted, held_out): (&[VerticalMatch], &[VerticalMatch])| {
                let model = fit(fitted, coefficients, size).unwrap_or_default();
                held_out.iter().map(|m| m.weight.sqrt() * residual(&model, m, size).min(1.0)).sum::<f64>()
            };
            cost((&folds[0], &folds[1])) + cost((&folds[1], &folds[0]))
        };
        let costs = MODELS.map(held_out_cost);
        let smallest = costs.into_iter().fold(f64::INFINITY, f64::min);
        let simplest = costs.iter().position(|cost| *cost <= MAX_EXCESS * smallest)?;
        let model = if costs[simplest] <= MAX_COST * costs[0] { simplest } else { 0 };
        let model = fit(&candidates, MODELS[model], size)?;
        let inliers = candidates.iter().filter(|m| residual(&model, m, size) <= 1.0).count();
        let [at_center, across, down, xx, xy, yy] = model.into();
        let estimate = Self { at_center, across, down, curvature: [xx, xy, yy], size };
        (inliers >= MIN_INLIERS && inliers as f64 >= min_inlier_ratio * candidates.len() as f64).then_some(estimate)
    }

    /// Corrects the right image: resamples it along its columns by cubic convolution.
    ///
    /// # Errors
    /// [`ImageError`] where memory for the result cannot be allocated.
    pub fn correct<T: Pixel, const C: usize>(&self, right: ImageView<'_, T, C>) -> Result<Image<T, C>, ImageError> {
        remap_vertical(right, |y| self.along_row(y))
    }

    /// Corrects matches as if the right image had been corrected.
    pub fn correct_matches(&self, matches: &mut [Correspondence]) {
        for m in matches {
            m.b.y -= self.at(m.b.x, m.b.y);
        }
    }
}

/// The sum of two functions for images of the same size: the offset of a pair that was corrected by `self` and then has an offset of `rest`.
impl Add for VerticalOffset {
    type Output = Self;

    fn add(self, rest: Self) -> Self {
        let [at_center, across, down, xx, xy, yy] =
            (Vector6::from(self.coefficients()) + Vector6::from(rest.coefficients())).into();
        Self { at_center, across, down, curvature: [xx, xy, yy], size: self.size }
    }
}

/// Returns the distance of a match from a model in px.
fn residual(model: &Vector6<f64>, m: &VerticalMatch, size: (usize, usize)) -> f64 {
    (model.dot(&terms(m.position, size)) - m.offset).abs()
}

/// Fits the first coefficients: least squares on the matches near the previous estimate, starting at the mode; `None` without matches.
fn fit(matches: &[VerticalMatch], coefficients: usize, size: (usize, usize)) -> Option<Vector6<f64>> {
    if coefficients == 0 {
        return Some(Vector6::zeros());
    }
    let mut sorted: Vec<f64> = matches.iter().map(|m| m.offset).collect();
    sorted.sort_unstable_by(f64::total_cmp);
    // The window of two pixels with most matches.
    let count_within = |i: &usize| sorted.partition_point(|d| *d <= sorted[*i] + 2.0) - i;
    let mode = (0..sorted.len()).max_by_key(|i| (count_within(i), std::cmp::Reverse(*i)))?;
    let mut model = Vector6::zeros();
    model[0] = sorted[mode + count_within(&mode) / 2];
    let mean_weight = matches.iter().map(|m| m.weight).sum::<f64>() / matches.len() as f64;
    for (round, threshold) in THRESHOLDS.into_iter().enumerate() {
        let count = if round < FIRST_QUADRATIC { coefficients.min(3) } else { coefficients };
        let regularization = |i: usize| if i == 0 { 1e-9 } else { REGULARIZATION };
        let mut normal = Matrix6::from_diagonal(&Vector6::from_fn(|i, _| mean_weight * regularization(i)));
        let mut right_side = Vector6::zeros();
        for m in matches.iter().filter(|m| residual(&model, m, size) <= threshold) {
            let mut terms = terms(m.position, size);
            terms.rows_mut(count, 6 - count).fill(0.0);
            normal += terms * terms.transpose() * m.weight;
            right_side += terms * (m.weight * m.offset);
        }
        model = normal.cholesky()?.solve(&right_side);
    }
    Some(model)
}

/// Returns the terms of the quadratic function of the position relative to the center, in widths and heights.
fn terms(p: Point2<f64>, (width, height): (usize, usize)) -> Vector6<f64> {
    let from_middle = |at: f64, n: usize| (at + 0.5) / n as f64 - 0.5;
    let (x, y) = (from_middle(p.x, width), from_middle(p.y, height));
    Vector6::new(1.0, x, y, x * x, x * y, y * y)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::GrayF32;
    use proptest::prelude::*;

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

    fn estimate(matches: &[Correspondence]) -> Option<VerticalOffset> {
        VerticalOffset::from_correspondences(matches, 0.5, SIZE)
    }

    /// As of a pitch and a yaw: with a square and a product.
    fn curved(x: f64, y: f64) -> f64 {
        let (x, y) = ((x - 299.5) / 600.0, (y - 199.5) / 400.0);
        2.0 + 3.0 * x - 1.6 * y + 1.5 * y * y - 2.0 * x * y + 0.4 * x * x
    }

    #[test]
    fn a_quadratic_offset_is_estimated_among_outliers() {
        let found = estimate(&matches(curved)).unwrap();
        assert!(found.is_to_correct() && found.is_notable());
        let corners = [(0.0, 0.0), (599.0, 0.0), (0.0, 399.0), (599.0, 399.0)];
        for (x, y) in corners.into_iter().chain([(299.5, 199.5)]) {
            // A tenth of a pixel, for outliers that happen to be close, and the regularization.
            assert!((found.at(x, y) - curved(x, y)).abs() < 0.1, "{x} {y}: {found:?}");
        }
        let largest = corners.map(|(x, y)| curved(x, y)).into_iter().fold(0.0, f64::max);
        assert!((found.largest() - largest).abs() < 0.1, "{found:?}");
        let mut corrected = matches(curved);
        found.correct_matches(&mut corrected);
        assert_eq!(corrected.iter().filter(|m| (m.a.y - m.b.y).abs() < 0.1).count(), 200);
    }

    #[test]
    fn negligible_and_large_offsets_are_not_corrected() {
        for (offset, is_notable) in [(0.05, false), (9.5, true)] {
            let found = estimate(&matches(|_, _| offset)).unwrap();
            assert!((found.largest() - offset).abs() < 0.04 && !found.is_to_correct(), "{found:?}");
            assert_eq!(found.is_notable(), is_notable);
        }
        assert_eq!(estimate(&[]), None);
        // Scattered: no offset has half of them.
        assert_eq!(estimate(&matches(|x, y| (x * 7.0 + y * 13.0) % 20.0 - 10.0)), None);
    }

    #[test]
    fn bad_pairs_and_options_are_errors_and_small_ones_have_no_offset() {
        let run = |left: (usize, usize), right: (usize, usize), options: &StereoOptions| {
            let image = |(width, height)| cv_core::GrayU8::from_fn(width, height, |x, y| [(x * 7 + y * y * 3) as u8]);
            let (left, right) = (image(left), image(right));
            VerticalOffset::estimate([left.view(), right.view()], options, &cv_core::Silent)
        };
        let options = StereoOptions { disparities: 16, ..StereoOptions::default() };
        // Of the same size when halved.
        assert!(matches!(run((100, 80), (101, 80), &options), Err(StereoError::SizeMismatch { .. })));
        for disparities in [0, usize::MAX] {
            let options = StereoOptions { disparities, ..options.clone() };
            assert!(matches!(run((100, 80), (100, 80), &options), Err(StereoError::Range { .. })));
        }
        for min_disparity in [i32::MIN, i32::MAX] {
            let options = StereoOptions { min_disparity, ..options.clone() };
            assert!(matches!(run((100, 80), (100, 80), &options), Err(StereoError::RangeOutsideImage { .. })));
        }
        for size in [(0, 0), (0, 40), (40, 0), (1, 1), (9, 9), (12, 40), (16, 12), (27, 27), (40, 16)] {
            match run(size, size, &options) {
                Ok(offset) => assert_eq!(offset, None, "{size:?}"),
                Err(error) => assert!(matches!(error, StereoError::TooSmall { .. }), "{size:?}: {error}"),
            }
        }
    }

    #[test]
    fn offsets_of_chance_are_none_and_models_are_simple() {
        // Errors of up to two tenths of a pixel, alike in fields of 100 px.
        let alike = |x: f64, y: f64| 0.2 * (17.3 * (x / 100.0).floor() + 5.1 * (y / 100.0).floor()).sin();
        assert_eq!(estimate(&matches(alike)).unwrap().coefficients(), [0.0; 6]);
        // Independent ones, and a constant offset.
        let independent = |x: f64, y: f64| 0.2 * (12.9 * x + 78.2 * y).sin();
        let found = estimate(&matches(|x, y| 1.0 + independent(x, y))).unwrap();
        assert!(found.coefficients()[1..] == [0.0; 5] && (found.at_center - 1.0).abs() < 0.1, "{found:?}");
    }

    #[test]
    fn weighted_matches_decide() {
        // Two offsets within the thresholds of the fits: that with the weight.
        let matches = |weights: [f64; 2]| -> Vec<VerticalMatch> {
            let all = matches(|_, _| 0.0).into_iter().enumerate();
            all.map(|(i, m)| VerticalMatch {
                position: m.b,
                offset: 1.0 + 0.4 * (i % 2) as f64,
                weight: weights[i % 2],
            })
            .collect()
        };
        for (weights, expected) in [([1.0, 1.0], 1.2), ([1.0, 99.0], 1.4), ([99.0, 1.0], 1.0)] {
            let found = VerticalOffset::from_matches(&matches(weights), 0.5, SIZE).unwrap();
            assert!((found.at(299.5, 199.5) - expected).abs() < 0.02, "{weights:?}: {found:?}");
        }
    }

    proptest! {
        #[test]
        fn a_corrected_image_has_the_rows_of_the_other(
            at_center in -3.0..3.0,
            slopes in prop::array::uniform2(-3.0..3.0),
            curvature in prop::array::uniform3(-3.0..3.0),
        ) {
            let size = (150, 110);
            let offset = VerticalOffset { at_center, across: slopes[0], down: slopes[1], curvature, size };
            // The content of row y of the left image is in row y + offset of the right one; its own row is found by fixed-point iteration.
            let texture = |x: f64, y: f64| 0.5 + 0.3 * (0.31 * y + 0.05 * x).sin();
            let right = GrayF32::from_fn(size.0, size.1, |x, y| {
                let (x, row) = (x as f64, y as f64);
                let mut y = row;
                for _ in 0..20 {
                    y = row - offset.at(x, y);
                }
                [texture(x, y) as f32]
            });
            let corrected = offset.correct(right.view()).unwrap();
            // Away from the border, which is repeated: the largest offset is 9 px.
            for y in 10..100 {
                for x in 0..150 {
                    let expected = texture(x as f64, y as f64) as f32;
                    // The error of cubic convolution for this texture.
                    prop_assert!((corrected.at(x, y)[0] - expected).abs() < 0.004, "{x} {y}");
                }
            }
        }
    }
}
