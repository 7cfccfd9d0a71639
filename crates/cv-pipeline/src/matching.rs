//! Features of photographs, and tentative matches between two of them.

use crate::asift::match_asift;
use crate::{ModelKind, Progress, RobustOptions, estimate};
use cv_core::{Cancelled, Correspondence, DMatch, ImageView, Point2, Scaling, StageClock};
use cv_features::{
    ByteDescriptors, FeatureError, FeatureOptions, Features, GuidedOptions, MatchError, MatchOptions, RatioTest,
    TwoViewModel, match_byte_descriptors, match_descriptors, match_guided,
};
use cv_geometry::EstimateError;
use cv_imgproc::{resize_area, rgb_to_gray_f32};

/// Whether [`match_photos`] also looks at affine-simulated views (ASIFT, Morel & Yu 2009), with SIFT only: some five times the time. Of large photographs, a third of the size tells which views to look at in full.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum AffineSimulation {
    /// Never.
    Never,
    /// Where neither a homography nor a fundamental matrix explains enough of the plain matches: 8 and 30 % of them (Brown & Lowe's test of a true
    /// match of two pictures, "Automatic panoramic image stitching", IJCV 2007).
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
    /// Which features, and their settings. Default SIFT.
    pub features: FeatureOptions,
    /// Which matches stay by how ambiguous they are. Default as of the kind of the descriptors.
    pub ratio: RatioTest,
    /// Keep a match only where each feature is the other's nearest. Default true.
    pub mutual: bool,
    /// Affine-simulated views (ASIFT). Default where needed.
    pub affine_simulation: AffineSimulation,
    /// Estimate this model from the matches and match once more along it: more matches, nearly all of them right, and none that disagree.
    /// Default none.
    pub guided: Option<ModelKind>,
    /// Seed of the searches for a model that `affine_simulation` and `guided` make. Default that of [`RobustOptions`].
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

/// What [`match_photos`] found.
#[derive(Debug, Clone, PartialEq)]
pub struct MatchingResult {
    /// The features of both photographs.
    pub features: [Features; 2],
    /// Matches by index of the features, in order of the first photograph's.
    pub matches: Vec<DMatch>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

impl MatchingResult {
    /// Where a match of these features is, in pixels.
    ///
    /// # Panics
    /// For a match of other features.
    pub fn pair(&self, m: &DMatch) -> Correspondence {
        pair(&self.features[0], &self.features[1], m)
    }

