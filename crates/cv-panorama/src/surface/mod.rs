//! Projection surfaces, canvas layout, local alignment and warping.
//!
//! A projection is one file of this module with a `Model`, a variant of [`Projection`] with its name, and an entry of `SURFACES`.

mod bounds;
mod correlation;
mod crop;
mod cylindrical;
mod displacement;
mod elastic;
mod framing;
mod layout;
mod mercator;
mod panini;
mod plane;
mod preview;
mod spherical;
mod stereographic;
mod structure_tensor;
mod tie_points;
mod warp;

pub use bounds::Bounds;
pub(crate) use correlation::{PAD, SEARCH_RADIUS, SEARCH_SIDE, Template, parabola_peak, score_maximum};
pub(crate) use crop::{largest_rectangle, largest_rectangle_of};
pub(crate) use displacement::DisplacementField;
pub use displacement::PhotoMap;
pub(crate) use elastic::{ROUND_UNITS, SeamTie, close_breaks, displacements, displacements_with, max_displacement};
pub use framing::Framing;
pub use layout::{Canvas, LayoutError};
pub(crate) use layout::{Layout, Placement, layout};
pub(crate) use preview::{Piece, Preview, PreviewScale, downsample_box, downsampled_view};
pub use warp::WarpedPhoto;
pub(crate) use warp::{CLIPPED, Map, WarpSettings, warp};

use cv_core::{Point2, Vector3, named};

/// Projection of the panorama.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum Projection {
    /// [`Plane`](Self::Plane) for narrow fields of view, else [`Cylindrical`](Self::Cylindrical), and
    /// [`Spherical`](Self::Spherical) where the vertical field of view is too large for a cylinder.
    #[default]
    Auto,
    /// Rectilinear: straight lines stay straight. Under 180°.
    Plane,
    /// Vertical cylinder: verticals stay straight, any width.
    Cylindrical,
    /// Equirectangular, longitude by latitude: any width and height.
    Spherical,
    /// Mercator: a conformal cylinder. Up to 85° from the horizon.
    Mercator,
    /// Pannini: verticals and lines toward the center stay straight. Up to 120° to each side.
    Panini,
    /// Stereographic: conformal; the "little planet" if centered at the nadir. Up to 150° from the center.
    Stereographic,
}

named!(Projection {
    Auto = "auto",
    Plane = "plane",
    Cylindrical = "cylindrical",
    Spherical = "spherical",
    Mercator = "mercator",
    Panini = "panini",
    Stereographic = "stereographic",
});

/// A projection in units of its scale: world directions to surface coordinates, the Z axis at (0, 0).
///
/// The inverse factors as `ray = (g·ax, b, g·az + c)`: `ax` and `az` depend on x alone, `g`, `b` and `c` on y alone, so that warping needs no
/// trigonometry per pixel.
trait Model: Sync {
    /// Projects a direction, times the scale; `None` outside the domain. Longitude is in (−π, π] times the scale.
    fn forward(&self, ray: &Vector3<f64>, scale: f64) -> Option<Point2<f64>>;

    /// Returns `ax` and `az` at x.
    fn column(&self, x: f64) -> (f64, f64);

    /// Returns `g`, `b` and `c` at y.
    fn row(&self, y: f64) -> (f64, f64, f64);

    /// Returns whether x is the longitude, with period 2π.
    fn is_periodic(&self) -> bool;

    /// Returns whether the zenith and nadir are in the domain.
    fn holds_poles(&self) -> bool;

    /// Returns the maximum field of view in radians, horizontal (through the center) and vertical; magnification is excessive beyond.
    fn field(&self) -> [f64; 2];

    /// Returns whether the projection diverges within usual fields of view, so that the canvas is always limited to its field.
    fn diverges(&self) -> bool;

    /// Returns whether the distortion is acceptable for views that span `across` horizontally and `up` from the horizon, in radians.
    fn suits(&self, across: f64, up: f64) -> bool;
}

/// All surfaces in order of preference. Those that are never chosen automatically come last.
const SURFACES: [(Projection, &dyn Model); 6] = [
    (Projection::Plane, &plane::Plane),
    (Projection::Cylindrical, &cylindrical::Cylindrical),
    (Projection::Spherical, &spherical::Spherical),
    (Projection::Mercator, &mercator::Mercator),
    (Projection::Panini, &panini::Panini),
    (Projection::Stereographic, &stereographic::Stereographic),
];

impl Projection {
    /// Returns the suitable projections for views of this extent, the preferred one first.
    fn suitable(across: f64, up: f64) -> impl Iterator<Item = Self> {
        SURFACES.iter().filter(move |(_, model)| model.suits(across, up)).map(|(projection, _)| *projection)
    }

    /// Returns the maximum field of view in radians, horizontal and vertical. That of a plane for [`Projection::Auto`].
    pub fn widest_field(self) -> [f64; 2] {
        self.model().field()
    }

    /// Returns the surface; a plane for [`Projection::Auto`].
    fn model(self) -> &'static dyn Model {
        SURFACES.iter().find(|(projection, _)| *projection == self).map_or(&plane::Plane, |(_, model)| *model)
    }
}

/// A projection with its scale: world directions to surface coordinates in pixels, the Z axis at (0, 0).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Surface {
    pub(crate) projection: Projection,
    /// Pixels per radian at the center of the panorama.
    pub(crate) scale: f64,
}

impl Surface {
    /// Projects a direction; `None` outside the domain. Longitude is in (−π, π] times the scale.
    pub(crate) fn forward(&self, ray: &Vector3<f64>) -> Option<Point2<f64>> {
        self.projection.model().forward(ray, self.scale)
    }

