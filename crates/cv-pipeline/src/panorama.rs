//! The panorama job: features, matching, alignment and compositing.

mod masked;
mod order;
mod register;
mod streamed;

pub use masked::panorama_with_masks;
pub use streamed::{PanoramaPrior, panorama_streamed};

use crate::Progress;
use crate::matching::{MatchingOptions, correspondences};
use cv_core::{Camera, Cancelled, Correspondence, DMatch, Image, ImageView, Mask, RgbF32, StageClock};
use cv_features::{FeatureError, FeatureOptions, Features, SiftOptions};
use cv_panorama::{
    AlignError, AlignOptions, Alignment, CameraMotion, Canvas, CompositingOptions, EightBits, PairRejection, Panorama,
    PhotoMap, PhotoMask, PhotoSample, Registration, RegistrationError, RenderError, Unplaced, VerifyOptions,
    check_masks, render_masked,
};
use order::Order;
use register::{Registered, register};

/// A photograph and prior knowledge of its camera.
#[derive(Debug, Clone, Copy)]
pub struct PanoramaPhoto<'a, T = u8> {
    /// The pixels, upright, of `u8` or `u16` samples.
    pub image: ImageView<'a, T, 3>,
    /// Focal length in pixels from EXIF, where there is one.
    pub focal: Option<f64>,
    /// The calibrated camera, where there is one; kept constant, and its distortion is corrected.
    pub camera: Option<Camera>,
    /// Which parts must be in the panorama and which must not, where there is a mask; of the size of the photograph. Features of removed parts are not matched.
    pub mask: Option<&'a PhotoMask>,
}

impl<'a, T> PanoramaPhoto<'a, T> {
    /// Creates a photograph of an unknown camera.
    pub fn new(image: ImageView<'a, T, 3>) -> Self {
        Self { image, focal: None, camera: None, mask: None }
    }
}

/// Settings of [`panorama`].
#[derive(Debug, Clone)]
pub struct PanoramaOptions {
    /// Features and matching. SIFT uses all of `registration_pixels`, the upsampled octave ([`SiftOptions::upsample`]) and low-contrast features ([`SiftOptions::min_features`]) only where the
    /// photographs are not connected by enough inliers with half of the pixels and without the others.
    pub matching: MatchingOptions,
    /// Approximate number of pixels to which photographs are resized for features and alignment, where inliers are localized by least-squares matching. 10,000 or more; default 800,000,
    /// similar to OpenCV's stitcher and Hugin's control point finders.
    pub registration_pixels: usize,
    /// Verification of pairs. The threshold is in pixels of the resized photographs.
    pub verify: VerifyOptions,
    /// Alignment. `outlier_px` is in pixels of the resized photographs.
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
    /// Adapts a method's options to panoramas: at most 2000 features, and low-contrast ones where there are few, as in a photograph underexposed by two stops.
    /// [`panorama`] uses those only where the photographs are not connected by enough inliers without.
    pub fn features(method: FeatureOptions) -> FeatureOptions {
        match method.at_most(2000) {
            FeatureOptions::Sift(sift) => {
                FeatureOptions::Sift(SiftOptions { min_features: 600, faint_contrast: 0.006, ..sift })
            }
            other => other,
        }
    }
}

/// Why a photograph is not registered.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum LeftOut {
    /// Feature extraction failed.
    Features(FeatureError),
    /// It has no features.
    NoFeatures,
    /// It has no verified pair.
    NoOverlap {
        /// The rejected pair with the most inliers, if any.
        nearest: Option<NearestPair>,
    },
    /// It belongs to a smaller connected component of the match graph.
    OtherComponent {
        /// Photographs in that component, itself included.
        size: usize,
    },
    /// Its pairs are inconsistent with those of the other photographs.
    Inconsistent,
}

/// A pair rejected for too few inliers.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct NearestPair {
    /// The other photograph.
    pub other: usize,
    /// Number of inliers.
    pub agree: usize,
    /// Number of matches inside the overlap by the homography.
    pub in_overlap: usize,
    /// Number of inliers expected by chance, which must be exceeded.
    pub needed: f64,
}

