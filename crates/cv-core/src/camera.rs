//! Camera intrinsics, and projection with its derivatives.

use nalgebra::{Matrix1x2, Matrix1x3, Matrix2x3, Matrix3, Point2, Point3, SMatrix};

use crate::Scaling;
use crate::distortion::{Distortion, MAX_PARAMETERS};

/// Maximum number of intrinsics of a camera: fx, fy, cx, cy, and the distortion parameters.
pub const MAX_INTRINSICS: usize = 4 + MAX_PARAMETERS;

/// Why a camera is not valid.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum CameraError {
    /// A focal length is not a positive number.
    #[error("the focal lengths {fx} and {fy} px are not both positive")]
    Focal {
        /// Horizontal focal length in pixels.
        fx: f64,
        /// Vertical focal length in pixels.
        fy: f64,
    },
    /// A parameter is NaN or infinite.
    #[error("a camera parameter is not finite")]
    NotFinite,
}

/// A camera: image size, pinhole intrinsics and lens distortion.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Camera {
    /// Image width in pixels.
    pub width: usize,
    /// Image height in pixels.
    pub height: usize,
    /// Horizontal focal length in pixels.
    pub fx: f64,
    /// Vertical focal length in pixels.
    pub fy: f64,
    /// Principal point, x, pixel centers at integers. (COLMAP puts them at +0.5: subtract 0.5 from its value.)
    pub cx: f64,
    /// Principal point, y.
    pub cy: f64,
    /// Lens distortion.
    pub distortion: Distortion,
}

/// A scene point projected into a camera, with the Jacobians of its pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ProjectedPoint {
    /// The projected pixel.
    pub pixel: Point2<f64>,
    /// Derivative of the pixel by the point in the camera frame.
    pub point_jacobian: Matrix2x3<f64>,
    /// Derivative of the pixel by the intrinsics, columns in the order of [`Camera::intrinsics`]; columns beyond the
    /// camera's intrinsics are zero.
    pub intrinsics_jacobian: SMatrix<f64, 2, MAX_INTRINSICS>,
}

impl Camera {
    /// Makes a camera without distortion.
    pub fn pinhole(width: usize, height: usize, fx: f64, fy: f64, cx: f64, cy: f64) -> Self {
        Self { width, height, fx, fy, cx, cy, distortion: Distortion::NONE }
    }

    /// Makes a camera with square pixels and its principal point at the image center.
    pub fn from_focal(width: usize, height: usize, focal: f64) -> Self {
        let center = |n: usize| (n as f64 - 1.0) / 2.0;
        Self::pinhole(width, height, focal, focal, center(width), center(height))
    }

    /// Checks that all parameters are finite and the focal lengths positive.
    ///
    /// # Errors
    /// [`CameraError`] for the first violation.
    pub fn validate(&self) -> Result<(), CameraError> {
        if !(self.cx.is_finite() && self.cy.is_finite() && self.distortion.is_finite()) {
            return Err(CameraError::NotFinite);
        }
        if !(self.fx > 0.0 && self.fy > 0.0 && self.fx.is_finite() && self.fy.is_finite()) {
            return Err(CameraError::Focal { fx: self.fx, fy: self.fy });
        }
        Ok(())
    }

    /// The calibration matrix K.
    pub fn matrix(&self) -> Matrix3<f64> {
        Matrix3::new(self.fx, 0.0, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0)
    }

    /// K⁻¹ in closed form.
    pub fn inverse_matrix(&self) -> Matrix3<f64> {
        let (fx, fy) = (self.fx, self.fy);
        Matrix3::new(1.0 / fx, 0.0, -self.cx / fx, 0.0, 1.0 / fy, -self.cy / fy, 0.0, 0.0, 1.0)
    }

    /// Returns the number of intrinsics: four and the distortion parameters.
    pub fn intrinsic_count(&self) -> usize {
        4 + self.distortion.parameters().len()
    }

    /// Returns the intrinsics as a vector: fx, fy, cx, cy, the distortion parameters in the model's order, then zeros.
    pub fn intrinsics(&self) -> [f64; MAX_INTRINSICS] {
        let mut out = [0.0; MAX_INTRINSICS];
        out[..4].copy_from_slice(&[self.fx, self.fy, self.cx, self.cy]);
        let parameters = self.distortion.parameters();
        out[4..4 + parameters.len()].copy_from_slice(parameters);
        out
    }

