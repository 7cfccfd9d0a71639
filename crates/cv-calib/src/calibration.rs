//! The result of a calibration.

use crate::lens_choice::LensTrial;
use crate::uncertainty::{CoverageMap, UncertaintyMap};
use crate::verdict::Verdict;
use cv_core::{Camera, Pose, StereoRig, Vector2};
use nalgebra::DMatrix;

/// A calibration: intrinsics, rig poses, target shape and target poses, with their uncertainties. See
/// [`calibrate`](crate::calibrate).
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// The cameras.
    pub cameras: Vec<CalibratedCamera>,
    /// The target's shape.
    pub target_shape: TargetShape,
    /// The views, in the order of the input.
    pub views: Vec<CalibratedView>,
    /// Root mean square reprojection error of the inlier corners of all cameras, in pixels.
    pub rms_px: f64,
    /// The same on held-out views; NaN where it was not computed.
    pub holdout_rms_px: f64,
    /// The same on all corners of held-out views, outliers included: comparable with systems that do not reject
    /// outliers.
    pub holdout_all_rms_px: f64,
    /// Standard deviation of a corner coordinate in pixels, estimated from the residuals.
    pub noise_px: f64,
    /// Intrinsics of each camera, then the pose of each camera but the first, then the deflections of the target where
    /// they were adjusted.
    pub parameters: Vec<CalibratedParameter>,
    /// Covariance of [`Calibration::parameters`], in their units.
    pub covariance: DMatrix<f64>,
    /// How far the calibration can be trusted.
    pub verdict: Verdict,
}

/// A camera of a calibration.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibratedCamera {
    /// Intrinsics and image size.
    pub camera: Camera,
    /// Pose in the rig: first camera's frame to this camera's frame, in the unit of the target.
    pub from_first: Pose,
    /// Root mean square reprojection error of its inlier corners, in pixels.
    pub rms_px: f64,
    /// The same on held-out views; NaN where it was not computed.
    pub holdout_rms_px: f64,
    /// The same on all corners of held-out views, outliers included: comparable with systems that do not reject
    /// outliers.
    pub holdout_all_rms_px: f64,
    /// The lens models that were tried, each for this camera alone.
    pub lenses: Vec<LensTrial>,
    /// Uncertainty of its projection over the image.
    pub uncertainty: UncertaintyMap,
    /// Coverage of the image by inlier corners.
    pub coverage: CoverageMap,
}

/// The shape of the target (board warp): see [`TargetPoints::bent`](crate::TargetPoints::bent).
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct TargetShape {
    /// Deflections along x and y, in the unit of the target; positive where the center is farther from the camera than
    /// the borders.
    pub deflection: [f64; 2],
    /// Whether they were adjusted; else they are zero.
    pub adjusted: bool,
}

/// A parameter and its standard deviation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CalibratedParameter {
    /// Index of the camera; `None` for the target.
    pub camera: Option<usize>,
    /// `fx`, `fy`, `cx`, `cy` in pixels, then the names of the distortion coefficients; for a rig pose `rx`, `ry`, `rz`
    /// (rotation vector in radians) and `tx`, `ty`, `tz`; for the target `kx`, `ky`.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
    /// Its standard deviation; of a rotation, that of a small rotation in the camera's frame.
    pub deviation: f64,
}

/// A view of a calibration.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibratedView {
    /// Pose of the target: target frame to first camera's frame. `None` where no image of the view was used.
    pub pose: Option<Pose>,
    /// The images of the view, by camera.
    pub images: Vec<CalibratedImage>,
}

/// Result for one image: one camera in one view.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibratedImage {
    /// Whether it was used, and why not.
    pub outcome: ImageOutcome,
    /// Root mean square reprojection error of the inlier corners, or of all corners of an unused image, in pixels; NaN
    /// without residuals.
    pub rms_px: f64,
    /// The corners, in the order of the input.
    pub corners: Vec<CalibratedCorner>,
    /// Index of the target's rotational symmetry by which its points were numbered otherwise than in the first camera's
    /// image ([`TargetPoints::with_rotational_symmetry`](crate::TargetPoints::with_rotational_symmetry)); 0 is the
    /// identity.
    pub symmetry: usize,
}

/// Result for one corner.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct CalibratedCorner {
    /// Reprojection residual in pixels (projected minus detected); `None` where there is none.
    pub residual: Option<Vector2<f64>>,
    /// Whether it was used (an inlier).
    pub used: bool,
}

/// Whether an image was used, and why not.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case", tag = "kind"))]
#[non_exhaustive]
pub enum ImageOutcome {
    /// It was used.
    Used {
        /// Inlier corners.
        corners: usize,
        /// Outlier corners.
        outliers: usize,
    },
    /// This camera has no corner in this view.
    Nothing,
    /// Too few corners.
    TooFewCorners {
        /// Number of corners.
        got: usize,
        /// Number that is needed.
        needed: usize,
    },
    /// Degenerate: the corners are collinear, or the target is seen edge-on.
    Flat,
    /// The image shows the target mirrored.
    Mirrored,
    /// No target pose explains the corners.
    NoPose,
    /// Most corners are outliers.
    Inconsistent {
        /// Corners within the limit.
        near: usize,
        /// Number of corners.
        of: usize,
        /// Outlier threshold, in pixels.
        limit_px: f64,
    },
}

impl ImageOutcome {
    /// Returns whether the image was used.
    pub fn is_used(&self) -> bool {
        matches!(self, Self::Used { .. })
    }
}

impl Calibration {
    /// Returns the first two cameras as a stereo rig; `None` for a single camera.
    pub fn stereo(&self) -> Option<StereoRig> {
        let [left, right, ..] = self.cameras.as_slice() else { return None };
        Some(StereoRig { left: left.camera, right: right.camera, right_from_left: right.from_first })
    }

    /// Returns the correlation of two parameters, −1 to 1; 0 where one has no variance.
    pub fn correlation(&self, a: usize, b: usize) -> f64 {
        let scale = self.covariance[(a, a)].sqrt() * self.covariance[(b, b)].sqrt();
        if scale > 0.0 { (self.covariance[(a, b)] / scale).clamp(-1.0, 1.0) } else { 0.0 }
    }

    /// Returns the views that were used in all cameras.
    pub fn complete_views(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.views.len()).filter(|v| self.views[*v].images.iter().all(|p| p.outcome.is_used()))
    }
}
