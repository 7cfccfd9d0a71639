//! Image warping by inverse mapping.

use crate::{
    Pixel,
    rows::for_rows2,
    sample::{bicubic_at, bilinear_at, split_coordinate},
};
use cv_core::{Camera, CameraError, Image, ImageError, ImageView, Mask, Matrix3, Point2};

/// Interpolation method.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Interpolation {
    /// Nearest neighbor.
    Nearest,
    /// Bilinear, from four pixels; the usual choice.
    #[default]
    Bilinear,
    /// Bicubic, from sixteen pixels by Keys's kernel (`a = −½`): sharper, may overshoot at edges.
    Bicubic,
}

/// Border mode: the value of a pixel that maps outside the source.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Border {
    /// Zero (constant border).
    #[default]
    Zero,
    /// The nearest source pixel.
    Replicate,
    /// The source reflected about its end samples (reflect-101).
    Reflect,
}

/// Options of the warps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct RemapOptions {
    /// Interpolation method. Default bilinear.
    pub interpolation: Interpolation,
    /// Border mode. Default zero. (A pixel without a source position is always zero.)
    pub border: Border,
}

/// Why an image could not be warped.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum WarpError {
    /// The homography is singular or not finite, so that inverse mapping is impossible.
    #[error("the homography cannot be inverted: its determinant is {determinant:e}")]
    NotInvertible {
        /// The determinant.
        determinant: f64,
    },
    /// The camera is invalid.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// The result would not fit into memory.
    #[error(transparent)]
    Size(#[from] ImageError),
    /// A source image does not have the source size of the map.
    #[error("the source image is {}×{} px, the map is for {}×{} px", got.0, got.1, expected.0, expected.1)]
    SourceSize {
        /// Width and height of the image.
        got: (usize, usize),
        /// Source size of the map.
        expected: (usize, usize),
    },
    /// An output image does not have the result size of the map.
    #[error("the output image is {}×{} px, the result is {}×{} px", got.0, got.1, expected.0, expected.1)]
    ResultSize {
        /// Width and height of the image.
        got: (usize, usize),
        /// Result size of the map.
        expected: (usize, usize),
    },
}

/// A source image with interpolation method and border mode.
#[derive(Clone, Copy)]
struct Sampler<'a, T, const C: usize> {
    view: ImageView<'a, T, C>,
    options: RemapOptions,
}

impl<T: Pixel, const C: usize> Sampler<'_, T, C> {
    /// Samples the value at `(x, y)`, and whether that is inside.
    #[inline(always)]
    fn at(&self, x: f64, y: f64) -> ([T; C], bool) {
        let (w, h) = self.view.size();
        match (split_coordinate(x, w), split_coordinate(y, h)) {
            (Some(x), Some(y)) => (self.interpolate(x, y), true),
            _ => (self.extrapolate(x, y), false),
        }
    }

    #[inline(always)]
    fn interpolate(&self, (ix, fx): (usize, f32), (iy, fy): (usize, f32)) -> [T; C] {
        match self.options.interpolation {
            Interpolation::Nearest => {
                let near = |i: usize, f: f32, n: usize| (i + usize::from(f >= 0.5)).min(n - 1);
                self.view.at(near(ix, fx, self.view.width()), near(iy, fy, self.view.height()))
            }
            Interpolation::Bilinear => bilinear_at(self.view, ix, iy, fx, fy).map(T::from_f32),
            Interpolation::Bicubic => bicubic_at(self.view, ix, iy, fx, fy).map(T::from_f32),
        }
    }

    #[cold]
    fn extrapolate(&self, x: f64, y: f64) -> [T; C] {
        let (w, h) = self.view.size();
        let border_coordinate = |v: f64, n: usize| match self.options.border {
            Border::Zero => None,
            _ if !v.is_finite() => None,
            Border::Replicate => Some(v.clamp(0.0, (n - 1) as f64)),
            Border::Reflect => {
                // Triangle wave with the period of the reflected line.
                let period = 2.0 * (n - 1) as f64;
                let v = if period > 0.0 { v.rem_euclid(period) } else { 0.0 };
                Some(v.min(period - v))
            }
        };
        match (
            border_coordinate(x, w).and_then(|x| split_coordinate(x, w)),
            border_coordinate(y, h).and_then(|y| split_coordinate(y, h)),
        ) {
            (Some(x), Some(y)) => self.interpolate(x, y),
            _ => [T::default(); C],
        }
    }
}

