//! Structure from motion of many views: cameras, poses and points from features that are matched by index.
//!
//! Takes keypoints and matches, never pictures: `cv-pipeline` joins features and this. The stages are calls of their own:
//! [`verify_view_pair`] says which matches of two views agree, [`Tracks::build`] joins them over the views, [`reconstruct_views`] solves for cameras and points.
//!
//! # Conventions
//!
//! * Pixel centers at integers; a pose maps world to camera. The unit of the world is arbitrary.
//! * A track has one observation of a view at most. A model's points are those of tracks.
//! * The same input, options and seed give the same bytes at any number of threads.

mod bundle;
mod complete;
mod focal_length;
mod incremental;
mod initial_pair;
mod model;
mod registration;
mod scene;
mod tracks;
mod triangulate_track;
mod view_pair;

pub use complete::FeatureDistance;
pub use incremental::{SfmError, SfmInput, SfmOptions, SfmOutcome, reconstruct_views};
pub use model::{SfmModel, SfmPoint, ViewOutcome};
pub use tracks::{Observation, PairMatches, Tracks};
pub use view_pair::{ViewPair, ViewPairError, ViewPairModel, ViewPairOptions, verify_view_pair};

use cv_core::Keypoint;

/// A photograph as this crate sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SfmView<'a> {
    /// Index of its camera.
    pub camera: usize,
    /// Its keypoints, in pixels as they were taken.
    pub keypoints: &'a [Keypoint],
}

/// What is known of a camera beforehand.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum CameraKnowledge {
    /// It is calibrated, and stays as it is.
    Known,
    /// Its calibration matrix is known, but nothing is said of its distortion: it stays as it is unless the matches fit much better with a distortion.
    Matrix,
    /// About what focal length it has, such as from EXIF; its distortion is unknown.
    Focal {
        /// Focal length in pixels.
        focal: f64,
        /// Relative standard deviation.
        deviation: f64,
    },
    /// Nothing.
    Unknown,
}

impl CameraKnowledge {
    /// Whether rays can be told from pixels, but for a lens that a matrix leaves out.
    fn is_calibrated(&self) -> bool {
        matches!(self, Self::Known | Self::Matrix)
    }
}
