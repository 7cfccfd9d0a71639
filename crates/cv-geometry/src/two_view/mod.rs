//! Cameras, relative pose and points of two views, from matches between their keypoints.

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

/// What is known of the cameras.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Intrinsics {
    /// Both cameras are calibrated, lens distortion included.
    Known([Camera; 2]),
    /// Both calibration matrices, without a word of the distortion of the lenses: radial distortion is estimated, whatever that of the cameras is, and the focal lengths are a
    /// prior with a standard deviation of 2 %, by about which a calibration without distortion is off.
    Matrix([Camera; 2]),
    /// About what focal length in pixels each photograph has, such as from EXIF: a prior with a standard deviation of 3 %. Principal points are in the middle, radial
    /// distortion is estimated.
    Focal([f64; 2]),
    /// One unknown focal length for both photographs, most likely between 0.4 and 3 times their longer side; principal points are in the middle, radial distortion
    /// is estimated.
    Unknown,
}

impl Intrinsics {
    /// What focal lengths in pixels tell, of which each may be missing: nothing unless both are known.
    pub fn from_focal_lengths(focal: [Option<f64>; 2]) -> Self {
        match focal {
            [Some(a), Some(b)] => Self::Focal([a, b]),
            _ => Self::Unknown,
        }
    }

    /// The cameras of photographs of these sizes, where they are known: undistorted ones of which only the matrix or the focal length is.
    ///
    /// # Errors
    /// [`TwoViewError::Camera`] and [`TwoViewError::CameraSize`].
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

    /// What is known of the focal lengths, where they may change.
    fn focal_prior(&self, sizes: [(usize, usize); 2]) -> Option<FocalPrior> {
        let of = |focal: [f64; 2], deviation: f64, one_camera: bool| {
            let ratio = if one_camera { FocalPrior::REFOCUSED } else { deviation * f64::sqrt(2.0) };
            FocalPrior { focal: focal[0], deviation, ratio }
        };
        match *self {
            Self::Known(_) => None,
            Self::Matrix([a, b]) => Some(of([a.fx, b.fx], MATRIX_DEVIATION, a == b)),
            Self::Focal(focal) => Some(of(focal, EXIF_FOCAL_DEVIATION, focal[0] == focal[1] && sizes[0] == sizes[1])),
            Self::Unknown => {
                let (share, deviation) = usual_focal();
                let focal = share * sizes[0].0.max(sizes[0].1) as f64;
                Some(FocalPrior { focal, deviation, ratio: FocalPrior::REFOCUSED })
            }
        }
    }
}

/// Relative standard deviation of focal lengths by EXIF: a 35 mm equivalent is rounded by up to 2 %, and focusing near lengthens what is written for infinity by some per cent.
pub const EXIF_FOCAL_DEVIATION: f64 = 0.03;
/// And of a calibration matrix that came without its lens: the focal length of a fit without distortion takes up some of it (of Sceaux's, 2.3 %).
const MATRIX_DEVIATION: f64 = 0.02;
/// What focal lengths of photographs are, as shares of the longer side: an unknown one is between these with 95 % (fields of view of 103 and of 19 degrees).
pub const PLAUSIBLE_FOCAL: (f64, f64) = (0.4, 3.0);

/// The middle of [`PLAUSIBLE_FOCAL`] as a share of the longer side, and the standard deviation of its logarithm.
fn usual_focal() -> (f64, f64) {
    let (low, high) = PLAUSIBLE_FOCAL;
    ((low * high).sqrt(), (high / low).ln() / 4.0)
}

/// Settings of [`reconstruct_two_views`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct TwoViewOptions {
    /// What is known of the cameras. Default unknown.
    pub intrinsics: Intrinsics,
    /// The search for the pose. The threshold is in pixels; default 2 px, three to four times what a SIFT point is good to.
    pub robust: RobustOptions,
    /// Fewest matches that must agree. Default 30, COLMAP's for a first pair being 100 and for any pair 15.
    pub min_inliers: usize,
    /// Smallest share of matches that must agree. 0 to 1; default 0.1: fewer may well agree by chance.
    pub min_inlier_share: f64,
    /// Smallest median angle between the two rays of a point, in radians. Default 0.5 degrees: depth is then known to a fifth
    /// or so, for a point good to half a pixel at a focal length of 1000 px.
    pub min_median_angle: f64,
    /// Largest standard deviation of the direction of the translation if the lens is what was found, in radians, and largest angle to another direction that the
    /// matches do not exclude. Default 3 degrees: beyond, depths along the motion are off by a tenth and more.
    pub max_deviation: f64,
    /// Smallest angle between the two rays of a point that is kept, in radians. Default 0.1 degrees.
    pub min_angle: f64,
    /// Largest reprojection error of a point that is kept, in pixels, in either photograph. Default 2 px.
    pub max_reprojection: f64,
    /// A homography (or a rotation) that explains this share of the matches that agree makes the scene a plane (or the motion a
    /// turn). 0 to 1; default 0.95.
    pub degenerate_share: f64,
}

impl Default for TwoViewOptions {
    fn default() -> Self {
        Self {
            intrinsics: Intrinsics::Unknown,
            robust: RobustOptions { threshold: 2.0, ..RobustOptions::default() },
            min_inliers: 30,
            min_inlier_share: 0.1,
            min_median_angle: 0.5f64.to_radians(),
            max_deviation: 3f64.to_radians(),
            min_angle: 0.1f64.to_radians(),
            max_reprojection: 2.0,
            degenerate_share: 0.95,
        }
    }
}

/// Keypoints of two photographs, and tentative matches between them.
#[derive(Debug, Clone, Copy)]
pub struct MatchedViews<'a> {
    /// Width and height of each photograph in pixels.
    pub sizes: [(usize, usize); 2],
    /// The keypoints of each photograph, in its pixels as they were taken (lens distortion included).
    pub keypoints: [&'a [Keypoint]; 2],
    /// The matches by index of the keypoints, of which many may be wrong.
    pub matches: &'a [DMatch],
}

impl MatchedViews<'_> {
    /// Where keypoints are that are matched.
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

/// Cameras, relative pose and points of two views, from tentative matches: [`estimate_two_view_geometry`], then
/// [`TwoViewAdjustment`]. (With descriptors at hand, further matches can be looked for between the two.)
///
/// The world is the first camera's frame and its unit the distance between the cameras, which photographs cannot tell.
///
/// # Errors
/// [`TwoViewError`], each with its numbers.
pub fn reconstruct_two_views(
    views: &MatchedViews<'_>,
    options: &TwoViewOptions,
    progress: &dyn Progress,
) -> Result<TwoViewReconstruction, TwoViewError> {
    let geometry = estimate_two_view_geometry(views, options, progress)?;
    TwoViewAdjustment::new(views, geometry, options, progress)?.finish()
}
