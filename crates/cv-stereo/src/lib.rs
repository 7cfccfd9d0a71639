//! Stereo: from a rectified pair of images to disparity and depth.
//!
//! ```
//! use cv_core::{GrayU8, Silent};
//! use cv_stereo::{StereoMatcher, StereoOptions};
//!
//! // A wall of random bricks with a disparity of five pixels.
//! let wall = |shift: usize| {
//!     GrayU8::from_fn(96, 64, |x, y| [(((x + shift) / 3 * 7919 + y / 4 * 104_729) * 2_654_435 >> 9) as u8])
//! };
//! let mut matcher = StereoMatcher::new(StereoOptions { disparities: 16, ..StereoOptions::default() })?;
//! let map = matcher.compute(wall(0).view(), wall(5).view(), &Silent)?;
//! assert!((map.disparity.at(60, 30)[0] - 5.0).abs() < 0.5);
//! # Ok::<(), cv_stereo::StereoError>(())
//! ```
//!
//! # Conventions
//!
//! Disparity is `x_left − x_right` in pixels, `f32`, NaN where unknown.

mod aligned_buffer;
mod border_mask;
mod buffer_pool;
mod census;
mod coarse_match;
mod coarse_prior;
mod confidence;
mod cost;
mod denoise;
mod depth;
mod disparity_map;
mod disparity_matcher;
mod edge_preserving;
mod error;
mod evaluate;
mod expansion_region;
mod fill_cost;
mod fill_uncertainty;
mod input;
mod kernel;
mod layout;
mod local_expansion;
mod local_planes;
mod matcher;
mod matcher_memory;
mod median;
mod moments;
mod options;
mod path_sums;
mod plane_cost;
mod plane_proposals;
mod rectify;
mod rectify_scene;
#[cfg(test)]
mod reference;
mod search_window;
mod select;
mod sequence;
mod sgm;
mod speckle;
mod surface_filling;
mod surfaces;
mod vertical_matches;
mod vertical_offset;
mod window_sweep;
mod winner;
mod winner_checks;

pub use coarse_match::CoarseRange;
pub use depth::{GeometryError, StereoGeometry};
pub use disparity_map::{DisparityMap, PixelState};
pub use disparity_matcher::DisparityMatcher;
pub use error::StereoError;
pub use evaluate::{BAD_THRESHOLDS, DisparityScores, EvaluateError, evaluate_disparity, non_occluded};
pub use input::Intensity;
pub use matcher::StereoMatcher;
pub use options::{Census, IntensityCost, Paths, Search, Smoothing, StereoOptions, Subpixel};
#[doc(hidden)]
pub use path_sums::PathSums;
pub use rectify::{Rectification, RectifiedView, RectifyError, RectifyOptions};
pub use rectify_scene::SceneRectification;
pub use vertical_offset::VerticalOffset;
