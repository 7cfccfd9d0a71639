//! ASIFT: SIFT on affine-simulated views, the image as it would look from a slanted direction.
//!
//! Source: J.-M. Morel & G. Yu, "ASIFT: a new framework for fully affine invariant image comparison", SIAM J. Imaging Sciences 2(2), 2009. A picture of a plane seen
//! under a slant is the frontal one turned, then compressed along one axis (the tilt); features of the compressed picture match those of the slanted one.

use crate::Features;
use crate::error::{FeatureError, check_image};
use crate::sift::{SMALLEST, SiftOptions, sift};
use crate::simd;
use cv_core::{GrayF32, ImageView, OptionError, Point2, Progress, Stage};
use cv_imgproc::{Border, RemapOptions, gaussian_half_kernel, mirror_ends, warp_with};
use rayon::prelude::*;

/// SIFT features of the image turned by `rotation` radians and then compressed `tilt` times along x; positions, scales and angles in the image as it is.
///
/// `tilt` is 1 to 8: the secant of the angle between the two directions of view. Features beyond the image's border are left out. Morel & Yu sample `rotation` every 72°/`tilt` over half a
/// turn, and `tilt` at powers of √2.
///
/// # Errors
/// As [`sift`]; [`FeatureError::Option`] for a tilt outside its range or a rotation that is not finite; [`FeatureError::ImageTooSmall`] where the compressed image would be too
/// small.
pub fn sift_affine_view(
    view: ImageView<'_, f32, 1>,
    options: &SiftOptions,
    tilt: f32,
    rotation: f32,
    progress: &dyn Progress,
) -> Result<Features, FeatureError> {
    OptionError::check("tilt", tilt.into(), "from 1 to 8", |v| (1.0..=8.0).contains(&v))?;
    OptionError::check("rotation", rotation.into(), "finite", f64::is_finite)?;
    check_image(view, SMALLEST)?;
    let (w, h) = view.size();
    let (sin, cos) = rotation.sin_cos();
    let (right, bottom) = (w as f32 - 1.0, h as f32 - 1.0);
    let turned = |x: f32, y: f32| Point2::new(cos * x - sin * y, sin * x + cos * y);
    let corners = [turned(0.0, 0.0), turned(right, 0.0), turned(0.0, bottom), turned(right, bottom)];
    let low = corners.iter().fold((f32::MAX, f32::MAX), |l, c| (l.0.min(c.x), l.1.min(c.y)));
    let high = corners.iter().fold((f32::MIN, f32::MIN), |l, c| (l.0.max(c.x), l.1.max(c.y)));
    let (turned_w, turned_h) = ((high.0 - low.0).ceil() as usize + 1, (high.1 - low.1).ceil() as usize + 1);
    let width = ((turned_w as f32 - 1.0) / tilt) as usize + 1;
    if width < SMALLEST {
        return Err(FeatureError::ImageTooSmall { width, height: turned_h, needed: SMALLEST });
    }
    // From the turned image to the input.
    let back = |x: f32, y: f32| {
        let (x, y) = (x + low.0, y + low.1);
        Point2::new(cos * x + sin * y, cos * y - sin * x)
    };
    let compressed = compressed(view, (turned_w, turned_h), (tilt, width), back, progress)?;
    let mut found = sift(compressed.view(), options, progress)?;
    // Areas shrink by the tilt, so lengths by its root.
    let grow = tilt.sqrt();
    let keep: Vec<bool> = found
        .keypoints
        .iter_mut()
        .map(|k| {
            let (s, c) = k.angle.sin_cos();
            let (dx, dy) = (c * tilt, s);
            k.angle = (cos * dy - sin * dx).atan2(cos * dx + sin * dy).rem_euclid(std::f32::consts::TAU);
            k.position = back(k.position.x * tilt, k.position.y);
            k.scale *= grow;
            let p = k.position;
            p.x >= 0.0 && p.y >= 0.0 && p.x <= right && p.y <= bottom
        })
        .collect();
    found.retain(&keep);
    Ok(found)
}

/// Rows that are turned at a time, between which it is asked whether to go on: some milliseconds, and less memory than the whole.
const BAND: usize = 128;

