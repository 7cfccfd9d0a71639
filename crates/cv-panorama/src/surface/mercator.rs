//! The Mercator projection: longitude by the integral of 1/cos over latitude, a conformal cylinder.
//!
//! `x = λ`, `y = asinh(tan φ)`, and back `ray = (sin x, sinh y, cos x)` (Snyder 1987, *Map Projections, a Working Manual*, §7). Verticals stay straight, angles are preserved, and heights
//! are stretched less than by a cylinder.

use super::Model;
use cv_core::{Point2, Vector3};
use std::f64::consts::{PI, TAU};

pub(super) struct Mercator;

impl Model for Mercator {
    fn forward(&self, ray: &Vector3<f64>, scale: f64) -> Option<Point2<f64>> {
        let horizontal = ray.x.hypot(ray.z);
        (horizontal > 1e-6 * ray.norm())
            .then(|| Point2::new(scale * ray.x.atan2(ray.z), scale * (ray.y / horizontal).asinh()))
    }

    fn column(&self, x: f64) -> (f64, f64) {
        x.sin_cos()
    }

    fn row(&self, y: f64) -> (f64, f64, f64) {
        (1.0, y.sinh(), 0.0)
    }

    fn is_periodic(&self) -> bool {
        true
    }

    fn holds_poles(&self) -> bool {
        false
    }

    /// All around, and up to the latitude of y = π, 85.05°, where maps of the world end: a full one is square. The poles lie at infinity.
    fn field(&self) -> [f64; 2] {
        [TAU, 2.0 * PI.sinh().atan()]
    }

    fn diverges(&self) -> bool {
        true
    }

    /// Never selected automatically: viewers expect a cylinder or a sphere.
    fn suits(&self, _: f64, _: f64) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heights_equal_the_formula_and_are_limited_to_a_square() {
        for degrees in [-80.0_f64, -30.0, 10.0, 60.0] {
            let (sin, cos) = degrees.to_radians().sin_cos();
            let p = Mercator.forward(&Vector3::new(0.6 * cos, sin, -0.8 * cos), 1.0).unwrap();
            // The textbook's ln tan(π/4 + φ/2).
            let y = (PI / 4.0 + degrees.to_radians() / 2.0).tan().ln();
            assert!((p - Point2::new(0.6_f64.atan2(-0.8), y)).norm() < 1e-12, "{p} {y}");
        }
        let (sin, cos) = (0.5 * Mercator.field()[1]).sin_cos();
        assert!((Mercator.forward(&Vector3::new(0.0, sin, cos), 1.0).unwrap().y - PI).abs() < 1e-12);
        for pole in [Vector3::y(), -Vector3::y(), Vector3::zeros()] {
            assert_eq!(Mercator.forward(&pole, 1.0), None);
        }
    }
}
