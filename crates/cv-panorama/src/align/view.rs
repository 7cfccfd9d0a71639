//! The pose and intrinsics of one photograph in the panorama.

use cv_core::{Camera, Matrix3, Point2, Vector3};

/// The projection of a photograph: `pixel ~ camera(from_world · ray)`.
///
/// `from_world` is a rotation for a camera rotating about its center, and any invertible 3×3 matrix (a homography) for a planar scene.
/// World frame: X right, Y down, Z forward toward the center of the panorama.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// Size, focal length, principal point and lens distortion, in pixels of the photograph.
    pub camera: Camera,
    /// World ray to camera ray, up to a positive factor.
    pub from_world: Matrix3<f64>,
}

impl View {
    /// Projects the direction `ray` to a pixel, which may lie outside the image; `None` behind the camera and beyond the range in which the lens model is monotonic, where
    /// directions fold back into the image.
    pub fn project(&self, ray: &Vector3<f64>) -> Option<Point2<f64>> {
        let p = self.from_world * ray;
        let is_in_front = p.z > 1e-9 * p.norm();
        if !is_in_front {
            return None;
        }
        self.camera.denormalize_in_range(Point2::new(p.x / p.z, p.y / p.z))
    }

    /// Back-projects a pixel to a world direction of unit length; `None` outside the range of the distortion model.
    pub fn ray(&self, pixel: Point2<f64>) -> Option<Vector3<f64>> {
        let n = self.camera.normalize(pixel);
        let inverse = self.from_world.try_inverse()?;
        let ray = (inverse * Vector3::new(n.x, n.y, 1.0)).normalize();
        ray.iter().all(|v| v.is_finite()).then_some(ray)
    }

    /// Returns whether the pixel lies inside the image.
    pub fn contains(&self, p: Point2<f64>) -> bool {
        p.x >= 0.0 && p.y >= 0.0 && p.x <= self.camera.width as f64 - 1.0 && p.y <= self.camera.height as f64 - 1.0
    }

    /// Returns the view of the image resized by `factor`.
    pub fn scaled(&self, factor: f64) -> Self {
        Self { camera: self.camera.scaled(factor), from_world: self.from_world }
    }

    /// Samples the border of the image in order, `per_side` points per side; where the lens model does not reach it, that of the model's range.
    pub(crate) fn border(&self, per_side: usize) -> Vec<Point2<f64>> {
        let (w, h) = (self.camera.width as f64 - 1.0, self.camera.height as f64 - 1.0);
        let n = per_side.max(1);
        let corners = [Point2::new(0.0, 0.0), Point2::new(w, 0.0), Point2::new(w, h), Point2::new(0.0, h)];
        (0..4)
            .flat_map(|side| {
                let (a, b) = (corners[side], corners[(side + 1) % 4]);
                (0..n).map(move |i| a + (b - a) * (i as f64 / n as f64))
            })
            .map(|pixel| self.in_range(pixel))
            .collect()
    }

    /// Returns the pixel itself if it has a ray, and otherwise the farthest one towards the principal point that has.
    fn in_range(&self, pixel: Point2<f64>) -> Point2<f64> {
        let has_ray = |p: &Point2<f64>| self.camera.normalize(*p).iter().all(|v| v.is_finite());
        let center = Point2::new(self.camera.cx, self.camera.cy);
        if has_ray(&pixel) {
            return pixel;
        }
        let at = |part: f64| center + (pixel - center) * part;
        let (mut inside, mut beyond) = (0.0, 1.0);
        // To a millionth of the distance.
        for _ in 0..20 {
            let middle = 0.5 * (inside + beyond);
            *(if has_ray(&at(middle)) { &mut inside } else { &mut beyond }) = middle;
        }
        at(inside)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Distortion;
    use nalgebra::Rotation3;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_ray_is_seen_at_the_pixel_it_is_of(x in 0.0..639.0_f64, y in 0.0..479.0_f64, yaw in -3.0..3.0_f64, k1 in -0.1..0.1_f64) {
            let camera = Camera { distortion: Distortion::simple_radial(k1), ..Camera::from_focal(640, 480, 600.0) };
            let view = View { camera, from_world: Rotation3::from_euler_angles(0.2, yaw, -0.1).into_inner() };
            let ray = view.ray(Point2::new(x, y)).unwrap();
            prop_assert!((ray.norm() - 1.0).abs() < 1e-12);
            // Undistortion iterates to 1e-10 or so of the normalized coordinates.
            prop_assert!((view.project(&(ray * 7.0)).unwrap() - Point2::new(x, y)).norm() < 1e-6);
            prop_assert_eq!(view.project(&-ray), None);
        }
    }

    #[test]
    fn a_direction_beyond_the_range_of_the_lens_is_not_seen() {
        let camera = Camera { distortion: Distortion::simple_radial(-0.2), ..Camera::from_focal(640, 480, 600.0) };
        let view = View { camera, from_world: Matrix3::identity() };
        // The distorted radius r (1 − 0.2 r²) increases up to r = √(5/3) = 1.29 and is 0.2 again at 2.13, inside the image.
        assert!(view.contains(camera.denormalize(Point2::new(2.13, 0.0))));
        assert_eq!(view.project(&Vector3::new(2.13, 0.0, 1.0)), None);
        assert!(view.project(&Vector3::new(1.28, 0.0, 1.0)).is_some_and(|p| !view.contains(p)));
    }

    #[test]
    fn the_border_is_that_of_the_range_of_the_lens_where_it_ends_before_the_image() {
        let camera = Camera { distortion: Distortion::simple_radial(-0.3), ..Camera::from_focal(640, 480, 400.0) };
        let view = View { camera, from_world: Matrix3::identity() };
        // The distorted radius r (1 − 0.3 r²) increases up to r = √(1 / 0.9) = 1.054, where it is 2/3 of that: 281 of 320 pixels.
        let limit = 400.0 * 2.0 / 3.0 * (1.0_f64 / 0.9).sqrt();
        let pinhole = View { camera: Camera { distortion: Distortion::NONE, ..camera }, ..view };
        for (reached, full) in view.border(9).into_iter().zip(pinhole.border(9)) {
            let center = Point2::new(319.5, 239.5);
            let (distance, to_border) = ((reached - center).norm(), (full - center).norm());
            assert!((distance - to_border.min(limit)).abs() < 0.5, "{reached}");
            assert!(view.ray(reached).is_some());
        }
    }

    #[test]
    fn the_border_goes_once_around_and_a_scaled_view_sees_the_same() {
        let view = View { camera: Camera::from_focal(30, 20, 25.0), from_world: Matrix3::identity() };
        let border = view.border(5);
        assert_eq!((border.len(), border[0], border[10]), (20, Point2::new(0.0, 0.0), Point2::new(29.0, 19.0)));
        assert!(border.iter().all(|p| view.contains(*p)));
        assert!(!view.contains(Point2::new(29.1, 5.0)) && !view.contains(Point2::new(5.0, -0.1)));
        let half = view.scaled(0.5);
        assert!((half.ray(Point2::new(2.0, 3.0)).unwrap() - view.ray(Point2::new(4.5, 6.5)).unwrap()).norm() < 1e-12);
    }
}
