//! Panoramas from overlapping photographs.

use crate::Progress;
use crate::matching::{MatchingOptions, correspondences, extract_features, match_features, rescale};
use cv_core::{
    Camera, Cancelled, Correspondence, DMatch, Image, ImageView, Mask, RgbF32, Scaling, Stage, StageClock, UnionFind,
};
use cv_features::{FeatureError, FeatureOptions, Features, MatchError, SiftOptions};
use cv_panorama::{
    AlignError, AlignOptions, Alignment, CameraMotion, Canvas, CompositingOptions, EightBits, PairRejection, Photo,
    PhotoMap, PhotoSample, Registration, RegistrationError, RenderError, Unplaced, VerifiedPair, VerifyOptions, align,
    render, verify_pair,
};
use rayon::prelude::*;

/// A photograph and what is known about its camera.
#[derive(Debug, Clone, Copy)]
pub struct PanoramaPhoto<'a, T = u8> {
    /// The upright image, with `u8` or `u16` samples.
    pub image: ImageView<'a, T, 3>,
    /// Focal length in pixels from EXIF, if there is one.
    pub focal: Option<f64>,
    /// The calibrated camera, if there is one; its distortion is corrected.
    pub camera: Option<Camera>,
}

impl<'a, T> PanoramaPhoto<'a, T> {
    /// Creates a photograph without knowledge of its camera.
    pub fn new(image: ImageView<'a, T, 3>) -> Self {
        Self { image, focal: None, camera: None }
    }
}

/// Settings of [`panorama`].
#[derive(Debug, Clone)]
pub struct PanoramaOptions {
    /// Features and matching. SIFT on the upsampled image ([`SiftOptions::upsample`]) and with faint features ([`SiftOptions::min_features`]) is used only
    /// where plain SIFT does not connect the photographs firmly.
    pub matching: MatchingOptions,
    /// Approximate number of pixels that photographs are reduced to for features and alignment. 10,000 or more; default 800,000, in the range of OpenCV's
    /// stitcher and Hugin's control point finders.
    pub registration_pixels: usize,
    /// Pair verification. The threshold is in pixels of the reduced photographs.
    pub verify: VerifyOptions,
    /// Alignment. `outlier_px` is in pixels of the reduced photographs.
    pub align: AlignOptions,
    /// Compositing.
    pub render: CompositingOptions,
}

impl Default for PanoramaOptions {
    fn default() -> Self {
        Self {
            matching: MatchingOptions {
                features: Self::features(FeatureOptions::default()),
                ..MatchingOptions::default()
            },
            registration_pixels: 800_000,
            verify: VerifyOptions::default(),
            align: AlignOptions::default(),
            render: CompositingOptions::default(),
        }
    }
}

impl PanoramaOptions {
    /// Returns a method's options with the limits for panoramas: at most 2000 features, and faint ones where strong ones are few, as in an underexposed
    /// photograph. [`panorama`] uses faint features only where the photographs are not firmly connected without.
    pub fn features(method: FeatureOptions) -> FeatureOptions {
        match method.at_most(2000) {
            FeatureOptions::Sift(sift) => {
                FeatureOptions::Sift(SiftOptions { min_features: 600, faint_contrast: 0.006, ..sift })
            }
            other => other,
        }
    }
}

/// Why a photograph is not in the panorama.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum LeftOut {
    /// Feature extraction failed.
    Features(FeatureError),
    /// It has no features.
    NoFeatures,
    /// It overlaps no other photograph.
    NoOverlap {
        /// The rejected pair with most inliers, if there is one.
        nearest: Option<NearestPair>,
    },
    /// It is in another connected component of overlapping photographs.
    OtherComponent {
        /// Number of photographs in that component.
        size: usize,
    },
    /// Its overlaps contradict those of the other photographs.
    Inconsistent,
}

/// A pair that was rejected for too few inliers.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct NearestPair {
    /// Index of the other photograph.
    pub other: usize,
    /// Number of inliers.
    pub agree: usize,
    /// Number of matches in the overlap by the homography.
    pub in_overlap: usize,
    /// Number of inliers that chance explains; more are needed.
    pub needed: f64,
}

/// Result for a photograph.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct PanoramaImage {
    /// Width and height in pixels.
    pub size: (usize, usize),
    /// Whether it is in the panorama.
    pub used: bool,
    /// Why not, if it is not.
    pub reason: Option<LeftOut>,
    /// Number of its features; 0 with [`panorama_with`].
    pub features: usize,
    /// Its focal length in pixels, if it is used.
    pub focal: Option<f64>,
    /// Gains of its red, green and blue linear intensities.
    pub gain: [f32; 3],
}

