//! Camera intrinsics and lens distortion.

use nalgebra::{Matrix2, Matrix3, Point2, Point3, Vector2};

/// Lens distortion, applied to normalized image coordinates `(x, y) = (X/Z, Y/Z)`.
///
/// The coefficients keep the names and order of OpenCV's `calib3d` and COLMAP's camera models.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Distortion {
    /// A pinhole.
    #[default]
    None,
    /// `x' = x (1 + k1 r² + k2 r⁴)`. COLMAP's SIMPLE_RADIAL has `k2 = 0`.
    Radial {
        /// Coefficient of r².
        k1: f64,
        /// Coefficient of r⁴.
        k2: f64,
    },
    /// Brown–Conrady: three radial and two tangential terms (OpenCV's default five, `k1 k2 p1 p2 k3`).
    BrownConrady {
        /// Coefficient of r².
        k1: f64,
        /// Coefficient of r⁴.
        k2: f64,
        /// First tangential coefficient.
        p1: f64,
        /// Second tangential coefficient.
        p2: f64,
        /// Coefficient of r⁶.
        k3: f64,
    },
    /// Kannala–Brandt fisheye: `θ' = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)`, `θ = atan r`.
    Fisheye {
        /// Coefficient of θ².
        k1: f64,
        /// Coefficient of θ⁴.
        k2: f64,
        /// Coefficient of θ⁶.
        k3: f64,
        /// Coefficient of θ⁸.
        k4: f64,
    },
}

impl Distortion {
    /// Ideal to distorted normalized coordinates.
    pub fn distort(&self, p: Point2<f64>) -> Point2<f64> {
        self.distort_with_jacobian(p).0
    }

    /// Ideal to distorted normalized coordinates, with the 2×2 derivative by the ideal ones.
    pub fn distort_with_jacobian(&self, p: Point2<f64>) -> (Point2<f64>, Matrix2<f64>) {
        let (x, y) = (p.x, p.y);
        let r2 = x * x + y * y;
        // A radial factor g(r²) and its derivative g' by r².
        let radial = |g: f64, dg: f64| {
            (
                Point2::new(x * g, y * g),
                Matrix2::new(g + 2.0 * x * x * dg, 2.0 * x * y * dg, 2.0 * x * y * dg, g + 2.0 * y * y * dg),
            )
        };
        match *self {
            Self::None => (p, Matrix2::identity()),
            Self::Radial { k1, k2 } => radial(1.0 + r2 * (k1 + r2 * k2), k1 + 2.0 * k2 * r2),
            Self::BrownConrady { k1, k2, p1, p2, k3 } => {
                let g = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                let (mut q, mut j) = radial(g, k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2));
                q.x += 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
                q.y += p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
                j[(0, 0)] += 2.0 * p1 * y + 6.0 * p2 * x;
                j[(0, 1)] += 2.0 * p1 * x + 2.0 * p2 * y;
                j[(1, 0)] += 2.0 * p1 * x + 2.0 * p2 * y;
                j[(1, 1)] += 6.0 * p1 * y + 2.0 * p2 * x;
                (q, j)
            }
            Self::Fisheye { k1, k2, k3, k4 } => {
                let r = r2.sqrt();
                if r < 1e-8 {
                    return (p, Matrix2::identity());
                }
                let theta = r.atan();
                let t2 = theta * theta;
                let d = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
                let dd = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)));
                // g(r²) = d(θ)/r; by r²: (d'·θ'·r − d)/(2 r³) with θ' = 1/(1 + r²).
                radial(d / r, (dd * r / (1.0 + r2) - d) / (2.0 * r2 * r))
            }
        }
    }

    /// Distorted to ideal normalized coordinates, by Newton's method from the distorted point.
    ///
    /// NaN where no ideal point near the image maps there (outside the range in which the model is monotonic).
    pub fn undistort(&self, q: Point2<f64>) -> Point2<f64> {
        const NONE: Point2<f64> = Point2::new(f64::NAN, f64::NAN);
        if *self == Self::None {
            return q;
        }
        let mut p = match *self {
            // The radius of a fisheye grows as tan θ: start from the inverse of the equidistant part.
            Self::Fisheye { .. } => {
                let r = q.coords.norm();
                let theta = r.min(1.5);
                if r > 1e-12 { Point2::from(q.coords * (theta.tan() / r)) } else { q }
            }
            _ => q,
        };
        let mut residual = f64::INFINITY;
        for _ in 0..50 {
            let (d, j) = self.distort_with_jacobian(p);
            let error: Vector2<f64> = d - q;
            residual = error.norm();
            // Ten digits below the smallest sub-pixel quantity of any real lens.
            if residual < 1e-13 * (1.0 + q.coords.norm()) {
                break;
            }
            let Some(step) = j.try_inverse().map(|inverse| inverse * error) else { return NONE };
            // Damped, so that a step never leaves the neighborhood where the model means something.
            let limit = 0.5 * (1.0 + p.coords.norm());
            let norm = step.norm();
            p -= if norm > limit { step * (limit / norm) } else { step };
        }
        let (_, j) = self.distort_with_jacobian(p);
        // Beyond its turning point the polynomial folds back: such a solution is not what the lens did.
        if residual < 1e-9 * (1.0 + q.coords.norm()) && j.determinant() > 0.0 && j.trace() > 0.0 { p } else { NONE }
    }

    /// True where every coefficient is finite.
    pub fn is_finite(&self) -> bool {
        match *self {
            Self::None => true,
            Self::Radial { k1, k2 } => k1.is_finite() && k2.is_finite(),
            Self::BrownConrady { k1, k2, p1, p2, k3 } => [k1, k2, p1, p2, k3].iter().all(|v| v.is_finite()),
            Self::Fisheye { k1, k2, k3, k4 } => [k1, k2, k3, k4].iter().all(|v| v.is_finite()),
        }
    }
}

