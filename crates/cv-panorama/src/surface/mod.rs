//! Surfaces a panorama is drawn on.

mod correlation;
mod crop;
mod elastic;
mod layout;
mod preview;
mod warp;

pub(crate) use correlation::{PAD, PLACES, REACH, Template};
pub(crate) use crop::largest_rectangle;
pub use elastic::PhotoMap;
pub(crate) use elastic::{Field, fields};
pub(crate) use layout::{Bounds, Layout, Placement, layout};
pub use layout::{Canvas, LayoutError};
pub(crate) use preview::{Piece, Preview, shrunk, shrunk_view};
pub(crate) use warp::{Map, Tone, Warped, warp};

use cv_core::{Point2, Vector3};

/// The surface a panorama is drawn on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Projection {
    /// [`Plane`](Self::Plane) while the field of view permits, else [`Cylindrical`](Self::Cylindrical), and
    /// [`Spherical`](Self::Spherical) where it is also too high for a cylinder.
    #[default]
    Auto,
    /// A plane, as a camera with a wide lens would see it: straight lines stay straight. Under 180°.
    Plane,
    /// A vertical cylinder: verticals stay straight, any width.
    Cylindrical,
    /// A sphere, longitude by latitude: any width and height.
    Spherical,
}

impl Projection {
    /// The name used on the command line and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Plane => "plane",
            Self::Cylindrical => "cylindrical",
            Self::Spherical => "spherical",
        }
    }
}

/// A projection with its scale: world directions to surface coordinates in pixels, the Z axis at (0, 0).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Surface {
    pub(crate) projection: Projection,
    /// Pixels per radian at the middle of the panorama.
    pub(crate) scale: f64,
}

impl Surface {
    /// Where the direction falls; `None` for directions the surface does not hold. Longitude is in (−π, π] times the scale.
    pub(crate) fn forward(&self, ray: &Vector3<f64>) -> Option<Point2<f64>> {
        let s = self.scale;
        let horizontal = ray.x.hypot(ray.z);
        match self.projection {
            Projection::Plane | Projection::Auto => {
                (ray.z > 1e-6 * ray.norm()).then(|| Point2::new(s * ray.x / ray.z, s * ray.y / ray.z))
            }
            Projection::Cylindrical => {
                (horizontal > 1e-6 * ray.norm()).then(|| Point2::new(s * ray.x.atan2(ray.z), s * ray.y / horizontal))
            }
            Projection::Spherical => {
                (ray.norm() > 0.0).then(|| Point2::new(s * ray.x.atan2(ray.z), s * ray.y.atan2(horizontal)))
            }
        }
    }

    /// The direction at a point of the surface.
    pub(crate) fn inverse(&self, p: Point2<f64>) -> Vector3<f64> {
        let (ax, az) = self.column(p.x);
        let (g, b) = self.row(p.y);
        Vector3::new(g * ax, b, g * az)
    }

    /// All three surfaces factor as `ray = (g·ax, b, g·az)`, `ax` and `az` depending on x alone ...
    pub(crate) fn column(&self, x: f64) -> (f64, f64) {
        let t = x / self.scale;
        match self.projection {
            Projection::Plane | Projection::Auto => (t, 1.0),
            Projection::Cylindrical | Projection::Spherical => t.sin_cos(),
        }
    }

    /// ... and `g` and `b` on y alone, so that warping needs no trigonometry per pixel.
    pub(crate) fn row(&self, y: f64) -> (f64, f64) {
        let t = y / self.scale;
        match self.projection {
            Projection::Plane | Projection::Auto | Projection::Cylindrical => (1.0, t),
            Projection::Spherical => {
                let (sin, cos) = t.sin_cos();
                (cos, sin)
            }
        }
    }

    /// Surface width of a full turn, where there is one.
    pub(crate) fn period(&self) -> Option<f64> {
        match self.projection {
            Projection::Plane | Projection::Auto => None,
            Projection::Cylindrical | Projection::Spherical => Some(std::f64::consts::TAU * self.scale),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn going_to_the_surface_and_back_is_the_same_direction(x in -1.0..1.0f64, y in -0.9..0.9f64, z in -1.0..1.0f64, s in 10.0..5000.0f64) {
            let ray = Vector3::new(x, y, z);
            prop_assume!(ray.norm() > 0.1 && ray.x.hypot(ray.z) > 0.05);
            for projection in [Projection::Plane, Projection::Cylindrical, Projection::Spherical] {
                let surface = Surface { projection, scale: s };
                if let Some(p) = surface.forward(&ray) {
                    let back = surface.inverse(p).normalize();
                    // A few f64 operations on numbers up to 1e6 (the plane, near its horizon).
                    prop_assert!((back - ray.normalize()).norm() < 1e-9, "{projection:?} {p} {back}");
                } else {
                    prop_assert!(projection == Projection::Plane && z < 1e-5);
                }
            }
        }
    }

    #[test]
    fn a_radian_at_the_middle_is_the_scale_on_every_surface() {
        for projection in [Projection::Plane, Projection::Cylindrical, Projection::Spherical] {
            let surface = Surface { projection, scale: 1000.0 };
            let p = surface.forward(&Vector3::new(1e-4, 2e-4, 1.0)).unwrap();
            // tan t = t + O(t³): 1e-12 × 1000.
            assert!((p - Point2::new(0.1, 0.2)).norm() < 1e-8, "{projection:?}: {p}");
        }
    }
}