/// Result for one photograph.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub struct PanoramaImage {
    /// Width and height in pixels.
    pub size: (usize, usize),
    /// Whether it is registered.
    pub used: bool,
    /// Why it is not registered.
    pub reason: Option<LeftOut>,
    /// Number of features; 0 for [`panorama_with`].
    pub features: usize,
    /// Focal length in pixels, where it is registered.
    pub focal: Option<f64>,
    /// Factors on its linear red, green and blue.
    pub gain: [f32; 3],
}

/// Result for one pair of photographs.
#[derive(Debug, Clone, PartialEq)]
pub struct PanoramaPair {
    /// First photograph.
    pub a: usize,
    /// Second photograph.
    pub b: usize,
    /// Tentative matches, by the indices of the two photographs' features; see [`PanoramaResult::correspondences`].
    pub matches: Vec<DMatch>,
    /// Indices of the inliers of the homography, ascending; empty where the pair was rejected.
    pub inliers: Vec<usize>,
    /// Why the pair was rejected.
    pub rejected: Option<PairRejection>,
}

/// A panorama with its registration and matches.
#[derive(Debug, Clone)]
pub struct PanoramaResult<T = u8> {
    /// Width and height in pixels.
    pub size: (usize, usize),
    /// The image, of the bit depth of the photographs; black where no photograph covers it. As `mask` and `labels`, empty where the panorama was
    /// [streamed](panorama_streamed).
    pub image: Image<T, 3>,
    /// Linear scene radiance, if requested by [`CompositingOptions::radiance`]; 1 is white in the reference photograph.
    pub radiance: Option<RgbF32>,
    /// True where a photograph covers the pixel.
    pub mask: Mask,
    /// Index of the photograph of each pixel; `u16::MAX` where none covers it.
    pub labels: Image<u16, 1>,
    /// One entry per input.
    pub images: Vec<PanoramaImage>,
    /// The matched pairs: of large sets only similar photographs, and without those rejected before a second matching with more features. Empty for
    /// [`panorama_with`].
    pub pairs: Vec<PanoramaPair>,
    /// Features of each photograph, in its own pixels; empty for [`panorama_with`].
    pub features: Vec<Features>,
    /// The alignment of the photographs at full size.
    pub alignment: Alignment,
    /// Projection geometry.
    pub canvas: Canvas,
    /// Map from panorama pixels to photograph pixels.
    pub map: PhotoMap,
    /// Whether photographs extend beyond the maximum field of view of the projection and none was requested.
    pub reaches_beyond: bool,
    /// Root mean square transfer error of all matches, in pixels of the photographs.
    pub reprojection_rms_px: f64,
    /// Exposure brackets ([`Panorama::stacks`]).
    pub stacks: Vec<Vec<usize>>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Root mean square transfer error, relative to the longer side of a photograph, above which parallax is reported: 5 px of 1,000.
const MIN_PARALLAX_RATIO: f64 = 0.005;

impl<T> PanoramaResult<T> {
    /// Returns the positions of the matches of a pair, in pixels of the photographs.
    ///
    /// # Panics
    /// For a pair of another panorama.
    pub fn correspondences(&self, pair: &PanoramaPair) -> Vec<Correspondence> {
        correspondences(&self.features[pair.a], &self.features[pair.b], &pair.matches)
    }

    /// Returns the registration for other photographs of the same cameras; `names` are those of the photographs, possibly fewer.
    ///
    /// # Errors
    /// [`RegistrationError`] where a parameter is out of range.
    pub fn registration(&self, names: &[String]) -> Result<Registration, RegistrationError> {
        let sizes: Vec<_> = self.images.iter().map(|image| image.size).collect();
        Registration::new(&self.alignment, &sizes, names)
    }