/// Warps to an image of `size` (width, height) whose pixel `(x, y)` is the source at `map(x, y)`, and returns the mask of pixels that map
/// inside the source.
///
/// Inside means between the outermost pixel centers, `[0, w − 1] × [0, h − 1]`. Where the map is `None` the pixel is zero. The map is called in
/// unspecified order from several threads.
///
/// # Errors
/// [`WarpError::Size`] where the result is larger than memory can address.
pub fn warp_with<T: Pixel, const C: usize>(
    view: ImageView<'_, T, C>,
    size: (usize, usize),
    options: &RemapOptions,
    map: impl Fn(usize, usize) -> Option<Point2<f64>> + Sync,
) -> Result<(Image<T, C>, Mask), WarpError> {
    let mut out = Image::try_new(size.0, size.1, [T::default(); C])?;
    let mut mask = Mask::try_new(size.0, size.1, [false])?;
    if view.is_empty() {
        return Ok((out, mask));
    }
    let sampler = Sampler { view, options: *options };
    for_rows2(&mut out, &mut mask, |y, out, mask| {
        let (out, _) = out.as_chunks_mut::<C>();
        for (x, (out, mask)) in out.iter_mut().zip(mask).enumerate() {
            if let Some(p) = map(x, y) {
                (*out, *mask) = sampler.at(p.x, p.y);
            }
        }
    });
    Ok((out, mask))
}

/// As [`warp_with`], with the source positions as an image of `(x, y)` (OpenCV's `remap`); NaN means no source position.
pub fn remap<T: Pixel, const C: usize>(
    view: ImageView<'_, T, C>,
    map: ImageView<'_, f32, 2>,
    options: &RemapOptions,
) -> (Image<T, C>, Mask) {
    let mut out = Image::new(map.width(), map.height(), [T::default(); C]);
    let mut mask = Mask::new(map.width(), map.height(), [false]);
    if view.is_empty() {
        return (out, mask);
    }
    let sampler = Sampler { view, options: *options };
    for_rows2(&mut out, &mut mask, |y, out, mask| {
        let (out, _) = out.as_chunks_mut::<C>();
        let (map, _) = map.row(y).as_chunks::<2>();
        for ((out, mask), &[x, y]) in out.iter_mut().zip(mask).zip(map) {
            (*out, *mask) = sampler.at(f64::from(x), f64::from(y));
        }
    });
    (out, mask)
}

/// Warps by the homography `h` from source to result pixels to an image of `size` (width, height), and returns the mask of pixels that map
/// inside the source.
///
/// Inverse mapping. Pixels whose source is on or beyond the horizon (the homogeneous coordinate does not have its sign at the source's center)
/// have no source position.
///
/// # Errors
/// [`WarpError::NotInvertible`], [`WarpError::Size`].
pub fn warp_perspective<T: Pixel, const C: usize>(
    view: ImageView<'_, T, C>,
    h: &Matrix3<f64>,
    size: (usize, usize),
    options: &RemapOptions,
) -> Result<(Image<T, C>, Mask), WarpError> {
    let m = invert_homography(h)?;
    // Make the homogeneous coordinate of the source's center positive through the inverse.
    let center = h * cv_core::Vector3::new(view.width() as f64 / 2.0, view.height() as f64 / 2.0, 1.0);
    let m = if center.z < 0.0 { -m } else { m };
    warp_with(view, size, options, |x, y| {
        let (x, y) = (x as f64, y as f64);
        let w = m[(2, 0)] * x + m[(2, 1)] * y + m[(2, 2)];
        (w > 0.0).then(|| {
            let inv = 1.0 / w;
            Point2::new(
                (m[(0, 0)] * x + m[(0, 1)] * y + m[(0, 2)]) * inv,
                (m[(1, 0)] * x + m[(1, 1)] * y + m[(1, 2)]) * inv,
            )
        })
    })
}

