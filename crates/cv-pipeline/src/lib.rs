//! One call per job, in memory: images and options in, result and timings out.
//!
//! This crate joins the stages of the crates below it (`cv-features`, `cv-geometry`, `cv-stereo`, `cv-segment`,
//! `cv-panorama`, `cv-calib`, `cv-sfm`) into the jobs of the toolkit. It reads and writes no files: `cv-cli` and other
//! programs do.
//!
//! ```
//! use cv_core::StageClock;
//! use cv_pipeline::{Cancelled, Progress, Silent};
//!
//! fn job(progress: &dyn Progress) -> Result<Vec<(&'static str, f64)>, Cancelled> {
//!     let mut clock = StageClock::new();
//!     for row in 0..10 {
//!         progress.report("detect", row + 1, 10)?;
//!     }
//!     clock.lap("detect");
//!     Ok(clock.into_stages())
//! }
//! assert_eq!(job(&Silent)?[0].0, "detect");
//! # Ok::<(), Cancelled>(())
//! ```
//!
//! # Conventions
//!
//! * One file per job, with `XOptions` (with `Default`), `XResult` and one function.
//! * Every result has `stages: Vec<(&'static str, f64)>`, stage names and their seconds from a
//!   [`StageClock`](cv_core::StageClock).
//! * Every job takes `&dyn Progress`; pass [`&Silent`](Silent) without a listener. When the callback returns stop, the
//!   job returns the variant `Cancelled` of its error.
//! * The same input, options and seed give the same result with any number of threads.

mod advice;
mod asift;
mod axes;
mod calibrate;
mod depth;
mod disparity_range;
mod estimate;
mod frame_depth;
mod guided;
mod matching;
mod no_pair;
mod pair_depth;
mod panorama;
mod reconstruct;
mod rectify;
mod rig_depth;
mod segment;
mod sfm;
mod similar;
mod vertical_alignment;

pub use advice::Advice;
pub use axes::Axes;
pub use calibrate::{
    BoardCalibration, BoardCalibrationError, BoardCalibrationOptions, BoardChoice, PhotoRefusal, calibrate,
};
pub use cv_core::{Cancelled, Progress, Silent};
pub use cv_features::{FeatureExtractor, FeatureMethod, FeatureOptions, Features};
pub use cv_geometry::{
    EstimateError, Intrinsics, PLAUSIBLE_FOCAL, RobustModel, RobustOptions, TwoViewError, TwoViewOptions, TwoViewPoint,
    TwoViewReconstruction, WorldMatch, estimate_pose,
};
pub use depth::{DepthError, DepthOptions, DepthResult, DisparityRange, depth, depth_with};
pub use disparity_range::{RangeError, disparity_range};
pub use estimate::{
    CalibratedResult, EstimateResult, ModelKind, PrevailingModel, estimate, estimate_calibrated, prevailing_model,
};
pub use frame_depth::FrameDepth;
pub use matching::{
    AffineSimulation, MatchingError, MatchingOptions, MatchingResult, extract_features, match_extracted,
    match_features, match_photos,
};
pub use no_pair::{FeatureAgreement, FewMatches, NoPairCause};
/// Types for features from elsewhere ([`match_extracted`]), and the options of ours.
pub mod features {
    pub use cv_features::{
        ByteDescriptors, ByteScale, CornerMeasure, DescriptorKind, Descriptors, DropReason, Dropped, FeatureError,
        HarrisFeatures, HarrisOptions, MopsOptions, MultiScaleOptions, PatchOptions, RatioTest, SiftOptions,
        Suppression,
    };
}
pub use panorama::{
    LeftOut, NearestPair, PanoramaError, PanoramaImage, PanoramaOptions, PanoramaPair, PanoramaPhoto, PanoramaPrior,
    PanoramaResult, panorama, panorama_streamed, panorama_with, panorama_with_masks,
};
/// Types of the panorama's stages.
pub mod panorama_types {
    pub use cv_panorama::*;
}
pub use reconstruct::{
    DenseError, DenseOptions, DenseResult, ReconstructError, ReconstructOptions, ReconstructResult, reconstruct,
    reconstruct_dense,
};
pub use rectify::{RectifyResult, rectify};
pub use rig_depth::{RigDepthResult, depth_by_rig};
pub use segment::{DetectResult, SegmentResult, SegmentTraining, detect, segment, train_segment};
pub use sfm::{
    DensePhoto, GpsCenters, GpsFix, OtherSize, PhotoOrder, PhotoProgress, PlacedModel, SfmCamera, SfmCameras, SfmDense,
    SfmDenseError, SfmDenseOptions, SfmJobError, SfmJobOptions, SfmPhoto, SfmPhotoError, SfmResult, gps_centers,
    place_model, sfm, sfm_covariance, sfm_dense, sfm_focal_deviations, sfm_pairs, sfm_photo, sfm_solve,
};

/// Types of the stereo stage: options and results, rectification, geometry and scores.
pub mod stereo {
    pub use cv_imgproc::{WarpError, WarpMap};
    pub use cv_stereo::{
        BAD_THRESHOLDS, Census, DisparityMap, DisparityMatcher, DisparityScores, EvaluateError, GeometryError,
        Intensity, IntensityCost, Paths, PixelState, Rectification, RectifiedView, RectifyError, RectifyOptions,
        Search, Smoothing, StereoError, StereoGeometry, StereoMatcher, StereoOptions, Subpixel, VerticalOffset,
        evaluate_disparity, non_occluded,
    };
}

/// Types of the color models for [`train_segment`] and [`segment()`]: options, model, scores.
pub mod segmentation {
    pub use cv_segment::{
        Cleanup, ColorModel, ColorSpace, ConfusionMatrix, DetectOptions, Detection, Detections, FeatureStatistics,
        Labeled, MIN_SCORE, ObjectStatistics, Region, Regions, Rule, SegmentError, ShapeStatistics, TrainOptions,
        Trained,
    };
}

/// Types of structure from motion for [`sfm()`]: knowledge of cameras, options, models.
pub mod many_views {
    pub use cv_sfm::*;
}

/// Types of calibration for [`calibrate()`]: boards, options, results, verdicts.
pub mod calibration {
    pub use cv_calib::*;
    pub use cv_features::{
        BlackRectangle, Board, BoardError, BoardKind, BoardPoint, BoardSize, CharucoBoard, Chessboard,
        ChessboardOptions, Dictionary, GridStyle, MarkerGrid, find_board, find_chessboard,
    };
}

/// The examples of the README, run as tests.
#[cfg(doctest)]
#[doc = include_str!("../../../README.md")]
struct Readme;
