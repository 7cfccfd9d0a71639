//! The types that every other crate of the workspace shares: images, cameras,
//! poses, keypoints, matches and point clouds. Also small utilities: stage timing, progress and cancellation, the error
//! for an option out of range, luma, quantiles, union-find. No input or output, no codecs, no thread pool.
//!
//! ```
//! use cv_core::{Image, Point2};
//!
//! let mut gray = Image::<f32, 1>::new(4, 3, [0.0]);
//! gray.set(2, 1, [1.0]);
//! assert_eq!(gray.at(2, 1), [1.0]);
//! assert_eq!(gray.view().crop(1, 1, 2, 2).map(|v| v.at(1, 0)), Some([1.0]));
//!
//! let camera = cv_core::Camera::pinhole(640, 480, 500.0, 500.0, 319.5, 239.5);
//! let ray = camera.normalize(Point2::new(319.5, 239.5));
//! assert!(ray.x.abs() < 1e-12 && ray.y.abs() < 1e-12);
//! ```
//!
//! # Conventions
//!
//! * Pixel centers lie at integer coordinates; x points right, y points down; the
//!   origin is the center of the top-left pixel. An image of width `w` covers
//!   `[-0.5, w - 0.5]` in x.
//! * A camera frame has X right, Y down, Z forward. A [`Pose`] maps world to camera:
//!   `x_cam = R x_world + t`.
//! * Images are row-major with interleaved channels. Color is RGB.
//! * Disparity is `x_left − x_right` in pixels. Invalid disparity and depth are NaN.
//! * Angles are radians.

mod camera;
mod distortion;
mod features;
mod geodetic;
mod image;
mod joined_ranges;
mod luma;
mod named;
mod option_error;
mod point_cloud;
mod pose;
mod progress;
mod quantile;
mod rig;
mod round_to_four_digits;
mod scaling;
mod size;
mod sparse_model;
mod stage_clock;
mod union_find;
mod upright_frame;
mod view;

pub use camera::{Camera, CameraError, MAX_INTRINSICS, ProjectedPoint};
pub use distortion::{
    ColmapModel, Distortion, DistortionModel, LensInfo, LensProjection, MAX_PARAMETERS, ParameterCountError,
    ParameterJacobian,
};
pub use features::{Correspondence, DMatch, Keypoint};
pub use geodetic::{GeodeticPoint, east_north_up};
pub use image::{GrayF32, GrayU8, Image, ImageError, Mask, RgbF32, RgbU8, Sample};
pub use joined_ranges::joined_ranges;
pub use luma::{luma_f32, luma_u8, luma_u16};
pub use named::{Named, UnknownName};
pub use option_error::OptionError;
pub use point_cloud::PointCloud;
pub use pose::Pose;
pub use progress::{Cancelled, Progress, Silent, Stage};
pub use quantile::{TotalOrder, median, quantile};
pub use rig::StereoRig;
pub use round_to_four_digits::round_to_four_digits;
pub use scaling::Scaling;
pub use sparse_model::{ModelImage, ModelPoint, SparseModel};
pub use stage_clock::StageClock;
pub use union_find::UnionFind;
pub use upright_frame::upright_frame;
pub use view::{ImageView, ImageViewMut};

pub use nalgebra;
pub use nalgebra::{Matrix3, Matrix3x4, Point2, Point3, Rotation3, Vector2, Vector3};