/// Inverts a homography, scaled to unit norm so that the singularity test does not depend on its scale.
fn invert_homography(h: &Matrix3<f64>) -> Result<Matrix3<f64>, WarpError> {
    let singular = || WarpError::NotInvertible { determinant: h.determinant() };
    let norm = h.norm();
    if !(norm > 0.0 && norm.is_finite()) {
        return Err(singular());
    }
    (h / norm).try_inverse().filter(|m| m.iter().all(|v| v.is_finite())).ok_or_else(singular)
}

/// Removes lens distortion: the image of the same camera without distortion, with the same size and calibration matrix; black where out of
/// view.
///
/// # Errors
/// [`WarpError::Camera`] where the camera is invalid.
pub fn undistort<T: Pixel, const C: usize>(
    view: ImageView<'_, T, C>,
    camera: &Camera,
) -> Result<Image<T, C>, WarpError> {
    camera.validate()?;
    let k = camera.inverse_matrix();
    let options = RemapOptions::default();
    let (image, _) = warp_with(view, view.size(), &options, |x, y| {
        let ray = Point2::new(k[(0, 0)] * x as f64 + k[(0, 2)], k[(1, 1)] * y as f64 + k[(1, 2)]);
        // Beyond its turning point a lens model folds back, which would repeat the border of the image.
        camera.denormalize_in_range(ray)
    })?;
    Ok(image)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Distortion, GrayF32, GrayU8, RgbU8};
    use proptest::prelude::*;

    fn texture(w: usize, h: usize) -> RgbU8 {
        RgbU8::from_fn(w, h, |x, y| [(x * 7 + y * 3) as u8, (x * y) as u8, (255 - x) as u8])
    }

    #[test]
    fn the_identity_changes_no_pixel() {
        let image = texture(37, 21);
        for interpolation in [Interpolation::Nearest, Interpolation::Bilinear, Interpolation::Bicubic] {
            let options = RemapOptions { interpolation, ..Default::default() };
            let (out, mask) =
                warp_perspective(image.view(), &(Matrix3::identity() * -3.0), (37, 21), &options).unwrap();
            assert_eq!(out, image);
            assert!(mask.as_slice().iter().all(|&m| m));
        }
    }

    #[test]
    fn a_translation_moves_pixels_in_its_direction() {
        let image = texture(20, 10);
        let h = Matrix3::new(1.0, 0.0, 3.0, 0.0, 1.0, -2.0, 0.0, 0.0, 1.0);
        let (out, mask) = warp_perspective(image.view(), &h, (20, 10), &RemapOptions::default()).unwrap();
        for y in 0..10 {
            for x in 0..20 {
                let inside = x >= 3 && y + 2 < 10;
                assert_eq!(mask.at(x, y), [inside]);
                assert_eq!(out.at(x, y), if inside { image.at(x - 3, y + 2) } else { [0; 3] });
            }
        }
    }

    proptest! {
        #[test]
        fn a_warped_ramp_has_the_source_position_of_each_pixel(
            a in proptest::array::uniform4(-0.2f64..0.2), t in proptest::array::uniform2(-5.0f64..5.0), p in proptest::array::uniform2(-2e-3f64..2e-3),
        ) {
            let h = Matrix3::new(1.0 + a[0], a[1], t[0], a[2], 1.0 + a[3], t[1], p[0], p[1], 1.0);
            let image = Image::<f32, 2>::from_fn(40, 30, |x, y| [x as f32, y as f32]);
            let (out, mask) = warp_perspective(image.view(), &h, (40, 30), &RemapOptions::default()).unwrap();
            prop_assert!(mask.as_slice().iter().any(|&m| m));
            for y in 0..30 {
                for x in 0..40 {
                    if mask.at(x, y)[0] {
                        let [u, v] = out.at(x, y).map(f64::from);
                        let q = h * cv_core::Vector3::new(u, v, 1.0);
                        // The border tolerance of 1e-3 px, magnified by at most two.
                        prop_assert!((q.x / q.z - x as f64).abs() < 2e-3 && (q.y / q.z - y as f64).abs() < 2e-3);
                    }
                }
            }
        }

        #[test]
        fn remap_equals_warp_with(seed in any::<u32>(), border in 0usize..3, interpolation in 0usize..3) {
            let options = RemapOptions {
                interpolation: [Interpolation::Nearest, Interpolation::Bilinear, Interpolation::Bicubic][interpolation],
                border: [Border::Zero, Border::Replicate, Border::Reflect][border],
            };
            let image = texture(9, 7);
            let mut state = seed;
            let map = Image::<f32, 2>::from_fn(31, 5, |_, _| std::array::from_fn(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 8) as f32 / (1 << 24) as f32 * 40.0 - 15.0
            }));
            let by_map = remap(image.view(), map.view(), &options);
            let by_function = warp_with(image.view(), (31, 5), &options, |x, y| {
                let [u, v] = map.at(x, y).map(f64::from);
                Some(Point2::new(u, v))
            }).unwrap();
            prop_assert_eq!(by_map, by_function);
        }
    }

    #[test]
    fn border_modes() {
        let image = GrayU8::from_fn(4, 1, |x, _| [10 * x as u8]);
        let map = Image::<f32, 2>::from_fn(10, 1, |x, _| [x as f32 - 3.0, 0.0]);
        let run = |border| remap(image.view(), map.view(), &RemapOptions { border, ..Default::default() }).0.into_vec();
        assert_eq!(run(Border::Zero), [0, 0, 0, 0, 10, 20, 30, 0, 0, 0]);
        assert_eq!(run(Border::Replicate), [0, 0, 0, 0, 10, 20, 30, 30, 30, 30]);
        assert_eq!(run(Border::Reflect), [30, 20, 10, 0, 10, 20, 30, 20, 10, 0]);
    }

    #[test]
    fn singular_homographies_are_errors() {
        let image = texture(4, 4);
        let flat = Matrix3::new(1.0, 2.0, 3.0, 2.0, 4.0, 6.0, 0.0, 0.0, 1.0);
        for h in [flat, Matrix3::zeros(), Matrix3::identity() * f64::NAN, Matrix3::identity() * f64::INFINITY] {
            let result = warp_perspective(image.view(), &h, (4, 4), &RemapOptions::default());
            assert!(matches!(result, Err(WarpError::NotInvertible { .. })), "{h}");
        }
        assert!(
            warp_perspective(image.view(), &(Matrix3::identity() * 1e-9), (4, 4), &RemapOptions::default()).is_ok()
        );
        let huge = warp_perspective(image.view(), &Matrix3::identity(), (usize::MAX, 2), &RemapOptions::default());
        assert!(matches!(huge, Err(WarpError::Size(_))));
    }

    #[test]
    fn pixels_beyond_the_horizon_have_no_source() {
        // w = 1 − x/10 in the source: its right part is beyond the horizon and not in the result.
        let image = GrayF32::new(8, 8, [1.0]);
        let h = Matrix3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, -0.1, 0.0, 1.0);
        let (_, mask) = warp_perspective(image.view(), &h, (60, 8), &RemapOptions::default()).unwrap();
        // Source x = 7 maps to 7 / 0.3 = 23.3; no pixel right of it has a source position.
        assert!(mask.at(23, 0)[0] && (24..60).all(|x| !mask.at(x, 0)[0]));
    }

    #[test]
    fn undistortion_straightens_lines() {
        let distortion = Distortion::radial(-0.2, 0.05);
        let camera = Camera { distortion, ..Camera::from_focal(160, 120, 120.0) };
        // Pixel value = undistorted x, so that after undistortion each column is constant.
        let image =
            GrayF32::from_fn(160, 120, |x, y| [camera.undistort_pixel(Point2::new(x as f64, y as f64)).x as f32]);
        let out = undistort(image.view(), &camera).unwrap();
        for y in 10..110 {
            for x in 20..140 {
                // Bilinear interpolation of a curve whose second derivative is below 0.01 per px².
                assert!((out.at(x, y)[0] - x as f32).abs() < 2e-3);
            }
        }
        let invalid = Camera { fx: 0.0, ..camera };
        assert!(matches!(undistort(image.view(), &invalid), Err(WarpError::Camera(_))));
        assert!(undistort(RgbU8::new(0, 0, [0; 3]).view(), &camera).unwrap().is_empty());
    }
}
