//! Local features (Harris, multi-scale Harris, SIFT), non-maximal suppression, descriptors, matching, and calibration
//! targets.
//!
//! From two gray images to tentative matches:
//!
//! ```
//! use cv_core::{GrayF32, Silent};
//! use cv_features::{anms, describe_patches, harris, match_descriptors, HarrisOptions, MatchOptions, PatchOptions};
//!
//! // A pattern of random gray squares, and the same pattern shifted by (3, 2) pixels.
//! let pattern = |dx: usize, dy: usize| {
//!     GrayF32::from_fn(160, 120, |x, y| {
//!         let cell = ((x + dx) / 9 * 31 + (y + dy) / 7 * 17) % 11;
//!         [(cell * cell % 11) as f32 / 10.0]
//!     })
//! };
//! let (a, b) = (pattern(0, 0), pattern(3, 2));
//! let mut described = Vec::new();
//! for image in [&a, &b] {
//!     let corners = harris(image.view(), &HarrisOptions::default(), &Silent)?;
//!     let spaced: Vec<_> = anms(&corners, 100, 0.9).into_iter().map(|i| corners[i]).collect();
//!     described.push(describe_patches(image.view(), &spaced, &PatchOptions::default())?);
//! }
//! let options = MatchOptions { mutual: true, ..MatchOptions::default() };
//! for m in match_descriptors(&described[0].descriptors, &described[1].descriptors, &options, &Silent)? {
//!     let (p, q) = (described[0].keypoints[m.query as usize], described[1].keypoints[m.train as usize]);
//!     println!("{} -> {}, SSD {}", p.position, q.position, m.distance);
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Conventions
//!
//! * Images have one channel of `f32`, by convention 0 to 1. A pixel that is not finite is an error; results have no
//!   NaN.
//! * Positions are sub-pixel with pixel centers at integers. Angles are radians, clockwise on screen from +x.
//! * Every detector and descriptor also returns the dropped keypoints, with the reason.
//! * Results do not depend on the number of threads.

mod anms;
mod asift;
mod byte_descriptors;
mod byte_neighbors;
mod descriptors;
mod dog;
mod error;
mod extractor;
mod gradient_histogram;
mod guided;
mod harris;
mod harris_features;
mod kind;
mod line_buffer;
mod matching;
mod mops;
mod nearest_neighbors;
mod patch;
mod pyramid;
mod scale_recipes;
mod scale_space;
mod sift;
mod simd;
mod square_covering;
mod structure_tensor;
mod targets;
mod vlad;

pub use anms::{anms, suppression_radii};
pub use asift::sift_affine_view;
pub use byte_descriptors::{ByteDescriptors, largest_keypoints, match_byte_descriptors};
pub use descriptors::{Descriptors, DropReason, Dropped, Features};
pub use error::FeatureError;
pub use extractor::{FeatureExtractor, FeatureMethod, FeatureOptions};
pub use guided::{GuidedOptions, TwoViewModel, match_guided, match_guided_bytes};
pub use harris::{CornerMeasure, HarrisOptions, harris, harris_response};
pub use harris_features::{HarrisFeatures, Suppression};
pub use kind::{ByteScale, DescriptorKind};
pub use matching::{MatchError, MatchOptions, RatioMeasure, RatioTest, match_descriptors};
pub use mops::{MopsOptions, MultiScaleOptions, describe_oriented_patches, harris_laplace, mops};
pub use patch::{PatchOptions, describe_patches};
pub use sift::{SiftOptions, sift};
pub use square_covering::{anms_square_covering, anms_tiled};
pub use targets::{
    BlackRectangle, Board, BoardError, BoardKind, BoardPoint, BoardSize, CharucoBoard, Chessboard, ChessboardOptions,
    Dictionary, GridStyle, MarkerGrid, find_board, find_charuco, find_chessboard, find_marker_grid,
};
pub use vlad::{Vocabulary, most_similar};