    /// Returns the camera with its intrinsics replaced by `values`, in the order of [`Self::intrinsics`]; entries beyond
    /// [`Self::intrinsic_count`] are ignored.
    pub fn with_intrinsics(&self, values: &[f64; MAX_INTRINSICS]) -> Self {
        let [fx, fy, cx, cy, ..] = *values;
        let mut out = Self { fx, fy, cx, cy, ..*self };
        out.distortion.parameters_mut().iter_mut().zip(&values[4..]).for_each(|(p, v)| *p = *v);
        out
    }

    /// Projects a point in camera coordinates to a pixel; `None` where its depth is not positive. The valid range of the
    /// lens is not checked ([`Distortion::distort_in_range`] does).
    #[inline]
    pub fn project(&self, p: &Point3<f64>) -> Option<Point2<f64>> {
        (p.z > 0.0).then(|| self.denormalize(Point2::new(p.x / p.z, p.y / p.z)))
    }

    /// As [`Self::project`], with the Jacobians by the point and by the intrinsics.
    #[inline]
    pub fn project_with_jacobians(&self, p: &Point3<f64>) -> Option<ProjectedPoint> {
        if p.z <= 0.0 || p.z.is_nan() {
            return None;
        }
        let inverse = 1.0 / p.z;
        let ideal = Point2::new(p.x * inverse, p.y * inverse);
        let (d, j, parameter_jacobian) = self.distortion.distort_with_jacobians(ideal);
        // Written out entry by entry: the matrix products would multiply mostly by zeros.
        let (by_x, by_y) = (j.row(0) * self.fx, j.row(1) * self.fy);
        let along = |m: &Matrix1x2<f64>| {
            Matrix1x3::new(m.x * inverse, m.y * inverse, m.x * (-ideal.x * inverse) + m.y * (-ideal.y * inverse))
        };
        let mut intrinsics_jacobian = SMatrix::<f64, 2, MAX_INTRINSICS>::zeros();
        let (pinhole_columns, distortion_columns) = intrinsics_jacobian.as_mut_slice().split_at_mut(8);
        pinhole_columns.copy_from_slice(&[d.x, 0.0, 0.0, d.y, 1.0, 0.0, 0.0, 1.0]);
        let columns =
            distortion_columns.as_chunks_mut::<2>().0.iter_mut().zip(parameter_jacobian.as_slice().as_chunks::<2>().0);
        columns.for_each(|(column, [x, y])| *column = [self.fx * x, self.fy * y]);
        Some(ProjectedPoint {
            pixel: Point2::new(self.fx * d.x + self.cx, self.fy * d.y + self.cy),
            point_jacobian: Matrix2x3::from_rows(&[along(&by_x), along(&by_y)]),
            intrinsics_jacobian,
        })
    }

