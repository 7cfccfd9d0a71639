//! Correspondences between views, from the geometry of the scene.

use crate::render::Rendered;
use crate::scene::Scene;
use crate::shape::Ray;
use cv_core::{Camera, Correspondence, Image, Mask, Point2, Pose};
use cv_parallel::prelude::*;
use nalgebra::{Matrix3, Point3, Vector3};

impl Scene {
    /// Returns the world position of the surface at a pixel of a camera.
    ///
    /// `None` without a surface, or outside the range of the distortion model.
    pub fn point_at(&self, camera: &Camera, pose: &Pose, pixel: Point2<f64>) -> Option<Point3<f64>> {
        let n = camera.normalize(pixel);
        let dir = pose.rotation.inverse() * Vector3::new(n.x, n.y, 1.0);
        let ray = Ray { origin: pose.center(), dir };
        let hit = self.world.hit(&ray).filter(|_| n.x.is_finite())?;
        Some(ray.origin + ray.dir * hit.t)
    }

    /// Returns the pixel of a point in a camera; `None` if it is occluded or out of view.
    pub fn pixel_of(&self, camera: &Camera, pose: &Pose, point: &Point3<f64>) -> Option<Point2<f64>> {
        let local = pose.transform(point);
        let pixel = camera.project(&local)?;
        let is_inside = |v: f64, n: usize| v >= -0.5 && v <= n as f64 - 0.5;
        // A distortion model that is not monotonic beyond its range would project distant points into the image too.
        let undistorted = camera.normalize(pixel);
        let is_in_range = (undistorted.x - local.x / local.z).hypot(undistorted.y - local.y / local.z) < 1e-6;
        let is_in_view = is_in_range && is_inside(pixel.x, camera.width) && is_inside(pixel.y, camera.height);
        (is_in_view && self.has_line_of_sight(point, &pose.center())).then_some(pixel)
    }

    /// Transfers pixel `(x, y)` of view `a` to view `b`; `None` if it is not visible there.
    fn transfer(&self, a: &Rendered, b: &Rendered, x: usize, y: usize) -> Option<Point2<f64>> {
        let point = self.point_at(&a.camera, &a.pose, Point2::new(x as f64, y as f64))?;
        self.pixel_of(&b.camera, &b.pose, &point)
    }

    /// Returns the pixels of `a` whose centers are visible in `b`: in view and not occluded.
    pub fn visible_in_both(&self, a: &Rendered, b: &Rendered) -> Mask {
        let (width, height) = a.depth.size();
        let mut mask = Image::new(width, height, [false]);
        mask.as_mut_slice().par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
            row.iter_mut().enumerate().for_each(|(x, m)| *m = self.transfer(a, b, x, y).is_some());
        });
        mask
    }

    /// Returns exact correspondences: every `step`-th pixel of `a` in both directions that is visible in `b`.
    pub fn correspondences(&self, a: &Rendered, b: &Rendered, step: usize) -> Vec<Correspondence> {
        let (width, height) = a.depth.size();
        let step = step.max(1);
        let rows: Vec<usize> = (step / 2..height).step_by(step).collect();
        let of_row = |y: usize| -> Vec<Correspondence> {
            let columns = (step / 2..width).step_by(step);
            let from = columns.map(|x| (Point2::new(x as f64, y as f64), self.transfer(a, b, x, y)));
            from.filter_map(|(a, b)| Some(Correspondence { a, b: b? })).collect()
        };
        rows.into_par_iter().map(of_row).collect().into_iter().flatten().collect()
    }
}

/// Returns the homography from pixels of `a` to pixels of `b` by the plane through `point` (world) with `normal`.
///
/// With distorted cameras it relates undistorted pixels. Hartley & Zisserman, 2nd ed., equation 13.2: `H = K_b (R + t
/// nᵀ / d) K_a⁻¹` with the plane `nᵀ X = d` in the frame of `a`. Entry (3, 3) is 1.
///
/// `None` if the plane contains the center of `a`.
pub fn plane_homography(
    a: (&Camera, &Pose),
    b: (&Camera, &Pose),
    point: &Point3<f64>,
    normal: &Vector3<f64>,
) -> Option<Matrix3<f64>> {
    let n = a.1.rotation * normal;
    let d = n.dot(&a.1.transform(point).coords);
    if d.abs() < 1e-12 {
        return None;
    }
    let relative = Pose::relative(a.1, b.1);
    let induced = relative.rotation.matrix() + relative.translation * n.transpose() / d;
    Some(normalized(b.0.matrix() * induced * a.0.inverse_matrix()))
}

/// Returns the homography from pixels of `a` to pixels of `b` between cameras with a common center: `K_b R K_a⁻¹`.
///
/// With distorted cameras it relates undistorted pixels. Entry (3, 3) is 1.
pub fn rotation_homography(a: (&Camera, &Pose), b: (&Camera, &Pose)) -> Matrix3<f64> {
    let relative = Pose::relative(a.1, b.1);
    normalized(b.0.matrix() * relative.rotation.matrix() * a.0.inverse_matrix())
}

/// Scales a homography so that entry (3, 3) is 1, or to unit norm if that entry is nearly zero.
fn normalized(h: Matrix3<f64>) -> Matrix3<f64> {
    let norm = h.norm();
    if h[(2, 2)].abs() > 1e-9 * norm { h / h[(2, 2)] } else { h / norm }
}
