//! The stereographic projection: a sphere projected from its point opposite the center, the "little planet" if centered at the nadir.
//!
//! A direction at an angle θ from the Z axis maps to distance 2 tan(θ/2) from the center: circles map to circles, and the projection is conformal (Snyder 1987, *Map
//! Projections, a Working Manual*, §21). With `n = |ray|`: `(x, y) = 2 (X, Y) / (n + Z)`, and back `ray = (x, y, 1 − (x² + y²) / 4)`.

use super::Model;
use cv_core::{Point2, Vector3};

pub(super) struct Stereographic;

impl Model for Stereographic {
    fn forward(&self, ray: &Vector3<f64>, scale: f64) -> Option<Point2<f64>> {
        let n = ray.norm();
        // Two equal expressions; each is used where it has no cancellation.
        let sum = if ray.z >= 0.0 { n + ray.z } else { (ray.x * ray.x + ray.y * ray.y) / (n - ray.z) };
        (sum > 1e-12 * n).then(|| Point2::new(2.0 * scale * ray.x / sum, 2.0 * scale * ray.y / sum))
    }

    fn column(&self, x: f64) -> (f64, f64) {
        (x, 1.0 - 0.25 * x * x)
    }

    fn row(&self, y: f64) -> (f64, f64, f64) {
        (1.0, y, -0.25 * y * y)
    }

    fn is_periodic(&self) -> bool {
        false
    }

    fn holds_poles(&self) -> bool {
        true
    }

    /// 150° from the center, where lengths are magnified by 1/cos²(75°) = 15; the antipode of the center is at infinity.
    fn field(&self) -> [f64; 2] {
        [300_f64.to_radians(); 2]
    }

    fn diverges(&self) -> bool {
        true
    }

    /// Never selected automatically: straight lines are curved.
    fn suits(&self, _: f64, _: f64) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn the_radius_is_twice_the_tangent_of_half_the_angle() {
        for (degrees, radius) in [(90.0_f64, 2.0), (120.0, 2.0 * 3_f64.sqrt()), (60.0, 2.0 / 3_f64.sqrt())] {
            let (sin, cos) = degrees.to_radians().sin_cos();
            let p = Stereographic.forward(&Vector3::new(0.6 * sin, -0.8 * sin, cos), 10.0).unwrap();
            assert!((p - Point2::new(6.0 * radius, -8.0 * radius)).norm() < 1e-12, "{degrees}: {p}");
        }
        assert_eq!(Stereographic.forward(&-Vector3::z(), 1.0), None);
        assert_eq!(Stereographic.forward(&Vector3::zeros(), 1.0), None);
    }

    proptest! {
        /// The circle of all directions at one angle from an axis is a circle on the plane: four of its points lie on one.
        #[test]
        fn circles_are_mapped_to_circles(yaw in -1.5..1.5_f64, pitch in -1.0..1.0_f64, radius in 0.05..0.5_f64) {
            let turn = nalgebra::Rotation3::from_euler_angles(pitch, yaw, 0.0);
            let at = |phi: f64| {
                let ray = Vector3::new(radius.sin() * phi.cos(), radius.sin() * phi.sin(), radius.cos());
                Stereographic.forward(&(turn * ray), 1.0).unwrap()
            };
            let points = [0.1, 1.7, 3.3, 5.0].map(at);
            // Zero where four points lie on a circle: the determinant of the rows (x² + y², x, y, 1).
            let rows = points.map(|p| nalgebra::RowVector4::new(p.coords.norm_squared(), p.x, p.y, 1.0));
            prop_assert!(nalgebra::Matrix4::from_rows(&rows).determinant().abs() < 1e-9);
        }
    }
}
