//! Upright 8×8 patch descriptors: samples of a blurred 40×40 window, normalized to zero mean and unit variance.
//!
//! Source: M. Brown, R. Szeliski & S. Winder, "Multi-image matching using multi-scale oriented patches", CVPR 2005, section 4,
//! without orientation.

use crate::error::{FeatureError, check_image};
use crate::kind::{ByteScale, MAX_SSD, RATIO};
use crate::{DescriptorKind, DropReason, Dropped, Features};
use cv_core::{GrayF32, ImageView, Keypoint, OptionError};
use cv_imgproc::{bilinear_at, gaussian_blur};
use cv_parallel::prelude::*;

/// Samples along a side of a patch.
pub(crate) const SIDE: usize = 8;

impl DescriptorKind {
    /// 8×8 upright patches, zero mean and unit variance ([`describe_patches`]).
    pub const PATCH: Self = Self {
        name: "patch",
        dimension: SIDE * SIDE,
        ratio: RATIO,
        // As for descriptors of unit length; the squared length of these is their dimension.
        max_ssd: MAX_SSD * (SIDE * SIDE) as f32,
        // ±4 standard deviations.
        bytes: Some(ByteScale { offset: 4.0, factor: 255.0 / 8.0 }),
        patch: Some(SIDE),
    };
}

/// Options of [`describe_patches`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct PatchOptions {
    /// Side of the window in pixels; the sample spacing is `window / 8`. 8 to 400; default 40 (Brown, Szeliski &
    /// Winder).
    pub window: f32,
    /// Sigma in pixels of the Gaussian blur before sampling (anti-aliasing). 0.3 to 50; default 2.5, half the sample
    /// spacing.
    pub blur_sigma: f32,
    /// Minimum standard deviation of a patch in the unit of the image; patches below are flat. Default 0.001 for images
    /// of 0 to 1: a quarter of an 8-bit gray level, below which a patch is quantization noise.
    pub min_deviation: f32,
}

impl Default for PatchOptions {
    fn default() -> Self {
        Self { window: 40.0, blur_sigma: 2.5, min_deviation: 1e-3 }
    }
}

/// Computes an upright 8×8 patch descriptor for each keypoint, at its sub-pixel position.
///
/// Keypoints whose window extends beyond the image or is flat are in `dropped` with the reason. Scale and angle of the
/// keypoints are not used.
///
/// # Errors
/// [`FeatureError`] for an image smaller than the window, pixels that are not finite, options out of range.
pub fn describe_patches(
    view: ImageView<'_, f32, 1>,
    keypoints: &[Keypoint],
    options: &PatchOptions,
) -> Result<Features, FeatureError> {
    OptionError::check("window", options.window.into(), "from 8 to 400 px", |v| (8.0..=400.0).contains(&v))?;
    OptionError::check("blur_sigma", options.blur_sigma.into(), "from 0.3 to 50 px", |v| (0.3..=50.0).contains(&v))?;
    OptionError::check("min_deviation", options.min_deviation.into(), "0 or more", |v| v >= 0.0 && v.is_finite())?;
    check_image(view, options.window.ceil() as usize)?;
    let smooth = gaussian_blur(view, options.blur_sigma);
    let patches: Vec<Result<[f32; SIDE * SIDE], DropReason>> =
        keypoints.par_iter().with_min_len(64).map(|k| patch(&smooth, k, options)).collect();
    let mut features = Features::new(DescriptorKind::PATCH);
    for (index, (keypoint, patch)) in keypoints.iter().zip(patches).enumerate() {
        match patch {
            Ok(values) => {
                features.keypoints.push(*keypoint);
                features.descriptors.push(&values);
            }
            Err(reason) => features.dropped.push(Dropped { index, reason }),
        }
    }
    Ok(features)
}

fn patch(smooth: &GrayF32, keypoint: &Keypoint, options: &PatchOptions) -> Result<[f32; SIDE * SIDE], DropReason> {
    let (x, y) = (keypoint.position.x, keypoint.position.y);
    if !(x.is_finite() && y.is_finite()) {
        return Err(DropReason::NotFinite);
    }
    let (w, h) = smooth.size();
    let half_window = options.window / 2.0;
    // The image extends from −0.5 to w − 0.5.
    let inside = |v: f32, n: usize| v - half_window >= -0.5 && v + half_window <= n as f32 - 0.5;
    if !(inside(x, w) && inside(y, h)) {
        return Err(DropReason::OutsideImage { margin: half_window });
    }
    let spacing = options.window / SIDE as f32;
    let first = |v: f32| v - spacing * (SIDE as f32 - 1.0) / 2.0;
    // The interpolation weights are shared along rows and columns.
    let cell_and_fraction = |v: f32, i: usize, n: usize| {
        let p = (first(v) + spacing * i as f32).clamp(0.0, n as f32 - 1.0);
        let cell = (p as usize).min(n - 2);
        (cell, p - cell as f32)
    };
    let columns: [(usize, f32); SIDE] = std::array::from_fn(|i| cell_and_fraction(x, i, w));
    let mut values = [0.0f32; SIDE * SIDE];
    for (j, out) in values.chunks_exact_mut(SIDE).enumerate() {
        let (row, fy) = cell_and_fraction(y, j, h);
        for (o, (column, fx)) in out.iter_mut().zip(columns) {
            [*o] = bilinear_at(smooth.view(), column, row, fx, fy);
        }
    }
    normalize(&mut values, options.min_deviation)?;
    Ok(values)
}

/// Normalizes to zero mean and unit (population) variance.
pub(crate) fn normalize(values: &mut [f32], min_deviation: f32) -> Result<(), DropReason> {
    let n = values.len() as f64;
    let mean = values.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
    let variance = values.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>() / n;
    let deviation = variance.sqrt();
    // A constant window is flat for any threshold.
    if deviation <= f64::from(min_deviation) || deviation <= 1e-7 * mean.abs() {
        return Err(DropReason::Flat { deviation: deviation as f32 });
    }
    values.iter_mut().for_each(|v| *v = ((f64::from(*v) - mean) / deviation) as f32);
    Ok(())
}
