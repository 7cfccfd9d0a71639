//! Why a calibration cannot be made.

use cv_core::{Cancelled, DistortionModel, OptionError};

/// Why a calibration cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub enum CalibrateError {
    /// Degenerate target: no area, or coordinates out of range.
    #[error("{points} points do not span a planar target")]
    Target {
        /// Number of points.
        points: usize,
    },
    /// There are no views.
    #[error("there are no views")]
    NoViews,
    /// The image size is below 2 or above a million.
    #[error("camera {camera}: images of {width} × {height} pixels")]
    Size {
        /// Index of the camera.
        camera: usize,
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// A view has no list of corners for each camera.
    #[error("view {view} has corner lists for {got} cameras, {needed} are needed")]
    Cameras {
        /// Index of the view.
        view: usize,
        /// Number of corner lists.
        got: usize,
        /// Number of cameras.
        needed: usize,
    },
    /// A corner refers to a point that the target does not have.
    #[error("view {view}, camera {camera}: there is no point {point} on a target of {points}")]
    Point {
        /// Index of the view.
        view: usize,
        /// Index of the camera.
        camera: usize,
        /// Index of the point.
        point: usize,
        /// Number of points of the target.
        points: usize,
    },
    /// Two corners of one image refer to the same point.
    #[error("view {view}, camera {camera}: point {point} has two corners")]
    Twice {
        /// Index of the view.
        view: usize,
        /// Index of the camera.
        camera: usize,
        /// Index of the point.
        point: usize,
    },
    /// The pixel of a corner is not finite or beyond ten million.
    #[error("view {view}, camera {camera}: the position of corner {corner} is out of range")]
    NotFinite {
        /// Index of the view.
        view: usize,
        /// Index of the camera.
        camera: usize,
        /// Index of the corner.
        corner: usize,
    },
    /// Too few usable views of a camera.
    #[error("camera {camera}: {got} views are usable, {needed} are needed")]
    TooFewViews {
        /// Index of the camera.
        camera: usize,
        /// Number of usable views.
        got: usize,
        /// Number that is needed.
        needed: usize,
        /// Views with too few or collinear corners.
        small: usize,
        /// Views that show the target mirrored.
        mirrored: usize,
    },
    /// Degenerate configuration: the focal length is not determined, since the target is nearly parallel to the image
    /// plane in all views.
    #[error(
        "camera {camera}: the views do not determine the intrinsics: the target is tilted by {largest_tilt_degrees:.1}° at most"
    )]
    Degenerate {
        /// Index of the camera.
        camera: usize,
        /// Largest angle between the target and the image plane, in degrees.
        largest_tilt_degrees: f64,
    },
    /// No initial intrinsics of the lens model fit the corners.
    #[error("camera {camera}: no lens of the model {} fits: the best initial values have a median error of {error_px:.1} px", model.info().name)]
    NoStart {
        /// Index of the camera.
        camera: usize,
        /// The lens model.
        model: DistortionModel,
        /// Median reprojection error of the best initial values, in pixels.
        error_px: f64,
    },
    /// A camera has no view in common with those that are connected to the first camera.
    #[error("camera {camera} has no view in common with the other cameras")]
    Unconnected {
        /// Index of the camera.
        camera: usize,
    },
    /// The lens model cannot be calibrated: a pinhole, or a model with fewer than four parameters.
    #[error("the lens model {} cannot be calibrated", model.info().name)]
    Lens {
        /// The lens model.
        model: DistortionModel,
    },
    /// An option is out of its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}
