//! How one photograph looks at the panorama's world.

use cv_core::{Camera, Matrix3, Point2, Vector3};

/// A photograph placed in the panorama's world: `pixel ~ camera(from_world · ray)`.
///
/// `from_world` is a rotation where the camera turned about its center, and any invertible 3×3 where the scene is flat and the
/// camera moved. World frame: X right, Y down, Z forward, the middle of the panorama on the Z axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// Size, focal length, principal point and lens distortion, in pixels of the photograph.
    pub camera: Camera,
    /// World ray to camera ray, up to a positive scale.
    pub from_world: Matrix3<f64>,
}

impl View {
    /// The pixel at which the photograph sees the direction `ray`, whether or not that lies inside it; `None` behind the camera.
    pub fn project(&self, ray: &Vector3<f64>) -> Option<Point2<f64>> {
        let p = self.from_world * ray;
        (p.z > 1e-9 * p.norm()).then(|| self.camera.denormalize(Point2::new(p.x / p.z, p.y / p.z)))
    }

    /// The world direction of a pixel, of unit length; `None` where no ray reaches the pixel (beyond the lens model's range).
    pub fn ray(&self, pixel: Point2<f64>) -> Option<Vector3<f64>> {
        let n = self.camera.normalize(pixel);
        let inverse = self.from_world.try_inverse()?;
        let ray = (inverse * Vector3::new(n.x, n.y, 1.0)).normalize();
        ray.iter().all(|v| v.is_finite()).then_some(ray)
    }

    /// True where the pixel lies on the photograph.
    pub fn contains(&self, p: Point2<f64>) -> bool {
        p.x >= 0.0 && p.y >= 0.0 && p.x <= self.camera.width as f64 - 1.0 && p.y <= self.camera.height as f64 - 1.0
    }

    /// The same view of the photograph resized by `factor`.
    pub fn scaled(&self, factor: f64) -> Self {
        Self { camera: self.camera.scaled(factor), from_world: self.from_world }
    }

    /// Points along the photograph's border, `per_side` to a side, in order.
    pub(crate) fn border(&self, per_side: usize) -> Vec<Point2<f64>> {
        let (w, h) = (self.camera.width as f64 - 1.0, self.camera.height as f64 - 1.0);
        let n = per_side.max(1);
        let corners = [Point2::new(0.0, 0.0), Point2::new(w, 0.0), Point2::new(w, h), Point2::new(0.0, h)];
        (0..4)
            .flat_map(|side| {
                let (a, b) = (corners[side], corners[(side + 1) % 4]);
                (0..n).map(move |i| a + (b - a) * (i as f64 / n as f64))
            })
            .collect()
    }
}
