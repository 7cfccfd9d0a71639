//! ASIFT: SIFT on affine-simulated views.
//!
//! Source: J.-M. Morel & G. Yu, "ASIFT: a new framework for fully affine invariant image comparison", SIAM J. Imaging
//! Sciences 2(2), 2009. An oblique view of a plane is approximately the frontal view, rotated and then compressed along
//! one axis (the tilt); features of the simulated view match those of the oblique one.

use crate::Features;
use crate::error::{FeatureError, check_image};
use crate::sift::{MIN_SIDE, SiftOptions, sift};
use crate::simd;
use cv_core::{GrayF32, ImageView, OptionError, Point2, Progress, Stage};
use cv_imgproc::{Border, RemapOptions, gaussian_half_kernel, mirror_ends, warp_with};
use cv_parallel::prelude::*;

/// Computes SIFT features of the image rotated by `rotation` radians and then compressed by `tilt` along x. Positions,
/// scales and angles are in the original image.
///
/// `tilt` is 1 to 8: the secant of the angle between the two viewing directions. Features outside the image are
/// removed. Morel & Yu sample `rotation` in steps of 72°/`tilt` over 180°, and `tilt` at powers of √2.
///
/// # Errors
/// As [`sift`]; [`FeatureError::Option`] for a tilt outside its range or a rotation that is not finite;
/// [`FeatureError::ImageTooSmall`] if the compressed image would be too small.
pub fn sift_affine_view(
    view: ImageView<'_, f32, 1>,
    options: &SiftOptions,
    tilt: f32,
    rotation: f32,
    progress: &dyn Progress,
) -> Result<Features, FeatureError> {
    OptionError::check("tilt", tilt.into(), "from 1 to 8", |v| (1.0..=8.0).contains(&v))?;
    OptionError::check("rotation", rotation.into(), "finite", f64::is_finite)?;
    check_image(view, MIN_SIDE)?;
    let (w, h) = view.size();
    let (sin, cos) = rotation.sin_cos();
    let (right, bottom) = (w as f32 - 1.0, h as f32 - 1.0);
    let rotated = |x: f32, y: f32| Point2::new(cos * x - sin * y, sin * x + cos * y);
    let corners = [rotated(0.0, 0.0), rotated(right, 0.0), rotated(0.0, bottom), rotated(right, bottom)];
    let low = corners.iter().fold((f32::MAX, f32::MAX), |l, c| (l.0.min(c.x), l.1.min(c.y)));
    let high = corners.iter().fold((f32::MIN, f32::MIN), |l, c| (l.0.max(c.x), l.1.max(c.y)));
    let (rotated_w, rotated_h) = ((high.0 - low.0).ceil() as usize + 1, (high.1 - low.1).ceil() as usize + 1);
    let width = ((rotated_w as f32 - 1.0) / tilt) as usize + 1;
    if width < MIN_SIDE {
        return Err(FeatureError::ImageTooSmall { width, height: rotated_h, needed: MIN_SIDE });
    }
    // Maps the rotated image to the input.
    let to_input = |x: f32, y: f32| {
        let (x, y) = (x + low.0, y + low.1);
        Point2::new(cos * x + sin * y, cos * y - sin * x)
    };
    let simulated = simulated_view(view, (rotated_w, rotated_h), (tilt, width), to_input, progress)?;
    let mut features = sift(simulated.view(), options, progress)?;
    // The area is scaled by 1/tilt, so the geometric mean of lengths by its root.
    let scale_factor = tilt.sqrt();
    let keep: Vec<bool> = features
        .keypoints
        .iter_mut()
        .map(|k| {
            let (s, c) = k.angle.sin_cos();
            let (dx, dy) = (c * tilt, s);
            k.angle = (cos * dy - sin * dx).atan2(cos * dx + sin * dy).rem_euclid(std::f32::consts::TAU);
            k.position = to_input(k.position.x * tilt, k.position.y);
            k.scale *= scale_factor;
            let p = k.position;
            p.x >= 0.0 && p.y >= 0.0 && p.x <= right && p.y <= bottom
        })
        .collect();
    features.retain(&keep);
    Ok(features)
}

/// Rows that are rotated between checks for cancellation: some milliseconds, and less memory than the whole image.
const BAND_ROWS: usize = 128;

/// Simulates an oblique view: resamples the image to size `(w, h)` by `to_input`, blurs the rows for anti-aliasing (σ =
/// 0.8·√(t² − 1), Morel & Yu), and samples `width` columns with a spacing of `tilt`.
fn simulated_view(
    view: ImageView<'_, f32, 1>,
    (w, h): (usize, usize),
    (tilt, width): (f32, usize),
    to_input: impl Fn(f32, f32) -> Point2<f32> + Sync,
    progress: &dyn Progress,
) -> Result<GrayF32, FeatureError> {
    let kernel = gaussian_half_kernel(0.8 * (tilt * tilt - 1.0).max(1e-6).sqrt());
    let r = kernel.len() - 1;
    let level = simd::level();
    let edge = RemapOptions { border: Border::Replicate, ..RemapOptions::default() };
    let mut out = GrayF32::new(width, h, [0.0]);
    let stage = Stage::new(progress, "slanted view", h.div_ceil(BAND_ROWS))?;
    for (band, rows) in out.as_mut_slice().chunks_mut(width * BAND_ROWS).enumerate() {
        let y0 = band * BAND_ROWS;
        let at = |x: usize, y: usize| Some(to_input(x as f32, (y0 + y) as f32).cast::<f64>());
        let Ok((rotated, _)) = warp_with(view, (w, rows.len() / width), &edge, at) else {
            let (width, height) = view.size();
            return Err(FeatureError::ImageTooSmall { width, height, needed: MIN_SIDE });
        };
        let buffers = || (vec![0.0; w + 2 * r], vec![0.0; w]);
        rows.par_chunks_mut(width).enumerate().for_each_init(buffers, |(padded, smooth), (y, row)| {
            padded[r..r + w].copy_from_slice(rotated.row(y));
            mirror_ends::<1>(padded, r, r);
            simd::horizontal(level, smooth, padded, &kernel);
            for (i, o) in row.iter_mut().enumerate() {
                let x = i as f32 * tilt;
                let cell = (x as usize).min(w - 2);
                *o = smooth[cell] + (x - cell as f32) * (smooth[cell + 1] - smooth[cell]);
            }
        });
        stage.add(1)?;
    }
    Ok(out)
}
