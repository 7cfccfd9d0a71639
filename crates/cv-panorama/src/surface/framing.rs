//! Framing: the requested field of view, and the extent of photographs within it.

use crate::align::{View, turn};
use crate::surface::{Bounds, Surface};
use cv_core::{Matrix3, OptionError, Point2, Vector2, Vector3};
use nalgebra::Rotation3;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// Orientation and field of view of the panorama, as of a virtual camera. The default covers all photographs.
///
/// Angles are in radians. An error for planar scenes ([`CameraMotion::Homography`](crate::CameraMotion::Homography)).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Framing {
    /// Direction of the surface center: yaw `[0]` to the right of the center of the photographs, −2π … 2π, and pitch `[1]` above the horizon, −π/2 … π/2. The surface is rotated, so that
    /// on a cylinder, for example, the horizon is straight at `[1] = 0` only. Default `None`: the center of the photographs at the horizon; a non-periodic surface is tilted toward
    /// photographs whose pitch exceeds 25°.
    pub center: Option<[f64; 2]>,
    /// Clockwise roll of the image, −π … π. Default 0.
    pub roll: f64,
    /// Horizontal field of view through the image center: above 0, at most [`Projection::widest_field`](crate::Projection::widest_field). The image has exactly this width, empty where no
    /// photograph covers it. Default `None`: the extent of the photographs; the surface center then need not be the image center.
    pub across: Option<f64>,
    /// Vertical field of view, likewise. Default `None`: the extent of the photographs.
    pub up: Option<f64>,
}

impl Framing {
    /// Checks that the angles are in range; the maximum field of view depends on the projection.
    pub(crate) fn check(&self) -> Result<(), OptionError> {
        // Tolerance for angles converted from degrees.
        let within = |limit: f64| move |v: f64| v.abs() <= limit + 1e-9;
        if let Some([yaw, pitch]) = self.center {
            OptionError::check("yaw", yaw, "from -2π to 2π", within(TAU))?;
            OptionError::check("pitch", pitch, "from -π/2 to π/2", within(FRAC_PI_2))?;
        }
        OptionError::check("roll", self.roll, "from -π to π", within(PI))?;
        for (name, field) in [("across", self.across), ("up", self.up)] {
            if let Some(field) = field {
                OptionError::check(name, field, "above 0, up to 2π", |v| v > 0.0 && v <= TAU + 1e-9)?;
            }
        }
        Ok(())
    }

    /// Returns the rotation from a level world centered at longitude `middle` to the surface; `pitch` is the default where `center` is `None`.
    pub(crate) fn frame(&self, middle: f64, pitch: f64) -> Matrix3<f64> {
        let [yaw, pitch] = self.center.unwrap_or([0.0, pitch]);
        // Y points down: a negative rotation about X brings directions above the horizon to the center.
        let tilt = Rotation3::from_axis_angle(&Vector3::x_axis(), -pitch).into_inner();
        let roll = Rotation3::from_axis_angle(&Vector3::z_axis(), self.roll).into_inner();
        roll * tilt * turn(middle + yaw)
    }
}

/// Samples per side of a photograph's border.
const SAMPLES_PER_SIDE: usize = 256;
/// Samples per side of a window.
const SAMPLES_PER_EDGE: usize = 512;

/// A rectangle of surface coordinates.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Window {
    pub(crate) min: Point2<f64>,
    pub(crate) max: Point2<f64>,
}

impl Window {
    /// Creates the window of this half width and half height around the surface center.
    pub(crate) fn around_middle(half: Vector2<f64>) -> Self {
        Self { min: (-half).into(), max: half.into() }
    }

    fn contains(&self, p: Point2<f64>) -> bool {
        p.x >= self.min.x && p.x <= self.max.x && p.y >= self.min.y && p.y <= self.max.y
    }

    /// Returns the bounding box of both.
    pub(crate) fn joined(&self, other: &Self) -> Self {
        Self { min: self.min.inf(&other.min), max: self.max.sup(&other.max) }
    }

    /// Splits the window into its left and right half.
    fn halves(&self) -> [Self; 2] {
        let middle = 0.5 * (self.min.x + self.max.x);
        [Self { max: Point2::new(middle, self.max.y), ..*self }, Self { min: Point2::new(middle, self.min.y), ..*self }]
    }

    /// Returns whether a point of the edges is at the top or the bottom.
    fn is_end(&self, p: Point2<f64>) -> bool {
        p.y <= self.min.y || p.y >= self.max.y
    }

