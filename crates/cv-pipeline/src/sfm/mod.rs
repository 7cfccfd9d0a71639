//! Structure from motion of many photographs.

mod cameras;
mod candidates;
mod dense;
mod fusion;
mod model;
mod pairs;
mod photo;
mod places;

pub use cameras::{OtherSize, PhotoProgress, SfmCameras};
pub use dense::{DensePhoto, SfmDense, SfmDenseError, SfmDenseOptions, sfm_dense};
pub use pairs::sfm_pairs;
pub use photo::{SfmPhoto, SfmPhotoError, sfm_photo};
pub use places::{GpsCenters, GpsFix, PlacedModel, gps_centers, place_model};

use crate::Progress;
use cv_core::{Camera, Cancelled, Distortion, OptionError, Pose, StageClock};
use cv_features::{FeatureOptions, RatioTest, SiftOptions};
use cv_geometry::EXIF_FOCAL_DEVIATION;
use cv_sfm::{
    AdjustError, CameraKnowledge, FeatureDistance, ModelCovariance, Observation, PairMatches, RefusedPair, SfmError,
    SfmInput, SfmModel, SfmView, Solver, ViewOutcome, ViewPairModel, ViewPairOptions, focal_deviations,
    model_covariance, reconstruct_views_from,
};

/// Settings of [`sfm`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct SfmJobOptions {
    /// Features. Default SIFT, at most 13,000 per photograph, with fainter ones where there are fewer than 3,000.
    pub features: FeatureOptions,
    /// Ratio test. Default that of the descriptor kind.
    pub ratio: RatioTest,
    /// Order of the photographs. Default [`PhotoOrder::Any`].
    pub order: PhotoOrder,
    /// Number of most similar photographs that each is matched with, in sets of more than twice as many. Default 20, at which the results
    /// on templeRing and kitti-2 equal those with all pairs.
    pub partners: usize,
    /// Number of features of largest scale that a pair is matched with first. Default 1,024.
    pub first_features: usize,
    /// A photograph with fewer firm pairs than this is matched again with its best others, with all features. Default 6.
    pub firm_partners: usize,
    /// Number of pairs of each photograph that guided matching is applied to, with all features. Default 3: more add pairs with wider
    /// baselines and less accurate positions (templeRing: 7,543 points at 0.325 px with 10, 7,916 at 0.314 with 3); track completion finds
    /// their observations later.
    pub guided_partners: usize,
    /// Pair verification.
    pub pairs: ViewPairOptions,
    /// Reconstruction.
    pub solve: cv_sfm::SfmOptions,
}

impl Default for SfmJobOptions {
    fn default() -> Self {
        Self {
            features: FeatureOptions::Sift(SiftOptions {
                max_features: 13_000,
                min_features: 3000,
                coarse_first: true,
                ..SiftOptions::default()
            }),
            ratio: RatioTest::Kind,
            order: PhotoOrder::Any,
            partners: 20,
            first_features: 1024,
            firm_partners: 6,
            guided_partners: 3,
            pairs: ViewPairOptions::default(),
            solve: cv_sfm::SfmOptions::default(),
        }
    }
}

/// Order of photographs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum PhotoOrder {
    /// Unordered.
    #[default]
    Any,
    /// A sequence by a moving camera: each photograph is matched with ten before and after it, and with the most similar others (loop
    /// closure).
    Sequence,
}

cv_core::named!(PhotoOrder {
    Any = "any": "in none: all pairs, or of large sets those that look most alike",
    Sequence = "sequence": "as they were taken by a camera that moved: neighbors, and where it may have come back",
});

/// A camera of some photographs.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SfmCamera {
    /// Image size, and intrinsics as far as they are known.
    pub camera: Camera,
    /// Prior knowledge of the intrinsics.
    pub knowledge: CameraKnowledge,
}

/// Initial focal length of an unknown camera, as a ratio of the longer image side (COLMAP's); used if the pairs do not determine it.
const DEFAULT_FOCAL_RATIO: f64 = 1.2;

impl SfmCamera {
    /// Creates a calibrated camera, with its distortion.
    pub fn known(camera: Camera) -> Self {
        Self { camera, knowledge: CameraKnowledge::Known }
    }

