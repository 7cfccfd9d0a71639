//! Multi-scale corners (Harris–Laplace) and multi-scale oriented patches (MOPS).
//!
//! Sources: M. Brown, R. Szeliski & S. Winder, "Multi-image matching using multi-scale oriented patches", CVPR 2005; K. Mikolajczyk & C. Schmid,
//! "Indexing based on scale invariant interest points", ICCV 2001 (Harris-Laplace).

use crate::error::{FeatureError, check_image};
use crate::extractor::FeatureExtractor;
use crate::harris::{CornerMeasure, corners};
use crate::patch::{SIDE, normalize};
use crate::pyramid::{FIRST_SIGMA, Pyramid};
use crate::simd;
use crate::structure_tensor::StructureTensor;
use crate::{DescriptorKind, DropReason, Dropped, Features};
use cv_core::{Cancelled, ImageView, Keypoint, OptionError, Progress, Stage};
use cv_imgproc::gaussian_half_kernel;
use cv_parallel::prelude::*;

/// Options of [`harris_laplace`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct MultiScaleOptions {
    /// The corner measure. Default Harris with `k` = 0.04.
    pub measure: CornerMeasure,
    /// Levels per octave, 1 to 6; default 3 (as SIFT).
    pub layers: usize,
    /// Minimum response relative to the maximum of all scales (with scale-normalized gradients). 0 to 1; default 0.001.
    pub threshold: f32,
    /// Scale selection by a local maximum of the scale-normalized Laplacian (Harris–Laplace), with refinement of the
    /// scale. If false, a corner is detected at every scale. Default true.
    pub laplacian: bool,
}

impl Default for MultiScaleOptions {
    fn default() -> Self {
        Self { measure: CornerMeasure::Harris { k: 0.04 }, layers: 3, threshold: 1e-3, laplacian: true }
    }
}

impl DescriptorKind {
    /// 8×8 patches with the orientation and scale of the keypoint, zero mean and unit variance ([`mops`]).
    pub const MOPS: Self = Self { name: "mops", ..Self::PATCH };
}

impl FeatureExtractor for MopsOptions {
    fn extract(&self, image: ImageView<'_, f32, 1>, progress: &dyn Progress) -> Result<Features, FeatureError> {
        mops(image, self, progress)
    }

    fn kind(&self) -> DescriptorKind {
        DescriptorKind::MOPS
    }
}

/// Options of [`mops`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct MopsOptions {
    /// Maximum number of features; the strongest are kept. 1 or more; default 2000.
    pub max_features: usize,
    /// Options of the detector. Default two levels per octave without scale selection (as Brown, Szeliski & Winder),
    /// which has a higher repeatability than with scale selection.
    pub corners: MultiScaleOptions,
    /// Side of the window in units of the keypoint's scale. The sample spacing is an eighth of it, in an image blurred
    /// with half the spacing. 8 to 100; default 40 (Brown, Szeliski & Winder).
    pub window: f32,
    /// σ of the gradient that defines the orientation, in units of the keypoint's scale. 1 to 20; default 4.5 (Brown,
    /// Szeliski & Winder).
    pub orientation_sigma: f32,
    /// Set all orientations to zero. Default false.
    pub upright: bool,
    /// Minimum standard deviation of a patch, as [`PatchOptions::min_deviation`](crate::PatchOptions::min_deviation).
    pub min_deviation: f32,
}

impl Default for MopsOptions {
    fn default() -> Self {
        Self {
            max_features: 2000,
            corners: MultiScaleOptions { layers: 2, laplacian: false, ..MultiScaleOptions::default() },
            window: 40.0,
            orientation_sigma: 4.5,
            upright: false,
            min_deviation: 1e-3,
        }
    }
}

/// Minimum image side in pixels.
const MIN_SIDE: usize = 16;
/// Ratio of integration scale to differentiation scale of the structure tensor (Brown, Szeliski & Winder).
const INTEGRATION_SCALE_RATIO: f32 = 1.5;

