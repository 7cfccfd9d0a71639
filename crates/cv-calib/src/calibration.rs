//! What a calibration is.

use crate::lens_choice::LensTrial;
use crate::uncertainty::{CoverageMap, UncertaintyMap};
use crate::verdict::Verdict;
use cv_core::{Camera, Pose, StereoRig, Vector2};
use nalgebra::DMatrix;

/// Cameras, their places, the target's shape and the poses of the views, with what is known of their errors. See [`calibrate`](crate::calibrate).
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// The cameras.
    pub cameras: Vec<CalibratedCamera>,
    /// The target's shape.
    pub target_shape: TargetShape,
    /// The views, as many as were given.
    pub views: Vec<CalibratedView>,
    /// Root mean square distance of the used corners of all cameras, in pixels.
    pub rms_px: f64,
    /// The same on views that had no part in the fit; NaN where that was not computed.
    pub holdout_rms_px: f64,
    /// The same over all corners of those views, those that were left out as outliers as well: the figure to set beside that of a system that leaves out none.
    pub holdout_all_rms_px: f64,
    /// Standard deviation of a coordinate of a corner, in pixels, as the residuals show it.
    pub noise_px: f64,
    /// Intrinsics of each camera, then position and turn of each camera but the first, then the deflections of the target where they were adjusted.
    pub parameters: Vec<CalibratedParameter>,
    /// Covariance of [`Calibration::parameters`], in their units.
    pub covariance: DMatrix<f64>,
    /// How far it can be trusted.
    pub verdict: Verdict,
}

/// A camera of a calibration.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibratedCamera {
    /// Lens and picture size.
    pub camera: Camera,
    /// Takes the first camera's frame to this one's, in the unit of the target.
    pub from_first: Pose,
    /// Root mean square distance of its used corners, in pixels.
    pub rms_px: f64,
    /// The same on views that had no part in the fit; NaN where that was not computed.
    pub holdout_rms_px: f64,
    /// The same over all corners of those views, those that were left out as outliers as well: the figure to set beside that of a system that leaves out none.
    pub holdout_all_rms_px: f64,
    /// The lens models that were tried, each by this camera alone.
    pub lenses: Vec<LensTrial>,
    /// How well its projection is known.
    pub uncertainty: UncertaintyMap,
    /// Where its used corners are.
    pub coverage: CoverageMap,
}

/// The shape of the target: see [`TargetPoints::bent`](crate::TargetPoints::bent).
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct TargetShape {
    /// Deflections along x and y, in the unit of the target; positive: the middle is farther from the camera than the ends.
    pub deflection: [f64; 2],
    /// Whether they were adjusted, or are zero because the views do not determine them or nobody asked.
    pub adjusted: bool,
}

/// A parameter, and how well it is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CalibratedParameter {
    /// Of which camera; `None` of the target.
    pub camera: Option<usize>,
    /// `fx`, `fy`, `cx`, `cy` in pixels, the distortion's names; of a rig `rx`, `ry`, `rz` (rotation vector in radians) and `tx`, `ty`, `tz`; of the target
    /// `kx`, `ky`.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
    /// Its standard deviation; of a rotation, that of a small turn about the axis of the camera's frame.
    pub deviation: f64,
}

/// A view of a calibration.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibratedView {
    /// Takes the target's frame to the first camera's; `None` where no picture of the view could be used.
    pub pose: Option<Pose>,
    /// By camera.
    pub pictures: Vec<CalibratedPicture>,
}

/// What became of what one camera saw in one view.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibratedPicture {
    /// Whether it was used.
    pub outcome: PictureOutcome,
    /// Root mean square distance of the used corners (of a picture left out: of all), in pixels; NaN where nothing is known.
    pub rms_px: f64,
    /// Each corner in the order given.
    pub corners: Vec<CalibratedCorner>,
    /// By which of the turns after which the target looks the same its points were numbered otherwise than in the first camera's picture
    /// ([`TargetPoints::with_equal_turns`](crate::TargetPoints::with_equal_turns)); 0: by none.
    pub turn: usize,
}

/// What became of a corner.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct CalibratedCorner {
    /// From where it was seen to where the calibration has it, in pixels; `None` where it has it nowhere.
    pub residual: Option<Vector2<f64>>,
    /// Whether it was used.
    pub used: bool,
}

/// Whether a picture was used, and why not.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case", tag = "kind"))]
#[non_exhaustive]
pub enum PictureOutcome {
    /// It was used.
    Used {
        /// Corners used.
        corners: usize,
        /// Corners left out as too far off.
        outliers: usize,
    },
    /// This camera saw nothing in this view.
    Nothing,
    /// There are too few corners.
    TooFewCorners {
        /// Corners given.
        got: usize,
        /// Corners needed.
        needed: usize,
    },
    /// The corners lie on a line, or the target was seen from its edge.
    Flat,
    /// The picture shows the target mirrored.
    Mirrored,
    /// No pose of the target explains the corners.
    NoPose,
    /// Most corners are too far off.
    Inconsistent {
        /// Corners that are near enough.
        near: usize,
        /// Corners given.
        of: usize,
        /// How far off a corner may be, in pixels.
        limit_px: f64,
    },
}

impl PictureOutcome {
    /// Whether it was used.
    pub fn is_used(&self) -> bool {
        matches!(self, Self::Used { .. })
    }
}

impl Calibration {
    /// The first two cameras as a rig; `None` of one camera.
    pub fn stereo(&self) -> Option<StereoRig> {
        let [left, right, ..] = self.cameras.as_slice() else { return None };
        Some(StereoRig { left: left.camera, right: right.camera, right_from_left: right.from_first })
    }

    /// Correlation of two parameters, −1 to 1; 0 where one is known exactly.
    pub fn correlation(&self, a: usize, b: usize) -> f64 {
        let scale = self.covariance[(a, a)].sqrt() * self.covariance[(b, b)].sqrt();
        if scale > 0.0 { (self.covariance[(a, b)] / scale).clamp(-1.0, 1.0) } else { 0.0 }
    }

    /// The views whose pictures by all cameras were used.
    pub fn complete_views(&self) -> impl Iterator<Item = usize> + '_ {
        (0..self.views.len()).filter(|v| self.views[*v].pictures.iter().all(|p| p.outcome.is_used()))
    }
}
