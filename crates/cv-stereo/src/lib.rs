//! Stereo: from a rectified pair of images to disparity and depth.
//!
//! See [`StereoMatcher`] for an example.
//!
//! # Conventions
//!
//! Disparity is `x_left − x_right` in pixels, `f32`, NaN where there is none.

mod aligned;
mod census;
mod confidence;
mod depth;
mod error;
mod evaluate;
mod fill;
mod input;
mod kernel;
mod matcher;
mod median;
mod options;
#[cfg(test)]
mod plain;
mod rectify;
mod sgm;
mod speckle;
mod winner;

pub use depth::{CloudPoint, GeometryError, StereoGeometry};
pub use error::StereoError;
pub use evaluate::{BAD_THRESHOLDS, DisparityScores, EvaluateError, evaluate_disparity, non_occluded};
pub use input::Intensity;
pub use matcher::{DisparityMap, PixelState, StereoMatcher};
pub use options::{Census, Paths, StereoOptions, Subpixel};
pub use rectify::{Rectification, RectifiedView, RectifyError, RectifyOptions};
