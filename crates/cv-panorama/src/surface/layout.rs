//! Canvas layout: projection, size, and the bounds of each photograph.

use crate::align::View;
use crate::align::turn;
use crate::align::{Alignment, CameraMotion};
use crate::surface::framing::{Framing, Shown, Window, shown, slack};
use crate::surface::{Bounds, Projection, Surface};
use cv_core::{Matrix3, Point2, Vector2, Vector3};
use nalgebra::Rotation3;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// Why the canvas cannot be laid out.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum LayoutError {
    /// No photograph is registered.
    #[error("there is no photograph to draw")]
    Nothing,
    /// The canvas exceeds the limit.
    #[error("the {projection} canvas would be {width:.0} x {height:.0} pixels, more than the limit of {max_pixels}")]
    TooLarge {
        /// Width in pixels.
        width: f64,
        /// Height in pixels.
        height: f64,
        /// The limit.
        max_pixels: usize,
        /// The surface.
        projection: Projection,
    },
    /// The field of view of the photographs exceeds that of the projection.
    #[error("the photographs span {degrees:.0} degrees, more than the {projection} projection can hold")]
    TooWide {
        /// Twice the angle between the center and the farthest point, in degrees.
        degrees: f64,
        /// The surface.
        projection: Projection,
    },
    /// The requested field of view exceeds that of the projection.
    #[error(
        "a field of view of {degrees:.1} degrees is more than the {most:.1} that the {projection} projection draws"
    )]
    FieldTooWide {
        /// The requested field of view, in degrees.
        degrees: f64,
        /// The maximum, in degrees.
        most: f64,
        /// The surface.
        projection: Projection,
    },
    /// No photograph overlaps the requested field of view.
    #[error("no photograph reaches into the field of view")]
    NothingInView,
    /// A field of view was requested for a planar scene.
    #[error("the scene is flat: it has no field of view, no middle at an angle and no horizon")]
    FlatScene,
}

/// Geometry of the panorama image: pixel (0, 0) is surface position `origin`; the surface is centered on the Z axis of `frame · world`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Canvas {
    /// The surface, never [`Projection::Auto`].
    pub projection: Projection,
    /// Pixels per radian at the center.
    pub scale: f64,
    /// Surface coordinates of pixel (0, 0).
    pub origin: Point2<f64>,
    /// Rotation from the world frame of the alignment to the surface frame.
    pub frame: Matrix3<f64>,
}

impl Canvas {
    /// Returns the world direction of a panorama pixel.
    pub fn ray(&self, pixel: Point2<f64>) -> Vector3<f64> {
        let surface = Surface { projection: self.projection, scale: self.scale };
        self.frame.transpose() * surface.inverse(pixel + self.origin.coords)
    }

    /// Projects a world direction to a panorama pixel; `None` outside the domain of the projection.
    pub fn pixel(&self, ray: &Vector3<f64>) -> Option<Point2<f64>> {
        let surface = Surface { projection: self.projection, scale: self.scale };
        surface.forward(&(self.frame * ray)).map(|p| p - self.origin.coords)
    }
}

/// A photograph on the canvas.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Placement {
    /// Index of the photograph.
    pub(crate) photo: usize,
    pub(crate) view: View,
    /// Bounding box of the photograph on the canvas.
    pub(crate) bounds: Bounds,
    /// Surface coordinates of canvas pixel (0, 0). Two placements of one photograph differ by a full turn.
    pub(crate) origin: Point2<f64>,
}

/// The canvas with its placements.
#[derive(Debug, Clone)]
pub(crate) struct Layout {
    pub(crate) surface: Surface,
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Whether the canvas spans 360°: the right edge continues at the left one.
    pub(crate) full_circle: bool,
    pub(crate) placements: Vec<Placement>,
    pub(crate) canvas: Canvas,
    /// Whether photographs extend beyond the maximum field of view of the projection.
    pub(crate) reaches_beyond: bool,
}

