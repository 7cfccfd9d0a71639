//! Dense point cloud from two images with known geometry.

use super::ReconstructResult;
use crate::Progress;
use crate::pair_depth::pair_depth;
use cv_core::{Cancelled, GrayF32, ImageView, OptionError, Point3, PointCloud, StageClock, StereoRig};
use cv_imgproc::resize_area;
use cv_stereo::{RectifyError, StereoError};

/// Settings of [`reconstruct_dense`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct DenseOptions {
    /// Images with a longer side above this are reduced to it first, in pixels. 32 or more; default 1600: about a
    /// million points, and half a gigabyte for the cost volume. (COLMAP matches at 2000.)
    pub max_size: usize,
    /// Maximum number of bytes of the matcher; above, it works in strips. Default 1 GiB.
    pub max_memory: usize,
    /// Largest standard deviation of the depth of a point, as a ratio of the depth. Above 0; default 0.05.
    pub max_deviation: f32,
    /// Whether pixels without a confirmed match get a depth by hole filling. Default false.
    pub fill: bool,
}

impl Default for DenseOptions {
    fn default() -> Self {
        Self { max_size: 1600, max_memory: 1 << 30, max_deviation: 0.05, fill: false }
    }
}

/// Result of [`reconstruct_dense`].
#[derive(Debug, Clone, PartialEq)]
pub struct DenseResult {
    /// The points, in the frame and unit of the sparse ones: the first camera's frame, with the baseline as unit.
    pub cloud: PointCloud,
    /// Depth along the first camera's axis for each pixel of the (reduced) first image, NaN where there is no point.
    pub depth: GrayF32,
    /// Width and height of the rectified images in pixels.
    pub size: (usize, usize),
    /// Smallest disparity of the rectified images in pixels, and number of disparities.
    pub disparities: (i32, usize),
    /// Fraction of the commonly visible pixels with a confirmed depth.
    pub coverage: f64,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Why there is no dense cloud.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum DenseError {
    /// The images cannot be rectified.
    #[error("the two photographs cannot be rectified: {0}")]
    Rectify(#[source] RectifyError),
    /// The rectified images cannot be matched.
    #[error(transparent)]
    Stereo(StereoError),
    /// Hardly any depth is confirmed by the left-right check.
    #[error("only {:.1} % of the commonly visible pixels were matched and confirmed; at least {:.0} % are needed", 100.0 * .coverage, 100.0 * .needed)]
    LittleConfirmed {
        /// Fraction of the commonly visible pixels that were confirmed.
        coverage: f64,
        /// The minimum fraction.
        needed: f64,
    },
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

impl From<StereoError> for DenseError {
    fn from(error: StereoError) -> Self {
        match error {
            StereoError::Cancelled(stop) => Self::Cancelled(stop),
            other => Self::Stereo(other),
        }
    }
}

impl From<RectifyError> for DenseError {
    fn from(error: RectifyError) -> Self {
        match error {
            RectifyError::Cancelled(stop) => Self::Cancelled(stop),
            other => Self::Rectify(other),
        }
    }
}

/// Computes a dense point cloud of two reconstructed images: rectification by their geometry
/// ([`SceneRectification`](cv_stereo::SceneRectification)), and semi-global matching
/// ([`StereoMatcher`](cv_stereo::StereoMatcher)) over the disparities of the sparse points. Pixels whose match the
/// left-right check confirms become points.
///
/// O(pixels × disparities); the memory is bounded by [`DenseOptions::max_memory`] and some hundred bytes per pixel.
///
/// # Errors
/// [`DenseError`]: a motion along the optical axis, too little memory, or hardly any confirmed depth.
pub fn reconstruct_dense(
    a: ImageView<'_, u8, 3>,
    b: ImageView<'_, u8, 3>,
    sparse: &ReconstructResult,
    options: &DenseOptions,
    progress: &dyn Progress,
) -> Result<DenseResult, DenseError> {
    OptionError::check("max_size", options.max_size as f64, "at least 32 px", |v| v >= 32.0)?;
    OptionError::check("max_deviation", options.max_deviation.into(), "above 0", |v| v > 0.0)?;
    let photos = [a, b];
    for (photo, camera) in photos.iter().zip(&sparse.scene.cameras) {
        let expected = (camera.width, camera.height);
        if photo.size() != expected {
            return Err(RectifyError::ImageSize { image: photo.size(), expected }.into());
        }
    }
    let mut clock = StageClock::new();
    let longest = sparse.scene.cameras.iter().map(|c| c.width.max(c.height)).max().unwrap_or(1);
    let factor = (options.max_size as f64 / longest as f64).min(1.0);
    let side = |n: usize| ((n as f64 * factor).round() as usize).max(1);
    let cameras = sparse.scene.cameras.map(|camera| camera.resized(side(camera.width), side(camera.height)));
    let mut reduced = Vec::new();
    if factor < 1.0 {
        for (photo, camera) in photos.iter().zip(&cameras) {
            progress.report("reduce", 0, 1)?;
            let too_large = RectifyError::TooLarge { width: camera.width, height: camera.height };
            reduced.push(resize_area(*photo, camera.width, camera.height).map_err(|_| too_large)?);
        }
    }
    clock.lap("rectify");
    let photos = if let [a, b] = &reduced[..] { [a.view(), b.view()] } else { photos };
    let rig = StereoRig { left: cameras[0], right: cameras[1], right_from_left: sparse.scene.pose };
    let positions: Vec<Point3<f64>> = sparse.scene.points.iter().map(|p| p.position).collect();
    let pair = pair_depth(photos, &rig, &positions, options, progress)?;
    let mut stages = pair.stages.clone();
    let mut after = StageClock::new();
    let (cloud, depth) = (pair.cloud(progress)?, pair.depth_map(&cameras[0], progress)?);
    after.lap("cloud");
    // The reduction counts as rectification.
    let ours = clock.into_stages().into_iter().chain(after.into_stages());
    for (name, seconds) in ours {
        stages.iter_mut().filter(|(other, _)| *other == name).for_each(|(_, sum)| *sum += seconds);
    }
    Ok(DenseResult { cloud, depth, size: pair.size(), disparities: pair.disparities, coverage: pair.coverage, stages })
}
