//! Feature extraction, and tentative matches of two images.

use crate::asift::match_asift;
use crate::{ModelKind, Progress, RobustOptions, estimate};
use cv_core::{Cancelled, Correspondence, DMatch, ImageView, Point2, Scaling, StageClock};
use cv_features::{
    ByteDescriptors, FeatureError, FeatureOptions, Features, GuidedOptions, MatchError, MatchOptions, RatioTest,
    TwoViewModel, match_byte_descriptors, match_descriptors, match_guided,
};
use cv_geometry::EstimateError;
use cv_imgproc::{resize_area, rgb_to_gray_f32};

/// Whether [`match_photos`] matches simulated affine views too (ASIFT, Morel & Yu 2009), with SIFT only, in about five
/// times the time. For large images the views are selected at a third of the resolution.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum AffineSimulation {
    /// Never.
    Never,
    /// If neither a homography nor a fundamental matrix has enough inliers among the plain matches: more than 8 plus 30
    /// % of them (Brown & Lowe's test of an image match, "Automatic panoramic image stitching", IJCV 2007).
    #[default]
    AsNeeded,
    /// Always.
    Always,
}

cv_core::named!(AffineSimulation {
    Never = "never",
    AsNeeded = "as-needed": "where no model explains enough of the plain matches",
    Always = "always",
});

/// Settings of [`match_photos`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct MatchingOptions {
    /// Feature method and its settings. Default SIFT.
    pub features: FeatureOptions,
    /// Ratio test. Default that of the descriptor kind.
    pub ratio: RatioTest,
    /// Whether matches must be mutual nearest neighbors. Default true.
    pub mutual: bool,
    /// Simulated affine views (ASIFT). Default as needed.
    pub affine_simulation: AffineSimulation,
    /// Guided matching: estimate this model from the matches, and match again near its predictions. It gives more
    /// matches, nearly all of them inliers. Default none.
    pub guided: Option<ModelKind>,
    /// Seed of the model estimation for `affine_simulation` and `guided`. Default that of [`RobustOptions`].
    pub seed: u64,
}

impl Default for MatchingOptions {
    fn default() -> Self {
        Self {
            features: FeatureOptions::default(),
            ratio: RatioTest::Kind,
            mutual: true,
            affine_simulation: AffineSimulation::default(),
            guided: None,
            seed: RobustOptions::default().seed,
        }
    }
}

impl MatchingOptions {
    /// Returns the settings of the comparison of descriptors.
    pub(crate) fn descriptor_matching(&self) -> MatchOptions {
        MatchOptions { ratio: self.ratio, mutual: self.mutual, ..MatchOptions::default() }
    }
}

/// Result of [`match_photos`].
#[derive(Debug, Clone, PartialEq)]
pub struct MatchingResult {
    /// The features of both images.
    pub features: [Features; 2],
    /// Matches by feature index, in the order of the first image's features.
    pub matches: Vec<DMatch>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

impl MatchingResult {
    /// Returns the pixels of a match.
    ///
    /// # Panics
    /// For a match of other features.
    pub fn pair(&self, m: &DMatch) -> Correspondence {
        correspondence(&self.features[0], &self.features[1], m)
    }

    /// Returns the pixels of all matches, in their order.
    pub fn pairs(&self) -> Vec<Correspondence> {
        correspondences(&self.features[0], &self.features[1], &self.matches)
    }
}

/// Why two images could not be matched.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum MatchingError {
    /// Feature extraction failed on an image.
    #[error("photograph {index}: {source}")]
    Features {
        /// Index of the image: 1 or 2.
        index: usize,
        /// The reason.
        source: FeatureError,
    },
    /// An image has no features.
    #[error(
        "photograph {index} has no features: {found} keypoints detected, {dropped} of them dropped near the border or in low-texture patches"
    )]
    NoFeatures {
        /// Index of the image: 1 or 2.
        index: usize,
        /// Keypoints detected.
        found: usize,
        /// Keypoints without a descriptor.
        dropped: usize,
    },
    /// The descriptors cannot be compared.
    #[error(transparent)]
    Match(MatchError),
    /// No model for guided matching was found.
    #[error("no model for guided matching: {source}")]
    NoModel {
        /// Kind of the model.
        kind: ModelKind,
        /// The reason.
        source: EstimateError,
    },
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

