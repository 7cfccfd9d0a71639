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
    /// The pixels, upright, of `u8` or `u16` samples.
    pub image: ImageView<'a, T, 3>,
    /// Focal length in pixels from EXIF, where there is one.
    pub focal: Option<f64>,
    /// The calibrated camera, where there is one; its lens distortion is taken out.
    pub camera: Option<Camera>,
}

impl<'a, T> PanoramaPhoto<'a, T> {
    /// A photograph of which nothing else is known.
    pub fn new(image: ImageView<'a, T, 3>) -> Self {
        Self { image, focal: None, camera: None }
    }
}

/// Settings of [`panorama`].
#[derive(Debug, Clone)]
pub struct PanoramaOptions {
    /// Features and matching. SIFT starts from the enlarged image ([`SiftOptions::upsample`]) and takes faint features ([`SiftOptions::min_features`]) only where the features of the plain one do not hold the photographs
    /// together firmly.
    pub matching: MatchingOptions,
    /// Pixels that photographs are reduced to (about) for features and alignment. 10,000 or more; default 800,000, in the range that OpenCV's stitcher
    /// and Hugin's control point finders use.
    pub registration_pixels: usize,
    /// Which pairs overlap. The threshold is in pixels of the reduced photographs.
    pub verify: VerifyOptions,
    /// Alignment. `outlier_px` is in pixels of the reduced photographs.
    pub align: AlignOptions,
    /// Drawing.
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
    /// A method's options as panoramas want them: 2000 features at most, and faint ones where strong ones are few, as in a photograph that is two stops too dark.
    /// [`panorama`] looks for those only where the photographs do not hang together firmly without.
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
    /// Features could not be looked for on it.
    Features(FeatureError),
    /// No features were found on it.
    NoFeatures,
    /// It overlaps no other photograph.
    NoOverlap {
        /// The pair with another photograph that came nearest to being one, where one came near.
        nearest: Option<NearestPair>,
    },
    /// It overlaps only photographs that do not overlap those of the panorama.
    OtherComponent {
        /// Photographs in that group, itself included.
        size: usize,
    },
    /// Its overlaps contradict those of the other photographs.
    Inconsistent,
}

/// A pair of photographs of which too few matches agree.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct NearestPair {
    /// The other photograph.
    pub other: usize,
    /// Matches that agree.
    pub agree: usize,
    /// Matches where the two photographs overlap by the homography.
    pub in_overlap: usize,
    /// The number that chance explains; more would have to agree.
    pub needed: f64,
}

/// What became of a photograph.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct PanoramaImage {
    /// Width and height in pixels.
    pub size: (usize, usize),
    /// Whether it is in the panorama.
    pub used: bool,
    /// Why not, where it is not.
    pub reason: Option<LeftOut>,
    /// Features found on it; 0 where nobody looked for any ([`panorama_with`]).
    pub features: usize,
    /// Its focal length in pixels, where it is used.
    pub focal: Option<f64>,
    /// What its red, green and blue light was multiplied with.
    pub gain: [f32; 3],
}

/// What became of a pair of photographs.
#[derive(Debug, Clone, PartialEq)]
pub struct PanoramaPair {
    /// First photograph.
    pub a: usize,
    /// Second photograph.
    pub b: usize,
    /// Tentative matches, by the indices of the two photographs' features; see [`PanoramaResult::correspondences`].
    pub matches: Vec<DMatch>,
    /// Indices of those that agree with a common homography, ascending; none where the pair was rejected.
    pub inliers: Vec<usize>,
    /// Why the pair was rejected.
    pub rejected: Option<PairRejection>,
}