/// Detects multi-scale corners by decreasing response, with sub-pixel position and scale.
///
/// `scale` is the differentiation scale σ in input pixels, `response` the corner measure of scale-normalized gradients
/// (times σ), comparable between scales.
///
/// # Errors
/// [`FeatureError`] for images below 16×16, pixels that are not finite, options out of range.
pub fn harris_laplace(
    view: ImageView<'_, f32, 1>,
    options: &MultiScaleOptions,
    progress: &dyn Progress,
) -> Result<Vec<Keypoint>, FeatureError> {
    check(options)?;
    check_image(view, MIN_SIDE)?;
    Ok(detect(&Pyramid::new(view, options.layers, progress)?, options, progress)?)
}

/// Detects multi-scale corners and computes an oriented 8×8 patch descriptor for each, by decreasing response.
///
/// The orientation is that of the gradient at a larger scale. Patches are sampled from the pyramid level whose blur
/// matches the sample spacing. Corners whose patch extends beyond the image or is flat are in `dropped` with the
/// reason.
///
/// # Errors
/// As [`harris_laplace`].
pub fn mops(
    view: ImageView<'_, f32, 1>,
    options: &MopsOptions,
    progress: &dyn Progress,
) -> Result<Features, FeatureError> {
    check(&options.corners)?;
    check_patches(options)?;
    check_image(view, MIN_SIDE)?;
    let pyramid = Pyramid::new(view, options.corners.layers, progress)?;
    let keypoints = detect(&pyramid, &options.corners, progress)?;
    Ok(describe(&pyramid, view.size(), &keypoints, options, progress)?)
}

/// Computes the descriptors of [`mops`] for given keypoints: their scale is used, their angle is replaced by the
/// orientation (0 if `upright`).
///
/// # Errors
/// As [`harris_laplace`].
pub fn describe_oriented_patches(
    view: ImageView<'_, f32, 1>,
    keypoints: &[Keypoint],
    options: &MopsOptions,
    progress: &dyn Progress,
) -> Result<Features, FeatureError> {
    check(&options.corners)?;
    check_patches(options)?;
    check_image(view, MIN_SIDE)?;
    let options = MopsOptions { max_features: usize::MAX, ..options.clone() };
    let pyramid = Pyramid::new(view, options.corners.layers, progress)?;
    Ok(describe(&pyramid, view.size(), keypoints, &options, progress)?)
}

fn check(options: &MultiScaleOptions) -> Result<(), OptionError> {
    if let CornerMeasure::Harris { k } = options.measure {
        OptionError::check("k", k.into(), "from 0 to 0.25", |v| (0.0..=0.25).contains(&v))?;
    }
    OptionError::check("layers", options.layers as f64, "from 1 to 6", |v| (1.0..=6.0).contains(&v))?;
    OptionError::check("threshold", options.threshold.into(), "from 0 to 1", |v| (0.0..=1.0).contains(&v))
}

fn check_patches(options: &MopsOptions) -> Result<(), OptionError> {
    OptionError::check("max_features", options.max_features as f64, "1 or more", |v| v >= 1.0)?;
    OptionError::check("window", options.window.into(), "from 8 to 100 scales", |v| (8.0..=100.0).contains(&v))?;
    OptionError::check("orientation_sigma", options.orientation_sigma.into(), "from 1 to 20 scales", |v| {
        (1.0..=20.0).contains(&v)
    })?;
    OptionError::check("min_deviation", options.min_deviation.into(), "0 or more", |v| v >= 0.0 && v.is_finite())
}