impl From<MatchError> for MatchingError {
    fn from(error: MatchError) -> Self {
        match error {
            MatchError::Cancelled(stop) => Self::Cancelled(stop),
            other => Self::Match(other),
        }
    }
}

/// Detects and describes the features of an image. Gray is Rec. 601 luma, 0 to 1.
///
/// # Errors
/// [`FeatureError`] for an image smaller than the method's window, and options out of range. An image without features
/// is no error.
pub fn extract_features(
    photo: ImageView<'_, u8, 3>,
    options: &FeatureOptions,
    progress: &dyn Progress,
) -> Result<Features, FeatureError> {
    options.extractor().extract(rgb_to_gray_f32(photo).view(), progress)
}

/// Returns tentative matches between the features of two images. Descriptors are compared as bytes if their kind
/// supports it.
///
/// # Errors
/// [`MatchError`] if an image has no features, or the kinds differ.
pub fn match_features(
    a: &Features,
    b: &Features,
    options: &MatchingOptions,
    progress: &dyn Progress,
) -> Result<Vec<DMatch>, MatchError> {
    let settings = options.descriptor_matching();
    match (ByteDescriptors::new(&a.descriptors), ByteDescriptors::new(&b.descriptors)) {
        (Some(a), Some(b)) => match_byte_descriptors(&a, &b, &settings, progress),
        _ => match_descriptors(&a.descriptors, &b.descriptors, &settings, progress),
    }
}

/// Returns the pixels of matched features, in the order of `matches`.
pub(crate) fn correspondences(a: &Features, b: &Features, matches: &[DMatch]) -> Vec<Correspondence> {
    matches.iter().map(|m| correspondence(a, b, m)).collect()
}

/// Returns the pixels of a match.
fn correspondence(a: &Features, b: &Features, m: &DMatch) -> Correspondence {
    let position = |f: &Features, i: u32| -> Point2<f64> { f.keypoints[i as usize].position.cast() };
    Correspondence { a: position(a, m.query), b: position(b, m.train) }
}

/// Extracts the features of two images and matches them.
///
/// # Errors
/// [`MatchingError`] if an image is too small or has no features.
pub fn match_photos(
    a: ImageView<'_, u8, 3>,
    b: ImageView<'_, u8, 3>,
    options: &MatchingOptions,
    progress: &dyn Progress,
) -> Result<MatchingResult, MatchingError> {
    let mut clock = StageClock::new();
    let extract = |photo, index| {
        let features = extract_features(photo, &options.features, progress).map_err(|error| match error {
            FeatureError::Cancelled(stop) => stop.into(),
            source => MatchingError::Features { index, source },
        })?;
        if features.keypoints.is_empty() {
            let dropped = features.dropped.len();
            return Err(MatchingError::NoFeatures { index, found: features.detected_count(), dropped });
        }
        Ok(features)
    };
    let mut features = [extract(a, 1)?, extract(b, 2)?];
    clock.lap("features");
    let mut matches = match_features(&features[0], &features[1], options, progress)?;
    clock.lap("match");
    let affine_simulation = match options.affine_simulation {
        AffineSimulation::Never => false,
        AffineSimulation::AsNeeded => {
            !has_model(&correspondences(&features[0], &features[1], &matches), options.seed, progress)?
        }
        AffineSimulation::Always => true,
    };
    if affine_simulation && let FeatureOptions::Sift(sift) = &options.features {
        let gray = [&rgb_to_gray_f32(a), &rgb_to_gray_f32(b)];
        match_asift(gray, sift, &mut features, &mut matches, options, progress)?;
        clock.lap("slanted views");
    }
    assemble_result(features, matches, options, progress, clock)
}