/// A panorama and how it came about.
#[derive(Debug, Clone)]
pub struct PanoramaResult<T = u8> {
    /// The picture, as deep as the photographs; black where no photograph reaches.
    pub image: Image<T, 3>,
    /// The light of the scene, linear, where [`CompositingOptions::radiance`] asks for it; 1 is the white of the photograph that all others are aligned to.
    pub radiance: Option<RgbF32>,
    /// True where a photograph reaches.
    pub mask: Mask,
    /// Which photograph each pixel is from; `u16::MAX` where none reaches.
    pub labels: Image<u16, 1>,
    /// One entry per input.
    pub images: Vec<PanoramaImage>,
    /// All pairs that had matches; none of [`panorama_with`].
    pub pairs: Vec<PanoramaPair>,
    /// Features of each photograph, in its own pixels; none of [`panorama_with`].
    pub features: Vec<Features>,
    /// The views, in full size.
    pub alignment: Alignment,
    /// The surface drawn on, and where each pixel of the picture looks.
    pub canvas: Canvas,
    /// Where in its photograph each pixel of the picture comes from.
    pub map: PhotoMap,
    /// Whether photographs reach beyond what the surface draws at the most, and no field of view was asked for.
    pub reaches_beyond: bool,
    /// Root mean square error of all matches of all overlaps, in pixels of the photographs.
    pub reprojection_rms_px: f64,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Share of a photograph's longer side by which matches disagree when the camera clearly moved: 5 px of 1,000. Features are good to a pixel or two; parallax
/// is what is left.
const PARALLAX: f64 = 0.005;

impl<T> PanoramaResult<T> {
    /// Where the matches of a pair are, in pixels of the photographs.
    ///
    /// # Panics
    /// For a pair of another panorama.
    pub fn correspondences(&self, pair: &PanoramaPair) -> Vec<Correspondence> {
        correspondences(&self.features[pair.a], &self.features[pair.b], &pair.matches)
    }

    /// Where the photographs look, for others of the same views; `names` are those of the photographs, as many as are known.
    ///
    /// # Errors
    /// [`RegistrationError`] where a camera or a matrix is out of the range that registrations take.
    pub fn registration(&self, names: &[String]) -> Result<Registration, RegistrationError> {
        let sizes: Vec<_> = self.images.iter().map(|image| image.size).collect();
        Registration::new(&self.alignment, &sizes, names)
    }