fn detect(pyramid: &Pyramid, options: &MultiScaleOptions, progress: &dyn Progress) -> Result<Vec<Keypoint>, Cancelled> {
    let levels = &pyramid.levels;
    let stage = Stage::new(progress, "corners", levels.len())?;
    let mut all: Vec<Keypoint> = Vec::new();
    for (i, level) in levels.iter().enumerate() {
        let plan = StructureTensor {
            view: level.image.view(),
            kernel: gaussian_half_kernel(INTEGRATION_SCALE_RATIO * level.sigma),
            measure: options.measure,
            level: simd::level(),
        };
        let candidates = corners(&plan, options.threshold, &stage)?;
        // The structure tensor is of degree two in the gradients, Harris's measure of degree four.
        let power = if matches!(options.measure, CornerMeasure::ShiTomasi) { 2 } else { 4 };
        let gain = level.sigma.powi(power);
        let keypoints = candidates.par_iter().with_min_len(64).map(|corner| {
            let (x, y) = (corner.position.x * level.pixel, corner.position.y * level.pixel);
            let mut scale = level.sigma * level.pixel;
            if options.laplacian {
                // The finest and the coarsest level have no scale maximum.
                let (below, above) = (levels.get(i.wrapping_sub(1))?, levels.get(i + 1)?);
                let [a, b, c] = [below, level, above].map(|l| l.laplacian(x, y).abs());
                if b <= a || b <= c {
                    return None;
                }
                let offset = 0.5 * (a - c) / (a - 2.0 * b + c);
                scale *= 2f32.powf(offset.clamp(-0.5, 0.5) / pyramid.per_octave as f32);
            }
            Some(Keypoint { scale, ..Keypoint::new(x, y, gain * corner.response) })
        });
        all.extend(keypoints.collect().into_iter().flatten());
        stage.add(1)?;
    }
    let strongest = all.iter().fold(0.0f32, |m, k| m.max(k.response));
    all.retain(|k| k.response >= options.threshold * strongest);
    all.sort_by(|a, b| b.response.total_cmp(&a.response));
    Ok(all)
}

fn describe(
    pyramid: &Pyramid,
    size: (usize, usize),
    keypoints: &[Keypoint],
    options: &MopsOptions,
    progress: &dyn Progress,
) -> Result<Features, Cancelled> {
    let stage = Stage::new(progress, "describe", keypoints.len())?;
    let describe_one = |keypoint: &Keypoint| -> Result<_, Cancelled> {
        stage.add(1)?;
        Ok(patch(pyramid, size, keypoint, options))
    };
    let patches: Vec<Result<(f32, Patch), DropReason>> =
        keypoints.par_iter().with_min_len(32).map(describe_one).try_collect()?;
    let mut out = Features::new(DescriptorKind::MOPS);
    for (index, (keypoint, patch)) in keypoints.iter().zip(patches).enumerate() {
        match patch {
            Err(reason) => out.dropped.push(Dropped { index, reason }),
            Ok(_) if out.keypoints.len() == options.max_features => out.beyond_limit += 1,
            Ok((angle, values)) => {
                out.keypoints.push(Keypoint { angle, ..*keypoint });
                out.descriptors.push(&values);
            }
        }
    }
    Ok(out)
}

type Patch = [f32; SIDE * SIDE];

/// Computes the orientation and the patch of a keypoint.
fn patch(
    pyramid: &Pyramid,
    (w, h): (usize, usize),
    keypoint: &Keypoint,
    options: &MopsOptions,
) -> Result<(f32, Patch), DropReason> {
    let (x, y, scale) = (keypoint.position.x, keypoint.position.y, keypoint.scale);
    if !(x.is_finite() && y.is_finite() && scale.is_finite() && scale > 0.0) {
        return Err(DropReason::NotFinite);
    }
    let angle = if options.upright {
        0.0
    } else {
        let level = pyramid.nearest(options.orientation_sigma * scale);
        let p = level.pixel;
        let (gx, gy) = (level.at(x + p, y) - level.at(x - p, y), level.at(x, y + p) - level.at(x, y - p));
        gy.atan2(gx).rem_euclid(std::f32::consts::TAU)
    };
    let spacing = options.window * scale / SIDE as f32;
    let (sin, cos) = angle.sin_cos();
    let radius = 0.5 * (SIDE as f32 - 1.0) * spacing;
    let margin = radius * (sin.abs() + cos.abs());
    if x < margin || y < margin || x + margin > w as f32 - 1.0 || y + margin > h as f32 - 1.0 {
        return Err(DropReason::OutsideImage { margin });
    }
    let level = pyramid.nearest((0.5 * spacing).max(FIRST_SIGMA));
    let mut values = [0.0; SIDE * SIDE];
    for (j, row) in values.chunks_exact_mut(SIDE).enumerate() {
        let v = j as f32 * spacing - radius;
        for (i, o) in row.iter_mut().enumerate() {
            let u = i as f32 * spacing - radius;
            *o = level.at(x + u * cos - v * sin, y + u * sin + v * cos);
        }
    }
    normalize(&mut values, options.min_deviation)?;
    Ok((angle, values))
}
