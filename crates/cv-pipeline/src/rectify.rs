//! Rectification of a pair of images, with its quality by feature matches.

use crate::depth::to_rgb8;
use crate::matching::match_reduced;
use crate::no_pair::diagnose_matches;
use crate::{MatchingError, MatchingOptions, NoPairCause, Progress};
use cv_core::{Image, ImageView, Mask, StageClock, StereoRig, median, quantile};
use cv_imgproc::Pixel;
use cv_stereo::{Intensity, Rectification, RectifyError, RectifyOptions};

/// Result of [`rectify`]; `P` is the image type.
#[derive(Debug, Clone, PartialEq)]
pub struct RectifyResult<P> {
    /// Both rectified views and their geometry.
    pub rectification: Rectification,
    /// The rectified images, left and right, with the bit depth of the input.
    pub images: [P; 2],
    /// Valid pixels of both.
    pub masks: [Mask; 2],
    /// Fraction of valid pixels, left and right.
    pub valid_area: [f64; 2],
    /// Median and 95 % quantile of the vertical disparity of feature matches between the rectified images, in px;
    /// `None` with fewer than eight, or if most matches show a fault.
    pub vertical_px: Option<(f64, f64)>,
    /// Number of those matches.
    pub matches: usize,
    /// The fault that most matches show: the rig is not that of the images, or they are in the wrong order.
    pub fault: Option<NoPairCause>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

impl<P> RectifyResult<P> {
    /// Converts the images.
    pub fn map_images<Q>(self, map: impl Fn(P) -> Q) -> RectifyResult<Q> {
        RectifyResult {
            rectification: self.rectification,
            images: self.images.map(map),
            masks: self.masks,
            valid_area: self.valid_area,
            vertical_px: self.vertical_px,
            matches: self.matches,
            fault: self.fault,
            stages: self.stages,
        }
    }
}

/// Rectifies a pair of images of `rig`, with the bit depth of the input.
///
/// # Errors
/// [`RectifyError`] if the rig cannot be rectified, or the images do not have its cameras' sizes.
pub fn rectify<T: Intensity + Pixel, const C: usize>(
    left: ImageView<'_, T, C>,
    right: ImageView<'_, T, C>,
    rig: &StereoRig,
    options: &RectifyOptions,
    progress: &dyn Progress,
) -> Result<RectifyResult<Image<T, C>>, RectifyError> {
    let mut clock = StageClock::new();
    let rectification = Rectification::new(rig, options)?;
    let (left, mask_left) = rectification.left.apply(left, progress)?;
    let (right, mask_right) = rectification.right.apply(right, progress)?;
    clock.lap("rectify");
    // A pair without features is rectified; its quality is unknown.
    let colors = [to_rgb8(left.view()), to_rgb8(right.view())];
    let pairs = match match_reduced(
        colors.each_ref().map(|c| c.view()),
        MAX_MATCHING_SIDE,
        &MatchingOptions::default(),
        progress,
    ) {
        Ok(found) => found.pairs(),
        Err(MatchingError::Cancelled(stop)) => return Err(stop.into()),
        Err(_) => Vec::new(),
    };
    // An outlier has any vertical disparity; those beyond a few pixels are not due to the calibration.
    let mut vertical_disparities: Vec<f64> =
        pairs.iter().filter(|p| p.a.x >= p.b.x - 4.0).map(|p| (p.a.y - p.b.y).abs()).filter(|&dy| dy < 8.0).collect();
    // Unless they are the majority.
    let fault = (2 * vertical_disparities.len() < pairs.len())
        .then(|| diagnose_matches(&pairs, left.height(), None))
        .filter(|cause| *cause != NoPairCause::Unknown);
    let quantiles = median(&mut vertical_disparities).zip(quantile(&mut vertical_disparities, 0.95));
    let vertical_px = quantiles.filter(|_| vertical_disparities.len() >= 8 && fault.is_none());
    clock.lap("quality");
    let valid_fraction = |mask: &Mask| {
        let m = mask.as_slice();
        m.iter().filter(|&&v| v).count() as f64 / m.len().max(1) as f64
    };
    Ok(RectifyResult {
        valid_area: [valid_fraction(&mask_left), valid_fraction(&mask_right)],
        rectification,
        images: [left, right],
        masks: [mask_left, mask_right],
        vertical_px,
        matches: vertical_disparities.len(),
        fault,
        stages: clock.into_stages(),
    })
}

/// Longer side in px above which rectified images are reduced for matching: features of the finest scales need memory
/// and add no information on the calibration.
const MAX_MATCHING_SIDE: usize = 4096;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Silent;
    use cv_core::{Camera, RgbU8};
    use cv_synth::{RenderOptions, Scene, render};

    #[test]
    fn matches_of_large_images_are_in_full_resolution_pixels() {
        let scene = Scene::room(2);
        let camera = Camera::from_focal(320, 240, 260.0);
        let photo = render(&scene, &camera, &scene.viewpoint(), &RenderOptions::default()).unwrap().image;
        let large = cv_imgproc::resize(photo.view(), 4500, 900, cv_imgproc::Interpolation::Bilinear).unwrap();
        let moved = RgbU8::from_fn(4500, 900, |x, y| large.at((x + 370).min(4499), (y + 90).min(899)));
        let pairs =
            match_reduced([large.view(), moved.view()], MAX_MATCHING_SIDE, &MatchingOptions::default(), &Silent)
                .unwrap()
                .pairs();
        let mut shift =
            [pairs.iter().map(|p| p.a.x - p.b.x).collect::<Vec<_>>(), pairs.iter().map(|p| p.a.y - p.b.y).collect()];
        let [x, y] = shift.each_mut().map(|d| median(d).unwrap());
        // At 0.91 of the size, a shift of 370 px would be 337. Features are accurate to a few tenths of a pixel.
        assert!(pairs.len() > 50 && (x - 370.0).abs() < 1.0 && (y - 90.0).abs() < 1.0, "{x} {y} of {}", pairs.len());
    }
}