impl Layout {
    /// Returns the median over the placements of the square root of the area, in pixels.
    pub(crate) fn typical_side(&self) -> f64 {
        let mut sides: Vec<f64> =
            self.placements.iter().map(|p| ((p.bounds.width() * p.bounds.height()) as f64).sqrt()).collect();
        sides.sort_by(f64::total_cmp);
        sides.get(sides.len() / 2).copied().unwrap_or(1.0)
    }
}

/// Pitch in radians up to which a plane stays upright, which keeps verticals parallel; beyond, it tilts with the photographs.
const MAX_UPRIGHT_PITCH: f64 = 25.0 * PI / 180.0;
/// Samples per side of a photograph's outline.
const SAMPLES_PER_SIDE: usize = 64;

/// Lays out the canvas.
///
/// `resolution` is relative to the photographs (1: the median focal length in pixels is the scale in pixels per radian).
pub(crate) fn layout(
    alignment: &Alignment,
    projection: Projection,
    framing: &Framing,
    resolution: f64,
    max_pixels: usize,
) -> Result<Layout, LayoutError> {
    let views: Vec<(usize, View)> = alignment.used().map(|(i, v)| (i, *v)).collect();
    let mut focals: Vec<f64> = views.iter().map(|(_, v)| (v.camera.fx * v.camera.fy).sqrt()).collect();
    focals.sort_by(f64::total_cmp);
    let Some(&focal) = focals.get(focals.len() / 2) else { return Err(LayoutError::Nothing) };
    let scale = focal * resolution;
    let flat = alignment.motion == CameraMotion::Homography;
    let is_framed = *framing != Framing::default();
    if flat && is_framed {
        return Err(LayoutError::FlatScene);
    }
    let attempt = |projection| {
        let surface = Surface { projection, scale };
        if is_framed || surface.diverges() {
            in_window(&views, surface, flat, framing, max_pixels)
        } else {
            on_surface(&views, surface, flat, max_pixels)
        }
    };
    match projection {
        Projection::Auto if flat => attempt(Projection::Plane),
        Projection::Auto => {
            let (across, up) = extent(&views, scale);
            let across = framing.across.unwrap_or(across);
            let up = framing.up.map_or(up, |up| 0.5 * up);
            let mut result = Err(LayoutError::Nothing);
            for projection in Projection::suitable(across, up) {
                result = attempt(projection);
                if result.is_ok() {
                    break;
                }
            }
            result
        }
        chosen => attempt(chosen),
    }
}