/// Why a camera is not one.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
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

impl Camera {
    /// A camera without distortion.
    pub fn pinhole(width: usize, height: usize, fx: f64, fy: f64, cx: f64, cy: f64) -> Self {
        Self { width, height, fx, fy, cx, cy, distortion: Distortion::None }
    }

    /// A camera with square pixels and its principal point in the middle of the image.
    pub fn from_focal(width: usize, height: usize, focal: f64) -> Self {
        let middle = |n: usize| (n as f64 - 1.0) / 2.0;
        Self::pinhole(width, height, focal, focal, middle(width), middle(height))
    }

    /// Checks that every parameter makes sense.
    ///
    /// # Errors
    /// [`CameraError`] with the first thing that is wrong.
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

    /// Camera coordinates to pixels; `None` behind the camera or in its plane.
    #[inline]
    pub fn project(&self, p: &Point3<f64>) -> Option<Point2<f64>> {
        (p.z > 0.0).then(|| self.denormalize(Point2::new(p.x / p.z, p.y / p.z)))
    }

    /// Pixel to the ideal normalized coordinates of its ray (distortion removed): the direction is `(x, y, 1)`.
    #[inline]
    pub fn normalize(&self, pixel: Point2<f64>) -> Point2<f64> {
        self.distortion.undistort(Point2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy))
    }

    /// Ideal normalized coordinates to a pixel (distortion applied).
    #[inline]
    pub fn denormalize(&self, ray: Point2<f64>) -> Point2<f64> {
        let d = self.distortion.distort(ray);
        Point2::new(self.fx * d.x + self.cx, self.fy * d.y + self.cy)
    }

    /// A pixel as the same camera without distortion would see it.
    pub fn undistort_pixel(&self, pixel: Point2<f64>) -> Point2<f64> {
        let n = self.normalize(pixel);
        Point2::new(self.fx * n.x + self.cx, self.fy * n.y + self.cy)
    }

    /// The same camera behind an image scaled by `factor` (0.5 for half size), pixel centers at integers. Where the image was made of a whole
    /// number of pixels, [`Self::resized`] says what it shows to the last digit.
    pub fn scaled(&self, factor: f64) -> Self {
        let side = |n: usize| (n as f64 * factor).round() as usize;
        self.stretched((side(self.width), side(self.height)), factor, factor)
    }

    /// The same camera behind an image resized to `width × height`: the corners of the pictures meet, not the centers of their corner pixels.
    pub fn resized(&self, width: usize, height: usize) -> Self {
        self.stretched((width, height), width as f64 / self.width as f64, height as f64 / self.height as f64)
    }

    fn stretched(&self, (width, height): (usize, usize), x: f64, y: f64) -> Self {
        Self {
            width,
            height,
            fx: self.fx * x,
            fy: self.fy * y,
            cx: (self.cx + 0.5) * x - 0.5,
            cy: (self.cy + 0.5) * y - 0.5,
            distortion: self.distortion,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn models() -> impl Strategy<Value = Distortion> {
        // Coefficients of the size real lenses have, small enough that the test's points stay in the monotonic range.
        let k = -0.2..0.2f64;
        let p = -0.01..0.01f64;
        prop_oneof![
            Just(Distortion::None),
            (k.clone(), -0.05..0.05f64).prop_map(|(k1, k2)| Distortion::Radial { k1, k2 }),
            (k, -0.05..0.05f64, p.clone(), p.clone(), -0.01..0.01f64)
                .prop_map(|(k1, k2, p1, p2, k3)| Distortion::BrownConrady { k1, k2, p1, p2, k3 }),
            (-0.05..0.05f64, p.clone(), -0.005..0.005f64, -0.001..0.001f64)
                .prop_map(|(k1, k2, k3, k4)| Distortion::Fisheye { k1, k2, k3, k4 }),
        ]
    }

    proptest! {
        #[test]
        fn undistorting_undoes_distorting(model in models(), x in -0.7..0.7f64, y in -0.6..0.6f64) {
            let p = Point2::new(x, y);
            let back = model.undistort(model.distort(p));
            // Newton stops at 1e-13; the model's derivative here is between 0.5 and 2.
            prop_assert!((back - p).norm() < 1e-11, "{back} for {p}");
        }

        #[test]
        fn the_jacobian_is_the_derivative(model in models(), x in -0.7..0.7f64, y in -0.6..0.6f64) {
            let h = 1e-6;
            let (_, j) = model.distort_with_jacobian(Point2::new(x, y));
            for (column, d) in [Vector2::new(h, 0.0), Vector2::new(0.0, h)].into_iter().enumerate() {
                let p = Point2::new(x, y);
                let numeric = (model.distort(p + d) - model.distort(p - d)) / (2.0 * h);
                // Central differences: h² truncation plus 1e-16/h rounding.
                prop_assert!((numeric - j.column(column)).norm() < 1e-8);
            }
        }
    }

    #[test]
    fn a_point_no_ray_reaches_is_nan_not_a_wrong_number() {
        // x(1 − 0.5 x²) peaks at 0.544 for x = 0.816: nothing maps to 0.7.
        let model = Distortion::Radial { k1: -0.5, k2: 0.0 };
        assert!(model.undistort(Point2::new(0.7, 0.0)).x.is_nan());
        assert!((model.undistort(Point2::new(0.54, 0.0)).x - 0.7).abs() < 0.1);
    }

    #[test]
    fn the_brown_conrady_terms_are_opencvs() {
        // By hand from the formula in OpenCV's calib3d documentation at (0.3, −0.2), r² = 0.13.
        let model = Distortion::BrownConrady { k1: 0.1, k2: 0.2, p1: 0.01, p2: 0.02, k3: 0.3 };
        let radial = 1.0 + 0.1 * 0.13 + 0.2 * 0.0169 + 0.3 * 0.002197;
        let x = 0.3 * radial + 2.0 * 0.01 * 0.3 * -0.2 + 0.02 * (0.13 + 2.0 * 0.09);
        let y = -0.2 * radial + 0.01 * (0.13 + 2.0 * 0.04) + 2.0 * 0.02 * 0.3 * -0.2;
        let q = model.distort(Point2::new(0.3, -0.2));
        // The same arithmetic in another order.
        assert!((q.x - x).abs() < 1e-15 && (q.y - y).abs() < 1e-15);
    }

    #[test]
    fn scaling_keeps_the_image_edges_where_they_are() {
        let camera = Camera::from_focal(640, 480, 500.0).scaled(0.5);
        assert_eq!((camera.width, camera.height, camera.fx), (320, 240, 250.0));
        assert_eq!((camera.cx, camera.cy), (159.5, 119.5));
    }

    #[test]
    fn resizing_keeps_each_edge_where_it_is_though_the_sides_round_apart() {
        let camera = Camera::pinhole(641, 479, 500.0, 510.0, 300.0, 250.0);
        let small = camera.resized(100, 75);
        // A ray through an edge of the picture goes through that edge of the small one: half a pixel outside the first and last centers.
        for (x, y) in [(0.0, 0.0), (1.0, 1.0)] {
            let ray = camera.normalize(Point2::new(641.0 * x - 0.5, 479.0 * y - 0.5));
            let p = small.denormalize(ray);
            assert!((p - Point2::new(100.0 * x - 0.5, 75.0 * y - 0.5)).norm() < 1e-12, "{p}");
        }
    }

    #[test]
    fn nonsense_cameras_are_named() {
        let mut camera = Camera::from_focal(10, 10, -1.0);
        assert_eq!(camera.validate(), Err(CameraError::Focal { fx: -1.0, fy: -1.0 }));
        camera.cx = f64::NAN;
        assert_eq!(camera.validate(), Err(CameraError::NotFinite));
    }
}
