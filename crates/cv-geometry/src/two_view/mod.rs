//! Two-view reconstruction: cameras, relative pose and points from matches between keypoints.

mod adjustment;
mod degeneracy;
mod error;
mod geometry;
mod lens;
mod neighbors;

pub use adjustment::{TwoViewAdjustment, TwoViewPoint, TwoViewReconstruction};
pub use error::TwoViewError;
pub use geometry::{TwoViewGeometry, estimate_two_view_geometry};

use crate::{FocalPrior, RobustOptions};
use cv_core::{Camera, Correspondence, DMatch, Keypoint, Progress};

/// Prior knowledge of the intrinsics.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Intrinsics {
    /// Both cameras are calibrated, including lens distortion.
    Known([Camera; 2]),
    /// Both calibration matrices, with unknown distortion (that of the cameras is ignored): radial distortion is
    /// estimated, and the focal lengths are a prior with a standard deviation of 2 %, the typical error of a
    /// calibration without distortion.
    Matrix([Camera; 2]),
    /// An approximate focal length in pixels of each image, such as from EXIF: a prior with a standard deviation of 3
    /// %. Principal points are at the image center, radial distortion is estimated.
    Focal([f64; 2]),
    /// One unknown focal length for both images, with a prior between 0.4 and 3 times the longer side (95 %). Principal
    /// points are at the image center, radial distortion is estimated.
    Unknown,
}

impl Intrinsics {
    /// Creates intrinsics from focal lengths in pixels: [`Self::Focal`] if both are known, else [`Self::Unknown`].
    pub fn from_focal_lengths(focal: [Option<f64>; 2]) -> Self {
        match focal {
            [Some(a), Some(b)] => Self::Focal([a, b]),
            _ => Self::Unknown,
        }
    }

    /// Returns the cameras for images of these sizes, or `None` for [`Self::Unknown`]; without distortion unless
    /// [`Self::Known`].
    ///
    /// # Errors
    /// [`TwoViewError::Camera`] for invalid parameters, [`TwoViewError::CameraSize`].
    pub fn cameras(&self, sizes: [(usize, usize); 2]) -> Result<Option<[Camera; 2]>, TwoViewError> {
        let cameras = match *self {
            Self::Unknown => return Ok(None),
            Self::Known(cameras) => cameras,
            Self::Matrix(cameras) => {
                cameras.map(|camera| Camera { distortion: cv_core::Distortion::default(), ..camera })
            }
            Self::Focal(focal) => [0, 1].map(|i: usize| Camera::from_focal(sizes[i].0, sizes[i].1, focal[i])),
        };
        for (i, camera) in cameras.iter().enumerate() {
            camera.validate().map_err(|source| TwoViewError::Camera { index: i + 1, source })?;
            let size = (camera.width, camera.height);
            if size != sizes[i] {
                return Err(TwoViewError::CameraSize { index: i + 1, camera: size, photo: sizes[i] });
            }
        }
        Ok(Some(cameras))
    }

    /// Returns the prior of the focal lengths; `None` if they are fixed.
    fn focal_prior(&self, sizes: [(usize, usize); 2]) -> Option<FocalPrior> {
        let prior = |focal: [f64; 2], deviation: f64, is_same_camera: bool| {
            let ratio = if is_same_camera { FocalPrior::SAME_LENS_RATIO_DEVIATION } else { deviation * f64::sqrt(2.0) };
            FocalPrior { focal: focal[0], deviation, ratio }
        };
        match *self {
            Self::Known(_) => None,
            Self::Matrix([a, b]) => Some(prior([a.fx, b.fx], MATRIX_DEVIATION, a == b)),
            Self::Focal(focal) => {
                Some(prior(focal, EXIF_FOCAL_DEVIATION, focal[0] == focal[1] && sizes[0] == sizes[1]))
            }
            Self::Unknown => {
                let (median, deviation) = log_normal_focal_prior();
                let focal = median * sizes[0].0.max(sizes[0].1) as f64;
                Some(FocalPrior { focal, deviation, ratio: FocalPrior::SAME_LENS_RATIO_DEVIATION })
            }
        }
    }
}

/// Relative standard deviation of EXIF focal lengths: a 35 mm equivalent is rounded by up to 2 %, and the recorded
/// value is that at infinity focus, some per cent shorter than at close focus.
pub const EXIF_FOCAL_DEVIATION: f64 = 0.03;
/// Relative standard deviation of the focal length of a calibration without distortion, which it partly compensates
/// (2.3 % for the Sceaux data set).
const MATRIX_DEVIATION: f64 = 0.02;
/// The 95 % interval of the prior of an unknown focal length, relative to the longer image side (fields of view of 103
/// and 19 degrees).
pub const PLAUSIBLE_FOCAL: (f64, f64) = (0.4, 3.0);