/// Lays out a window of the surface: the requested field of view, or the maximum of the projection.
fn in_window(
    views: &[(usize, View)],
    surface: Surface,
    flat: bool,
    framing: &Framing,
    max_pixels: usize,
) -> Result<Layout, LayoutError> {
    let projection = surface.projection;
    let widest = projection.widest_field();
    let (across, up) = (framing.across.unwrap_or(widest[0]), framing.up.unwrap_or(widest[1]));
    let too_wide = |field: f64, most: f64| LayoutError::FieldTooWide {
        degrees: field.to_degrees(),
        most: most.to_degrees(),
        projection,
    };
    let [half_width, half_height] = surface.half_size(across, up);
    let half_width = half_width.ok_or_else(|| too_wide(across, widest[0]))?;
    let half_height = half_height.ok_or_else(|| too_wide(up, widest[1]))?;
    let frame = if flat {
        Matrix3::identity()
    } else {
        let (gap, middle, pitch) = middle(views);
        // A full circle keeps the center of the alignment.
        let middle = if gap * surface.scale < 1.0 { 0.0 } else { middle };
        let pitch = if surface.period().is_none() && pitch.abs() > MAX_UPRIGHT_PITCH { -pitch } else { 0.0 };
        framing.frame(middle, pitch)
    };
    let views: Vec<(usize, View)> =
        views.iter().map(|&(i, v)| (i, View { from_world: v.from_world * frame.transpose(), ..v })).collect();
    let window = Window::around_middle(Vector2::new(half_width, half_height));
    let found: Vec<Shown> = views.iter().map(|(_, view)| shown(view, &surface, &window)).collect();
    let boxes = found.iter().flat_map(|s| &s.boxes).copied();
    let all = boxes.reduce(|a, b| a.joined(&b)).ok_or(LayoutError::NothingInView)?;
    let full_circle = surface.period().is_some_and(|period| all.max.x - all.min.x > period - 1.0);
    // A requested side is centered to half a pixel; otherwise the canvas ends with the photographs.
    let side = |asked: bool, half: f64, min: f64, max: f64| {
        if asked {
            let size = (2.0 * half).round().max(1.0);
            (size, -0.5 * (size - 1.0))
        } else {
            ((max.floor() - min.ceil() + 1.0).max(1.0), min.ceil())
        }
    };
    let (width, left) = side(framing.across.is_some() || full_circle, half_width, all.min.x, all.max.x);
    let (height, top) = side(framing.up.is_some(), half_height, all.min.y, all.max.y);
    let (canvas_w, canvas_h) = canvas_size(width, height, max_pixels, projection)?;
    let origin = Point2::new(left, top);
    let slack = slack(&window);
    let mut placements = Vec::new();
    for (&(photo, view), shown) in views.iter().zip(&found) {
        for part in &shown.boxes {
            if let Some(bounds) = part.pixels(origin, slack, (canvas_w, canvas_h)) {
                placements.push(Placement { photo, view, bounds, origin });
            }
        }
    }
    let canvas = Canvas { projection, scale: surface.scale, origin, frame };
    let reaches_beyond = framing.across.is_none() && framing.up.is_none() && found.iter().any(|s| s.reaches_beyond);
    Ok(Layout { surface, width: canvas_w, height: canvas_h, full_circle, placements, canvas, reaches_beyond })
}

/// Checks and rounds the size of the canvas.
fn canvas_size(
    width: f64,
    height: f64,
    max_pixels: usize,
    projection: Projection,
) -> Result<(usize, usize), LayoutError> {
    if width * height > max_pixels as f64 || !(width * height).is_finite() {
        return Err(LayoutError::TooLarge { width, height, max_pixels, projection });
    }
    Ok((width as usize, height as usize))
}

/// Returns the width of the largest uncovered range of longitude, the longitude opposite its center, and the mean of the lowest and highest latitude
/// (positive downwards), in radians.
fn middle(views: &[(usize, View)]) -> (f64, f64, f64) {
    let sphere = Surface { projection: Projection::Spherical, scale: 1.0 };
    let outlines: Vec<Outline> = views.iter().filter_map(|(_, v)| outline(v, &sphere)).collect();
    let (gap, opposite) = largest_gap(&outlines, TAU);
    let low = outlines.iter().map(|o| o.min.y).fold(f64::INFINITY, f64::min);
    let high = outlines.iter().map(|o| o.max.y).fold(f64::NEG_INFINITY, f64::max);
    (gap, opposite + PI, 0.5 * (low + high))
}

/// Bounding box of a view on the surface in surface pixels, with longitudes unwrapped.
struct Outline {
    min: Point2<f64>,
    max: Point2<f64>,
}

