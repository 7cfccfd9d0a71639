//! Color-based object segmentation: Gaussian mixture models of object and background, posterior odds, morphological
//! clean-up, and scores.
//!
//! ```
//! use cv_core::{Mask, RgbU8, Silent};
//! use cv_segment::{ConfusionMatrix, TrainOptions, train};
//!
//! // An orange square on gray.
//! let inside = |x: usize, y: usize| (20..40).contains(&x) && (10..30).contains(&y);
//! let image = RgbU8::from_fn(64, 48, |x, y| if inside(x, y) { [230, 110, 30 + x as u8] } else { [90, 90, 80 + y as u8] });
//! let mask = Mask::from_fn(64, 48, |x, y| [inside(x, y)]);
//!
//! let trained = train(&[(image.view(), mask.view())], &TrainOptions::default(), &Silent)?;
//! let predicted = trained.model.predict(image.view(), &Silent)?;
//! assert!(ConfusionMatrix::new(predicted.view(), mask.view())?.f1() > 0.97);
//! # Ok::<(), cv_segment::SegmentError>(())
//! ```
//!
//! # How it works
//!
//! Training builds color histograms inside and outside the masks and fits a [`Mixture`] to each, in a [`ColorSpace`]. A
//! pixel's score is the log posterior odds of object against background. Scores are smoothed by a Gaussian and
//! thresholded; the mask is opened and closed by a small disc ([`Cleanup`]). The [`ColorModel`] contains all parameters
//! and serializes with serde.
//!
//! [`ColorModel::detect`] measures the connected components of a mask (bounding box, moments) and scores each by the
//! Mahalanobis-like distance of its color and shape from those of the training objects ([`ObjectStatistics`]). Regions
//! with a low score are rejected.
//!
//! Everything is deterministic: the same images, options and seed give the same model and the same masks for any number
//! of threads.

mod cleanup;
mod color_space;
mod confusion_matrix;
mod detection;
mod error;
mod log_odds;
mod mixture;
mod model;
mod train;

pub use cleanup::Cleanup;
pub use color_space::ColorSpace;
pub use confusion_matrix::ConfusionMatrix;
pub use detection::{
    DetectOptions, Detection, Detections, FeatureStatistics, MIN_SCORE, ObjectStatistics, Region, ShapeStatistics,
};
pub use error::SegmentError;
pub use mixture::{Component, Mixture, MixtureError, MixtureOptions, WeightedSample};
pub use model::{ColorModel, Rule};
pub use train::{Labeled, Regions, TrainOptions, Trained, train};
