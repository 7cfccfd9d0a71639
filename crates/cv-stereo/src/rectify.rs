//! Rectification: virtual rotations of both cameras that make epipolar lines coincide with rows.
//!
//! The common orientation has its x axis along the baseline, and its optical axis as near as possible to the mean of those of the
//! cameras (Bouguet's splitting of the rotation; Fusiello, Trucco & Verri, "A compact algorithm for rectification of stereo pairs", MVA
//! 2000, for the x axis).

use crate::StereoGeometry;
use cv_core::{
    Camera, CameraError, Cancelled, Distortion, Image, ImageView, Mask, OptionError, Point2, Point3, Progress,
    Rotation3, Stage, StereoRig, Vector3, round_to_four_digits,
};
use cv_imgproc::{Pixel, WarpError, WarpMap};
use nalgebra::{Matrix3, Matrix4};
use std::sync::atomic::{AtomicBool, Ordering};

/// Options of [`Rectification::new`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct RectifyOptions {
    /// From 0, where every pixel of both rectified images is valid, to 1, where they contain every pixel of the originals. Default 0
    /// (OpenCV's usual choice).
    pub alpha: f64,
    /// Width and height of the rectified images in px; `None` for those of the left camera (exchanged for vertical rigs). Default `None`.
    pub size: Option<(usize, usize)>,
}

impl Default for RectifyOptions {
    fn default() -> Self {
        Self { alpha: 0.0, size: None }
    }
}

/// Why a rig cannot be rectified.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum RectifyError {
    /// A camera is invalid.
    #[error("the {side} camera: {error}")]
    Camera {
        /// `left` or `right`; `only` for a single camera.
        side: &'static str,
        /// Its error.
        error: CameraError,
    },
    /// The camera centers coincide, or the translation is not finite.
    #[error("the cameras are {} apart: there is no parallax between them", round_to_four_digits(*.baseline))]
    NoBaseline {
        /// Length of the translation.
        baseline: f64,
    },
    /// The right camera is left of the left one, or the lower one above.
    #[error(
        "the second camera is {} {} the first: they are exchanged",
        round_to_four_digits(*.distance), if *.vertical { "above" } else { "left of" }
    )]
    Exchanged {
        /// By how much, in the unit of the rig.
        distance: f64,
        /// Whether the rig is vertical.
        vertical: bool,
    },
    /// One camera is behind the other, or their optical axes diverge, so that the rectified views would have another field of view.
    #[error(
        "the {side} camera would have to be rotated by {degrees:.1}°, more than {limit}°, to face perpendicular to the baseline: the rig is not a stereo rig"
    )]
    TooFarTurned {
        /// `left` or `right`.
        side: &'static str,
        /// The rotation it would need.
        degrees: f64,
        /// The maximum rotation.
        limit: f64,
    },
    /// The fields of view do not overlap after rectification.
    #[error("the rectified cameras have no field of view in common")]
    NoOverlap,
    /// An image does not have the size its camera was calibrated for.
    #[error("the image is {}×{} px, its camera was calibrated for {}×{} px", image.0, image.1, expected.0, expected.1)]
    ImageSize {
        /// Width and height of the image.
        image: (usize, usize),
        /// Width and height of the camera's images.
        expected: (usize, usize),
    },
    /// The rectified image is too large to be addressed.
    #[error("a rectified image of {width}×{height} px is larger than memory can address")]
    TooLarge {
        /// Width in px.
        width: usize,
        /// Height in px.
        height: usize,
    },
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

/// Maximum rotation of a camera: beyond, the rectified image plane would be at a grazing angle to the scene.
const MAX_TURN_DEGREES: f64 = 60.0;

/// One view of a rectified rig.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RectifiedView {
    /// The camera of the original image.
    pub source: Camera,
    /// The virtual camera of the rectified image.
    pub camera: Camera,
    /// Rotates directions from the frame of the source camera to the rectified one.
    pub rotation: Rotation3<f64>,
}