/// Returns the median of the log-normal prior of [`PLAUSIBLE_FOCAL`], relative to the longer image side, and the
/// standard deviation of the logarithm.
fn log_normal_focal_prior() -> (f64, f64) {
    let (low, high) = PLAUSIBLE_FOCAL;
    ((low * high).sqrt(), (high / low).ln() / 4.0)
}

/// Options of [`reconstruct_two_views`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct TwoViewOptions {
    /// Prior knowledge of the intrinsics. Default unknown.
    pub intrinsics: Intrinsics,
    /// RANSAC options of the relative pose. The threshold is in pixels; default 2 px, three to four times the
    /// localization error of SIFT keypoints.
    pub robust: RobustOptions,
    /// Minimum number of inliers. Default 30 (COLMAP: 100 for an initial pair, 15 for any pair).
    pub min_inliers: usize,
    /// Minimum inlier ratio, 0 to 1. Default 0.1: lower ratios occur by chance.
    #[cfg_attr(feature = "serde", serde(rename = "min_inlier_share"))]
    pub min_inlier_ratio: f64,
    /// Minimum median parallax angle, in radians. Default 0.5 degrees: a relative depth error of about 0.2, for a
    /// localization error of half a pixel at a focal length of 1000 px.
    pub min_median_angle: f64,
    /// Maximum standard deviation of the direction of the translation conditional on the intrinsics, in radians, and
    /// maximum angle to another direction that fits the matches as well. Default 3 degrees: beyond, depths along the
    /// motion have errors of a tenth and more.
    pub max_deviation: f64,
    /// Minimum parallax angle of a point, in radians. Default 0.1 degrees.
    pub min_angle: f64,
    /// Maximum reprojection error of a point in either image, in pixels. Default 2 px.
    pub max_reprojection: f64,
    /// Fraction of the inliers that fit a homography (or a rotation) from which the scene counts as planar (or the
    /// motion as a pure rotation). 0 to 1; default 0.95.
    #[cfg_attr(feature = "serde", serde(rename = "degenerate_share"))]
    pub degenerate_ratio: f64,
}

impl Default for TwoViewOptions {
    fn default() -> Self {
        Self {
            intrinsics: Intrinsics::Unknown,
            robust: RobustOptions { threshold: 2.0, ..RobustOptions::default() },
            min_inliers: 30,
            min_inlier_ratio: 0.1,
            min_median_angle: 0.5f64.to_radians(),
            max_deviation: 3f64.to_radians(),
            min_angle: 0.1f64.to_radians(),
            max_reprojection: 2.0,
            degenerate_ratio: 0.95,
        }
    }
}

/// Keypoints of two images, and tentative matches between them.
#[derive(Debug, Clone, Copy)]
pub struct MatchedViews<'a> {
    /// Width and height of each image in pixels.
    pub sizes: [(usize, usize); 2],
    /// The keypoints of each image, in distorted pixels.
    pub keypoints: [&'a [Keypoint]; 2],
    /// The tentative matches, by keypoint index.
    pub matches: &'a [DMatch],
}

impl MatchedViews<'_> {
    /// Looks up the coordinates of matched keypoints.
    ///
    /// # Errors
    /// [`TwoViewError::MatchOutOfRange`].
    fn correspondences(&self, matches: &[DMatch]) -> Result<Vec<Correspondence>, TwoViewError> {
        let [a, b] = self.keypoints;
        let pixels = |(index, m): (usize, &DMatch)| {
            let DMatch { query, train, .. } = *m;
            let keypoints = (a.len(), b.len());
            m.correspondence(a, b).ok_or(TwoViewError::MatchOutOfRange { index, query, train, keypoints })
        };
        matches.iter().enumerate().map(pixels).collect()
    }
}

/// Reconstructs cameras, relative pose and points of two views from tentative matches: [`estimate_two_view_geometry`],
/// then [`TwoViewAdjustment`]. (Guided matching is possible between the two steps.)
///
/// The world frame is that of the first camera. The scale is a gauge freedom; the unit is the baseline.
///
/// # Errors
/// [`TwoViewError`].
pub fn reconstruct_two_views(
    views: &MatchedViews<'_>,
    options: &TwoViewOptions,
    progress: &dyn Progress,
) -> Result<TwoViewReconstruction, TwoViewError> {
    let geometry = estimate_two_view_geometry(views, options, progress)?;
    TwoViewAdjustment::new(views, geometry, options, progress)?.finish()
}
