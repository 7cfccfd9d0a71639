//! Vertical alignment of a nearly rectified pair: the vertical disparity is estimated from coarse matches or from features, and the right image
//! is corrected.

use crate::depth::to_rgb8;
use crate::disparity_range::match_pair;
use crate::{DepthError, Progress, RangeError};
use cv_core::{Correspondence, Image, ImageView};
use cv_imgproc::Pixel;
use cv_stereo::{Intensity, RectifyError, StereoError, StereoOptions, VerticalOffset};

/// Largest offset in px that blocks estimate reliably, within their search range.
const MAX_BLOCK_OFFSET: f64 = 1.5;
/// Minimum inlier ratio of feature matches.
const MIN_FEATURE_INLIER_RATIO: f64 = 0.5;
/// Frames of a film that are tried.
const MAX_ATTEMPTS: u8 = 8;

/// Vertical alignment of a pair, or of all pairs of a film.
#[derive(Debug, Default)]
pub(crate) struct Alignment {
    /// Whether estimation has ended: the offset is known, or cannot be determined.
    is_closed: bool,
    attempts: u8,
    /// The estimate of features, once it was made: in a film, matching them again would take most of the time.
    from_features: Option<Option<VerticalOffset>>,
    /// Until estimation has ended, that of features.
    pub(crate) offset: Option<VerticalOffset>,
}

impl Alignment {
    /// Creates an alignment that corrects nothing.
    pub(crate) fn off() -> Self {
        Self { is_closed: true, ..Self::default() }
    }

    /// Uses the offset of feature matches if it is larger than blocks can estimate.
    pub(crate) fn update_from_features(&mut self, matches: &[Correspondence], size: (usize, usize)) {
        if !self.is_closed {
            let estimate = estimate_from_features(matches, size);
            self.from_features = Some(estimate);
            self.offset = estimate.filter(|offset| offset.largest() > MAX_BLOCK_OFFSET);
        }
    }

    /// Ends the estimation.
    fn close(&mut self, offset: Option<VerticalOffset>) {
        self.is_closed = true;
        self.offset = offset.filter(VerticalOffset::is_to_correct);
    }

    /// Estimates the vertical disparity of a pair if it is not known, from blocks near the disparities of a coarse match with these options. A larger
    /// one than blocks can estimate, or blocks that disagree, which they do with an offset beyond their search range: from features, and
    /// then from blocks of the corrected pair, which are more accurate. Returns whether a correction begins with this pair: previous ones of a film were
    /// not corrected.
    pub(crate) fn estimate<T: Intensity + Pixel, const C: usize>(
        &mut self,
        [left, right]: [ImageView<'_, T, C>; 2],
        options: &StereoOptions,
        progress: &dyn Progress,
    ) -> Result<bool, DepthError> {
        // The matcher reports images of different sizes.
        if self.is_closed || left.size() != right.size() {
            return Ok(false);
        }
        self.attempts += 1;
        if self.offset.is_none() {
            let from_blocks = estimate_from_blocks([left, right], options, progress)?;
            if from_blocks.is_some_and(|offset| offset.largest() <= MAX_BLOCK_OFFSET) {
                self.close(from_blocks);
                return Ok(self.offset.is_some());
            }
            self.offset = match self.from_features {
                Some(known) => known,
                None => {
                    let [a, b] = [left, right].map(to_rgb8);
                    match match_pair(a.view(), b.view(), progress) {
                        Ok(matches) => estimate_from_features(&matches, left.size()),
                        Err(RangeError::Cancelled(stop)) => return Err(stop.into()),
                        Err(_) => None,
                    }
                }
            };
            self.from_features = Some(self.offset);
        }
        if let Some(offset) = self.offset {
            let corrected = self.correct(right)?;
            let right = corrected.as_ref().map_or(right, Image::view);
            let rest = estimate_from_blocks([left, right], options, progress)?;
            let rest = rest.filter(|rest| rest.largest() <= MAX_BLOCK_OFFSET);
            self.close(Some(rest.map_or(offset, |rest| offset + rest)));
        } else if self.attempts == MAX_ATTEMPTS {
            self.close(None);
        }
        Ok(self.offset.is_some())
    }

    /// Returns the corrected right image; `None` without a correction for this size.
    pub(crate) fn correct<T: Pixel, const C: usize>(
        &self,
        right: ImageView<'_, T, C>,
    ) -> Result<Option<Image<T, C>>, DepthError> {
        let (width, height) = right.size();
        let offset = self.offset.filter(|offset| offset.size == (width, height));
        let corrected = offset.map(|offset| offset.correct(right)).transpose();
        corrected.map_err(|_| DepthError::Rectify(RectifyError::TooLarge { width, height }))
    }
}

/// Estimates the offset from blocks; `None` where they disagree. What is wrong with a pair, the matcher reports.
fn estimate_from_blocks<T: Intensity, const C: usize>(
    images: [ImageView<'_, T, C>; 2],
    options: &StereoOptions,
    progress: &dyn Progress,
) -> Result<Option<VerticalOffset>, DepthError> {
    match VerticalOffset::estimate(images, options, progress) {
        Ok(estimate) => Ok(estimate),
        Err(StereoError::Cancelled(stop)) => Err(stop.into()),
        Err(_) => Ok(None),
    }
}

/// Estimates the offset from feature matches, if it is to be corrected.
fn estimate_from_features(matches: &[Correspondence], size: (usize, usize)) -> Option<VerticalOffset> {
    VerticalOffset::from_correspondences(matches, MIN_FEATURE_INLIER_RATIO, size).filter(VerticalOffset::is_to_correct)
}