    /// The matches as positions in pixels, in their order.
    pub fn pairs(&self) -> Vec<Correspondence> {
        correspondences(&self.features[0], &self.features[1], &self.matches)
    }
}

/// Why photographs could not be matched.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum MatchingError {
    /// A photograph cannot be looked at.
    #[error("photograph {index}: {source}")]
    Features {
        /// 1 or 2.
        index: usize,
        /// Why.
        source: FeatureError,
    },
    /// A photograph has no features to match.
    #[error(
        "photograph {index} has no features: {found} points found, {dropped} of them too near the border or on flat patches"
    )]
    NoFeatures {
        /// 1 or 2.
        index: usize,
        /// Points found before description.
        found: usize,
        /// Points that could not be described.
        dropped: usize,
    },
    /// The descriptors cannot be compared.
    #[error(transparent)]
    Match(MatchError),
    /// There is no model for guided matching to go by.
    #[error("there is no model to be guided by: {source}")]
    NoModel {
        /// Which was asked for.
        kind: ModelKind,
        /// Why there is none.
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

/// Finds and describes the features of a photograph. Gray is Rec. 601 luma, 0 to 1.
///
/// # Errors
/// [`FeatureError`] for a photograph smaller than the method's window and for options out of range. One without features is no error here.
pub fn extract_features(
    photo: ImageView<'_, u8, 3>,
    options: &FeatureOptions,
    progress: &dyn Progress,
) -> Result<Features, FeatureError> {
    options.extractor().extract(rgb_to_gray_f32(photo).view(), progress)
}

/// Tentative matches between the features of two photographs. Descriptors are compared as bytes where their kind says how.
///
/// # Errors
/// [`MatchError`] where one has no features, or they are of different kinds.
pub fn match_features(
    a: &Features,
    b: &Features,
    options: &MatchingOptions,
    progress: &dyn Progress,
) -> Result<Vec<DMatch>, MatchError> {
    let settings = MatchOptions { ratio: options.ratio, mutual: options.mutual, ..MatchOptions::default() };
    match (ByteDescriptors::new(&a.descriptors), ByteDescriptors::new(&b.descriptors)) {
        (Some(a), Some(b)) => match_byte_descriptors(&a, &b, &settings, progress),
        _ => match_descriptors(&a.descriptors, &b.descriptors, &settings, progress),
    }
}

/// The positions of matched features, in the order of `matches`.
pub(crate) fn correspondences(a: &Features, b: &Features, matches: &[DMatch]) -> Vec<Correspondence> {
    matches.iter().map(|m| pair(a, b, m)).collect()
}

fn pair(a: &Features, b: &Features, m: &DMatch) -> Correspondence {
    let at = |f: &Features, i: u32| -> Point2<f64> { f.keypoints[i as usize].position.cast() };
    Correspondence { a: at(a, m.query), b: at(b, m.train) }
}

/// Features of two photographs and the tentative matches between them.
///
/// # Errors
/// [`MatchingError`] where a photograph is too small or has no features.
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
            !explained(&correspondences(&features[0], &features[1], &matches), options.seed, progress)?
        }
        AffineSimulation::Always => true,
    };
    if affine_simulation && let FeatureOptions::Sift(sift) = &options.features {
        let gray = [&rgb_to_gray_f32(a), &rgb_to_gray_f32(b)];
        match_asift(gray, sift, &mut features, &mut matches, options, progress)?;
        clock.lap("slanted views");
    }
    finish(features, matches, options, progress, clock)
}

/// Tentative matches between features found elsewhere; those of other programs are of the kind [`DescriptorKind::foreign`](cv_features::DescriptorKind::foreign).
///
/// # Errors
/// [`MatchingError`] where there are none, or they are of different kinds.
pub fn match_extracted(
    features: [Features; 2],
    options: &MatchingOptions,
    progress: &dyn Progress,
) -> Result<MatchingResult, MatchingError> {
    let mut clock = StageClock::new();
    let matches = match_features(&features[0], &features[1], options, progress)?;
    clock.lap("match");
    finish(features, matches, options, progress, clock)
}

/// Matches once more along a model, where asked for, and packs up.
fn finish(
    features: [Features; 2],
    mut matches: Vec<DMatch>,
    options: &MatchingOptions,
    progress: &dyn Progress,
    mut clock: StageClock,
) -> Result<MatchingResult, MatchingError> {
    if let Some(kind) = options.guided {
        let pairs = correspondences(&features[0], &features[1], &matches);
        let found = estimate(&pairs, kind, &RobustOptions { seed: options.seed, ..kind.options() }, progress);
        let robust = match found {
            Ok(found) => found.robust,
            Err(EstimateError::Cancelled(stop)) => return Err(stop.into()),
            Err(source) => return Err(MatchingError::NoModel { kind, source }),
        };
        let model = match kind {
            ModelKind::Homography => TwoViewModel::Homography(robust.model),
            ModelKind::Fundamental => TwoViewModel::Fundamental(robust.model),
        };
        let along = GuidedOptions { threshold: kind.options().threshold as f32, ..GuidedOptions::default() };
        matches = match_guided(&features[0], &features[1], None, &model, &along, progress)?;
        clock.lap("guided");
    }
    Ok(MatchingResult { features, matches, stages: clock.into_stages() })
}

