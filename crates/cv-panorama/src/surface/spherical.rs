//! A sphere: longitude by latitude (equirectangular).

use super::Model;
use cv_core::{Point2, Vector3};
use std::f64::consts::{PI, TAU};

pub(super) struct Spherical;

impl Model for Spherical {
    fn forward(&self, ray: &Vector3<f64>, scale: f64) -> Option<Point2<f64>> {
        let horizontal = ray.x.hypot(ray.z);
        (ray.norm() > 0.0).then(|| Point2::new(scale * ray.x.atan2(ray.z), scale * ray.y.atan2(horizontal)))
    }

    fn column(&self, x: f64) -> (f64, f64) {
        x.sin_cos()
    }

    fn row(&self, y: f64) -> (f64, f64, f64) {
        let (sin, cos) = y.sin_cos();
        (cos, sin, 0.0)
    }

    fn is_periodic(&self) -> bool {
        true
    }

    fn holds_poles(&self) -> bool {
        true
    }

    fn field(&self) -> [f64; 2] {
        [TAU, PI]
    }

    fn diverges(&self) -> bool {
        false
    }

    fn suits(&self, _: f64, _: f64) -> bool {
        true
    }
}