    /// Whether the photographs fit each other so badly that they must have been taken from different places: what is near may then be cut in two at the seams.
    pub fn shows_parallax(&self) -> bool {
        let longest = self.alignment.used().map(|(_, view)| view.camera.width.max(view.camera.height)).max();
        self.reprojection_rms_px > PARALLAX * longest.unwrap_or(0) as f64
    }
}

/// Why there is no panorama.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum PanoramaError {
    /// The photographs could not be aligned. `images` says for each what is the matter with it.
    #[error("{source}")]
    Align {
        /// Why.
        source: AlignError,
        /// One entry per input.
        images: Vec<PanoramaImage>,
    },
    /// The photographs are not as they were registered.
    #[error(transparent)]
    Registration(#[from] RegistrationError),
    /// The panorama could not be drawn.
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

/// Joins overlapping photographs, in any order, to a panorama.
///
/// Features on reduced photographs, matches of every pair, verification of the pairs (all of it again with finer features where some hold only loosely),
/// alignment of all at once, drawing in full size. Photographs that do not belong are left out and say why. They are of `u8` or of `u16` samples, and so is the panorama; where they belong
/// is found on 8 bits of them.
///
/// # Errors
/// [`PanoramaError`]: fewer than two photographs belong together, or the canvas would be too large.
pub fn panorama<T: PhotoSample>(
    photos: &[PanoramaPhoto<'_, T>],
    options: &PanoramaOptions,
    progress: &dyn Progress,
) -> Result<PanoramaResult<T>, PanoramaError> {
    let views: Vec<_> = photos.iter().map(|photo| photo.image).collect();
    let found = {
        let eight = EightBits::new(&views, "features", progress)?;
        let bytes = eight.views().into_iter().zip(photos);
        let bytes: Vec<_> = bytes.map(|(image, p)| PanoramaPhoto { image, focal: p.focal, camera: p.camera }).collect();
        register(&bytes, options, progress)?
    };
    draw(&views, found, &options.render, progress)
}

/// What is known of photographs before the panorama is drawn.
struct Registered {
    alignment: Alignment,
    images: Vec<PanoramaImage>,
    pairs: Vec<PanoramaPair>,
    features: Vec<Features>,
    clock: StageClock,
}

/// Where photographs belong, from their features.
fn register(
    photos: &[PanoramaPhoto<'_>],
    options: &PanoramaOptions,
    progress: &dyn Progress,
) -> Result<Registered, PanoramaError> {
    let mut clock = StageClock::new();
    let n = photos.len();
    let candidates: Vec<(usize, usize)> = (0..n).flat_map(|a| (a + 1..n).map(move |b| (a, b))).collect();
    let mut look = |matching: &MatchingOptions| -> Result<(Vec<Prepared>, Vec<Option<Tried>>), Cancelled> {
        let stage = Stage::new(progress, "features", n)?;
        let extract = |p| -> Result<Prepared, Cancelled> {
            let prepared = Prepared::new(p, matching, options.registration_pixels, &stage)?;
            stage.add(1)?;
            Ok(prepared)
        };
        let prepared: Vec<Prepared> = photos.par_iter().map(extract).collect::<Result<_, _>>()?;
        clock.lap("features");
        let stage = Stage::new(progress, "match", candidates.len())?;
        let compare = |&(a, b): &(usize, usize)| -> Result<Option<Tried>, Cancelled> {
            let pair = try_pair(&prepared, a, b, options, &stage)?;
            stage.add(1)?;
            Ok(pair)
        };
        let tried = candidates.par_iter().map(compare).collect::<Result<_, _>>()?;
        clock.lap("match");
        Ok((prepared, tried))
    };
    let matching = &options.matching;
    // The enlarged image is most of the work of SIFT, faint features are less exact: both are seldom needed.
    let plain = match &matching.features {
        FeatureOptions::Sift(sift) if sift.upsample => {
            let features = FeatureOptions::Sift(SiftOptions { upsample: false, min_features: 0, ..sift.clone() });
            Some(MatchingOptions { features, ..matching.clone() })
        }
        _ => None,
    };
    let (mut prepared, mut tried) = look(plain.as_ref().unwrap_or(matching))?;
    if plain.is_some() && !held_firmly(n, &tried) {
        (prepared, tried) = look(matching)?;
    }
    let (pairs, verified): (Vec<PanoramaPair>, Vec<Option<VerifiedPair>>) = tried.into_iter().flatten().unzip();
    let verified: Vec<VerifiedPair> = verified.into_iter().flatten().collect();
    let known: Vec<Photo> = prepared.iter().map(|p| p.photo).collect();
    let alignment = match align(&known, &verified, &options.align, progress) {
        Ok(alignment) => alignment,
        Err(AlignError::Cancelled(stop)) => return Err(stop.into()),
        Err(source) => {
            let views = vec![Err(Unplaced::NoOverlap); n];
            return Err(PanoramaError::Align { source, images: describe(&prepared, &views, &pairs) });
        }
    };
    let mut images = describe(&prepared, &alignment.views, &pairs);
    let sizes: Vec<_> = prepared.iter().zip(photos).map(|(p, photo)| (p.factor, photo.image.size())).collect();
    for (image, (_, size)) in images.iter_mut().zip(&sizes) {
        image.size = *size;
    }
    let alignment = alignment.resized(&sizes);
    clock.lap("align");
    let features = prepared.into_iter().map(Prepared::into_features).collect();
    Ok(Registered { alignment, images, pairs, features, clock })
}

/// Joins photographs whose views are known from others: the next frames of a rig, another exposure of the same views.
///
/// As [`panorama`] without features, matches and alignment; light, seams and local deformations are those of these photographs, so that the photographs that were registered give the same bytes
/// again. As many photographs, of the same sizes, in the same order.
///
/// # Errors
/// [`PanoramaError`]: the photographs are not as registered, or the canvas would be too large.
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
    let found = Registered { alignment, images, pairs: Vec::new(), features: Vec::new(), clock: StageClock::new() };
    draw(photos, found, options, progress)
}

/// The picture, and what is to be told of it.
fn draw<T: PhotoSample>(
    photos: &[ImageView<'_, T, 3>],
    found: Registered,
    options: &CompositingOptions,
    progress: &dyn Progress,
) -> Result<PanoramaResult<T>, PanoramaError> {
    let Registered { alignment, mut images, pairs, features, mut clock } = found;
    for (image, view) in images.iter_mut().zip(&alignment.views) {
        image.focal = view.as_ref().ok().filter(|_| alignment.motion == CameraMotion::Rotation).map(|v| v.camera.fx);
    }
    let drawn = render(photos, &alignment, options, progress)?;
    for (image, gain) in images.iter_mut().zip(&drawn.gains.gains) {
        image.gain = *gain;
    }
    for (stage, seconds) in &drawn.stages {
        clock.add(stage, *seconds);
    }
    Ok(PanoramaResult {
        image: drawn.image,
        radiance: drawn.radiance,
        mask: drawn.mask,
        labels: drawn.labels,
        images,
        pairs,
        features,
        canvas: drawn.canvas,
        map: drawn.map,
        reaches_beyond: drawn.reaches_beyond,
        reprojection_rms_px: alignment.rms_px,
        alignment,
        stages: clock.into_stages(),
    })
}

/// A photograph ready to be matched.
struct Prepared {
    /// In pixels of the reduced photograph.
    photo: Photo,
    /// Size of the photograph over that of the reduced one.
    factor: f64,
    features: Features,
    /// Why it has no features.
    failure: Option<FeatureError>,
}

impl Prepared {
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

    /// In pixels of the photograph.
    fn into_features(mut self) -> Features {
        rescale(&mut self.features, Scaling::uniform(self.factor));
        self.features
    }
}

/// A pair that was matched, and what verification left of it.
type Tried = (PanoramaPair, Option<VerifiedPair>);

/// Agreeing matches that hold two photographs together firmly. On sixteen rendered sets, whose links had 66 and more, neighbors then lie within 0.16 px of the
/// truth (0.08 px median at 480 px, 0.05 px at 800 px); with those of the enlarged image too, within 0.08 px (0.04 px median), at twice the time for features.
const FIRM: usize = 50;

/// Whether all photographs hang together by links that are firm.
fn held_firmly(n: usize, tried: &[Option<Tried>]) -> bool {
    let verified = tried.iter().flatten().filter_map(|(_, verified)| verified.as_ref());
    let firm = verified.filter(|v| v.inliers.len() >= FIRM);
    let mut sets = UnionFind::new(n);
    firm.filter(|v| sets.union(v.a as u32, v.b as u32)).count() + 1 >= n
}

/// Matches and verifies a pair; `None` where one has no features.
fn try_pair(
    prepared: &[Prepared],
    a: usize,
    b: usize,
    options: &PanoramaOptions,
    progress: &dyn Progress,
) -> Result<Option<Tried>, Cancelled> {
    let (p, q) = (&prepared[a], &prepared[b]);
    let matches = match match_features(&p.features, &q.features, &options.matching, progress) {
        Ok(matches) => matches,
        Err(MatchError::Cancelled(stop)) => return Err(stop),
        Err(_) => return Ok(None),
    };
    let pixels = correspondences(&p.features, &q.features, &matches);
    let size = |p: &Prepared| (p.photo.width, p.photo.height);
    let verified = verify_pair((a, size(p)), (b, size(q)), &pixels, &options.verify);
    let (verified, rejected) = match verified {
        Ok(pair) => (Some(pair), None),
        Err(reason) => (None, Some(reason)),
    };
    let inliers = verified.as_ref().map(|v| v.inliers.clone()).unwrap_or_default();
    Ok(Some((PanoramaPair { a, b, matches, inliers, rejected }, verified)))
}

/// What to tell about each photograph.
fn describe(
    prepared: &[Prepared],
    views: &[Result<cv_panorama::View, Unplaced>],
    pairs: &[PanoramaPair],
) -> Vec<PanoramaImage> {
    let nearest = |i: usize| {
        let miss = |p: &PanoramaPair| match p.rejected {
            Some(PairRejection::TooFewInliers { inliers: agree, in_overlap, needed }) if p.a == i || p.b == i => {
                Some(NearestPair { other: if p.a == i { p.b } else { p.a }, agree, in_overlap, needed })
            }
            _ => None,
        };
        pairs.iter().filter_map(miss).max_by_key(|miss| miss.agree)
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
    fn photographs_hold_firmly_where_firm_links_connect_them_all() {
        let link = |a: usize, b: usize, agree: usize| {
            let pair = PanoramaPair { a, b, matches: Vec::new(), inliers: Vec::new(), rejected: None };
            let (inliers, matches) = ((0..agree).collect(), vec![Correspondence::new(0.0, 0.0, 0.0, 0.0); agree]);
            Some((pair, Some(VerifiedPair { a, b, homography: Matrix3::identity(), inliers, matches })))
        };
        let rejected = || {
            let pair = PanoramaPair { a: 0, b: 1, matches: Vec::new(), inliers: Vec::new(), rejected: None };
            Some((pair, None))
        };
        assert!(held_firmly(0, &[]) && held_firmly(1, &[]));
        assert!(!held_firmly(2, &[None]) && !held_firmly(2, &[rejected()]));
        assert!(held_firmly(3, &[link(1, 2, FIRM), None, link(0, 2, FIRM), link(0, 1, 9)]));
        // Two firm pairs and a loose link between them.
        assert!(!held_firmly(4, &[link(2, 3, FIRM), link(0, 1, 900), link(0, 2, FIRM - 1)]));
    }
}
