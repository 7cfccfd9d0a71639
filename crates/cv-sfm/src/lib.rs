//! Structure from motion of many views: cameras, poses and points from features that are matched by index.
//!
//! Takes keypoints and matches, never pictures: `cv-pipeline` joins features and this. The stages are calls of their own:
//! [`verify_view_pair`] says which matches of two views agree, [`Tracks::build`] joins them over the views, [`reconstruct_views`] solves for cameras and points,
//! [`align_model`] brings a model to known places.
//!
//! ```
//! use cv_core::{Camera, DMatch, Keypoint, Point3, Pose, Silent, Vector3};
//! use cv_sfm::{
//!     CameraKnowledge, PairMatches, SfmInput, SfmOptions, SfmView, ViewPairOptions, reconstruct_views, verify_view_pair,
//! };
//!
//! // A bent wall of 200 points, seen by four cameras side by side.
//! let camera = Camera::from_focal(640, 480, 500.0);
//! let wall: Vec<Point3<f64>> = (0..200)
//!     .map(|i| (f64::from(i % 20) - 9.5, f64::from(i / 20) - 4.5))
//!     .map(|(x, y)| Point3::new(0.2 * x, 0.3 * y, 5.0 + 0.05 * x * y))
//!     .collect();
//! let pose = |i: usize| Pose { translation: Vector3::new(-0.4 * i as f64, 0.0, 0.0), ..Pose::identity() };
//! let keypoint = |pose: &Pose, p: &Point3<f64>| {
//!     let pixel = camera.project(&pose.transform(p)).unwrap_or_default();
//!     Keypoint::new(pixel.x as f32, pixel.y as f32, 1.0)
//! };
//! let keypoints: Vec<Vec<Keypoint>> = (0..4).map(|i| wall.iter().map(|p| keypoint(&pose(i), p)).collect()).collect();
//! let matches: Vec<DMatch> = (0..200).map(|i| DMatch { query: i, train: i, distance: 0.1, ratio: 0.5 }).collect();
//!
//! let (mut pairs, mut geometry) = (Vec::new(), Vec::new());
//! for (a, b) in [(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)] {
//!     let known = (&camera, &CameraKnowledge::Known);
//!     let both = [&keypoints[a][..], &keypoints[b]];
//!     let pair = verify_view_pair([known; 2], both, &matches, &ViewPairOptions::default(), &Silent)?;
//!     pairs.push(PairMatches::new(a, b, pair.inliers.iter().map(|i| matches[*i]).collect()));
//!     geometry.push(pair.model);
//! }
//! let views: Vec<SfmView<'_>> = keypoints.iter().map(|k| SfmView { camera: 0, keypoints: k }).collect();
//! let knowledge = [CameraKnowledge::Known];
//! let input = SfmInput {
//!     views: &views, cameras: &[camera], knowledge: &knowledge, pairs: &pairs, geometry: &geometry, alike: None,
//! };
//! let found = reconstruct_views(&input, &SfmOptions::default(), &Silent)?;
//! assert_eq!((found.models[0].registered(), found.models[0].points.len()), (4, 200));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Conventions
//!
//! * Pixel centers at integers; a pose maps world to camera. The unit of the world is arbitrary, and so is its frame: [`align_model`] turns it upright and,
//!   by what is known of places, to meters.
//! * A track has one observation of a view at most. A model's points are those of tracks.
//! * The same input, options and seed give the same bytes at any number of threads.

mod align;
mod bundle;
mod complete;
mod covariance;
mod finish;
mod focal_length;
mod global;
mod global_positions;
mod incremental;
mod initial_pair;
mod known_poses;
mod model;
mod model_parts;
mod pair_scales;
mod reconstruct;
mod registration;
mod repeated_structure;
mod rotation_averaging;
mod scene;
mod tracks;
mod translation_direction;
mod triangulate_track;
mod view_graph;
mod view_pair;

pub use align::{CenterFit, KnownPlaces, ModelAlignError, ModelAlignment, align_model, align_to_poses};
pub use complete::FeatureDistance;
pub use covariance::{ModelCovariance, PoseCovariance, model_covariance};
pub use cv_numeric::adjust::AdjustError;
pub use model::{SfmModel, SfmPoint, ViewOutcome};
pub use reconstruct::{SfmError, SfmInput, SfmOptions, SfmOutcome, Solver, reconstruct_views, reconstruct_views_from};
pub use tracks::{Observation, PairMatches, Tracks};
pub use view_graph::{PairRefusal, RefusedPair};
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
    pub fn is_calibrated(&self) -> bool {
        matches!(self, Self::Known | Self::Matrix)
    }
}