/// Result for a pair of photographs.
#[derive(Debug, Clone, PartialEq)]
pub struct PanoramaPair {
    /// First photograph.
    pub a: usize,
    /// Second photograph.
    pub b: usize,
    /// Tentative matches by feature index; see [`PanoramaResult::correspondences`].
    pub matches: Vec<DMatch>,
    /// Indices of the inliers of the homography, ascending; empty if the pair was rejected.
    pub inliers: Vec<usize>,
    /// Why the pair was rejected.
    pub rejected: Option<PairRejection>,
}

/// A panorama and its intermediate results.
#[derive(Debug, Clone)]
pub struct PanoramaResult<T = u8> {
    /// The image, with the bit depth of the photographs; black where there is no coverage.
    pub image: Image<T, 3>,
    /// Linear radiance of the scene, if [`CompositingOptions::radiance`] requests it; 1 is the white level of the reference photograph.
    pub radiance: Option<RgbF32>,
    /// True where a photograph covers the pixel.
    pub mask: Mask,
    /// Index of the photograph of each pixel; `u16::MAX` without coverage.
    pub labels: Image<u16, 1>,
    /// One entry per input.
    pub images: Vec<PanoramaImage>,
    /// All pairs with matches; empty with [`panorama_with`].
    pub pairs: Vec<PanoramaPair>,
    /// Features of each photograph, in its own pixels; empty with [`panorama_with`].
    pub features: Vec<Features>,
    /// The alignment, in full resolution.
    pub alignment: Alignment,
    /// The canvas: projection surface, and the viewing direction of each pixel.
    pub canvas: Canvas,
    /// The source pixel of each pixel of the panorama.
    pub map: PhotoMap,
    /// Whether photographs extend beyond the largest field of the projection, without a requested field of view.
    pub reaches_beyond: bool,
    /// Root mean square reprojection error of all matches, in pixels of the photographs.
    pub reprojection_rms_px: f64,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Root mean square error that indicates parallax, as a ratio of the longer image side: 5 px of 1,000. Features are accurate to a pixel or two.
const PARALLAX_RATIO: f64 = 0.005;

impl<T> PanoramaResult<T> {
    /// Returns the pixels of the matches of a pair.
    ///
    /// # Panics
    /// For a pair of another panorama.
    pub fn correspondences(&self, pair: &PanoramaPair) -> Vec<Correspondence> {
        correspondences(&self.features[pair.a], &self.features[pair.b], &pair.matches)
    }

    /// Returns the alignment for other photographs of the same views; `names` are those of the photographs, as far as they are known.
    ///
    /// # Errors
    /// [`RegistrationError`] if a camera or a matrix is out of range.
    pub fn registration(&self, names: &[String]) -> Result<Registration, RegistrationError> {
        let sizes: Vec<_> = self.images.iter().map(|image| image.size).collect();
        Registration::new(&self.alignment, &sizes, names)
    }

