//! Image processing: color conversion, filtering, sampling, warping, pyramids, morphology and components.
//!
//! ```
//! use cv_core::{Matrix3, RgbU8};
//! use cv_imgproc::{RemapOptions, gaussian_blur, gray_to_f32, rgb_to_gray, sobel, warp_perspective};
//!
//! let photo = RgbU8::from_fn(64, 48, |x, y| [4 * x as u8, 5 * y as u8, 128]);
//! let gray = gray_to_f32(rgb_to_gray(photo.view()).view());
//! let smooth = gaussian_blur(gray.view(), 1.5);
//! let (dx, dy) = sobel(smooth.view());
//! assert!(dx.at(32, 24)[0] > 0.0 && dy.at(32, 24)[0] > 0.0);
//!
//! // The homography maps source pixels to result pixels; the mask is true where a result pixel maps inside the source.
//! let shift = Matrix3::new(1.0, 0.0, 10.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0);
//! let (moved, mask) = warp_perspective(photo.view(), &shift, (64, 48), &RemapOptions::default())?;
//! assert_eq!(moved.at(10, 0), photo.at(0, 0));
//! assert!(!mask.at(9, 0)[0]);
//! # Ok::<(), cv_imgproc::WarpError>(())
//! ```
//!
//! # Conventions
//!
//! * Functions take views and return owned images. `f32` images are 0 to 1.
//! * The border mode of filters is reflect-101 (`dcb|abcd|cba`), as OpenCV's default; that of medians is replicate.
//! * Empty images give empty results. Unless stated otherwise, a NaN pixel affects only results whose window contains it.
//! * Rows are processed in parallel; results do not depend on the number of threads or the instruction set.

mod byte_windows;
mod color;
mod connected_components;
mod gaussian;
mod grid_cut;
mod integral_image;
mod median;
mod mirror;
mod morphology;
mod pixel;
mod pyramid;
mod remap_vertical;
mod resize;
mod rows;
mod sample;
mod sample_lanes;
mod simd;
mod warp;
mod warp_map;

pub use color::{
    decode_srgb, f32_to_u8, gray_to_f32, gray_to_rgb, hsv_to_rgb, linear_rgb_to_lab, linear_to_srgb, rgb_pixel_to_hsv,
    rgb_pixel_to_lab, rgb_to_f32, rgb_to_gray, rgb_to_gray_f32, rgb_to_hsv, rgb_to_lab, srgb_to_linear, u8_to_f32,
};
pub use connected_components::{
    ComponentStats, Components, Connectivity, connected_components, fill_holes, largest_component,
    remove_small_components,
};
pub use gaussian::{gaussian_blur, gaussian_half_kernel, separable_symmetric, sobel};
pub use grid_cut::{GridCut, grid_neighbors};
pub use integral_image::{IntegralImage, box_filter};
pub use median::{median_filter_3x3, median_filter_5x5};
pub use mirror::{mirror_ends, mirror_index};
pub use morphology::{StructuringElement, close, dilate, erode, open};
pub use pixel::Pixel;
pub use pyramid::{gaussian_pyramid, pyr_down, pyr_up};
pub use remap_vertical::remap_vertical;
pub use resize::{resize, resize_area};
pub use sample::{bicubic_at, bilinear_at, integer_and_fraction, sample_bicubic, sample_bilinear};
pub use sample_lanes::{SAMPLE_LANES, bicubic_lanes, bicubic_rgb_lanes, bilinear_lanes};
pub use warp::{Border, Interpolation, RemapOptions, WarpError, remap, undistort, warp_perspective, warp_with};
pub use warp_map::WarpMap;
