//! Rectification of a pair of photographs, with what tells whether it is any good.

use crate::depth::color_bytes;
use crate::matching::match_reduced;
use crate::no_pair::judge;
use crate::{MatchingError, MatchingOptions, NoPairCause, Progress};
use cv_core::{Image, ImageView, Mask, StageClock, StereoRig, median, quantile};
use cv_imgproc::Pixel;
use cv_stereo::{Intensity, Rectification, RectifyError, RectifyOptions};

/// What [`rectify`] made; `P` is a photograph.
#[derive(Debug, Clone, PartialEq)]
pub struct RectifyResult<P> {
    /// Both rectified views and their geometry.
    pub rectification: Rectification,
    /// The rectified photographs, left and right, as deep as they came.
    pub images: [P; 2],
    /// Where they show anything.
    pub masks: [Mask; 2],
    /// Share of pixels that show anything, left and right.
    pub valid_area: [f64; 2],
    /// Median and 95 % quantile in px of the difference in rows of features found in both rectified photographs; `None`
    /// with fewer than eight of them, or where most features say something else.
    pub vertical_px: Option<(f64, f64)>,
    /// Number of those features.
    pub matches: usize,
    /// What most features show where they do not lie as those of a rectified pair: the rig is not that of the photographs,
    /// or they are not in its order.
    pub fault: Option<NoPairCause>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

impl<P> RectifyResult<P> {
    /// The same with other photographs.
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

/// Rectifies a pair taken by `rig`, as deep as it is: 16 bits stay 16 bits.
///
/// # Errors
/// [`RectifyError`] where the rig cannot be rectified, or the photographs are not of its cameras' sizes.
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
    // A pair without features is rectified all the same; only its quality stays unknown.
    let colors = [color_bytes(left.view()), color_bytes(right.view())];
    let pairs = match match_reduced(colors.each_ref().map(|c| c.view()), LARGEST, &MatchingOptions::default(), progress)
    {
        Ok(found) => found.pairs(),
        Err(MatchingError::Cancelled(stop)) => return Err(stop.into()),
        Err(_) => Vec::new(),
    };
    // A wrong match has any row; those beyond a few pixels say nothing of the calibration.
    let mut rows: Vec<f64> =
        pairs.iter().filter(|p| p.a.x >= p.b.x - 4.0).map(|p| (p.a.y - p.b.y).abs()).filter(|&dy| dy < 8.0).collect();
    // Unless they are most of them.
    let fault = (2 * rows.len() < pairs.len())
        .then(|| judge(&pairs, left.height(), None))
        .filter(|cause| *cause != NoPairCause::Unknown);
    let quantiles = median(&mut rows).zip(quantile(&mut rows, 0.95));
    let vertical_px = quantiles.filter(|_| rows.len() >= 8 && fault.is_none());
    clock.lap("quality");
    let share = |mask: &Mask| {
        let m = mask.as_slice();
        m.iter().filter(|&&v| v).count() as f64 / m.len().max(1) as f64
    };
    Ok(RectifyResult {
        valid_area: [share(&mask_left), share(&mask_right)],
        rectification,
        images: [left, right],
        masks: [mask_left, mask_right],
        vertical_px,
        matches: rows.len(),
        fault,
        stages: clock.into_stages(),
    })
}

/// Rectified photographs whose longer side is above this are reduced to it for matching, in px: features of the finest scales take
/// memory, and tell no more of the calibration.
const LARGEST: usize = 4096;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Silent;
    use cv_core::{Camera, Distortion, Pose, RgbU8, Rotation3, Vector3};
    use cv_synth::{RenderOptions, Scene, render};

    #[test]
    fn matches_of_large_photographs_are_in_their_own_pixels() {
        let scene = Scene::room(2);
        let camera = Camera::from_focal(320, 240, 260.0);
        let photo = render(&scene, &camera, &scene.viewpoint(), &RenderOptions::default()).unwrap().image;
        let large = cv_imgproc::resize(photo.view(), 4500, 900, cv_imgproc::Interpolation::Bilinear).unwrap();
        let moved = RgbU8::from_fn(4500, 900, |x, y| large.at((x + 370).min(4499), (y + 90).min(899)));
        let pairs =
            match_reduced([large.view(), moved.view()], LARGEST, &MatchingOptions::default(), &Silent).unwrap().pairs();
        let mut shift =
            [pairs.iter().map(|p| p.a.x - p.b.x).collect::<Vec<_>>(), pairs.iter().map(|p| p.a.y - p.b.y).collect()];
        let [x, y] = shift.each_mut().map(|d| median(d).unwrap());
        // Reduced by a tenth: a shift of 370 px would be 337 there. Features are placed to a few tenths of a pixel.
        assert!(pairs.len() > 50 && (x - 370.0).abs() < 1.0 && (y - 90.0).abs() < 1.0, "{x} {y} of {}", pairs.len());
    }

    #[test]
    fn features_of_a_turned_and_distorted_pair_come_to_lie_in_the_same_rows() {
        let scene = Scene::room(2);
        let mut camera = Camera::from_focal(320, 240, 260.0);
        camera.distortion = Distortion::radial(-0.12, 0.02);
        let relative = Pose::new(Rotation3::from_euler_angles(0.02, -0.03, 0.015), Vector3::new(-0.2, 0.01, 0.004));
        let first = scene.viewpoint();
        let options = RenderOptions::default();
        let a = render(&scene, &camera, &first, &options).unwrap();
        let b = render(&scene, &camera, &relative.compose(&first), &options).unwrap();
        let rig = StereoRig { left: camera, right: camera, right_from_left: relative };
        let result = rectify(a.image.view(), b.image.view(), &rig, &RectifyOptions::default(), &Silent).unwrap();
        let (median, _) = result.vertical_px.unwrap();
        // Features are placed to a few tenths of a pixel; an unrectified pair of this rig is off by five and more.
        assert!(median < 0.4 && result.matches > 30, "{median} px over {}", result.matches);
        assert_eq!(result.fault, None);
        assert!(result.valid_area[0] > 0.999 && result.valid_area[1] > 0.999);
    }
}
