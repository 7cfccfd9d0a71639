//! The general Pannini projection at d = 1 (Sharpless, Postle & German 2010, *Pannini: A New Projection for Rendering Wide Angle Perspective Images*): a
//! cylinder projected from its point opposite the center.
//!
//! With longitude λ and latitude φ: `S = 2 / (1 + cos λ)`, `x = S sin λ = 2 tan(λ/2)`, `y = S tan φ`. Verticals stay straight, and so does every line toward the center. With
//! `h = hypot(X, Z)`: `(x, y) = 2 (X, Y) / (h + Z)`, and back `ray = (x, y, 1 − x² / 4)`.

use super::Model;
use cv_core::{Point2, Vector3};

pub(super) struct Panini;

impl Model for Panini {
    fn forward(&self, ray: &Vector3<f64>, scale: f64) -> Option<Point2<f64>> {
        let h = ray.x.hypot(ray.z);
        // Two equal expressions; each is used where it has no cancellation.
        let sum = if ray.z >= 0.0 { h + ray.z } else { ray.x * ray.x / (h - ray.z) };
        let holds = h > 1e-6 * ray.norm() && sum > 1e-9 * h;
        holds.then(|| Point2::new(2.0 * scale * ray.x / sum, 2.0 * scale * ray.y / sum))
    }

    fn column(&self, x: f64) -> (f64, f64) {
        (x, 1.0 - 0.25 * x * x)
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

    /// 120° to each side, where heights are magnified by S = 4 and widths by 1/cos²(60°) = 4, and up to 75° above and below the center.
    fn field(&self) -> [f64; 2] {
        [240_f64.to_radians(), 150_f64.to_radians()]
    }

    fn diverges(&self) -> bool {
        true
    }

    /// Never selected automatically: horizontal lines are curved.
    fn suits(&self, _: f64, _: f64) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn positions_equal_the_formulas() {
        // λ = 90°, φ = 45°: S = 2, x = 2, y = 2. λ = 120°: S = 4, x = 4 sin 120° = 2 √3.
        let p = Panini.forward(&Vector3::new(1.0, 1.0, 0.0), 100.0).unwrap();
        assert!((p - Point2::new(200.0, 200.0)).norm() < 1e-9, "{p}");
        let p = Panini.forward(&Vector3::new(0.75_f64.sqrt(), -0.5, -0.5), 1.0).unwrap();
        assert!((p - Point2::new(12_f64.sqrt(), -2.0)).norm() < 1e-12, "{p}");
        for nowhere in [-Vector3::z(), Vector3::y(), -Vector3::y(), Vector3::zeros()] {
            assert_eq!(Panini.forward(&nowhere, 1.0), None, "{nowhere}");
        }
    }

    proptest! {
        #[test]
        fn verticals_and_radial_lines_are_straight(x in -3.0..3.0_f64, y in -2.0..2.0_f64, z in 0.2..3.0_f64, t in 0.1..5.0_f64) {
            let at = |x: f64, y: f64, z: f64| Panini.forward(&Vector3::new(x, y, z), 1.0).unwrap();
            // A vertical of the scene is vertical in the panorama.
            prop_assert!((at(x, y, z).x - at(x, y + t, z).x).abs() < 1e-12);
            // A line parallel to the z axis is a straight line through the center of the panorama.
            let (p, q) = (at(x, y, z), at(x, y, z + t));
            prop_assert!((p.x * q.y - p.y * q.x).abs() < 1e-12 * (1.0 + p.coords.norm_squared()), "{p} {q}");
        }
    }
}
