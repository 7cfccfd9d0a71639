//! Why a calibration cannot be made.

use cv_core::{Cancelled, DistortionModel, OptionError};

/// Why a calibration cannot be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[non_exhaustive]
pub enum CalibrateError {
    /// The target has no area, or coordinates that are no use.
    #[error("{points} points do not make a flat target")]
    Target {
        /// Points given.
        points: usize,
    },
    /// There is nothing to calibrate from.
    #[error("there are no views")]
    NoViews,
    /// A picture has no size, or one beyond a million.
    #[error("camera {camera}: pictures of {width} × {height} pixels")]
    Size {
        /// Which camera.
        camera: usize,
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
    },
    /// A view does not tell of every camera.
    #[error("view {view} is of {got} cameras where there are {needed}")]
    Cameras {
        /// Which view.
        view: usize,
        /// Lists of corners.
        got: usize,
        /// Cameras.
        needed: usize,
    },
    /// A corner is of a point that the target does not have.
    #[error("view {view}, camera {camera}: there is no point {point} on a target of {points}")]
    Point {
        /// Which view.
        view: usize,
        /// Which camera.
        camera: usize,
        /// The point named.
        point: usize,
        /// Points of the target.
        points: usize,
    },
    /// Two corners of one picture are of the same point.
    #[error("view {view}, camera {camera}: point {point} is there twice")]
    Twice {
        /// Which view.
        view: usize,
        /// Which camera.
        camera: usize,
        /// Which point.
        point: usize,
    },
    /// A pixel is NaN, infinite or beyond ten million.
    #[error("view {view}, camera {camera}: corner {corner} has a position that is no use")]
    NotFinite {
        /// Which view.
        view: usize,
        /// Which camera.
        camera: usize,
        /// Which of its corners.
        corner: usize,
    },
    /// Too few views of a camera can be used.
    #[error("camera {camera}: {got} views can be used, {needed} are needed")]
    TooFewViews {
        /// Which camera.
        camera: usize,
        /// Views that can be used.
        got: usize,
        /// Views needed.
        needed: usize,
        /// Views that have some corners, but too few, or on a line.
        small: usize,
        /// Views that show the target mirrored.
        mirrored: usize,
    },
    /// The views leave the focal length open: the target is nearly parallel to the picture in all of them.
    #[error(
        "camera {camera}: the views do not determine the lens; the target is tilted by {largest_tilt_degrees:.1}° at most"
    )]
    Degenerate {
        /// Which camera.
        camera: usize,
        /// Largest angle between the target and the picture plane, in degrees.
        largest_tilt_degrees: f64,
    },
    /// No lens of the model fits the corners.
    #[error("camera {camera}: no lens of the model {} fits: the best start is {error_px:.1} px off", model.info().name)]
    NoStart {
        /// Which camera.
        camera: usize,
        /// The model.
        model: DistortionModel,
        /// Median distance of the corners from where the best start has them, in pixels.
        error_px: f64,
    },
    /// No view shows the target to this camera and to one that is connected with the first.
    #[error("camera {camera} shares no view with the cameras it should be joined to")]
    Unconnected {
        /// Which camera.
        camera: usize,
    },
    /// This model has no adjustment here: a pinhole or a model with fewer than four parameters.
    #[error("lenses of the model {} are not calibrated", model.info().name)]
    Lens {
        /// The model.
        model: DistortionModel,
    },
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}