impl RectifiedView {
    /// Returns the view of one camera without distortion and rotation: square pixels, and the field of view that `options` select.
    ///
    /// # Errors
    /// [`RectifyError`] if the camera is invalid, an option is out of range, or the distortion model covers no central part of the image.
    pub fn undistorted(source: &Camera, options: &RectifyOptions) -> Result<Self, RectifyError> {
        source.validate().map_err(|error| RectifyError::Camera { side: "only", error })?;
        OptionError::check("alpha", options.alpha, "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
        let (width, height) = options.size.unwrap_or((source.width, source.height));
        OptionError::check("size", width.min(height) as f64, "at least 1×1 px", |v| v >= 1.0)?;
        let rotation = Rotation3::identity();
        let camera = common_camera([(*source, rotation); 2], (width, height), options.alpha)?;
        Ok(Self { source: *source, camera, rotation })
    }

    /// Maps a pixel of the rectified image to the original; `None` outside the field of view of the original camera.
    pub fn source_pixel(&self, pixel: Point2<f64>) -> Option<Point2<f64>> {
        let n = self.camera.normalize(pixel);
        let ray = self.rotation.inverse_transform_point(&Point3::new(n.x, n.y, 1.0));
        if ray.z <= 0.0 {
            return None;
        }
        // Beyond the monotonic range of a distortion model, rays from far outside fold back into the image.
        self.source.denormalize_in_range(Point2::new(ray.x / ray.z, ray.y / ray.z))
    }

    /// Computes the warp map from the rectified image to the original, for many originals: the distortion model is evaluated only here.
    ///
    /// # Errors
    /// [`RectifyError::TooLarge`], [`RectifyError::Cancelled`].
    pub fn map(&self, progress: &dyn Progress) -> Result<WarpMap, RectifyError> {
        let size = (self.camera.width, self.camera.height);
        let stage = Stage::new(progress, "rectify", size.1)?;
        let stopped = AtomicBool::new(false);
        let source = |x: usize, y: usize| {
            // Once stopped, the remaining pixels are skipped.
            if stopped.load(Ordering::Relaxed) {
                return None;
            }
            if x == 0 && stage.add(1).is_err() {
                stopped.store(true, Ordering::Relaxed);
                return None;
            }
            self.source_pixel(Point2::new(x as f64, y as f64))
        };
        let map = WarpMap::new((self.source.width, self.source.height), size, source).map_err(|e| self.failed(&e))?;
        if stopped.into_inner() { Err(Cancelled.into()) } else { Ok(map) }
    }

    /// Rectifies an original by bilinear interpolation, and returns the mask of valid pixels; others are black. For many originals, compute
    /// the [`map`](Self::map) once.
    ///
    /// # Errors
    /// [`RectifyError::ImageSize`] if the image does not have the camera's size; [`RectifyError::Cancelled`].
    pub fn apply<T: Pixel, const C: usize>(
        &self,
        image: ImageView<'_, T, C>,
        progress: &dyn Progress,
    ) -> Result<(Image<T, C>, Mask), RectifyError> {
        let expected = (self.source.width, self.source.height);
        if image.size() != expected {
            return Err(RectifyError::ImageSize { image: image.size(), expected });
        }
        let map = self.map(progress)?;
        Ok((map.compute(image).map_err(|e| self.failed(&e))?, map.inside()))
    }

    /// Converts the error of a warp.
    fn failed(&self, error: &WarpError) -> RectifyError {
        match *error {
            WarpError::SourceSize { got, expected } => RectifyError::ImageSize { image: got, expected },
            _ => RectifyError::TooLarge { width: self.camera.width, height: self.camera.height },
        }
    }

    /// Returns by how many px of the original the border of the rectified image is at most outside it; infinity outside the field of view of
    /// the camera, negative inside.
    fn max_px_outside(&self) -> f64 {
        let last = |n: usize| n as f64 - 1.0;
        let (w, h) = (last(self.source.width), last(self.source.height));
        let outside = |x: usize, y: usize| {
            self.source_pixel(Point2::new(x as f64, y as f64))
                .map_or(f64::INFINITY, |p| (-p.x).max(-p.y).max(p.x - w).max(p.y - h))
        };
        let (right, bottom) = (self.camera.width - 1, self.camera.height - 1);
        let columns = (0..=right).map(|x| outside(x, 0).max(outside(x, bottom)));
        let rows = (0..=bottom).map(|y| outside(0, y).max(outside(right, y)));
        columns.chain(rows).fold(-f64::INFINITY, f64::max)
    }

    /// Maps a pixel of the original to the rectified image; `None` behind the rectified camera.
    pub fn rectified_pixel(&self, pixel: Point2<f64>) -> Option<Point2<f64>> {
        let n = self.source.normalize(pixel);
        self.camera.project(&(self.rotation * Point3::new(n.x, n.y, 1.0)))
    }
}

/// A rectified rig: both views, and the geometry of their disparities.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Rectification {
    /// The left (or upper) view.
    pub left: RectifiedView,
    /// The right (or lower) view.
    pub right: RectifiedView,
    /// Converts disparities to depth, in the unit of the rig.
    pub geometry: StereoGeometry,
    /// True if one camera is above the other. The rectified images are then rotated by 90°, so that epipolar lines are rows: their x axis
    /// points down in the scene.
    pub vertical: bool,
}