    /// Creates a camera with a known calibration matrix and unknown distortion.
    pub fn from_matrix(camera: Camera) -> Self {
        Self { camera: with_free_distortion(camera), knowledge: CameraKnowledge::Matrix }
    }

    /// Creates a camera with an image size and an approximate focal length in pixels, such as from EXIF.
    pub fn from_focal((width, height): (usize, usize), focal: f64) -> Self {
        let knowledge = CameraKnowledge::Focal { focal, deviation: EXIF_FOCAL_DEVIATION };
        Self { camera: with_free_distortion(Camera::from_focal(width, height, focal)), knowledge }
    }

    /// Creates a camera of which only the image size is known.
    pub fn unknown((width, height): (usize, usize)) -> Self {
        let camera = Camera::from_focal(width, height, DEFAULT_FOCAL_RATIO * width.max(height) as f64);
        Self { camera: with_free_distortion(camera), knowledge: CameraKnowledge::Unknown }
    }
}

/// Returns the camera with free radial distortion coefficients.
fn with_free_distortion(camera: Camera) -> Camera {
    Camera { distortion: Distortion::radial(0.0, 0.0), ..camera }
}

/// Result of [`sfm`].
#[derive(Debug, Clone, PartialEq)]
pub struct SfmResult {
    /// The models, the one with most photographs first.
    pub models: Vec<SfmModel>,
    /// How the poses of each model were estimated.
    pub solvers: Vec<Solver>,
    /// Outcome of each photograph.
    pub outcomes: Vec<ViewOutcome>,
    /// The verified pairs, with their inlier matches.
    pub pairs: Vec<PairMatches>,
    /// The verified pairs that were rejected, with the reason.
    pub refused: Vec<RefusedPair>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Why a reconstruction failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum SfmJobError {
    /// A photograph does not have the size of its camera.
    #[error("photograph {index} has {photo:?} pixels but its camera has {camera:?}")]
    CameraSize {
        /// Index of the photograph.
        index: usize,
        /// Its width and height.
        photo: (usize, usize),
        /// Width and height of the camera.
        camera: (usize, usize),
    },
    /// A photograph refers to a missing camera.
    #[error("photograph {index} refers to camera {camera}, but there are {cameras}")]
    NoCamera {
        /// Index of the photograph.
        index: usize,
        /// Index of the camera.
        camera: usize,
        /// Number of cameras.
        cameras: usize,
    },
    /// No pair was verified.
    #[error("no two of {photos} photographs have enough overlap")]
    NoPairs {
        /// Number of photographs.
        photos: usize,
    },
    /// Reconstruction from the pairs failed.
    #[error(transparent)]
    Solve(SfmError),
    /// A parameter of the model is undetermined, or the model is of other photographs.
    #[error("no covariances: {0}")]
    Covariance(AdjustError),
    /// An option is outside its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

impl From<SfmError> for SfmJobError {
    fn from(error: SfmError) -> Self {
        match error {
            SfmError::Cancelled(stop) => Self::Cancelled(stop),
            other => Self::Solve(other),
        }
    }
}

/// Distances between the descriptors of photographs.
struct DescriptorDistance<'p>(&'p [SfmPhoto]);

/// Largest descriptor distance in track completion, as a ratio of the largest distance of a match: near a projection there are hardly any
/// chance matches. On fountain-P11, three of four matches over a viewpoint change of 50 degrees are below.
const MAX_COMPLETION_DISTANCE: f32 = 0.5;

impl FeatureDistance for DescriptorDistance<'_> {
    fn distance(&self, a: Observation, b: Observation) -> f32 {
        let [one, two] = [a, b].map(|o| &self.0[o.view as usize].descriptors);
        one.ssd(a.keypoint as usize, two, b.keypoint as usize) / (MAX_COMPLETION_DISTANCE * one.kind().max_ssd)
    }
}