    /// Converts a pixel to the undistorted normalized coordinates of its ray, whose direction is `(x, y, 1)`. NaN where
    /// the lens model has no ray for it ([`Distortion::undistort`]).
    #[inline]
    pub fn normalize(&self, pixel: Point2<f64>) -> Point2<f64> {
        self.distortion.undistort(Point2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy))
    }

    /// Converts undistorted normalized coordinates to a pixel (distortion applied).
    #[inline]
    pub fn denormalize(&self, ray: Point2<f64>) -> Point2<f64> {
        let d = self.distortion.distort(ray);
        Point2::new(self.fx * d.x + self.cx, self.fy * d.y + self.cy)
    }

    /// As [`Self::denormalize`], but `None` beyond the range in which the lens model is monotonic, where rays fold back into the image.
    #[inline]
    pub fn denormalize_in_range(&self, ray: Point2<f64>) -> Option<Point2<f64>> {
        let d = self.distortion.distort_in_range(ray)?;
        Some(Point2::new(self.fx * d.x + self.cx, self.fy * d.y + self.cy))
    }

    /// Returns the pixel at which the same camera without distortion would image the ray of `pixel`.
    pub fn undistort_pixel(&self, pixel: Point2<f64>) -> Point2<f64> {
        let n = self.normalize(pixel);
        Point2::new(self.fx * n.x + self.cx, self.fy * n.y + self.cy)
    }

    /// Returns the camera of the image scaled by `factor` (0.5 for half resolution), pixel centers at integers. The sides are
    /// rounded but the intrinsics scale by exactly `factor`; [`Self::resized`] is exact for an image resampled to a whole
    /// number of pixels.
    pub fn scaled(&self, factor: f64) -> Self {
        let side = |n: usize| (n as f64 * factor).round() as usize;
        self.with_scaling((side(self.width), side(self.height)), Scaling::uniform(factor))
    }

    /// Returns the camera of the image resized to `width × height` pixels, image edges aligned ([`Scaling`]).
    pub fn resized(&self, width: usize, height: usize) -> Self {
        self.with_scaling((width, height), Scaling::between((self.width, self.height), (width, height)))
    }

    fn with_scaling(&self, (width, height): (usize, usize), scaling: Scaling) -> Self {
        let center = scaling.point(Point2::new(self.cx, self.cy));
        Self {
            width,
            height,
            fx: self.fx * scaling.x,
            fy: self.fy * scaling.y,
            cx: center.x,
            cy: center.y,
            distortion: self.distortion,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector2;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_jacobians_are_the_derivatives(
            distortion in crate::distortion::examples(), x in -0.5..0.5f64, y in -0.5..0.5f64, z in 1.0..3.0f64,
        ) {
            let camera = Camera { distortion, ..Camera::pinhole(640, 480, 500.0, 510.0, 310.0, 245.0) };
            let point = Point3::new(x, y, z);
            let seen = camera.project_with_jacobians(&point).unwrap();
            prop_assert!((seen.pixel - camera.project(&point).unwrap()).norm() < 1e-10);
            let h = 1e-6;
            // Pixels up to a thousand: rounding 1e-13/h, and h² of third derivatives of a few thousand.
            let near = |analytic: Vector2<f64>, a: Point2<f64>, b: Point2<f64>, h: f64| ((a - b) / (2.0 * h) - analytic).norm() < 1e-6 * (1.0 + analytic.norm());
            for axis in 0..3 {
                let d = nalgebra::Vector3::ith(axis, h);
                let (a, b) = (camera.project(&(point + d)).unwrap(), camera.project(&(point - d)).unwrap());
                prop_assert!(near(seen.point_jacobian.column(axis).into(), a, b, h), "axis {axis}");
            }
            for i in 0..MAX_INTRINSICS {
                let moved = |d: f64| {
                    let mut values = camera.intrinsics();
                    values[i] += d;
                    camera.with_intrinsics(&values).project(&point).unwrap()
                };
                prop_assert!(near(seen.intrinsics_jacobian.column(i).into(), moved(h), moved(-h), h), "intrinsic {i}");
            }
        }
    }

    #[test]
    fn scaling_keeps_the_image_edges_where_they_are() {
        let camera = Camera::from_focal(640, 480, 500.0).scaled(0.5);
        assert_eq!((camera.width, camera.height, camera.fx), (320, 240, 250.0));
        assert_eq!((camera.cx, camera.cy), (159.5, 119.5));
    }

    #[test]
    fn resizing_keeps_image_edges_where_the_aspect_ratio_changes_by_rounding() {
        let camera = Camera::pinhole(641, 479, 500.0, 510.0, 300.0, 250.0);
        let small = camera.resized(100, 75);
        // A ray through an image edge goes through the same edge of the small image: half a pixel outside the first and last centers.
        for (x, y) in [(0.0, 0.0), (1.0, 1.0)] {
            let ray = camera.normalize(Point2::new(641.0 * x - 0.5, 479.0 * y - 0.5));
            let p = small.denormalize(ray);
            assert!((p - Point2::new(100.0 * x - 0.5, 75.0 * y - 0.5)).norm() < 1e-12, "{p}");
        }
    }

    #[test]
    fn invalid_cameras_are_refused_with_the_reason() {
        let mut camera = Camera::from_focal(10, 10, -1.0);
        assert_eq!(camera.validate(), Err(CameraError::Focal { fx: -1.0, fy: -1.0 }));
        camera.cx = f64::NAN;
        assert_eq!(camera.validate(), Err(CameraError::NotFinite));
    }
}
