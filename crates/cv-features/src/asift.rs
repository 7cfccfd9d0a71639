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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::matching::{MatchOptions, match_descriptors};
    use cv_core::Silent;

    /// Blobs of various sizes at random positions of a 300 × 260 plane.
    fn blobs() -> impl Fn(f32, f32) -> f32 {
        let mut state = 11u32;
        let mut random = move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        let blobs: Vec<[f32; 4]> =
            (0..260).map(|_| [300.0 * random(), 260.0 * random(), 2.5 + 4.0 * random(), random() - 0.5]).collect();
        move |x, y| {
            let value = |s: &[f32; 4]| s[3] * (-((x - s[0]).powi(2) + (y - s[1]).powi(2)) / (2.0 * s[2] * s[2])).exp();
            0.5 + 0.3 * blobs.iter().map(value).sum::<f32>()
        }
    }

    /// Matches features of the plane with features of an oblique view; counts all and correct matches.
    fn matches(tilt: f32, simulated: bool) -> (usize, usize) {
        let f = blobs();
        let rotation = 0.9f32;
        let (sin, cos) = rotation.sin_cos();
        let plane = GrayF32::from_fn(300, 260, |x, y| [f(x as f32, y as f32)]);
        // Maps the oblique view to the center of the plane.
        let to_plane = |x: f32, y: f32| {
            let (x, y) = ((x - 60.0) * tilt, y - 120.0);
            Point2::new(150.0 + cos * x + sin * y, 130.0 + cos * y - sin * x)
        };
        let oblique = GrayF32::from_fn(120, 240, |x, y| {
            let p = to_plane(x as f32, y as f32);
            [f(p.x, p.y)]
        });
        let options = SiftOptions::default();
        let a = if simulated {
            sift_affine_view(plane.view(), &options, tilt, rotation, &Silent)
        } else {
            sift(plane.view(), &options, &Silent)
        };
        let (a, b) = (a.unwrap(), sift(oblique.view(), &options, &Silent).unwrap());
        assert_eq!(a.keypoints.len(), a.descriptors.len());
        let options = MatchOptions { mutual: true, ..MatchOptions::default() };
        let found = match_descriptors(&a.descriptors, &b.descriptors, &options, &Silent).unwrap();
        let correct = found.iter().filter(|m| {
            let (p, q) = (a.keypoints[m.query as usize].position, b.keypoints[m.train as usize].position);
            // Half a pixel of the oblique image is half a tilt in the plane.
            (to_plane(q.x, q.y) - p).norm() < 0.5 * tilt
        });
        (found.len(), correct.count())
    }

    #[test]
    fn an_oblique_view_matches_the_simulated_view_but_not_the_original() {
        let (found, correct) = matches(4.0, true);
        // The two differ by resampling, and the blobs are strongly compressed: most matches are correct.
        assert!(correct >= 20 && correct * 10 >= found * 8, "{correct} of {found}");
        let (_, plain) = matches(4.0, false);
        assert!(plain * 3 < correct, "{plain} and {correct}");
    }

    #[test]
    fn without_tilt_the_result_is_that_of_sift() {
        let f = blobs();
        let image = GrayF32::from_fn(150, 140, |x, y| [f(x as f32, y as f32)]);
        let options = SiftOptions::default();
        let (tilted, plain) = (
            sift_affine_view(image.view(), &options, 1.0, 0.0, &Silent).unwrap(),
            sift(image.view(), &options, &Silent).unwrap(),
        );
        assert_eq!(tilted.descriptors, plain.descriptors);
        for (a, b) in tilted.keypoints.iter().zip(&plain.keypoints) {
            // The angle is computed from its sine and cosine.
            assert!(a.position == b.position && a.scale == b.scale && (a.angle - b.angle).abs() < 1e-5, "{a:?} {b:?}");
        }
        for (tilt, rotation) in [(0.5, 0.0), (f32::NAN, 0.0), (2.0, f32::INFINITY)] {
            let error = sift_affine_view(image.view(), &options, tilt, rotation, &Silent);
            assert!(matches!(error, Err(FeatureError::Option(_))));
        }
        let narrow = GrayF32::new(30, 30, [0.5]);
        let error = sift_affine_view(narrow.view(), &options, 8.0, 0.0, &Silent).unwrap_err();
        assert_eq!(error, FeatureError::ImageTooSmall { width: 4, height: 30, needed: 8 });
        assert!(sift_affine_view(GrayF32::new(0, 0, [0.0]).view(), &options, 2.0, 0.0, &Silent).is_err());
    }
}