/// Reconstructs cameras and points from the features of photographs ([`sfm_photo`]): pair verification ([`sfm_pairs`]), then [`sfm_solve`].
///
/// # Errors
/// [`SfmJobError`].
pub fn sfm(
    photos: &[SfmPhoto],
    cameras: &[SfmCamera],
    options: &SfmJobOptions,
    progress: &dyn Progress,
) -> Result<SfmResult, SfmJobError> {
    check_cameras(photos, cameras)?;
    let mut clock = StageClock::new();
    let (pairs, geometry) = sfm_pairs(photos, cameras, options, progress)?;
    clock.lap("match");
    let mut result = sfm_solve(photos, cameras, (pairs, &geometry), &[], options, progress)?;
    let mut stages = clock.into_stages();
    stages.append(&mut result.stages);
    Ok(SfmResult { stages, ..result })
}

/// Checks that every photograph has a camera of its size.
fn check_cameras(photos: &[SfmPhoto], cameras: &[SfmCamera]) -> Result<(), SfmJobError> {
    for (index, photo) in photos.iter().enumerate() {
        let Some(SfmCamera { camera, .. }) = cameras.get(photo.camera) else {
            return Err(SfmJobError::NoCamera { index, camera: photo.camera, cameras: cameras.len() });
        };
        if photo.size != (camera.width, camera.height) {
            return Err(SfmJobError::CameraSize { index, photo: photo.size, camera: (camera.width, camera.height) });
        }
    }
    Ok(())
}

/// Computes the covariances of the cameras and points of a model of [`sfm`], in the model's frame and unit ([`model_covariance`]).
///
/// # Errors
/// [`SfmJobError::Covariance`].
pub fn sfm_covariance(
    photos: &[SfmPhoto],
    cameras: &[SfmCamera],
    model: &SfmModel,
) -> Result<ModelCovariance, SfmJobError> {
    check_cameras(photos, cameras)?;
    let knowledge: Vec<CameraKnowledge> = cameras.iter().map(|c| c.knowledge).collect();
    model_covariance(&views(photos), &knowledge, model).map_err(SfmJobError::Covariance)
}

/// Computes the standard deviations in pixels of the focal lengths of a model of [`sfm`] that were estimated, by camera ([`focal_deviations`]).
///
/// # Errors
/// [`SfmJobError::Covariance`].
pub fn sfm_focal_deviations(
    photos: &[SfmPhoto],
    cameras: &[SfmCamera],
    model: &SfmModel,
) -> Result<Vec<Option<f64>>, SfmJobError> {
    check_cameras(photos, cameras)?;
    let knowledge: Vec<CameraKnowledge> = cameras.iter().map(|c| c.knowledge).collect();
    focal_deviations(&views(photos), &knowledge, model).map_err(SfmJobError::Covariance)
}

fn views(photos: &[SfmPhoto]) -> Vec<SfmView<'_>> {
    photos.iter().map(|p| SfmView { camera: p.camera, keypoints: &p.keypoints }).collect()
}

/// The second half of [`sfm`]: cameras and points ([`reconstruct_views_from`]) from the verified pairs of [`sfm_pairs`] and their geometry.
/// `known`: poses of photographs in an earlier model, which the first model extends; empty without.
///
/// # Errors
/// [`SfmJobError`].
pub fn sfm_solve(
    photos: &[SfmPhoto],
    cameras: &[SfmCamera],
    (pairs, geometry): (Vec<PairMatches>, &[ViewPairModel]),
    known: &[Option<Pose>],
    options: &SfmJobOptions,
    progress: &dyn Progress,
) -> Result<SfmResult, SfmJobError> {
    check_cameras(photos, cameras)?;
    if pairs.is_empty() {
        return Err(SfmJobError::NoPairs { photos: photos.len() });
    }
    let mut clock = StageClock::new();
    let views = views(photos);
    let (lenses, knowledge): (Vec<Camera>, Vec<CameraKnowledge>) =
        cameras.iter().map(|c| (c.camera, c.knowledge)).unzip();
    let distance = DescriptorDistance(photos);
    let input = SfmInput {
        views: &views,
        cameras: &lenses,
        knowledge: &knowledge,
        pairs: &pairs,
        geometry,
        feature_distance: Some(&distance),
    };
    let outcome = reconstruct_views_from(&input, known, &options.solve, progress)?;
    clock.lap("solve");
    let cv_sfm::SfmOutcome { models, solvers, views, refused } = outcome;
    Ok(SfmResult { models, solvers, outcomes: views, pairs, refused, stages: clock.into_stages() })
}