/// Computes the outline of a view; `None` where its border leaves the domain of the projection.
fn outline(view: &View, surface: &Surface) -> Option<Outline> {
    let axis = surface.forward(&view.ray(Point2::new(view.camera.cx, view.camera.cy))?)?;
    let (mut min, mut max) = (axis, axis);
    let mut border = view.border(SAMPLES_PER_SIDE);
    border.extend(border.first().copied());
    let (mut first, mut last) = (None, axis.x);
    for pixel in border {
        let mut p = surface.forward(&view.ray(pixel)?)?;
        if let Some(period) = surface.period() {
            p.x -= ((p.x - last) / period).round() * period;
        }
        last = p.x;
        first.get_or_insert(p.x);
        min = Point2::new(min.x.min(p.x), min.y.min(p.y));
        max = Point2::new(max.x.max(p.x), max.y.max(p.y));
    }
    if let (Some(period), Some(first)) = (surface.period(), first) {
        // A border that winds around the vertical encloses a pole.
        if (last - first).abs() > 0.5 * period || max.x - min.x > 0.98 * period {
            if !surface.holds_poles() {
                return None;
            }
            (min.x, max.x) = (-0.5 * period, 0.5 * period);
            for (sign, edge) in [(1.0, &mut max.y), (-1.0, &mut min.y)] {
                if view.project(&Vector3::new(0.0, sign, 0.0)).is_some_and(|p| view.contains(p)) {
                    *edge = sign * FRAC_PI_2 * surface.scale;
                }
            }
        }
    }
    Some(Outline { min, max })
}

/// Computes the horizontal field of view of all views, and their largest latitude, in radians.
fn extent(views: &[(usize, View)], scale: f64) -> (f64, f64) {
    let sphere = Surface { projection: Projection::Spherical, scale };
    let outlines: Vec<Outline> = views.iter().filter_map(|(_, v)| outline(v, &sphere)).collect();
    let up = outlines.iter().map(|o| o.max.y.max(-o.min.y)).fold(0.0, f64::max) / scale;
    let (gap, _) = largest_gap(&outlines, TAU * scale);
    (TAU - gap / scale, up)
}

/// Returns the width and center of the largest range of longitude that no outline covers.
fn largest_gap(outlines: &[Outline], period: f64) -> (f64, f64) {
    let wrap = |x: f64| x.rem_euclid(period);
    let mut intervals: Vec<(f64, f64)> = outlines.iter().map(|o| (wrap(o.min.x), o.max.x - o.min.x)).collect();
    intervals.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut best = (0.0, 0.0);
    let Some(first) = intervals.first().copied() else { return (period, 0.0) };
    // Two turns, for intervals across the start.
    let mut reach = first.0 + first.1;
    for turn in 0..2 {
        for &(start, length) in &intervals {
            let start = start + f64::from(turn) * period;
            if start - reach > best.0 {
                best = (start - reach, 0.5 * (start + reach));
            }
            reach = reach.max(start + length);
        }
    }
    best
}