    /// Returns whether the residuals show parallax: the camera moved, and near objects may be cut at the seams.
    pub fn shows_parallax(&self) -> bool {
        let longest = self.alignment.used().map(|(_, view)| view.camera.width.max(view.camera.height)).max();
        self.reprojection_rms_px > MIN_PARALLAX_RATIO * longest.unwrap_or(0) as f64
    }
}

/// Why there is no panorama.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum PanoramaError {
    /// The photographs could not be aligned. `images` has the reason for each.
    #[error("{source}")]
    Align {
        /// Why.
        source: AlignError,
        /// One entry per input.
        images: Vec<PanoramaImage>,
    },
    /// The photographs do not fit the registration.
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
/// Extracts features on resized photographs, matches and verifies all pairs (in sets of more than 41 photographs the 20 most similar ones of each, and those between photographs that are
/// not connected; repeated with more features where the connections are weak), aligns by bundle adjustment, and composites at full size. Photographs without a consistent pair are left out with the reason. The panorama has the sample type of the photographs, `u8` or `u16`; alignment uses 8 bits.
///
/// # Errors
/// [`PanoramaError`]: fewer than two photographs belong together, or the canvas would be too large.
pub fn panorama<T: PhotoSample>(
    photos: &[PanoramaPhoto<'_, T>],
    options: &PanoramaOptions,
    progress: &dyn Progress,
) -> Result<PanoramaResult<T>, PanoramaError> {
    let views: Vec<_> = photos.iter().map(|photo| photo.image).collect();
    let masks: Vec<_> = photos.iter().map(|photo| photo.mask).collect();
    check_masks(|index| views[index].size(), &masks)?;
    let order = Order::of(&views);
    let (photos, views, masks) = (order.sorted(photos), order.sorted(&views), order.sorted(&masks));
    let stitch = || {
        let found = {
            let eight = EightBits::new(&views, "features", progress)?;
            let bytes = eight.views().into_iter().zip(&photos);
            let bytes: Vec<_> = bytes
                .map(|(image, p)| PanoramaPhoto { image, focal: p.focal, camera: p.camera, mask: p.mask })
                .collect();
            register(&bytes, options, progress)?
        };
        composite(&views, &masks, found, &options.render, progress)
    };
    stitch().map(|result| order.restored_result(result)).map_err(|error| order.restored_error(error))
}

/// Stitches photographs with a known registration: further frames of a rig, another exposure of the same views.
///
/// As [`panorama`] without features, matching and alignment; exposure, seams and local alignment are estimated for these photographs, so that the registered photographs give the same bytes
/// again. Number, sizes and order of the photographs must be as registered.
///
/// # Errors
/// [`PanoramaError`]: the photographs are not as registered, or the canvas would be too large.
pub fn panorama_with<T: PhotoSample>(
    registration: &Registration,
    photos: &[ImageView<'_, T, 3>],
    options: &CompositingOptions,
    progress: &dyn Progress,
) -> Result<PanoramaResult<T>, PanoramaError> {
    panorama_with_masks(registration, photos, &[], options, progress)
}

/// Returns a registration as if by features.
fn known_registration(alignment: Alignment, sizes: &[(usize, usize)]) -> Registered {
    let images = alignment.views.iter().zip(sizes).map(|(view, &size)| PanoramaImage {
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
    Registered { alignment, images, pairs: Vec::new(), features: Vec::new(), clock: StageClock::new() }
}

/// Composites the panorama and collects the result.
fn composite<T: PhotoSample>(
    photos: &[ImageView<'_, T, 3>],
    masks: &[Option<&PhotoMask>],
    found: Registered,
    options: &CompositingOptions,
    progress: &dyn Progress,
) -> Result<PanoramaResult<T>, PanoramaError> {
    collected(found, |alignment| render_masked(photos, masks, alignment, options, progress))
}

/// Composites the panorama by `draw` and collects the result.
fn collected<T: PhotoSample>(
    found: Registered,
    draw: impl FnOnce(&Alignment) -> Result<Panorama<T>, RenderError>,
) -> Result<PanoramaResult<T>, PanoramaError> {
    let Registered { alignment, mut images, pairs, features, mut clock } = found;
    for (image, view) in images.iter_mut().zip(&alignment.views) {
        image.focal = view.as_ref().ok().filter(|_| alignment.motion == CameraMotion::Rotation).map(|v| v.camera.fx);
    }
    let drawn = draw(&alignment)?;
    for (image, gain) in images.iter_mut().zip(&drawn.gains.gains) {
        image.gain = *gain;
    }
    for (stage, seconds) in &drawn.stages {
        clock.add(stage, *seconds);
    }
    Ok(PanoramaResult {
        size: drawn.size,
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
        stacks: drawn.stacks,
        alignment,
        stages: clock.into_stages(),
    })
}