/// Whether a homography or a fundamental matrix explains enough of the matches: see [`AffineSimulation::AsNeeded`].
fn explained(pairs: &[Correspondence], seed: u64, progress: &dyn Progress) -> Result<bool, Cancelled> {
    for kind in [ModelKind::Homography, ModelKind::Fundamental] {
        match estimate(pairs, kind, &RobustOptions { seed, ..kind.options() }, progress) {
            Ok(m) if m.robust.inliers.len() as f64 > 8.0 + 0.3 * pairs.len() as f64 => return Ok(true),
            Err(EstimateError::Cancelled(stop)) => return Err(stop),
            _ => {}
        }
    }
    Ok(false)
}

/// To pixels of the photograph as it is when scaled.
pub(crate) fn rescale(features: &mut Features, scaling: Scaling) {
    for point in features.keypoints.iter_mut().chain(&mut features.candidates) {
        point.position = scaling.point_f32(point.position);
        point.scale *= scaling.length() as f32;
    }
}

/// [`match_photos`] in photographs reduced to a longer side of `max_size` where they are larger, in pixels of the photographs themselves.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{FeatureMethod, Silent};
    use cv_core::RgbU8;

    /// Colored blobs of many sizes at places drawn from a fixed sequence.
    fn blobs(shift: (f32, f32)) -> RgbU8 {
        let mut state = 7u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        let spots: Vec<[f32; 4]> =
            (0..400).map(|_| [random() * 240.0, random() * 180.0, 0.8 + 4.0 * random(), random() - 0.5]).collect();
        RgbU8::from_fn(240, 180, |x, y| {
            let (x, y) = (x as f32 - shift.0, y as f32 - shift.1);
            let sum: f32 = spots
                .iter()
                .map(|s| s[3] * (-((x - s[0]).powi(2) + (y - s[1]).powi(2)) / (2.0 * s[2] * s[2])).exp())
                .sum();
            [(128.0 + 120.0 * sum) as u8; 3]
        })
    }

    #[test]
    fn both_methods_find_a_shift() {
        let (a, b) = (blobs((0.0, 0.0)), blobs((6.5, -4.0)));
        for method in [FeatureMethod::Harris, FeatureMethod::Mops, FeatureMethod::Sift] {
            let options = MatchingOptions { features: method.into(), ..MatchingOptions::default() };
            let result = match_photos(a.view(), b.view(), &options, &Silent).unwrap();
            let pairs = result.pairs();
            let good =
                pairs.iter().filter(|p| (p.b.x - p.a.x - 6.5).abs() < 1.0 && (p.b.y - p.a.y + 4.0).abs() < 1.0).count();
            // The images differ only by the shift and rounding to bytes; a pixel is what the top of a round blob may wander by that.
            // Oriented patches at all scales need a wide margin: few fit into this small image.
            let least = if method == FeatureMethod::Mops { 15 } else { 30 };
            assert!(good >= least && good * 10 >= pairs.len() * 9, "{method:?}: {good} of {}", pairs.len());
            assert_eq!(result.matches.len(), pairs.len());
        }
    }

    #[test]
    fn photographs_without_features_are_named() {
        let flat = RgbU8::new(100, 80, [9; 3]);
        let good = blobs((0.0, 0.0));
        for method in [FeatureMethod::Harris, FeatureMethod::Mops, FeatureMethod::Sift] {
            let options = MatchingOptions { features: method.into(), ..MatchingOptions::default() };
            let error = match_photos(good.view(), flat.view(), &options, &Silent).unwrap_err();
            assert_eq!(error, MatchingError::NoFeatures { index: 2, found: 0, dropped: 0 });
            let tiny = RgbU8::new(1, 1, [9; 3]);
            let error = match_photos(tiny.view(), good.view(), &options, &Silent).unwrap_err();
            assert!(matches!(
                error,
                MatchingError::Features { index: 1, source: FeatureError::ImageTooSmall { width: 1, height: 1, .. } }
            ));
        }
    }
}