impl Rectification {
    /// Rectifies a rig.
    ///
    /// # Errors
    /// [`RectifyError`] with the reason.
    pub fn new(rig: &StereoRig, options: &RectifyOptions) -> Result<Self, RectifyError> {
        let (x, baseline) = baseline_direction(rig)?;
        OptionError::check("alpha", options.alpha, "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
        let center = rig.right_from_left.center();
        let vertical = center.y.abs() > center.x.abs();
        let along = if vertical { center.y } else { center.x };
        if along < 0.0 {
            return Err(RectifyError::Exchanged { distance: -along, vertical });
        }
        let rotations = common_rotations(x, &rig.right_from_left.rotation)?;

        let native = (rig.left.width, rig.left.height);
        let (width, height) = options.size.unwrap_or(if vertical { (native.1, native.0) } else { native });
        OptionError::check("size", width.min(height) as f64, "at least 1×1 px", |v| v >= 1.0)?;
        let sources = [(rig.left, rotations[0]), (rig.right, rotations[1])];
        let camera = common_camera(sources, (width, height), options.alpha)?;
        let view = |source, rotation| RectifiedView { source, camera, rotation };
        Ok(Self {
            left: view(rig.left, rotations[0]),
            right: view(rig.right, rotations[1]),
            geometry: StereoGeometry { focal: camera.fx, cx: camera.cx, cy: camera.cy, baseline, offset: 0.0 },
            vertical,
        })
    }

    /// Returns `Q` of [`StereoGeometry::q`].
    pub fn q(&self) -> Matrix4<f64> {
        self.geometry.q()
    }

    /// Returns the fraction of valid pixels of the left and of the right rectified image, on a grid of every fourth pixel.
    pub fn valid_area(&self) -> (f64, f64) {
        let valid_fraction = |view: &RectifiedView| {
            let (w, h) = (view.camera.width, view.camera.height);
            let (mut valid, mut all) = (0usize, 0usize);
            for y in (0..h).step_by(4) {
                for x in (0..w).step_by(4) {
                    all += 1;
                    valid += usize::from(view.source_pixel(Point2::new(x as f64, y as f64)).is_some_and(|p| {
                        p.x >= 0.0
                            && p.y >= 0.0
                            && p.x <= view.source.width as f64 - 1.0
                            && p.y <= view.source.height as f64 - 1.0
                    }));
                }
            }
            valid as f64 / all.max(1) as f64
        };
        (valid_fraction(&self.left), valid_fraction(&self.right))
    }
}

/// Validates the cameras and returns the direction of the baseline in the left camera's frame, and its length.
pub(crate) fn baseline_direction(rig: &StereoRig) -> Result<(Vector3<f64>, f64), RectifyError> {
    for (side, camera) in [("left", &rig.left), ("right", &rig.right)] {
        camera.validate().map_err(|error| RectifyError::Camera { side, error })?;
    }
    let baseline = rig.baseline();
    let x = rig.right_from_left.center().coords.try_normalize(1e-12).filter(|_| baseline.is_finite());
    x.map(|x| (x, baseline)).ok_or(RectifyError::NoBaseline { baseline })
}

/// Returns the rotations of both cameras to the common frame: x along the baseline, z as near as possible to the mean of the optical axes.
pub(crate) fn common_rotations(
    x: Vector3<f64>,
    relative: &Rotation3<f64>,
) -> Result<[Rotation3<f64>; 2], RectifyError> {
    let axes = [Vector3::z(), relative.inverse() * Vector3::z()];
    let turned = |side, degrees: f64| RectifyError::TooFarTurned { side, degrees, limit: MAX_TURN_DEGREES };
    let mean = axes[0] + axes[1];
    let across = mean - x * x.dot(&mean);
    let Some(z) = across.try_normalize(1e-9) else { return Err(turned("right", 90.0)) };
    for (side, axis) in [("left", axes[0]), ("right", axes[1])] {
        let degrees = axis.angle(&z).to_degrees();
        if degrees > MAX_TURN_DEGREES {
            return Err(turned(side, degrees));
        }
    }
    let rows = Matrix3::from_rows(&[x.transpose(), z.cross(&x).transpose(), z.transpose()]);
    let to_common = Rotation3::from_matrix_unchecked(rows);
    Ok([to_common, to_common * relative.inverse()])
}

/// A rectangle in normalized coordinates.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rect {
    pub(crate) left: f64,
    pub(crate) top: f64,
    pub(crate) right: f64,
    pub(crate) bottom: f64,
}

