//! SIFT features: difference-of-Gaussian points with orientation, and gradient histograms around them, as rootSIFT by default.
//!
//! Sources: D. Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 60(2), 2004; R. Arandjelović & A. Zisserman,
//! "Three things everyone should know to improve object retrieval", CVPR 2012 (the square root).
//!
//! Two things differ from Lowe's code. The first octave is made by sampling a Gaussian at half-pixel phases, so positions have no bias of a quarter of a
//! pixel. A descriptor is computed on a grid of 20×20 samples turned and scaled with the point (four to a histogram bin, as in Lowe's
//! figure 7), not on every pixel under the window, so its cost does not depend on scale.

use crate::dog::{Extremum, Search};
use crate::error::{FeatureError, check_image};
use crate::extractor::FeatureExtractor;
use crate::gradient_histogram::{DIMENSION, describe, dominant_angles};
use crate::kind::{ByteScale, MAX_SSD, RATIO};
use crate::scale_space::{Octave, scale_space};
use crate::simd;
use crate::{DescriptorKind, DropReason, Dropped, Features};
use cv_core::{Cancelled, ImageView, Keypoint, OptionError, Point2, Progress, Stage};
use rayon::prelude::*;

/// Settings of [`sift`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct SiftOptions {
    /// Largest number of features; those with the strongest contrast stay (or those of the largest scale, see `coarse_first`). 1 or
    /// more; default 8192 (COLMAP's).
    pub max_features: usize,
    /// Where there are more than `max_features`, those of the largest scale stay (COLMAP's choice) instead of those with the strongest
    /// contrast: gravel, leaves and grain have much contrast, but look alike everywhere and like nothing from another place. Default false.
    pub coarse_first: bool,
    /// Start from an image of twice the size, which about quadruples the number of points and finds the smallest. Default true (Lowe).
    pub upsample: bool,
    /// Scales per octave. 1 to 8; default 3 (Lowe).
    pub layers: usize,
    /// σ of the first scale of an octave, in its pixels. 0.8 to 4; default 1.6 (Lowe).
    pub sigma: f32,
    /// Smallest contrast of a point, times `layers`, for images of 0 to 1. 0 or more; default 0.02 (COLMAP's), half of OpenCV's 0.04.
    pub contrast: f32,
    /// Where fewer points than this have `contrast`, the strongest of `faint_contrast` and more fill up. Default 0: none do.
    pub min_features: usize,
    /// Smallest contrast of a point that fills up. 0 or more; default 0.4 × 0.02.
    pub faint_contrast: f32,
    /// Largest ratio of the two principal curvatures. 1 or more; default 10 (Lowe).
    pub edge: f32,
    /// Take the square root of the L1-normalized histogram (rootSIFT). Default true.
    pub root: bool,
    /// Leave every angle at zero: for images known to be upright. Default false.
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
        // COLMAP's: no number of a unit vector that was clipped at 0.2 comes near 0.5.
        bytes: Some(ByteScale { offset: 0.0, factor: 512.0 }),
        patch: None,
    };

    /// The square roots of SIFT histograms that sum to one ([`sift`]); unit length.
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

/// The smallest image the scale space can be built on.
pub(crate) const SMALLEST: usize = 8;

/// Finds and describes SIFT features, strongest contrast first.
///
/// `scale` of a keypoint is σ of the Gaussian it was found at, in input pixels; `response` is |D|, for images of 0 to 1. A point with several dominant
/// orientations gives a feature for each. A flat image has none: the result is empty.
///
/// # Errors
/// [`FeatureError`] for images below 8×8, samples that are not finite, options out of range.
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
    check_image(view, SMALLEST)?;
    // Never zero: rounding noise in flat regions is not a point. 1e-5 is a hundred times the error of the f32 sums.
    let per_layer = |contrast: f32| (contrast / options.layers as f32).max(1e-5);
    let contrast = per_layer(options.contrast);
    let faint = if options.min_features > 0 { per_layer(options.faint_contrast).min(contrast) } else { contrast };
    let search = Search {
        layers: options.layers,
        sigma: options.sigma,
        upsample: options.upsample,
        contrast: faint,
        edge: options.edge,
    };
    let (octaves, mut points) = scale_space(view, &search, progress)?;
    // The strongest come first.
    points.truncate(points.partition_point(|p| p.contrast >= contrast).max(options.min_features));
    let mut out = Features::new(options.kind());
    if options.coarse_first && points.len() > options.max_features {
        // Stable: contrast decides between equals.
        points.sort_by(|a, b| {
            let scale = |p: &Extremum| p.sigma * octaves[p.octave].pixel;
            scale(b).total_cmp(&scale(a))
        });
    }
    // A point gives at least one feature: more points than the limit are never needed.
    out.beyond_limit = points.len().saturating_sub(options.max_features);
    points.truncate(options.max_features);
    let level = simd::level();
    // In the order of the image, so that neighbors find each other's pixels in the cache.
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
            // In pixels of the image, which are twice those of the octave.
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
        .collect::<Result<_, Cancelled>>()?;
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