fn on_surface(views: &[(usize, View)], surface: Surface, flat: bool, max_pixels: usize) -> Result<Layout, LayoutError> {
    let too_wide = || {
        let up = extent(views, surface.scale);
        let degrees = up.0.max(2.0 * up.1).to_degrees();
        LayoutError::TooWide { degrees, projection: surface.projection }
    };
    let mut frame = Matrix3::identity();
    // The center of the panorama is rotated to the Z axis.
    let mut recentered = |m: Matrix3<f64>| -> Vec<(usize, View)> {
        frame = m;
        views.iter().map(|&(i, v)| (i, View { from_world: v.from_world * m.transpose(), ..v })).collect()
    };
    let mut full_circle = false;
    let views = match surface.period() {
        _ if flat => views.to_vec(),
        None => {
            let (gap, middle, pitch) = middle(views);
            if gap < PI {
                return Err(too_wide());
            }
            let level = turn(middle);
            let tilt = if pitch.abs() > MAX_UPRIGHT_PITCH {
                Rotation3::from_axis_angle(&Vector3::x_axis(), pitch).into_inner()
            } else {
                Matrix3::identity()
            };
            recentered(tilt * level)
        }
        Some(period) => {
            let outlines: Option<Vec<Outline>> = views.iter().map(|(_, v)| outline(v, &surface)).collect();
            let outlines = outlines.ok_or_else(too_wide)?;
            let (gap, middle) = largest_gap(&outlines, period);
            full_circle = gap < 1.0;
            // A full circle keeps the center of the alignment.
            if full_circle { views.to_vec() } else { recentered(turn(middle / surface.scale + PI)) }
        }
    };
    let outlines: Option<Vec<Outline>> = views.iter().map(|(_, v)| outline(v, &surface)).collect();
    let mut outlines = outlines.ok_or_else(too_wide)?;
    if let Some(period) = surface.period() {
        for o in &mut outlines {
            // The outline starts at the longitude of the optical axis in (−π, π]; the gap is at ±π.
            let middle = 0.5 * (o.min.x + o.max.x);
            let shift = -(middle / period).round() * period;
            o.min.x += shift;
            o.max.x += shift;
        }
    }
    let mut min = outlines
        .iter()
        .fold(Point2::new(f64::INFINITY, f64::INFINITY), |m, o| Point2::new(m.x.min(o.min.x), m.y.min(o.min.y)));
    let mut max = outlines.iter().fold(Point2::new(f64::NEG_INFINITY, f64::NEG_INFINITY), |m, o| {
        Point2::new(m.x.max(o.max.x), m.y.max(o.max.y))
    });
    let mut size = (max.x.floor() - min.x.ceil() + 1.0, max.y.floor() - min.y.ceil() + 1.0);
    if let (true, Some(period)) = (full_circle, surface.period()) {
        min.x = -0.5 * period;
        max.x = 0.5 * period;
        size.0 = period.round();
    }
    let (width, height) = (size.0.max(1.0), size.1.max(1.0));
    let (canvas_w, canvas_h) = canvas_size(width, height, max_pixels, surface.projection)?;
    let origin = Point2::new(min.x.ceil(), min.y.ceil());
    let mut placements = Vec::new();
    for ((photo, view), o) in views.iter().zip(&outlines) {
        let turns: &[f64] = if full_circle { &[0.0, 1.0, -1.0] } else { &[0.0] };
        for turns in turns {
            let shift = turns * surface.period().unwrap_or(0.0);
            let clamp = |v: f64, limit: usize| v.clamp(0.0, limit as f64) as usize;
            // A margin of one pixel for the curvature of the outline between its samples.
            let bounds = Bounds {
                left: clamp((o.min.x + shift - origin.x).floor() - 1.0, canvas_w),
                top: clamp((o.min.y - origin.y).floor() - 1.0, canvas_h),
                right: clamp((o.max.x + shift - origin.x).ceil() + 2.0, canvas_w),
                bottom: clamp((o.max.y - origin.y).ceil() + 2.0, canvas_h),
            };
            if bounds.left < bounds.right && bounds.top < bounds.bottom {
                placements.push(Placement {
                    photo: *photo,
                    view: *view,
                    bounds,
                    origin: origin - nalgebra::Vector2::new(shift, 0.0),
                });
            }
        }
    }
    let canvas = Canvas { projection: surface.projection, scale: surface.scale, origin, frame };
    Ok(Layout { surface, width: canvas_w, height: canvas_h, full_circle, placements, canvas, reaches_beyond: false })
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Camera, Named};

    /// Photographs of 600 × 400 px at focal length 500 px (62° by 44°), rotated by these yaws and pitches.
    fn alignment(turns: &[(f64, f64)]) -> Alignment {
        let views = turns
            .iter()
            .map(|&(yaw, pitch)| {
                let r = Rotation3::from_axis_angle(&Vector3::x_axis(), pitch)
                    * Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw);
                Ok(View { camera: Camera::from_focal(600, 400, 500.0), from_world: r.into_inner() })
            })
            .collect();
        Alignment {
            views,
            reference: 0,
            motion: CameraMotion::Rotation,
            pairs: Vec::new(),
            rms_px: 0.0,
            median_px: 0.0,
        }
    }

    const MANY: usize = 100_000_000;

    #[test]
    fn the_projection_is_selected_by_the_field_of_view() {
        let chosen = |turns: &[(f64, f64)]| {
            layout(&alignment(turns), Projection::Auto, &Framing::default(), 1.0, MANY).unwrap().surface.projection
        };
        assert_eq!(chosen(&[(0.0, 0.0), (0.3, 0.0)]), Projection::Plane);
        assert_eq!(chosen(&[(-0.7, 0.0), (0.0, 0.0), (0.7, 0.0)]), Projection::Cylindrical);
        assert_eq!(chosen(&[(-0.7, 0.0), (0.0, 0.8), (0.7, 0.0)]), Projection::Spherical);
    }

    #[test]
    fn the_canvas_contains_every_photograph_in_any_world_frame() {
        for offset in [0.0, 2.0, 3.1, -3.0] {
            let set = alignment(&[(offset, 0.0), (offset + 0.4, 0.05)]);
            for projection in Projection::NAMES.iter().map(|(_, p)| *p) {
                let l = layout(&set, projection, &Framing::default(), 1.0, MANY).unwrap();
                assert_eq!(l.placements.len(), 2);
                for p in &l.placements {
                    // Every border pixel of the photograph is inside its bounds.
                    for pixel in p.view.border(100) {
                        let q = l.surface.forward(&p.view.ray(pixel).unwrap()).unwrap() - p.origin;
                        assert!(
                            q.x >= p.bounds.left as f64 - 1.0 && q.x <= p.bounds.right as f64,
                            "{offset} {projection:?} {q}"
                        );
                        assert!(
                            q.y >= p.bounds.top as f64 - 1.0 && q.y <= p.bounds.bottom as f64,
                            "{offset} {projection:?} {q}"
                        );
                    }
                }
                // 62 degrees and 0.4 rad: 500 tan and 500 rad, both under 900 px.
                assert!(l.width < 1100 && l.height < 600, "{projection:?} {} {}", l.width, l.height);
            }
        }
    }

    #[test]
    fn a_lens_model_that_ends_inside_the_photographs_limits_their_extent() {
        let mut set = alignment(&[(0.0, 0.0), (0.4, 0.05)]);
        for view in set.views.iter_mut().flatten() {
            view.camera.distortion = cv_core::Distortion::simple_radial(-0.6);
        }
        for projection in Projection::NAMES.iter().map(|(_, p)| *p) {
            let l = layout(&set, projection, &Framing::default(), 1.0, MANY).unwrap();
            // r (1 − 0.6 r²) increases up to r = √(1 / 1.8), an angle of 36.7°; vertically the photographs end before.
            let most = 500.0 * (2.0 * (1.0_f64 / 1.8).sqrt().atan() + 0.4);
            assert!(l.width as f64 > 0.95 * most && (l.width as f64) < 1.4 * most, "{projection:?} {}", l.width);
            assert!(l.height > 400 && l.height < 1000, "{projection:?} {}", l.height);
        }
    }

    #[test]
    fn a_full_circle_is_one_period_wide_and_photographs_over_the_cut_are_drawn_twice() {
        let turns: Vec<_> = (0..10).map(|k| (f64::from(k) * TAU / 10.0, 0.0)).collect();
        let l = layout(&alignment(&turns), Projection::Auto, &Framing::default(), 1.0, MANY).unwrap();
        assert!(l.full_circle && l.surface.projection == Projection::Cylindrical);
        assert_eq!(l.width, (TAU * 500.0_f64).round() as usize);
        let covered: Vec<bool> =
            (0..l.width).map(|x| l.placements.iter().any(|p| p.bounds.left <= x && x < p.bounds.right)).collect();
        assert!(covered.iter().all(|c| *c));
        assert!(l.placements.len() > 10);
    }

    #[test]
    fn a_field_too_wide_for_the_projection_is_an_error_with_the_numbers() {
        let wide = alignment(&[(-1.2, 0.0), (0.0, 0.0), (1.2, 0.0)]);
        // 62 + 138 = 200 degrees.
        match layout(&wide, Projection::Plane, &Framing::default(), 1.0, MANY) {
            Err(LayoutError::TooWide { degrees, projection: Projection::Plane }) => {
                assert!((degrees - 199.4).abs() < 1.0)
            }
            other => panic!("{other:?}"),
        }
        let nearly = alignment(&[(-1.0, 0.0), (1.0, 0.0)]);
        assert!(
            matches!(layout(&nearly, Projection::Plane, &Framing::default(), 1.0, MANY), Err(LayoutError::TooLarge { width, .. }) if width > 9000.0)
        );
        assert!(matches!(
            layout(&wide, Projection::Auto, &Framing::default(), 1.0, 1000),
            Err(LayoutError::TooLarge { .. })
        ));
        let straight_up = alignment(&[(0.0, 1.5), (0.5, 1.5)]);
        assert!(matches!(
            layout(&straight_up, Projection::Cylindrical, &Framing::default(), 1.0, MANY),
            Err(LayoutError::TooWide { .. })
        ));
        assert!(layout(&straight_up, Projection::Auto, &Framing::default(), 1.0, MANY).is_ok());
    }

    /// A full circle of photographs in three rows, up to about 60° above and below the horizon.
    fn all_around() -> Alignment {
        let row = |pitch: f64| (0..10).map(move |k| (f64::from(k) * TAU / 10.0, pitch));
        alignment(&row(-0.6).chain(row(0.0)).chain(row(0.6)).collect::<Vec<_>>())
    }

    #[test]
    fn unbounded_projections_are_truncated_and_reported() {
        let set = all_around();
        let lay = |projection| layout(&set, projection, &Framing::default(), 0.2, MANY).unwrap();
        let stereographic = lay(Projection::Stereographic);
        // 2 · 100 tan 75° to each side, where the photographs reach.
        let width = (400.0 * 75_f64.to_radians().tan()) as usize;
        assert!(stereographic.reaches_beyond && stereographic.width.abs_diff(width) <= 2, "{}", stereographic.width);
        let panini = lay(Projection::Panini);
        let width = (400.0 * 60_f64.to_radians().tan()) as usize;
        assert!(panini.reaches_beyond && panini.width.abs_diff(width) <= 2, "{}", panini.width);
        let mercator = lay(Projection::Mercator);
        assert!(mercator.full_circle && !mercator.reaches_beyond);
        assert_eq!(mercator.width, (TAU * 100.0_f64).round() as usize);
        // Half of 44° above 0.6 rad.
        let top = 0.6 + 200_f64.atan2(500.0);
        assert!(mercator.height.abs_diff((200.0 * top.tan().asinh()) as usize) <= 2, "{}", mercator.height);
        // Straight up there is a pole, on Mercator's surface at infinity.
        let up = alignment(&[(0.0, 1.5), (0.5, 1.5)]);
        let cut = layout(&up, Projection::Mercator, &Framing::default(), 1.0, MANY).unwrap();
        assert!(cut.reaches_beyond);
        // It ends at y = ±π, the one or the other.
        let ends = [-cut.canvas.origin.y, cut.canvas.origin.y + cut.height as f64 - 1.0];
        assert!(ends.iter().any(|y| (y - 500.0 * PI).abs() < 1.0), "{ends:?}");
    }

    /// Returns the angle between the directions of two canvas pixels, in degrees.
    fn angle(canvas: &Canvas, a: (f64, f64), b: (f64, f64)) -> f64 {
        let ray = |(x, y)| canvas.ray(Point2::new(x, y));
        ray(a).angle(&ray(b)).to_degrees()
    }

    #[test]
    fn the_requested_field_of_view_is_rendered_and_empty_outside_the_photographs() {
        let set = all_around();
        for (projection, across, up) in [
            (Projection::Plane, 60.0_f64, 40.0_f64),
            (Projection::Cylindrical, 120.0, 60.0),
            (Projection::Spherical, 170.0, 90.0),
            (Projection::Mercator, 120.0, 100.0),
            (Projection::Panini, 150.0, 60.0),
            (Projection::Stereographic, 120.0, 170.0),
        ] {
            for center in [[0.0, 0.0], [2.0, 0.3], [-3.1, -0.2]] {
                let framing = Framing {
                    center: Some(center),
                    roll: 0.2,
                    across: Some(across.to_radians()),
                    up: Some(up.to_radians()),
                };
                let l = layout(&set, projection, &framing, 1.0, MANY).unwrap();
                let (w, h) = (l.width as f64, l.height as f64);
                let (x, y) = (0.5 * (w - 1.0), 0.5 * (h - 1.0));
                // From edge to edge, of which rounding to pixels takes half a pixel of a radian in 500 or less.
                let got = angle(&l.canvas, (-0.5, y), (w - 0.5, y));
                assert!((got - across).abs() < 0.12, "{projection:?} {got} {across}");
                let got = angle(&l.canvas, (x, -0.5), (x, h - 0.5));
                assert!((got - up).abs() < 0.12, "{projection:?} {got} {up}");
                // The center of the canvas has the requested direction.
                let [yaw, pitch] = center;
                let want = Vector3::new(pitch.cos() * yaw.sin(), -pitch.sin(), pitch.cos() * yaw.cos());
                assert!(l.canvas.ray(Point2::new(x, y)).normalize().dot(&want) > 1.0 - 1e-12);
            }
        }
        // Photographs of 62° on a canvas of 120°.
        let one = alignment(&[(0.0, 0.0)]);
        let framing = Framing { across: Some(120_f64.to_radians()), ..Framing::default() };
        let l = layout(&one, Projection::Cylindrical, &framing, 1.0, MANY).unwrap();
        assert_eq!(l.width, (500.0 * 120_f64.to_radians()).round() as usize);
        let b = l.placements[0].bounds;
        let free = (0.5 * l.width as f64 - 500.0 * 300_f64.atan2(500.0)).abs();
        // As many pixels more as a sample of the window's edges: of a cylinder up to 75°, 3732 in height, 512 samples.
        assert!(
            (b.left as f64 - free).abs() < 12.0 && (b.right as f64 - (l.width as f64 - free)).abs() < 12.0,
            "{b:?}"
        );
    }

    #[test]
    fn an_invalid_field_of_view_is_refused_with_the_numbers() {
        let set = alignment(&[(0.0, 0.0), (0.4, 0.0)]);
        let go = |projection, framing: Framing| layout(&set, projection, &framing, 1.0, MANY).unwrap_err();
        let wide = |degrees: f64| Framing { across: Some(degrees.to_radians()), ..Framing::default() };
        for (projection, degrees, limit) in [
            (Projection::Plane, 151.0, 150.0),
            (Projection::Panini, 241.0, 240.0),
            (Projection::Stereographic, 320.0, 300.0),
        ] {
            match go(projection, wide(degrees)) {
                LayoutError::FieldTooWide { degrees: told, most, .. } => {
                    assert!((told - degrees).abs() < 1e-9 && (most - limit).abs() < 1e-9);
                }
                other => panic!("{other:?}"),
            }
            assert!(!matches!(
                go(projection, Framing { up: Some(6.2), ..Framing::default() }),
                LayoutError::NothingInView
            ));
        }
        let behind = Framing { center: Some([PI, 0.0]), ..wide(60.0) };
        assert_eq!(go(Projection::Cylindrical, behind), LayoutError::NothingInView);
        assert_eq!(go(Projection::Auto, behind), LayoutError::NothingInView);
        let mut flat = set.clone();
        flat.motion = CameraMotion::Homography;
        let error = layout(&flat, Projection::Plane, &wide(60.0), 1.0, MANY).unwrap_err();
        assert_eq!(error, LayoutError::FlatScene);
    }
}
