//! SIFT features: difference-of-Gaussian keypoints with orientation, and gradient histogram descriptors, as rootSIFT by
//! default.
//!
//! Sources: D. Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 60(2), 2004; R. Arandjelović &
//! A. Zisserman, "Three things everyone should know to improve object retrieval", CVPR 2012 (rootSIFT).
//!
//! Two differences from Lowe's code: The first octave is upsampled by sampling a Gaussian at half-pixel phases, so
//! positions have no bias of a quarter pixel. A descriptor is computed on a grid of 20×20 samples rotated and scaled
//! with the keypoint (four per histogram cell and axis, as in Lowe's figure 7), not on every pixel of the window, so
//! its cost does not depend on scale.

use crate::dog::{DogOptions, Extremum};
use crate::error::{FeatureError, check_image};
use crate::extractor::FeatureExtractor;
use crate::gradient_histogram::{DIMENSION, describe, dominant_angles};
use crate::kind::{ByteScale, MAX_SSD, RATIO};
use crate::scale_space::{Octave, scale_space};
use crate::simd;
use crate::{DescriptorKind, DropReason, Dropped, Features};
use cv_core::{Cancelled, ImageView, Keypoint, OptionError, Point2, Progress, Stage};
use cv_parallel::prelude::*;

/// Options of [`sift`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct SiftOptions {
    /// Maximum number of features, 1 or more; default 8192 (COLMAP's). Those with the highest contrast are kept (or
    /// those of the largest scale, see `coarse_first`).
    pub max_features: usize,
    /// Keep the features of the largest scale (as COLMAP) instead of those with the highest contrast, if there are more
    /// than `max_features`. Fine texture such as gravel and leaves has high contrast, but is repetitive and not
    /// repeatable from other viewpoints. Default false.
    pub coarse_first: bool,
    /// Start from an image upsampled by two, which about quadruples the number of keypoints. Default true (Lowe).
    pub upsample: bool,
    /// Layers per octave, 1 to 8; default 3 (Lowe).
    pub layers: usize,
    /// σ of the first scale of an octave, in octave pixels. 0.8 to 4; default 1.6 (Lowe).
    pub sigma: f32,
    /// Contrast threshold, times `layers`, for images of 0 to 1. 0 or more; default 0.02 (COLMAP's), half of OpenCV's
    /// 0.04.
    pub contrast: f32,
    /// Minimum number of keypoints: if fewer have `contrast`, those of the highest contrast above `faint_contrast` are
    /// added. Default 0: none are added.
    pub min_features: usize,
    /// Contrast threshold of the keypoints added for `min_features`. 0 or more; default 0.4 × 0.02.
    pub faint_contrast: f32,
    /// Edge threshold: maximum ratio of the principal curvatures. 1 or more; default 10 (Lowe).
    pub edge: f32,
    /// Take the square root of the L1-normalized histogram (rootSIFT). Default true.
    pub root: bool,
    /// Set all orientations to zero, for images known to be upright. Default false.
    pub upright: bool,
}

impl Default for SiftOptions {
    fn default() -> Self {
        Self {
            max_features: 8192,
            coarse_first: false,
            upsample: true,
            layers: 3,
            sigma: 1.6,
            contrast: 0.02,
            min_features: 0,
            faint_contrast: 0.008,
            edge: 10.0,
            root: true,
            upright: false,
        }
    }
}

impl DescriptorKind {
    /// SIFT gradient histograms of unit length ([`sift`] with `root: false`).
    pub const SIFT: Self = Self {
        name: "sift",
        dimension: DIMENSION,
        ratio: RATIO,
        max_ssd: MAX_SSD,
        // COLMAP's: the values of a unit vector that was clipped at 0.2 are below 0.5.
        bytes: Some(ByteScale { offset: 0.0, factor: 512.0 }),
        patch: None,
    };

    /// rootSIFT: the square roots of L1-normalized SIFT histograms ([`sift`]); unit length.
    pub const ROOT_SIFT: Self = Self { name: "rootsift", ..Self::SIFT };
}

impl FeatureExtractor for SiftOptions {
    fn extract(&self, image: ImageView<'_, f32, 1>, progress: &dyn Progress) -> Result<Features, FeatureError> {
        sift(image, self, progress)
    }

    fn kind(&self) -> DescriptorKind {
        if self.root { DescriptorKind::ROOT_SIFT } else { DescriptorKind::SIFT }
    }
}

/// Minimum image side in pixels.
pub(crate) const MIN_SIDE: usize = 8;