/// Returns the border of a camera's field of view in the rectified frame: a closed polygon without the parts behind the camera.
pub(crate) fn field_of_view(camera: &Camera, rotation: &Rotation3<f64>) -> Vec<Point2<f64>> {
    // Points per side: enough for strong distortion.
    const STEPS: usize = 64;
    let (w, h) = (camera.width as f64 - 1.0, camera.height as f64 - 1.0);
    let corners = [(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)];
    (0..4 * STEPS)
        .filter_map(|i| {
            let (from, to) = (corners[i / STEPS], corners[(i / STEPS + 1) % 4]);
            let t = (i % STEPS) as f64 / STEPS as f64;
            let n = camera.normalize(Point2::new(from.0 + (to.0 - from.0) * t, from.1 + (to.1 - from.1) * t));
            let ray = rotation * Point3::new(n.x, n.y, 1.0);
            (ray.z > 1e-3).then(|| Point2::new(ray.x / ray.z, ray.y / ray.z))
        })
        .collect()
}

/// Returns the bounding box of a polygon.
pub(crate) fn bounding_box(polygon: &[Point2<f64>]) -> Rect {
    let nothing = Rect { left: f64::INFINITY, top: f64::INFINITY, right: -f64::INFINITY, bottom: -f64::INFINITY };
    polygon.iter().fold(nothing, |r, p| Rect {
        left: r.left.min(p.x),
        top: r.top.min(p.y),
        right: r.right.max(p.x),
        bottom: r.bottom.max(p.y),
    })
}

/// Returns the sides of a closed polygon.
fn sides(polygon: &[Point2<f64>]) -> impl Iterator<Item = (Point2<f64>, Point2<f64>)> {
    polygon.iter().copied().zip(polygon.iter().copied().cycle().skip(1))
}

/// Returns the extent of a polygon from an inside point `p` to the left and right, or, with `axis` 1, up and down; `None` outside.
fn extent(polygon: &[Point2<f64>], p: Point2<f64>, axis: usize) -> Option<(f64, f64)> {
    let (along, across) = (axis, 1 - axis);
    let (mut before, mut behind, mut crossed) = (-f64::INFINITY, f64::INFINITY, 0);
    for (a, b) in sides(polygon) {
        if (a[across] > p[across]) == (b[across] > p[across]) {
            continue;
        }
        let t = (p[across] - a[across]) / (b[across] - a[across]);
        let at = a[along] + (b[along] - a[along]) * t - p[along];
        if at < 0.0 {
            crossed += 1;
            before = before.max(at);
        } else {
            behind = behind.min(at);
        }
    }
    (crossed % 2 == 1 && behind.is_finite()).then_some((before, behind))
}

