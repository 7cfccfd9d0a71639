//! Features of photographs, and tentative matches between two of them.

use crate::asift::match_asift;
use crate::{ModelKind, Progress, RobustOptions, estimate};
use cv_core::{Cancelled, Correspondence, DMatch, ImageView, Keypoint, Point2, Scaling, StageClock};
use cv_features::{
    DescriptorKind, FeatureError, Features, GuidedOptions, HarrisOptions, MatchError, MatchOptions, MopsOptions,
    PatchOptions, SiftOptions, TwoViewModel, anms, anms_square_covering, anms_tiled, describe_patches, harris,
    match_descriptors, match_guided, mops, sift,
};
use cv_geometry::EstimateError;
use cv_imgproc::{resize_area, rgb_to_gray_f32};

/// Which features to find.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum FeatureMethod {
    /// Harris corners with upright 8×8 patches: fast, for neighboring frames of a film or a slowly turned camera.
    Harris,
    /// Corners at all scales with oriented 8×8 patches: for photographs that turn and zoom a little, at half the time of SIFT.
    Mops,
    /// rootSIFT: for photographs that turn, zoom, or change light or viewpoint.
    #[default]
    Sift,
}

cv_core::named!(FeatureMethod {
    Sift = "sift": "rootSIFT: photographs that turn, zoom, or change light or viewpoint",
    Mops = "mops": "corners at all scales with oriented 8×8 patches",
    Harris = "harris": "corners with upright 8×8 patches: neighboring frames of a film or of a slowly turned camera",
});

/// The non-maximal suppression that spreads Harris corners over the photograph.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Suppression {
    /// By suppression radius (Brown, Szeliski & Winder).
    #[default]
    Radius,
    /// By square covering (Bailo et al.): faster, nearly as even.
    SquareCovering,
    /// As many from each of 8 × 8 tiles.
    Tiles,
}

cv_core::named!(Suppression {
    Radius = "radius": "by suppression radius",
    SquareCovering = "squares": "by square covering: faster, nearly as even",
    Tiles = "tiles": "as many from each of 8×8 tiles",
});

/// Whether [`match_photos`] also looks at affine-simulated views (ASIFT, Morel & Yu 2009), with SIFT only: some ten times the time.
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

/// Settings of [`extract_features`] and [`match_photos`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct MatchingOptions {
    /// Which features. Default SIFT, which works on a stranger's photographs without knowing anything about them.
    pub method: FeatureMethod,
    /// Most features per photograph; `None` takes the method's default: 500 well-spread corners (Brown, Szeliski & Winder), 2000 oriented
    /// patches, or 8192 SIFT features (COLMAP's).
    pub max_features: Option<usize>,
    /// Settings of the corners.
    pub harris: HarrisOptions,
    /// Robustness factor of the suppression. 0 to 1; default 0.9 (Brown, Szeliski & Winder).
    pub anms_robust: f32,
    /// How the corners are spread. Default by radius.
    pub suppression: Suppression,
    /// Settings of the patches.
    pub patch: PatchOptions,
    /// Settings of the oriented patches and their corners.
    pub mops: MopsOptions,
    /// Settings of SIFT. Of more features than asked for, the coarse ones stay by default (COLMAP's choice).
    pub sift: SiftOptions,
    /// Largest ratio of the SSD of the best candidate to that of the second. 0 to 1; `None` keeps every nearest neighbor. Default 0.66, which is
    /// 0.81 on distances.
    pub ratio: Option<f32>,
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
            method: FeatureMethod::default(),
            max_features: None,
            harris: HarrisOptions::default(),
            anms_robust: 0.9,
            suppression: Suppression::default(),
            patch: PatchOptions::default(),
            mops: MopsOptions::default(),
            sift: SiftOptions { coarse_first: true, ..SiftOptions::default() },
            ratio: Some(0.66),
            mutual: true,
            affine_simulation: AffineSimulation::default(),
            guided: None,
            seed: RobustOptions::default().seed,
        }
    }
}

/// The features of a photograph.
#[derive(Debug, Clone, PartialEq)]
pub struct PhotoFeatures {
    /// Keypoints, descriptors, and what was left out.
    pub described: Features,
    /// Points found before spacing and limits.
    pub found: usize,
    /// The corners before spacing, for pictures; empty for methods that do not space their points.
    pub candidates: Vec<Keypoint>,
}