/// Returns tentative matches between given features; those of other programs have the kind
/// [`DescriptorKind::foreign`](cv_features::DescriptorKind::foreign).
///
/// # Errors
/// [`MatchingError`] if there are none, or the kinds differ.
pub fn match_extracted(
    features: [Features; 2],
    options: &MatchingOptions,
    progress: &dyn Progress,
) -> Result<MatchingResult, MatchingError> {
    let mut clock = StageClock::new();
    let matches = match_features(&features[0], &features[1], options, progress)?;
    clock.lap("match");
    assemble_result(features, matches, options, progress, clock)
}

/// Applies guided matching, if requested, and assembles the result.
fn assemble_result(
    features: [Features; 2],
    mut matches: Vec<DMatch>,
    options: &MatchingOptions,
    progress: &dyn Progress,
    mut clock: StageClock,
) -> Result<MatchingResult, MatchingError> {
    if let Some(kind) = options.guided {
        let pairs = correspondences(&features[0], &features[1], &matches);
        let estimated = estimate(&pairs, kind, &RobustOptions { seed: options.seed, ..kind.options() }, progress);
        let robust = match estimated {
            Ok(estimated) => estimated.robust,
            Err(EstimateError::Cancelled(stop)) => return Err(stop.into()),
            Err(source) => return Err(MatchingError::NoModel { kind, source }),
        };
        let model = match kind {
            ModelKind::Homography => TwoViewModel::Homography(robust.model),
            ModelKind::Fundamental => TwoViewModel::Fundamental(robust.model),
        };
        let guided_options = GuidedOptions { threshold: kind.options().threshold as f32, ..GuidedOptions::default() };
        matches = match_guided(&features[0], &features[1], None, &model, &guided_options, progress)?;
        clock.lap("guided");
    }
    Ok(MatchingResult { features, matches, stages: clock.into_stages() })
}

/// Returns whether a homography or a fundamental matrix has enough inliers: see [`AffineSimulation::AsNeeded`].
fn has_model(pairs: &[Correspondence], seed: u64, progress: &dyn Progress) -> Result<bool, Cancelled> {
    for kind in [ModelKind::Homography, ModelKind::Fundamental] {
        match estimate(pairs, kind, &RobustOptions { seed, ..kind.options() }, progress) {
            Ok(m) if m.robust.inliers.len() as f64 > 8.0 + 0.3 * pairs.len() as f64 => return Ok(true),
            Err(EstimateError::Cancelled(stop)) => return Err(stop),
            _ => {}
        }
    }
    Ok(false)
}

/// Converts keypoints to pixels of the image in full size.
pub(crate) fn rescale(features: &mut Features, scaling: Scaling) {
    for point in features.keypoints.iter_mut().chain(&mut features.candidates) {
        point.position = scaling.point_f32(point.position);
        point.scale *= scaling.length() as f32;
    }
}

/// As [`match_photos`] on images reduced to a longer side of at most `max_size`; the result is in pixels of the full
/// images.
pub(crate) fn match_reduced(
    photos: [ImageView<'_, u8, 3>; 2],
    max_size: usize,
    options: &MatchingOptions,
    progress: &dyn Progress,
) -> Result<MatchingResult, MatchingError> {
    let reduced = photos.map(|photo| {
        let factor = max_size.max(8) as f64 / photo.width().max(photo.height()) as f64;
        let side = |n: usize| ((n as f64 * factor).round() as usize).max(1);
        (factor < 1.0).then(|| resize_area(photo, side(photo.width()), side(photo.height())).ok()).flatten()
    });
    let views = [0, 1].map(|i: usize| reduced[i].as_ref().map_or(photos[i], |r| r.view()));
    let mut matching = match_photos(views[0], views[1], options, progress)?;
    for ((features, view), photo) in matching.features.iter_mut().zip(&views).zip(&photos) {
        rescale(features, Scaling::between(view.size(), photo.size()));
    }
    Ok(matching)
}
