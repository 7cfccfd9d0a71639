//! Color segmentation of an object: training on images with masks, then segmentation of other images.

use crate::Progress;
use cv_core::{Cancelled, ImageView, Mask, StageClock};
use cv_segment::{ColorModel, DetectOptions, Detection, Labeled, SegmentError, TrainOptions, Trained, train};

/// Result of [`train_segment`].
#[derive(Debug, Clone, PartialEq)]
pub struct SegmentTraining {
    /// The model and its scores on the training images.
    pub trained: Trained,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Result of [`segment`].
#[derive(Debug, Clone, PartialEq)]
pub struct SegmentResult {
    /// The object mask.
    pub mask: Mask,
    /// Fraction of marked pixels, 0 to 1; 0 for an empty image.
    pub fraction: f64,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Result of [`detect`].
#[derive(Debug, Clone, PartialEq)]
pub struct DetectResult {
    /// Mask of the detected objects.
    pub mask: Mask,
    /// Fraction of marked pixels, 0 to 1; 0 for an empty image.
    pub fraction: f64,
    /// All regions of the object's color, detected or not, by descending score.
    pub objects: Vec<Detection>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Trains a color model of an object from images with masks.
///
/// # Errors
/// [`SegmentError`]: no training data, masks of other sizes or without objects, options out of range.
pub fn train_segment(
    photos: &[Labeled<'_>],
    options: &TrainOptions,
    progress: &dyn Progress,
) -> Result<SegmentTraining, SegmentError> {
    let mut clock = StageClock::new();
    let trained = train(photos, options, progress)?;
    clock.lap("train");
    Ok(SegmentTraining { trained, stages: clock.into_stages() })
}

/// Segments an image.
///
/// # Errors
/// [`Cancelled`].
pub fn segment(
    photo: ImageView<'_, u8, 3>,
    model: &ColorModel,
    progress: &dyn Progress,
) -> Result<SegmentResult, Cancelled> {
    let mut clock = StageClock::new();
    let raw = model.classify(photo, progress)?;
    clock.lap("classify");
    let mask = model.cleanup().apply(raw.view(), progress)?;
    clock.lap("clean up");
    let marked = mask.as_slice().iter().filter(|&&m| m).count();
    let fraction = marked as f64 / mask.as_slice().len().max(1) as f64;
    Ok(SegmentResult { mask, fraction, stages: clock.into_stages() })
}

/// Detects objects: measures the regions of [`segment`] and scores each by its agreement with the training objects in
/// color and shape. Regions with a low score are not marked.
///
/// # Errors
/// [`SegmentError`]: an option out of range, or the job was stopped.
pub fn detect(
    photo: ImageView<'_, u8, 3>,
    model: &ColorModel,
    options: &DetectOptions,
    progress: &dyn Progress,
) -> Result<DetectResult, SegmentError> {
    options.validate()?;
    let mut clock = StageClock::new();
    let score = model.score(photo, progress)?;
    let raw = model.binarize(score.view());
    clock.lap("classify");
    let cleaned = model.cleanup().apply(raw.view(), progress)?;
    clock.lap("clean up");
    let detections = model.detect(cleaned.view(), score.view(), options, progress)?;
    clock.lap("detect");
    let marked: usize = detections.objects.iter().filter(|o| o.found).map(|o| o.region.area).sum();
    let fraction = marked as f64 / detections.mask.as_slice().len().max(1) as f64;
    Ok(DetectResult { mask: detections.mask, fraction, objects: detections.objects, stages: clock.into_stages() })
}