/// What [`match_photos`] found.
#[derive(Debug, Clone, PartialEq)]
pub struct MatchingResult {
    /// The features of both photographs.
    pub features: [PhotoFeatures; 2],
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
    options: &MatchingOptions,
    progress: &dyn Progress,
) -> Result<PhotoFeatures, FeatureError> {
    let gray = rgb_to_gray_f32(photo);
    match options.method {
        FeatureMethod::Harris => {
            let corners = harris(gray.view(), &options.harris, progress)?;
            let n = options.max_features.unwrap_or(500);
            let spaced = match options.suppression {
                Suppression::Radius => anms(&corners, n, options.anms_robust),
                Suppression::SquareCovering => anms_square_covering(&corners, n),
                Suppression::Tiles => anms_tiled(&corners, n, (8, 8)),
            };
            let spaced: Vec<_> = spaced.into_iter().map(|i| corners[i]).collect();
            let mut described = describe_patches(gray.view(), &spaced, &options.patch)?;
            described.beyond_limit = corners.len() - spaced.len();
            Ok(PhotoFeatures { described, found: corners.len(), candidates: corners })
        }
        FeatureMethod::Mops => {
            let mut settings = options.mops.clone();
            if let Some(n) = options.max_features {
                settings.max_features = n;
            }
            let described = mops(gray.view(), &settings, progress)?;
            Ok(PhotoFeatures { found: accounted(&described), described, candidates: Vec::new() })
        }
        FeatureMethod::Sift => {
            let mut settings = options.sift.clone();
            if let Some(n) = options.max_features {
                settings.max_features = n;
            }
            let described = sift(gray.view(), &settings, progress)?;
            Ok(PhotoFeatures { found: accounted(&described), described, candidates: Vec::new() })
        }
    }
}

/// The features kept, dropped, and beyond the limit.
fn accounted(described: &Features) -> usize {
    described.keypoints.len() + described.dropped.len() + described.beyond_limit
}

/// Tentative matches between the features of two photographs.
///
/// # Errors
/// [`MatchError`] where one has no features, or they are of different kinds.
pub fn match_features(
    a: &PhotoFeatures,
    b: &PhotoFeatures,
    options: &MatchingOptions,
    progress: &dyn Progress,
) -> Result<Vec<DMatch>, MatchError> {
    let settings = MatchOptions { ratio: options.ratio, mutual: options.mutual, ..MatchOptions::default() };
    match_descriptors(&a.described.descriptors, &b.described.descriptors, &settings, progress)
}

/// The positions of matched features, in the order of `matches`.
pub(crate) fn correspondences(a: &PhotoFeatures, b: &PhotoFeatures, matches: &[DMatch]) -> Vec<Correspondence> {
    matches.iter().map(|m| pair(a, b, m)).collect()
}

fn pair(a: &PhotoFeatures, b: &PhotoFeatures, m: &DMatch) -> Correspondence {
    let at = |f: &PhotoFeatures, i: u32| -> Point2<f64> { f.described.keypoints[i as usize].position.cast() };
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
        let features = extract_features(photo, options, progress).map_err(|error| match error {
            FeatureError::Cancelled(stop) => stop.into(),
            source => MatchingError::Features { index, source },
        })?;
        if features.described.keypoints.is_empty() {
            let dropped = features.described.dropped.len();
            return Err(MatchingError::NoFeatures { index, found: features.found, dropped });
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
    if affine_simulation && options.method == FeatureMethod::Sift {
        match_asift([&rgb_to_gray_f32(a), &rgb_to_gray_f32(b)], &mut features, &mut matches, options, progress)?;
        clock.lap("slanted views");
    }
    finish(features, matches, options, progress, clock)
}

/// Tentative matches between features found elsewhere; those of other programs count as [`DescriptorKind::Foreign`](cv_features::DescriptorKind::Foreign).
///
/// # Errors
/// [`MatchingError`] where there are none, or they are of different kinds.
pub fn match_extracted(
    features: [PhotoFeatures; 2],
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
    features: [PhotoFeatures; 2],
    mut matches: Vec<DMatch>,
    options: &MatchingOptions,
    progress: &dyn Progress,
    mut clock: StageClock,
) -> Result<MatchingResult, MatchingError> {
    if let Some(kind) = options.guided {
        let pairs = correspondences(&features[0], &features[1], &matches);
        // Without a model there is nothing to be guided by: the tentative matches stay.
        let found = match estimate(&pairs, kind, &RobustOptions { seed: options.seed, ..kind.options() }, progress) {
            Err(EstimateError::Cancelled(stop)) => return Err(stop.into()),
            found => found.ok(),
        };
        if let Some(found) = found {
            let model = match kind {
                ModelKind::Homography => TwoViewModel::Homography(found.robust.model),
                ModelKind::Fundamental => TwoViewModel::Fundamental(found.robust.model),
            };
            // Patches are of unit variance, 64 numbers: the limit for unit vectors times 64.
            let unit = features[0].described.descriptors.kind();
            let max_ssd = match unit {
                DescriptorKind::Patch | DescriptorKind::Mops => 64.0 * GuidedOptions::default().max_ssd,
                DescriptorKind::Foreign { .. } => f32::INFINITY,
                DescriptorKind::Sift | DescriptorKind::RootSift => GuidedOptions::default().max_ssd,
            };
            let along =
                GuidedOptions { threshold: kind.options().threshold as f32, max_ssd, ..GuidedOptions::default() };
            matches = match_guided(&features[0].described, &features[1].described, None, &model, &along, progress)?;
        }
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
        let scaling = Scaling::between(view.size(), photo.size());
        let points = features.described.keypoints.iter_mut();
        for point in points.chain(&mut features.candidates) {
            point.position = scaling.point_f32(point.position);
            point.scale *= scaling.length() as f32;
        }
    }
    Ok(matching)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Silent;
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
            let options = MatchingOptions { method, ..MatchingOptions::default() };
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
            let options = MatchingOptions { method, ..MatchingOptions::default() };
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