/// A keypoint, its descriptor, and the length of that before it was normalized.
type Feature = (Keypoint, [f32; DIMENSION], f32);

fn keypoint(point: &Extremum, octave: &Octave, angle: f32) -> Keypoint {
    Keypoint {
        position: Point2::new(point.x * octave.pixel, point.y * octave.pixel),
        response: point.contrast,
        scale: point.sigma * octave.pixel,
        angle,
    }
}

/// Unit length, no entry above 0.2, unit length again; for rootSIFT then the root of each share. Gives back the first length.
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

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{GrayF32, Silent};

    fn image_of(w: usize, h: usize, f: impl Fn(f32, f32) -> f32) -> GrayF32 {
        GrayF32::from_fn(w, h, |x, y| [f(x as f32, y as f32)])
    }

    #[test]
    fn a_gaussian_blob_is_found_where_and_as_large_as_it_is() {
        // The normalized Laplacian of a Gaussian blob of σ0 peaks at σ = σ0; the difference of Gaussians with k = 2^(1/3) peaks where the two
        // scales it compares bracket that, and a point takes the smaller of the two: σ0 = σ·2^(1/6) to first order. The camera's 0.5 is
        // already counted in the image.
        for (x0, y0, s0) in [(60.3f32, 50.7f32, 4.0f32), (70.0, 60.5, 6.0), (64.25, 61.0, 2.5)] {
            let blob =
                image_of(130, 120, |x, y| 0.1 + 0.8 * (-((x - x0).powi(2) + (y - y0).powi(2)) / (2.0 * s0 * s0)).exp());
            let found = sift(blob.view(), &SiftOptions::default(), &Silent).unwrap();
            let best = found.keypoints.iter().min_by(|a, b| {
                let off = |k: &Keypoint| (k.scale / s0).ln().abs();
                off(a).total_cmp(&off(b))
            });
            let k = best.unwrap();
            assert!((k.position.x - x0).abs() < 0.05 && (k.position.y - y0).abs() < 0.05, "{k:?} not ({x0}, {y0})");
            // Quadratic interpolation over three scales of a curve that is not a parabola: a tenth of a scale step, 3 %, and the step itself is
            // known to the first order only.
            assert!((k.scale * 2f32.powf(1.0 / 6.0) / s0 - 1.0).abs() < 0.06, "{k:?} not σ {s0}");
        }
    }

    #[test]
    fn nothing_to_find_and_nothing_to_look_at() {
        let options = SiftOptions::default();
        let flat = sift(GrayF32::new(64, 48, [0.7]).view(), &options, &Silent).unwrap();
        assert!(flat.keypoints.is_empty() && flat.dropped.is_empty() && flat.beyond_limit == 0);
        for (w, h) in [(0, 0), (1, 1), (7, 100)] {
            let error = sift(GrayF32::new(w, h, [0.7]).view(), &options, &Silent).unwrap_err();
            assert_eq!(error, FeatureError::ImageTooSmall { width: w, height: h, needed: 8 });
        }
        let mut image = GrayF32::new(64, 48, [0.7]);
        image.set(3, 4, [f32::NAN]);
        assert_eq!(sift(image.view(), &options, &Silent), Err(FeatureError::NotFinite { x: 3, y: 4 }));
        let bad = SiftOptions { layers: 0, ..options };
        assert!(matches!(
            sift(image.view(), &bad, &Silent),
            Err(FeatureError::Option(OptionError { name: "layers", .. }))
        ));
    }
}
