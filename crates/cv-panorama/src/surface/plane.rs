//! A plane orthogonal to the Z axis: the perspective (rectilinear) projection.

use super::Model;
use cv_core::{Point2, Vector3};
use std::f64::consts::FRAC_PI_4;

pub(super) struct Plane;

impl Model for Plane {
    fn forward(&self, ray: &Vector3<f64>, scale: f64) -> Option<Point2<f64>> {
        (ray.z > 1e-6 * ray.norm()).then(|| Point2::new(scale * ray.x / ray.z, scale * ray.y / ray.z))
    }

    fn column(&self, x: f64) -> (f64, f64) {
        (x, 1.0)
    }

    fn row(&self, y: f64) -> (f64, f64, f64) {
        (1.0, y, 0.0)
    }

    fn is_periodic(&self) -> bool {
        false
    }

    fn holds_poles(&self) -> bool {
        false
    }

    /// 75° to each side, where it stretches lengths by 1/cos² = 15.
    fn field(&self) -> [f64; 2] {
        [150_f64.to_radians(); 2]
    }

    fn diverges(&self) -> bool {
        false
    }

    /// Up to 45° from the center, where lengths are magnified by 1/cos² = 2.
    fn suits(&self, across: f64, up: f64) -> bool {
        across <= 2.0 * FRAC_PI_4 && up <= FRAC_PI_4
    }
}
