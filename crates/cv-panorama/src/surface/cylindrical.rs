//! A vertical cylinder: longitude by the tangent of latitude.

use super::Model;
use cv_core::{Point2, Vector3};
use std::f64::consts::TAU;

pub(super) struct Cylindrical;

impl Model for Cylindrical {
    fn forward(&self, ray: &Vector3<f64>, scale: f64) -> Option<Point2<f64>> {
        let horizontal = ray.x.hypot(ray.z);
        (horizontal > 1e-6 * ray.norm()).then(|| Point2::new(scale * ray.x.atan2(ray.z), scale * ray.y / horizontal))
    }

    fn column(&self, x: f64) -> (f64, f64) {
        x.sin_cos()
    }

    fn row(&self, y: f64) -> (f64, f64, f64) {
        (1.0, y, 0.0)
    }

    fn is_periodic(&self) -> bool {
        true
    }

    fn holds_poles(&self) -> bool {
        false
    }

    /// All around, and up to 75° from the horizon, where it stretches heights by 1/cos² = 15.
    fn field(&self) -> [f64; 2] {
        [TAU, 150_f64.to_radians()]
    }

    fn diverges(&self) -> bool {
        false
    }

    /// Up to 50° from the horizon: there it stretches heights by 1/cos² = 2.4.
    fn suits(&self, _: f64, up: f64) -> bool {
        up <= 50_f64.to_radians()
    }
}