    /// Returns the direction at a point of the surface.
    pub(crate) fn inverse(&self, p: Point2<f64>) -> Vector3<f64> {
        let (ax, az) = self.column(p.x);
        let (g, b, c) = self.row(p.y);
        Vector3::new(g * ax, b, g * az + c)
    }

    /// Returns `ax` and `az` of `ray = (g·ax, b, g·az + c)` at x.
    pub(crate) fn column(&self, x: f64) -> (f64, f64) {
        self.projection.model().column(x / self.scale)
    }

    /// Returns `g`, `b` and `c` at y.
    pub(crate) fn row(&self, y: f64) -> (f64, f64, f64) {
        self.projection.model().row(y / self.scale)
    }

    /// Returns the surface width of a full turn, where the surface is periodic.
    pub(crate) fn period(&self) -> Option<f64> {
        self.projection.model().is_periodic().then_some(std::f64::consts::TAU * self.scale)
    }

    /// Returns half the width and height, in pixels, of a field of view in radians; `None` where it exceeds the maximum.
    pub(crate) fn half_size(&self, across: f64, up: f64) -> [Option<f64>; 2] {
        let most = self.projection.model().field();
        let half = |angle: f64, most: f64, ray: Vector3<f64>, of: fn(Point2<f64>) -> f64| {
            // Tolerance for angles converted from degrees.
            let p = self.forward(&ray).filter(|_| angle > 0.0 && angle <= most + 1e-9)?;
            Some(of(p).abs()).filter(|half| half.is_finite() && *half > 0.0)
        };
        let [(sin_x, cos_x), (sin_y, cos_y)] = [across, up].map(|angle| (0.5 * angle).sin_cos());
        [
            half(across, most[0], Vector3::new(sin_x, 0.0, cos_x), |p| p.x),
            half(up, most[1], Vector3::new(0.0, sin_y, cos_y), |p| p.y),
        ]
    }

    /// Returns whether the canvas is always limited to the maximum field of view.
    pub(crate) fn diverges(&self) -> bool {
        self.projection.model().diverges()
    }

    /// Returns whether the zenith and nadir are in the domain.
    pub(crate) fn holds_poles(&self) -> bool {
        self.projection.model().holds_poles()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Named;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn forward_and_inverse_projection_round_trip(x in -1.0..1.0f64, y in -0.9..0.9f64, z in -1.0..1.0f64, s in 10.0..5000.0f64) {
            let ray = Vector3::new(x, y, z);
            prop_assume!(ray.norm() > 0.1 && ray.x.hypot(ray.z) > 0.05);
            for (projection, _) in SURFACES {
                let surface = Surface { projection, scale: s };
                if let Some(p) = surface.forward(&ray) {
                    let back = surface.inverse(p).normalize();
                    // A few f64 operations on numbers up to 1e6 (the plane, near its horizon).
                    prop_assert!((back - ray.normalize()).norm() < 1e-9, "{projection:?} {p} {back}");
                } else {
                    let straight_back = x.abs() < 1e-3 && z < 0.0;
                    prop_assert!(projection == Projection::Plane && z < 1e-5 || straight_back, "{projection:?}");
                }
            }
        }
    }

    #[test]
    fn the_scale_at_the_center_is_in_pixels_per_radian_on_every_surface() {
        for (projection, _) in SURFACES {
            let surface = Surface { projection, scale: 1000.0 };
            let p = surface.forward(&Vector3::new(1e-4, 2e-4, 1.0)).unwrap();
            // tan t = t + O(t³): 1e-12 × 1000.
            assert!((p - Point2::new(0.1, 0.2)).norm() < 1e-8, "{projection:?}: {p}");
        }
    }

    #[test]
    fn the_declared_limits_of_surfaces_agree_with_their_formulas() {
        for (projection, model) in SURFACES {
            let surface = Surface { projection, scale: 100.0 };
            // Only periodic and stereographic surfaces contain directions behind the camera.
            let behind = surface.period().is_some() || projection == Projection::Stereographic;
            assert_eq!(surface.forward(&Vector3::new(0.0, 0.1, -1.0)).is_some(), behind);
            // The formulas are finite up to the widest field; beyond it the surface reports no size.
            let [across, up] = projection.widest_field();
            assert!(surface.half_size(across, up).iter().all(Option::is_some), "{projection:?}");
            for beyond in [1.01, 3.0, f64::NAN, f64::INFINITY, -0.1, 0.0] {
                assert_eq!(surface.half_size(across * beyond, up * beyond), [None, None], "{projection:?} {beyond}");
            }
            let near_pole = surface.forward(&Vector3::new(0.0, 1.0, 1e-9));
            assert_eq!(near_pole.is_some(), surface.holds_poles(), "{projection:?}");
            if let Some(period) = surface.period() {
                let (a, b) =
                    (surface.inverse(Point2::new(30.0, 5.0)), surface.inverse(Point2::new(30.0 + period, 5.0)));
                assert!((a - b).norm() < 1e-12, "{projection:?}");
            }
            assert_eq!(surface.holds_poles(), model.holds_poles());
        }
        // Every projection but the choice among them has its surface.
        assert_eq!(Projection::NAMES.len(), SURFACES.len() + 1);
    }

    #[test]
    fn wider_and_higher_fields_have_fewer_suitable_projections() {
        let suitable =
            |across: f64, up: f64| Projection::suitable(across.to_radians(), up.to_radians()).collect::<Vec<_>>();
        assert_eq!(suitable(89.0, 44.0), [Projection::Plane, Projection::Cylindrical, Projection::Spherical]);
        assert_eq!(suitable(91.0, 44.0), [Projection::Cylindrical, Projection::Spherical]);
        assert_eq!(suitable(80.0, 49.0), [Projection::Cylindrical, Projection::Spherical]);
        assert_eq!(suitable(80.0, 51.0), [Projection::Spherical]);
    }
}