    /// Samples the edges.
    fn edges(&self) -> impl Iterator<Item = Point2<f64>> + '_ {
        let at = |t: f64, a: f64, b: f64| a + t * (b - a);
        (0..=SAMPLES_PER_EDGE).map(|i| i as f64 / SAMPLES_PER_EDGE as f64).flat_map(move |t| {
            let (x, y) = (at(t, self.min.x, self.max.x), at(t, self.min.y, self.max.y));
            let sides = [(x, self.min.y), (x, self.max.y), (self.min.x, y), (self.max.x, y)];
            sides.map(|(x, y)| Point2::new(x, y))
        })
    }

    /// Converts to pixels of a canvas whose pixel (0, 0) is at `origin`, with a margin of `slack` pixels.
    pub(crate) fn pixels(&self, origin: Point2<f64>, slack: f64, (width, height): (usize, usize)) -> Option<Bounds> {
        let clamp = |v: f64, limit: usize| v.clamp(0.0, limit as f64) as usize;
        let bounds = Bounds {
            left: clamp((self.min.x - origin.x - slack).floor(), width),
            top: clamp((self.min.y - origin.y - slack).floor(), height),
            right: clamp((self.max.x - origin.x + slack).ceil() + 1.0, width),
            bottom: clamp((self.max.y - origin.y + slack).ceil() + 1.0, height),
        };
        (bounds.left < bounds.right && bounds.top < bounds.bottom).then_some(bounds)
    }
}

/// The extent of a photograph in a window.
pub(crate) struct Shown {
    /// Bounding boxes: none, one, or two where the photograph crosses the ±180° meridian of a periodic surface.
    pub(crate) boxes: Vec<Window>,
    /// Whether the photograph extends beyond the window.
    pub(crate) reaches_beyond: bool,
}

/// Computes the extent of a photograph in a window, whose left and right edges may be a full turn apart.
///
/// The bounding box of a region clipped to a window is that of the region's border inside the window and of the window's edges inside the region. Poles, meridians and points at
/// infinity need no special cases. Accurate to one sample of either.
pub(crate) fn shown(view: &View, surface: &Surface, window: &Window) -> Shown {
    let sees = |ray: &Vector3<f64>| view.project(ray).is_some_and(|q| view.contains(q));
    let border = view.border(SAMPLES_PER_SIDE).into_iter();
    let border: Vec<Option<Point2<f64>>> =
        border.map(|pixel| view.ray(pixel).and_then(|ray| surface.forward(&ray))).collect();
    // The border may enclose a pole or points at infinity.
    let ends = || surface.diverges() && window.edges().any(|p| window.is_end(p) && sees(&surface.inverse(p)));
    let reaches_beyond = border.iter().any(|p| p.is_none_or(|p| !window.contains(p))) || ends();
    let shown_in = |part: &Window| -> Option<Window> {
        let inside = border.iter().flatten().copied().filter(|p| part.contains(*p));
        let edges = part.edges().filter(|p| sees(&surface.inverse(*p)));
        inside.chain(edges).map(|p| Window { min: p, max: p }).reduce(|a, b| a.joined(&b))
    };
    let boxes = match surface.period() {
        None => shown_in(window).into_iter().collect(),
        Some(_) => {
            let halves = window.halves();
            match halves.each_ref().map(shown_in) {
                // One box where it crosses the center, not the ±180° meridian.
                [Some(left), Some(right)] if left.max.x >= halves[0].max.x && right.min.x <= halves[1].min.x => {
                    vec![left.joined(&right)]
                }
                parts => parts.into_iter().flatten().collect(),
            }
        }
    };
    Shown { boxes, reaches_beyond }
}

