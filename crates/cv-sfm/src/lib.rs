//! Structure from motion of many views: cameras, poses and points from features that are matched by index.
//!
//! The input is keypoints and matches, never images: `cv-pipeline` joins feature detection and this crate. The stages
//! can be called separately: [`verify_view_pair`] finds the matches that are consistent with a two-view geometry,
//! [`Tracks::build`] merges them into tracks, [`reconstruct_views`] solves for cameras and points, [`align_model`]
//! aligns a model to external measurements.
//!
//! ```
//! use cv_core::{Camera, DMatch, Keypoint, Point3, Pose, Silent, Vector3};
//! use cv_sfm::{
//!     CameraKnowledge, PairMatches, SfmInput, SfmOptions, SfmView, ViewPairOptions, reconstruct_views, verify_view_pair,
//! };
//!
//! // A curved wall of 200 points, observed by four cameras in a row.
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
//!     views: &views, cameras: &[camera], knowledge: &knowledge, pairs: &pairs, geometry: &geometry, feature_distance: None,
//! };
//! let outcome = reconstruct_views(&input, &SfmOptions::default(), &Silent)?;
//! assert_eq!((outcome.models[0].registered(), outcome.models[0].points.len()), (4, 200));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Conventions
//!
//! * Pixel centers are at integers; a pose maps world to camera. The world frame and its unit are arbitrary:
//!   [`align_model`] makes it upright and, with measured positions or distances, metric.
//! * A track has at most one observation of a view. The points of a model are those of tracks.
//! * The same input, options and seed give the same bytes with any number of threads.

mod align;
mod bundle;
mod complete;
mod covariance;
mod focal_length;
mod global;
mod global_positions;
mod incremental;
mod initial_pair;
mod known_poses;
mod model;
mod model_parts;
mod options;
mod pair_scales;
mod reconstruct;
mod refine_model;
mod registration;
mod repeated_structure;
mod rotation_averaging;
mod rotation_only;
mod scene;
mod tracks;
mod translation_direction;
mod tree_paths;
mod triangulate_track;
mod view_graph;
mod view_pair;

pub use align::{CenterFit, KnownPlaces, ModelAlignError, ModelAlignment, align_model, align_to_poses};
pub use complete::FeatureDistance;
pub use covariance::{ModelCovariance, PoseCovariance, focal_deviations, model_covariance};
pub use cv_numeric::adjust::AdjustError;
pub use model::{SfmModel, SfmPoint, ViewOutcome};
pub use options::{SfmOptions, Solver};
pub use reconstruct::{SfmError, SfmInput, SfmOutcome, reconstruct_views, reconstruct_views_from};
pub use tracks::{Observation, PairMatches, Tracks};
pub use view_graph::{PairRefusal, RefusedPair};
pub use view_pair::{ViewPair, ViewPairError, ViewPairModel, ViewPairOptions, verify_view_pair};

use cv_core::Keypoint;

/// A view: an image by its keypoints.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SfmView<'a> {
    /// Index of its camera.
    pub camera: usize,
    /// Its keypoints, in distorted pixels.
    pub keypoints: &'a [Keypoint],
}

/// Prior knowledge of a camera's intrinsics.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum CameraKnowledge {
    /// Calibrated: the intrinsics stay constant.
    Known,
    /// The calibration matrix is known, the distortion is not: a distortion is estimated only where it lowers the
    /// residuals much.
    Matrix,
    /// An approximate focal length, such as from EXIF; the distortion is unknown.
    Focal {
        /// Focal length in pixels.
        focal: f64,
        /// Relative standard deviation of the focal length.
        deviation: f64,
    },
    /// Nothing is known.
    Unknown,
}

impl CameraKnowledge {
    /// Returns whether the calibration matrix is known, so that pixels can be normalized (without an unknown
    /// distortion).
    pub fn is_calibrated(&self) -> bool {
        matches!(self, Self::Known | Self::Matrix)
    }
}
