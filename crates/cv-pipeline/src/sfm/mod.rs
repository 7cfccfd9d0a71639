//! Cameras and points from many photographs.

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
    SfmInput, SfmModel, SfmView, Solver, ViewOutcome, ViewPairModel, ViewPairOptions, model_covariance,
    reconstruct_views_from,
};

/// Settings of [`sfm`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct SfmJobOptions {
    /// Features. Default SIFT, 13,000 in a photograph at most; where there are fewer than 3,000, fainter ones as well.
    pub features: FeatureOptions,
    /// Which matches stay by how ambiguous they are. Default as of the kind of the descriptors.
    pub ratio: RatioTest,
    /// In what order the photographs come. Default [`PhotoOrder::Any`].
    pub order: PhotoOrder,
    /// Photographs that each is tried with in sets of more than twice as many: those that look most like it. Default 20 (with it, templeRing and kitti-2 come out as with all pairs).
    pub partners: usize,
    /// Features of the largest scale that a pair is tried with first. Default 1,024.
    pub first_features: usize,
    /// A photograph that has fewer pairs than this in which most matches agree is tried with its best others once more, with all features. Default 6.
    pub firm_partners: usize,
    /// Pairs of each photograph that are matched with all features along their geometry. Default 3: with more, those of wider angles come in, whose positions are less exact (templeRing:
    /// 7,916 points at 0.314 px in place of 7,543 at 0.325 with 10); what they miss is found once there is a model.
    pub guided_partners: usize,
    /// Which pairs of photographs hold.
    pub pairs: ViewPairOptions,
    /// The solution.
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

/// In what order photographs come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum PhotoOrder {
    /// In none.
    #[default]
    Any,
    /// As they were taken by a camera that moved: each is tried with ten before and after it, and with those that look most like it where the camera may have come back.
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
    /// Size, and parameters as far as they are known.
    pub camera: Camera,
    /// What is known of it.
    pub knowledge: CameraKnowledge,
}

/// Focal length over the longer side of a photograph of which nothing is known: COLMAP's, where the pairs do not tell better.
const USUAL_FOCAL: f64 = 1.2;

impl SfmCamera {
    /// A calibrated camera, with its lens.
    pub fn known(camera: Camera) -> Self {
        Self { camera, knowledge: CameraKnowledge::Known }
    }

    /// A camera of which the calibration matrix is known and the lens is not.
    pub fn of_matrix(camera: Camera) -> Self {
        Self { camera: open_lens(camera), knowledge: CameraKnowledge::Matrix }
    }

    /// The camera of photographs of that size and about that focal length in pixels, as EXIF tells it.
    pub fn of_focal((width, height): (usize, usize), focal: f64) -> Self {
        let knowledge = CameraKnowledge::Focal { focal, deviation: EXIF_FOCAL_DEVIATION };
        Self { camera: open_lens(Camera::from_focal(width, height, focal)), knowledge }
    }

    /// The camera of photographs of that size of which nothing is known.
    pub fn unknown((width, height): (usize, usize)) -> Self {
        let camera = Camera::from_focal(width, height, USUAL_FOCAL * width.max(height) as f64);
        Self { camera: open_lens(camera), knowledge: CameraKnowledge::Unknown }
    }
}

/// The same with radial distortion, to be found.
fn open_lens(camera: Camera) -> Camera {
    Camera { distortion: Distortion::radial(0.0, 0.0), ..camera }
}