/// Returns the factor by which a rectangle around `middle` of half size `half` can grow until it touches a polygon.
fn max_growth(polygon: &[Point2<f64>], middle: Point2<f64>, half: (f64, f64)) -> f64 {
    let mut least = f64::INFINITY;
    for (a, b) in sides(polygon) {
        // In units of the rectangle; along a side, the maximum norm is smallest at an end or where both coordinates are equal.
        let (u0, v0) = ((a.x - middle.x) / half.0, (a.y - middle.y) / half.1);
        let (u1, v1) = ((b.x - middle.x) / half.0, (b.y - middle.y) / half.1);
        let same = |sign: f64| (u0 - sign * v0) / ((u0 - sign * v0) - (u1 - sign * v1));
        for t in [0.0, same(1.0), same(-1.0)] {
            if (0.0..=1.0).contains(&t) {
                least = least.min((u0 + (u1 - u0) * t).abs().max((v0 + (v1 - v0) * t).abs()));
            }
        }
    }
    least
}

/// Returns the camera of both views, between the largest that is valid in every pixel and the smallest that contains both fields of view.
fn common_camera(
    sources: [(Camera, Rotation3<f64>); 2],
    (width, height): (usize, usize),
    alpha: f64,
) -> Result<Camera, RectifyError> {
    let polygons = sources.map(|(camera, rotation)| field_of_view(&camera, &rotation));
    let [a, b] = [bounding_box(&polygons[0]), bounding_box(&polygons[1])];
    let middle = |left: f64, right: f64, top: f64, bottom: f64| Point2::new((left + right) / 2.0, (top + bottom) / 2.0);
    let both = middle(a.left.max(b.left), a.right.min(b.right), a.top.max(b.top), a.bottom.min(b.bottom));
    let (left, right) = (a.left.min(b.left), a.right.max(b.right));
    let (top, bottom) = (a.top.min(b.top), a.bottom.max(b.bottom));
    // The extent of the common field of view from a point.
    let common_extent = |p: Point2<f64>, axis: usize| -> Option<(f64, f64)> {
        let ((a0, a1), (b0, b1)) = (extent(&polygons[0], p, axis)?, extent(&polygons[1], p, axis)?);
        Some((a0.max(b0), a1.min(b1)))
    };
    let (Some(x), Some(y)) = (common_extent(both, 0), common_extent(both, 1)) else {
        return Err(RectifyError::NoOverlap);
    };
    let inner = Point2::new(both.x + (x.0 + x.1) / 2.0, both.y + (y.0 + y.1) / 2.0);
    let inner = if common_extent(inner, 0).is_some() { inner } else { both };
    // Pixel centers at the very corners.
    let (w, h) = ((width as f64 - 1.0).max(1.0), (height as f64 - 1.0).max(1.0));
    let camera = |focal: f64, middle: Point2<f64>| Camera {
        width,
        height,
        fx: focal,
        fy: focal,
        cx: (width as f64 - 1.0) / 2.0 - focal * middle.x,
        cy: (height as f64 - 1.0) / 2.0 - focal * middle.y,
        distortion: Distortion::NONE,
    };
    let [growth_a, growth_b] = [0, 1].map(|i: usize| max_growth(&polygons[i], inner, (w / 2.0, h / 2.0)));
    let mut tight = (1.0 + ROUNDING) / growth_a.min(growth_b);
    // Between the vertices the border is curved: grows the focal length until no pixel is outside.
    for _ in 0..20 {
        let outside = sources.map(|(source, rotation)| {
            RectifiedView { source, camera: camera(tight, inner), rotation }.max_px_outside()
        });
        let outside = outside[0].max(outside[1]);
        if outside <= 0.0 {
            break;
        }
        tight *= 1.0 + ROUNDING + (4.0 * outside / w.min(h)).min(0.05);
    }
    let wide = (w / (right - left)).min(h / (bottom - top));
    let focal = tight + (wide - tight) * alpha;
    if !(focal.is_finite() && focal > 0.0) {
        return Err(RectifyError::NoOverlap);
    }
    Ok(camera(focal, inner + (middle(left, right, top, bottom) - inner) * alpha))
}

/// Relative margin of a focal length, far above rounding errors and far below a pixel.
const ROUNDING: f64 = 1e-12;
