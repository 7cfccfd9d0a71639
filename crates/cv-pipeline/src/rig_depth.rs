//! Depth from the photographs of a calibrated rig: rectified first, at their own depth of bits.

use crate::{DepthError, DepthOptions, DepthResult, FrameDepth, Progress};
use cv_core::{ImageView, PointCloud, RgbU8};
use cv_imgproc::Pixel;
use cv_stereo::{Intensity, Rectification};

/// What [`depth_by_rig`] and [`FrameDepth`] found.
#[derive(Debug, Clone, PartialEq)]
pub struct RigDepthResult {
    /// The photographs, of a rig rectified, left (or upper) and right, as bytes of color.
    pub images: [RgbU8; 2],
    /// The maps of the left one. Of a rig, the `stages` begin with `rectify`.
    pub maps: DepthResult,
    /// The colored points in the frame of the left camera as it stood, not of the rectified one; in the unit of the rig.
    pub cloud: PointCloud,
}

/// Rectifies the photographs of a rig and finds disparity and depth, as [`depth()`](crate::depth()) does. The photographs are resampled and matched as deep
/// as they are: 16 bits stay 16 bits.
///
/// # Errors
/// [`DepthError`]: as [`depth()`](crate::depth()), and [`DepthError::Rectify`] where a photograph is not of its camera's size.
pub fn depth_by_rig<T: Intensity + Pixel, const C: usize>(
    left: ImageView<'_, T, C>,
    right: ImageView<'_, T, C>,
    rectification: &Rectification,
    options: &DepthOptions,
    progress: &dyn Progress,
) -> Result<RigDepthResult, DepthError> {
    FrameDepth::of_rig(options.clone(), rectification)?.next_depth(left, right, true, progress)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Silent;
    use crate::depth::color_bytes;
    use cv_core::{Camera, Image, Pose, Rotation3, StereoRig, Vector3};
    use cv_stereo::{PixelState, RectifyOptions, StereoOptions};
    use cv_synth::{RenderOptions, Scene, render};

    #[test]
    fn sixteen_bits_whose_upper_byte_is_the_same_everywhere_are_matched() {
        let scene = Scene::room(2);
        let camera = Camera::from_focal(320, 240, 260.0);
        let relative = Pose::new(Rotation3::from_euler_angles(0.02, -0.03, 0.015), Vector3::new(-0.2, 0.01, 0.004));
        let first = scene.viewpoint();
        let photo = |pose: &Pose| render(&scene, &camera, pose, &RenderOptions::default()).unwrap().image;
        let photos = [photo(&first), photo(&relative.compose(&first))];
        let rig = StereoRig { left: camera, right: camera, right_from_left: relative };
        let rectification = Rectification::new(&rig, &RectifyOptions::default()).unwrap();
        let stereo = StereoOptions { disparities: 64, ..StereoOptions::default() };
        let options = DepthOptions { stereo, ..DepthOptions::default() };
        let bytes = depth_by_rig(photos[0].view(), photos[1].view(), &rectification, &options, &Silent).unwrap();
        let low: Vec<Image<u16, 3>> = photos.iter().map(|p| p.map(|c| c.map(|v| 0x4e00 + u16::from(v)))).collect();
        // As bytes they are a gray wall: at most two neighboring values.
        let gray = color_bytes(low[0].view());
        assert!(gray.as_slice().iter().all(|v| (78..=79).contains(v)));
        let deep = depth_by_rig(low[0].view(), low[1].view(), &rectification, &options, &Silent).unwrap();
        // The census counts which neighbors are darker, whatever the step; only what knows edges of the photograph by their height (the
        // penalties and the smoothing) sees less. Half a pixel is what rectified pairs are good to.
        let (a, b) = (&bytes.maps.map, &deep.maps.map);
        let both = a.state.as_slice().iter().zip(b.state.as_slice());
        let known: Vec<bool> = both.map(|(a, b)| *a == PixelState::Matched && *b == PixelState::Matched).collect();
        let same = a.disparity.as_slice().iter().zip(b.disparity.as_slice()).zip(&known);
        let count = known.iter().filter(|k| **k).count();
        let near = same.filter(|((a, b), known)| **known && (**a - **b).abs() < 0.5).count();
        assert!(b.matched_fraction() > 0.5 && near * 10 > count * 9, "{} {near} of {count}", b.matched_fraction());
        assert!(deep.cloud.len() > 40_000 && deep.maps.stages[0].0 == "rectify");
    }
}