/// What [`sfm`] found.
#[derive(Debug, Clone, PartialEq)]
pub struct SfmResult {
    /// The models, the one with most photographs first.
    pub models: Vec<SfmModel>,
    /// How each of them was found.
    pub solvers: Vec<Solver>,
    /// What became of each photograph.
    pub outcomes: Vec<ViewOutcome>,
    /// The pairs of photographs that hold, and their matches.
    pub pairs: Vec<PairMatches>,
    /// Those of them that were not used all the same, and why.
    pub refused: Vec<RefusedPair>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Why many photographs could not be reconstructed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum SfmJobError {
    /// A photograph has another size than its camera.
    #[error("photograph {index} has {photo:?} pixels where its camera has {camera:?}")]
    CameraSize {
        /// Index of the photograph.
        index: usize,
        /// Its width and height.
        photo: (usize, usize),
        /// The camera's.
        camera: (usize, usize),
    },
    /// A photograph names a camera that there is not.
    #[error("photograph {index} names camera {camera} of {cameras}")]
    NoCamera {
        /// Index of the photograph.
        index: usize,
        /// Index of the camera.
        camera: usize,
        /// Number of cameras.
        cameras: usize,
    },
    /// No two photographs show the same.
    #[error("of {photos} photographs no two show enough of the same")]
    NoPairs {
        /// Number of photographs.
        photos: usize,
    },
    /// The pairs give no model.
    #[error(transparent)]
    Solve(SfmError),
    /// Something of a model is not determined, or it is of other photographs.
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
struct Alike<'p>(&'p [SfmPhoto]);

/// Largest distance of two features that are one point, as a share of the largest of a match anywhere: where a point must be, hardly any feature is there by chance, and of
/// photographs of fountain-P11 from 50 degrees apart three matches in four are nearer.
const ALIKE: f32 = 0.5;

impl FeatureDistance for Alike<'_> {
    fn distance(&self, a: Observation, b: Observation) -> f32 {
        let [one, two] = [a, b].map(|o| &self.0[o.view as usize].descriptors);
        one.ssd(a.keypoint as usize, two, b.keypoint as usize) / (ALIKE * one.kind().max_ssd)
    }
}

/// Reconstructs cameras and points from the features of many photographs ([`sfm_photo`]): pairs that hold ([`sfm_pairs`]), then [`sfm_solve`].
///
/// # Errors
/// [`SfmJobError`].
pub fn sfm(
    photos: &[SfmPhoto],
    cameras: &[SfmCamera],
    options: &SfmJobOptions,
    progress: &dyn Progress,
) -> Result<SfmResult, SfmJobError> {
    check(photos, cameras)?;
    let mut clock = StageClock::new();
    let (pairs, geometry) = sfm_pairs(photos, cameras, options, progress)?;
    clock.lap("match");
    let mut result = sfm_solve(photos, cameras, (pairs, &geometry), &[], options, progress)?;
    let mut stages = clock.into_stages();
    stages.append(&mut result.stages);
    Ok(SfmResult { stages, ..result })
}

/// Every photograph has a camera of its size.
fn check(photos: &[SfmPhoto], cameras: &[SfmCamera]) -> Result<(), SfmJobError> {
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

/// How well the cameras and points of a model are known that [`sfm`] found of these photographs, in the model's frame and unit ([`model_covariance`]).
///
/// # Errors
/// [`SfmJobError::Covariance`].
pub fn sfm_covariance(
    photos: &[SfmPhoto],
    cameras: &[SfmCamera],
    model: &SfmModel,
) -> Result<ModelCovariance, SfmJobError> {
    check(photos, cameras)?;
    let knowledge: Vec<CameraKnowledge> = cameras.iter().map(|c| c.knowledge).collect();
    model_covariance(&views(photos), &knowledge, model).map_err(SfmJobError::Covariance)
}

fn views(photos: &[SfmPhoto]) -> Vec<SfmView<'_>> {
    photos.iter().map(|p| SfmView { camera: p.camera, keypoints: &p.keypoints }).collect()
}

/// The second half of [`sfm`]: cameras and points ([`reconstruct_views_from`]) from pairs that [`sfm_pairs`] found, and their geometry. `known`: poses of photographs by an earlier model, which
/// the first one goes on from; empty where there is none.
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
    check(photos, cameras)?;
    if pairs.is_empty() {
        return Err(SfmJobError::NoPairs { photos: photos.len() });
    }
    let mut clock = StageClock::new();
    let views = views(photos);
    let (lenses, knowledge): (Vec<Camera>, Vec<CameraKnowledge>) =
        cameras.iter().map(|c| (c.camera, c.knowledge)).unzip();
    let alike = Alike(photos);
    let input = SfmInput {
        views: &views,
        cameras: &lenses,
        knowledge: &knowledge,
        pairs: &pairs,
        geometry,
        feature_distance: Some(&alike),
    };
    let found = reconstruct_views_from(&input, known, &options.solve, progress)?;
    clock.lap("solve");
    let cv_sfm::SfmOutcome { models, solvers, views, refused } = found;
    Ok(SfmResult { models, solvers, outcomes: views, pairs, refused, stages: clock.into_stages() })
}