/// Detects and describes SIFT features, by decreasing contrast.
///
/// `scale` of a keypoint is σ of the Gaussian at which it was detected, in input pixels; `response` is |D|, for images
/// of 0 to 1. A keypoint with several dominant orientations has a feature for each. A flat image has no features.
///
/// # Errors
/// [`FeatureError`] for images below 8×8, pixels that are not finite, options out of range.
pub fn sift(
    view: ImageView<'_, f32, 1>,
    options: &SiftOptions,
    progress: &dyn Progress,
) -> Result<Features, FeatureError> {
    OptionError::check("max_features", options.max_features as f64, "1 or more", |v| v >= 1.0)?;
    OptionError::check("layers", options.layers as f64, "from 1 to 8", |v| (1.0..=8.0).contains(&v))?;
    OptionError::check("sigma", options.sigma.into(), "from 0.8 to 4 px", |v| (0.8..=4.0).contains(&v))?;
    for (name, value) in [("contrast", options.contrast), ("faint_contrast", options.faint_contrast)] {
        OptionError::check(name, value.into(), "0 or more", |v| v >= 0.0 && v.is_finite())?;
    }
    OptionError::check("edge", options.edge.into(), "1 or more", |v| v >= 1.0 && v.is_finite())?;
    check_image(view, MIN_SIDE)?;
    // A lower bound against rounding noise in flat regions: 1e-5 is a hundred times the error of the f32 sums.
    let per_layer = |contrast: f32| (contrast / options.layers as f32).max(1e-5);
    let contrast = per_layer(options.contrast);
    let faint = if options.min_features > 0 { per_layer(options.faint_contrast).min(contrast) } else { contrast };
    let dog_options = DogOptions {
        layers: options.layers,
        sigma: options.sigma,
        upsample: options.upsample,
        contrast: faint,
        edge: options.edge,
    };
    let (octaves, mut points) = scale_space(view, &dog_options, progress)?;
    // Sorted by decreasing contrast.
    points.truncate(points.partition_point(|p| p.contrast >= contrast).max(options.min_features));
    let mut out = Features::new(options.kind());
    if options.coarse_first && points.len() > options.max_features {
        // A stable sort: ties by contrast.
        points.sort_by(|a, b| {
            let scale = |p: &Extremum| p.sigma * octaves[p.octave].pixel;
            scale(b).total_cmp(&scale(a))
        });
    }
    // Each keypoint has at least one feature, so more keypoints than the limit are not needed.
    out.beyond_limit = points.len().saturating_sub(options.max_features);
    points.truncate(options.max_features);
    let level = simd::level();
    // In image order, for cache locality.
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_unstable_by_key(|&i| (points[i].octave, points[i].row / 16, points[i].column, i));
    let stage = Stage::new(progress, "describe", order.len())?;
    let mut features: Vec<(usize, Vec<Feature>)> = order
        .into_par_iter()
        .with_min_len(16)
        .map(|index| {
            let point = &points[index];
            let octave = &octaves[point.octave];
            let image = &octave.scales[point.layer - 1];
            // In pixels of the stored scale, which are twice as large as octave pixels.
            let (at, sigma) = ((0.5 * point.x, 0.5 * point.y), 0.5 * point.sigma);
            let angles = if options.upright { vec![0.0] } else { dominant_angles(level, image, at, sigma) };
            let describe = |angle| {
                let mut histogram = describe(level, image, at, sigma, angle);
                let norm = normalize(&mut histogram, options.root);
                (keypoint(point, octave, angle), histogram, norm)
            };
            stage.add(1)?;
            Ok((index, angles.into_iter().map(describe).collect()))
        })
        .try_collect::<_, Cancelled>()?;
    features.sort_unstable_by_key(|f| f.0);
    for (index, (keypoint, histogram, norm)) in features.into_iter().flat_map(|f| f.1).enumerate() {
        if norm <= 0.0 {
            out.dropped.push(Dropped { index, reason: DropReason::Flat { deviation: norm } });
        } else if out.keypoints.len() == options.max_features {
            out.beyond_limit += 1;
        } else {
            out.keypoints.push(keypoint);
            out.descriptors.push(&histogram);
        }
    }
    Ok(out)
}

/// A keypoint, its descriptor, and the norm of the descriptor before normalization.
type Feature = (Keypoint, [f32; DIMENSION], f32);

fn keypoint(point: &Extremum, octave: &Octave, angle: f32) -> Keypoint {
    Keypoint {
        position: Point2::new(point.x * octave.pixel, point.y * octave.pixel),
        response: point.contrast,
        scale: point.sigma * octave.pixel,
        angle,
    }
}

/// Normalizes to unit length, clips at 0.2, and normalizes again (for rootSIFT to unit sum, then takes the square
/// roots). Returns the initial length.
fn normalize(v: &mut [f32; DIMENSION], root: bool) -> f32 {
    let length = |v: &[f32; DIMENSION]| v.iter().map(|a| a * a).sum::<f32>().sqrt();
    let norm = length(v);
    if norm <= 0.0 {
        return 0.0;
    }
    v.iter_mut().for_each(|a| *a = (*a / norm).min(0.2));
    if root {
        let sum: f32 = v.iter().sum();
        v.iter_mut().for_each(|a| *a = (*a / sum).sqrt());
    } else {
        let clipped = length(v);
        v.iter_mut().for_each(|a| *a /= clipped);
    }
    norm
}