    /// Returns whether the reprojection error indicates parallax: nearby objects may then be cut at the seams.
    pub fn shows_parallax(&self) -> bool {
        let longest = self.alignment.used().map(|(_, view)| view.camera.width.max(view.camera.height)).max();
        self.reprojection_rms_px > PARALLAX_RATIO * longest.unwrap_or(0) as f64
    }
}

/// Why there is no panorama.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum PanoramaError {
    /// The photographs could not be aligned. `images` has the reason for each.
    #[error("{source}")]
    Align {
        /// The reason.
        source: AlignError,
        /// One entry per input.
        images: Vec<PanoramaImage>,
    },
    /// The photographs do not match the registration.
    #[error(transparent)]
    Registration(#[from] RegistrationError),
    /// Compositing failed.
    #[error(transparent)]
    Render(RenderError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

impl From<RenderError> for PanoramaError {
    fn from(error: RenderError) -> Self {
        match error {
            RenderError::Cancelled(stop) => Self::Cancelled(stop),
            error => Self::Render(error),
        }
    }
}

/// Stitches overlapping photographs, in any order, to a panorama.
///
/// Extracts features on reduced photographs, matches and verifies all pairs (again with more features where the connection is loose), aligns all photographs
/// jointly, and composites in full resolution. Photographs that do not fit are left out, with a reason. With `u16` samples the panorama has 16 bits;
/// alignment uses 8 bits.
///
/// # Errors
/// [`PanoramaError`]: fewer than two photographs fit together, or the canvas would be too large.
pub fn panorama<T: PhotoSample>(
    photos: &[PanoramaPhoto<'_, T>],
    options: &PanoramaOptions,
    progress: &dyn Progress,
) -> Result<PanoramaResult<T>, PanoramaError> {
    let views: Vec<_> = photos.iter().map(|photo| photo.image).collect();
    let registered = {
        let eight_bits = EightBits::new(&views, "features", progress)?;
        let bytes = eight_bits.views().into_iter().zip(photos);
        let bytes: Vec<_> = bytes.map(|(image, p)| PanoramaPhoto { image, focal: p.focal, camera: p.camera }).collect();
        register(&bytes, options, progress)?
    };
    composite(&views, registered, &options.render, progress)
}

/// The registration of the photographs, before compositing.
struct Registered {
    alignment: Alignment,
    images: Vec<PanoramaImage>,
    pairs: Vec<PanoramaPair>,
    features: Vec<Features>,
    clock: StageClock,
}

/// Registers photographs by their features.
fn register(
    photos: &[PanoramaPhoto<'_>],
    options: &PanoramaOptions,
    progress: &dyn Progress,
) -> Result<Registered, PanoramaError> {
    let mut clock = StageClock::new();
    let n = photos.len();
    let candidates: Vec<(usize, usize)> = (0..n).flat_map(|a| (a + 1..n).map(move |b| (a, b))).collect();
    let mut match_all =
        |matching: &MatchingOptions| -> Result<(Vec<PreparedPhoto>, Vec<Option<MatchedPair>>), Cancelled> {
            let stage = Stage::new(progress, "features", n)?;
            let extract = |p| -> Result<PreparedPhoto, Cancelled> {
                let prepared = PreparedPhoto::new(p, matching, options.registration_pixels, &stage)?;
                stage.add(1)?;
                Ok(prepared)
            };
            let prepared: Vec<PreparedPhoto> = photos.par_iter().map(extract).collect::<Result<_, _>>()?;
            clock.lap("features");
            let stage = Stage::new(progress, "match", candidates.len())?;
            let compare = |&(a, b): &(usize, usize)| -> Result<Option<MatchedPair>, Cancelled> {
                let pair = match_pair(&prepared, a, b, options, &stage)?;
                stage.add(1)?;
                Ok(pair)
            };
            let matched = candidates.par_iter().map(compare).collect::<Result<_, _>>()?;
            clock.lap("match");
            Ok((prepared, matched))
        };
    let matching = &options.matching;
    // The upsampled image takes most of the time of SIFT, and faint features are less accurate; both are rarely needed.
    let plain = match &matching.features {
        FeatureOptions::Sift(sift) if sift.upsample => {
            let features = FeatureOptions::Sift(SiftOptions { upsample: false, min_features: 0, ..sift.clone() });
            Some(MatchingOptions { features, ..matching.clone() })
        }
        _ => None,
    };
    let (mut prepared, mut matched) = match_all(plain.as_ref().unwrap_or(matching))?;
    if plain.is_some() && !is_firmly_connected(n, &matched) {
        (prepared, matched) = match_all(matching)?;
    }
    let (pairs, verified): (Vec<PanoramaPair>, Vec<Option<VerifiedPair>>) = matched.into_iter().flatten().unzip();
    let verified: Vec<VerifiedPair> = verified.into_iter().flatten().collect();
    let cameras: Vec<Photo> = prepared.iter().map(|p| p.photo).collect();
    let alignment = match align(&cameras, &verified, &options.align, progress) {
        Ok(alignment) => alignment,
        Err(AlignError::Cancelled(stop)) => return Err(stop.into()),
        Err(source) => {
            let views = vec![Err(Unplaced::NoOverlap); n];
            return Err(PanoramaError::Align { source, images: image_reports(&prepared, &views, &pairs) });
        }
    };
    let mut images = image_reports(&prepared, &alignment.views, &pairs);
    let sizes: Vec<_> = prepared.iter().zip(photos).map(|(p, photo)| (p.factor, photo.image.size())).collect();
    for (image, (_, size)) in images.iter_mut().zip(&sizes) {
        image.size = *size;
    }
    let alignment = alignment.resized(&sizes);
    clock.lap("align");
    let features = prepared.into_iter().map(PreparedPhoto::into_features).collect();
    Ok(Registered { alignment, images, pairs, features, clock })
}

/// Stitches photographs with a known alignment: the next frames of a rig, or another exposure of the same views.
///
/// As [`panorama`] without features, matching and alignment. Exposure compensation, seams and local deformations are computed from these photographs, so that
/// the registered photographs give the same bytes again. Number, sizes and order must be those of the registration.
///
/// # Errors
/// [`PanoramaError`]: the photographs do not match the registration, or the canvas would be too large.
pub fn panorama_with<T: PhotoSample>(
    registration: &Registration,
    photos: &[ImageView<'_, T, 3>],
    options: &CompositingOptions,
    progress: &dyn Progress,
) -> Result<PanoramaResult<T>, PanoramaError> {
    let sizes: Vec<_> = photos.iter().map(ImageView::size).collect();
    registration.check_photographs(&sizes)?;
    let alignment = registration.alignment();
    let images = alignment.views.iter().zip(&sizes).map(|(view, &size)| PanoramaImage {
        size,
        used: view.is_ok(),
        reason: view.as_ref().err().map(|why| match *why {
            Unplaced::NoOverlap => LeftOut::NoOverlap { nearest: None },
            Unplaced::OtherComponent { size } => LeftOut::OtherComponent { size },
            Unplaced::Inconsistent => LeftOut::Inconsistent,
        }),
        features: 0,
        focal: None,
        gain: [1.0; 3],
    });
    let images = images.collect();
    let registered =
        Registered { alignment, images, pairs: Vec::new(), features: Vec::new(), clock: StageClock::new() };
    composite(photos, registered, options, progress)
}

/// Composites the panorama and assembles the result.
fn composite<T: PhotoSample>(
    photos: &[ImageView<'_, T, 3>],
    registered: Registered,
    options: &CompositingOptions,
    progress: &dyn Progress,
) -> Result<PanoramaResult<T>, PanoramaError> {
    let Registered { alignment, mut images, pairs, features, mut clock } = registered;
    for (image, view) in images.iter_mut().zip(&alignment.views) {
        image.focal = view.as_ref().ok().filter(|_| alignment.motion == CameraMotion::Rotation).map(|v| v.camera.fx);
    }
    let rendered = render(photos, &alignment, options, progress)?;
    for (image, gain) in images.iter_mut().zip(&rendered.gains.gains) {
        image.gain = *gain;
    }
    for (stage, seconds) in &rendered.stages {
        clock.add(stage, *seconds);
    }
    Ok(PanoramaResult {
        image: rendered.image,
        radiance: rendered.radiance,
        mask: rendered.mask,
        labels: rendered.labels,
        images,
        pairs,
        features,
        canvas: rendered.canvas,
        map: rendered.map,
        reaches_beyond: rendered.reaches_beyond,
        reprojection_rms_px: alignment.rms_px,
        alignment,
        stages: clock.into_stages(),
    })
}

/// A photograph prepared for matching.
struct PreparedPhoto {
    /// In pixels of the reduced photograph.
    photo: Photo,
    /// Ratio of the full to the reduced size.
    factor: f64,
    features: Features,
    /// Why it has no features.
    failure: Option<FeatureError>,
}

impl PreparedPhoto {
    fn new(
        p: &PanoramaPhoto<'_>,
        matching: &MatchingOptions,
        registration_pixels: usize,
        progress: &dyn Progress,
    ) -> Result<Self, Cancelled> {
        let (w, h) = p.image.size();
        let factor = ((w * h) as f64 / registration_pixels.max(10_000) as f64).sqrt().max(1.0);
        let size = ((w as f64 / factor).round() as usize, (h as f64 / factor).round() as usize);
        let reduced = (factor > 1.2).then(|| cv_imgproc::resize_area(p.image, size.0, size.1).ok()).flatten();
        let (image, factor) = match &reduced {
            Some(small) => (small.view(), w as f64 / size.0 as f64),
            None => (p.image, 1.0),
        };
        let (features, failure) = match extract_features(image, &matching.features, progress) {
            Ok(features) => (features, None),
            Err(FeatureError::Cancelled(stop)) => return Err(stop),
            Err(error) => (Features::new(matching.features.extractor().kind()), Some(error)),
        };
        let (width, height) = image.size();
        let camera = p.camera.map(|c| Camera { width, height, ..c.scaled(1.0 / factor) });
        let photo = Photo { width, height, focal: p.focal.map(|f| f / factor), camera };
        Ok(Self { photo, factor, features, failure })
    }

    /// Returns the features in pixels of the full photograph.
    fn into_features(mut self) -> Features {
        rescale(&mut self.features, Scaling::uniform(self.factor));
        self.features
    }
}

/// A matched pair, and its verification if it succeeded.
type MatchedPair = (PanoramaPair, Option<VerifiedPair>);

/// Number of inliers of a firm connection. On sixteen rendered sets, with 66 and more inliers, neighbors are aligned within 0.16 px (median 0.08 px at 480
/// px, 0.05 px at 800 px); upsampled SIFT halves that at twice the time.
const FIRM_INLIERS: usize = 50;

/// Returns whether firm pairs connect all photographs.
fn is_firmly_connected(n: usize, pairs: &[Option<MatchedPair>]) -> bool {
    let verified = pairs.iter().flatten().filter_map(|(_, verified)| verified.as_ref());
    let firm = verified.filter(|v| v.inliers.len() >= FIRM_INLIERS);
    let mut sets = UnionFind::new(n);
    firm.filter(|v| sets.union(v.a as u32, v.b as u32)).count() + 1 >= n
}

/// Matches and verifies a pair; `None` if one has no features.
fn match_pair(
    prepared: &[PreparedPhoto],
    a: usize,
    b: usize,
    options: &PanoramaOptions,
    progress: &dyn Progress,
) -> Result<Option<MatchedPair>, Cancelled> {
    let (p, q) = (&prepared[a], &prepared[b]);
    let matches = match match_features(&p.features, &q.features, &options.matching, progress) {
        Ok(matches) => matches,
        Err(MatchError::Cancelled(stop)) => return Err(stop),
        Err(_) => return Ok(None),
    };
    let pixels = correspondences(&p.features, &q.features, &matches);
    let size = |p: &PreparedPhoto| (p.photo.width, p.photo.height);
    let verified = verify_pair((a, size(p)), (b, size(q)), &pixels, &options.verify);
    let (verified, rejected) = match verified {
        Ok(pair) => (Some(pair), None),
        Err(reason) => (None, Some(reason)),
    };
    let inliers = verified.as_ref().map(|v| v.inliers.clone()).unwrap_or_default();
    Ok(Some((PanoramaPair { a, b, matches, inliers, rejected }, verified)))
}

/// Assembles the results for each photograph.
fn image_reports(
    prepared: &[PreparedPhoto],
    views: &[Result<cv_panorama::View, Unplaced>],
    pairs: &[PanoramaPair],
) -> Vec<PanoramaImage> {
    let nearest = |i: usize| {
        let rejected = |p: &PanoramaPair| match p.rejected {
            Some(PairRejection::TooFewInliers { inliers: agree, in_overlap, needed }) if p.a == i || p.b == i => {
                Some(NearestPair { other: if p.a == i { p.b } else { p.a }, agree, in_overlap, needed })
            }
            _ => None,
        };
        pairs.iter().filter_map(rejected).max_by_key(|rejected| rejected.agree)
    };
    let reason = |i: usize, why: Unplaced| match (why, &prepared[i].failure) {
        (_, Some(failure)) => LeftOut::Features(*failure),
        (Unplaced::OtherComponent { size }, _) => LeftOut::OtherComponent { size },
        (Unplaced::Inconsistent, _) => LeftOut::Inconsistent,
        (Unplaced::NoOverlap, _) if prepared[i].features.keypoints.is_empty() => LeftOut::NoFeatures,
        (Unplaced::NoOverlap, _) => LeftOut::NoOverlap { nearest: nearest(i) },
    };
    views
        .iter()
        .enumerate()
        .map(|(i, view)| PanoramaImage {
            size: (prepared[i].photo.width, prepared[i].photo.height),
            used: view.is_ok(),
            reason: view.as_ref().err().map(|why| reason(i, *why)),
            features: prepared[i].features.keypoints.len(),
            focal: None,
            gain: [1.0; 3],
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Matrix3;

    #[test]
    fn photographs_are_firmly_connected_if_firm_pairs_connect_them_all() {
        let link = |a: usize, b: usize, agree: usize| {
            let pair = PanoramaPair { a, b, matches: Vec::new(), inliers: Vec::new(), rejected: None };
            let (inliers, matches) = ((0..agree).collect(), vec![Correspondence::new(0.0, 0.0, 0.0, 0.0); agree]);
            Some((pair, Some(VerifiedPair { a, b, homography: Matrix3::identity(), inliers, matches })))
        };
        let rejected = || {
            let pair = PanoramaPair { a: 0, b: 1, matches: Vec::new(), inliers: Vec::new(), rejected: None };
            Some((pair, None))
        };
        assert!(is_firmly_connected(0, &[]) && is_firmly_connected(1, &[]));
        assert!(!is_firmly_connected(2, &[None]) && !is_firmly_connected(2, &[rejected()]));
        assert!(is_firmly_connected(3, &[link(1, 2, FIRM_INLIERS), None, link(0, 2, FIRM_INLIERS), link(0, 1, 9)]));
        // Two firm pairs and a loose pair between them.
        assert!(!is_firmly_connected(4, &[link(2, 3, FIRM_INLIERS), link(0, 1, 900), link(0, 2, FIRM_INLIERS - 1)]));
    }
}