/// Margin, in canvas pixels, of the boxes of [`shown`]: one sample of the window's edges, and the curvature of a border between two samples.
pub(crate) fn slack(window: &Window) -> f64 {
    2.0 + (window.max - window.min).amax() / SAMPLES_PER_EDGE as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::Projection;
    use cv_core::Camera;

    #[test]
    fn the_requested_direction_is_at_the_center() {
        let framing = Framing { center: Some([0.3, 0.5]), ..Framing::default() };
        let (yaw, pitch) = (0.2 + 0.3_f64, 0.5_f64);
        // 0.5 rad above the horizon (Y points down), 0.3 rad to the right of a center at 0.2 rad.
        let ray = Vector3::new(pitch.cos() * yaw.sin(), -pitch.sin(), pitch.cos() * yaw.cos());
        assert!((framing.frame(0.2, 9.0) * ray - Vector3::z()).norm() < 1e-12);
        // Higher directions are above the center.
        let above = Vector3::new(0.6_f64.cos() * yaw.sin(), -0.6_f64.sin(), 0.6_f64.cos() * yaw.cos());
        let seen = framing.frame(0.2, 9.0) * above;
        assert!(seen.y < -0.09 && seen.x.abs() < 1e-12);
        // After a roll of 90° clockwise, directions above the center are to its right.
        let seen = Framing { roll: FRAC_PI_2, ..framing }.frame(0.2, 9.0) * above;
        assert!(seen.x > 0.09 && seen.y.abs() < 1e-12);
    }

    #[test]
    fn invalid_angles_are_refused_by_name() {
        let name = |framing: Framing| framing.check().unwrap_err().name;
        assert_eq!(Framing::default().check(), Ok(()));
        assert_eq!(name(Framing { center: Some([f64::NAN, 0.0]), ..Framing::default() }), "yaw");
        assert_eq!(name(Framing { center: Some([0.0, 1.6]), ..Framing::default() }), "pitch");
        assert_eq!(name(Framing { roll: f64::INFINITY, ..Framing::default() }), "roll");
        for wrong in [0.0, -1.0, 6.3, f64::NAN] {
            assert_eq!(name(Framing { across: Some(wrong), ..Framing::default() }), "across");
            assert_eq!(name(Framing { up: Some(wrong), ..Framing::default() }), "up");
        }
    }

    /// Computes the bounding box of all visible points of a fine grid of the window: the definition by brute force.
    fn by_looking_everywhere(view: &View, surface: &Surface, window: &Window) -> Option<Window> {
        const N: usize = 400;
        let at = |i: usize, a: f64, b: f64| a + (b - a) * i as f64 / N as f64;
        let points = (0..=N).flat_map(|y| (0..=N).map(move |x| (x, y)));
        let points =
            points.map(|(x, y)| Point2::new(at(x, window.min.x, window.max.x), at(y, window.min.y, window.max.y)));
        let seen = points.filter(|p| view.project(&surface.inverse(*p)).is_some_and(|q| view.contains(q)));
        seen.map(|p| Window { min: p, max: p }).reduce(|a, b| a.joined(&b))
    }

    #[test]
    fn bounding_boxes_equal_those_of_dense_sampling() {
        // Ahead, behind, up, down, aside and aslant: over poles, cuts and points at infinity.
        let turns = [(0.0, 0.0), (3.1, 0.1), (0.3, 1.5), (2.0, -1.4), (1.5, 0.0), (-2.9, 0.7), (3.13, -0.6)];
        for projection in [
            Projection::Plane,
            Projection::Cylindrical,
            Projection::Spherical,
            Projection::Mercator,
            Projection::Panini,
            Projection::Stereographic,
        ] {
            let surface = Surface { projection, scale: 300.0 };
            let [across, up] = projection.widest_field();
            for share in [1.0, 0.4] {
                let [half_w, half_h] = surface.half_size(share * across, share * up).map(Option::unwrap);
                let window = Window::around_middle(Vector2::new(half_w, half_h));
                for (yaw, pitch) in turns {
                    let r = Rotation3::from_axis_angle(&Vector3::x_axis(), pitch)
                        * Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw);
                    let view = View { camera: Camera::from_focal(600, 400, 500.0), from_world: r.into_inner() };
                    let found = shown(&view, &surface, &window);
                    let joined = found.boxes.iter().copied().reduce(|a, b| a.joined(&b));
                    // A step of either grid.
                    let tolerance = slack(&window) + (window.max - window.min).amax() / 400.0;
                    match (joined, by_looking_everywhere(&view, &surface, &window)) {
                        (Some(a), Some(b)) => {
                            let off = (a.min - b.min).amax().max((a.max - b.max).amax());
                            assert!(off < tolerance, "{projection:?} {share} {yaw} {pitch}: {a:?} {b:?}");
                        }
                        (None, None) => assert!(found.reaches_beyond),
                        // A corner that slips between the samples of one of them.
                        (a, b) => {
                            let small = a.or(b).unwrap();
                            assert!(
                                (small.max - small.min).amin() < tolerance,
                                "{projection:?} {yaw} {pitch}: {a:?} {b:?}"
                            );
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn a_photograph_across_the_cut_has_two_boxes() {
        let view = View {
            camera: Camera::from_focal(600, 400, 500.0),
            from_world: Rotation3::from_axis_angle(&Vector3::y_axis(), -3.0).into_inner(),
        };
        let surface = Surface { projection: Projection::Mercator, scale: 100.0 };
        let window = Window::around_middle(Vector2::new(100.0 * PI, 100.0 * PI));
        let boxes = shown(&view, &surface, &window).boxes;
        // 31° to each side of 172°: from 141° to 180°, and from −180° to −157°.
        assert_eq!(boxes.len(), 2);
        let half = 300.0_f64.atan2(500.0);
        for (got, want) in [
            (boxes[0].min.x, -100.0 * PI),
            (boxes[0].max.x, 100.0 * (3.0 + half - TAU)),
            (boxes[1].min.x, 100.0 * (3.0 - half)),
            (boxes[1].max.x, 100.0 * PI),
        ] {
            // The centers of border pixels are half a pixel inside, of 300 px: a tenth of a surface pixel.
            assert!((got - want).abs() < 0.5, "{boxes:?}");
        }
    }
}