/// The view turned into `size` by `back`, which gives the position in the view; of that every `tilt`-th column, `width` of them, smoothed along the rows by what the coarser
/// sampling asks for (0.8·√(t² − 1), Morel & Yu).
fn compressed(
    view: ImageView<'_, f32, 1>,
    (w, h): (usize, usize),
    (tilt, width): (f32, usize),
    back: impl Fn(f32, f32) -> Point2<f32> + Sync,
    progress: &dyn Progress,
) -> Result<GrayF32, FeatureError> {
    let kernel = gaussian_half_kernel(0.8 * (tilt * tilt - 1.0).max(1e-6).sqrt());
    let r = kernel.len() - 1;
    let level = simd::level();
    let edge = RemapOptions { border: Border::Replicate, ..RemapOptions::default() };
    let mut out = GrayF32::new(width, h, [0.0]);
    let stage = Stage::new(progress, "slanted view", h.div_ceil(BAND))?;
    for (band, rows) in out.as_mut_slice().chunks_mut(width * BAND).enumerate() {
        let y0 = band * BAND;
        let at = |x: usize, y: usize| Some(back(x as f32, (y0 + y) as f32).cast::<f64>());
        let Ok((turned, _)) = warp_with(view, (w, rows.len() / width), &edge, at) else {
            let (width, height) = view.size();
            return Err(FeatureError::ImageTooSmall { width, height, needed: SMALLEST });
        };
        let buffers = || (vec![0.0; w + 2 * r], vec![0.0; w]);
        rows.par_chunks_mut(width).enumerate().for_each_init(buffers, |(padded, smooth), (y, row)| {
            padded[r..r + w].copy_from_slice(turned.row(y));
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

    /// Blobs of many sizes at fixed random places of a 300 × 260 plane.
    fn blobs() -> impl Fn(f32, f32) -> f32 {
        let mut state = 11u32;
        let mut random = move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        let spots: Vec<[f32; 4]> =
            (0..260).map(|_| [300.0 * random(), 260.0 * random(), 2.5 + 4.0 * random(), random() - 0.5]).collect();
        move |x, y| {
            let value = |s: &[f32; 4]| s[3] * (-((x - s[0]).powi(2) + (y - s[1]).powi(2)) / (2.0 * s[2] * s[2])).exp();
            0.5 + 0.3 * spots.iter().map(value).sum::<f32>()
        }
    }

    /// Features of the plane as it is against its features seen under a slant: how many match, and how many of those in the right place.
    fn matches(tilt: f32, simulated: bool) -> (usize, usize) {
        let f = blobs();
        let rotation = 0.9f32;
        let (sin, cos) = rotation.sin_cos();
        let plane = GrayF32::from_fn(300, 260, |x, y| [f(x as f32, y as f32)]);
        // The middle of the plane, turned and compressed.
        let place = |x: f32, y: f32| {
            let (x, y) = ((x - 60.0) * tilt, y - 120.0);
            Point2::new(150.0 + cos * x + sin * y, 130.0 + cos * y - sin * x)
        };
        let slanted = GrayF32::from_fn(120, 240, |x, y| {
            let p = place(x as f32, y as f32);
            [f(p.x, p.y)]
        });
        let options = SiftOptions::default();
        let a = if simulated {
            sift_affine_view(plane.view(), &options, tilt, rotation, &Silent)
        } else {
            sift(plane.view(), &options, &Silent)
        };
        let (a, b) = (a.unwrap(), sift(slanted.view(), &options, &Silent).unwrap());
        assert_eq!(a.keypoints.len(), a.descriptors.len());
        let options = MatchOptions { mutual: true, ..MatchOptions::default() };
        let found = match_descriptors(&a.descriptors, &b.descriptors, &options, &Silent).unwrap();
        let right = found.iter().filter(|m| {
            let (p, q) = (a.keypoints[m.query as usize].position, b.keypoints[m.train as usize].position);
            // Half a pixel of the slanted image is half a tilt along the slant.
            (place(q.x, q.y) - p).norm() < 0.5 * tilt
        });
        (found.len(), right.count())
    }

    #[test]
    fn a_slanted_view_matches_the_simulated_one_where_the_plain_one_does_not() {
        let (found, right) = matches(4.0, true);
        // The two differ by resampling, and the blobs have lost most of their width: most that match are right.
        assert!(right >= 20 && right * 10 >= found * 8, "{right} of {found}");
        let (_, plain) = matches(4.0, false);
        assert!(plain * 3 < right, "{plain} and {right}");
    }

    #[test]
    fn without_tilt_it_is_sift() {
        let f = blobs();
        let image = GrayF32::from_fn(150, 140, |x, y| [f(x as f32, y as f32)]);
        let options = SiftOptions::default();
        let (tilted, plain) = (
            sift_affine_view(image.view(), &options, 1.0, 0.0, &Silent).unwrap(),
            sift(image.view(), &options, &Silent).unwrap(),
        );
        assert_eq!(tilted.descriptors, plain.descriptors);
        for (a, b) in tilted.keypoints.iter().zip(&plain.keypoints) {
            // The angle went through its sine and back.
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
