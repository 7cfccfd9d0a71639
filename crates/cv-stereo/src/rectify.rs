//! Rectification: turning both cameras, in thought, until their rows coincide.
//!
//! The common orientation has its x axis along the baseline and looks as nearly as possible where the two cameras look on
//! average (Bouguet's way of splitting the rotation; Fusiello, Trucco & Verri, "A compact algorithm for rectification of
//! stereo pairs", MVA 2000, for the axis).

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
    /// From 0, where both rectified images show the scene in every pixel, to 1, where they show every pixel of the
    /// originals. Default 0 (OpenCV's usual choice).
    pub alpha: f64,
    /// Width and height of the rectified images in px; `None` for those of the left camera (exchanged where the rig is
    /// vertical). Default `None`.
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
    /// A camera is none.
    #[error("the {side} camera: {error}")]
    Camera {
        /// `left` or `right`; `only` of a camera by itself.
        side: &'static str,
        /// What is wrong with it.
        error: CameraError,
    },
    /// The two cameras stand at the same place, or the translation is not finite.
    #[error("the cameras are {} apart: there is no parallax between them", round_to_four_digits(*.baseline))]
    NoBaseline {
        /// Length of the translation.
        baseline: f64,
    },
    /// The right camera stands left of the left one, or the lower one above.
    #[error(
        "the second camera stands {} {} the first: they are exchanged",
        round_to_four_digits(*.distance), if *.vertical { "above" } else { "left of" }
    )]
    Exchanged {
        /// By how much, in the unit of the rig.
        distance: f64,
        /// Whether the rig is a vertical one.
        vertical: bool,
    },
    /// The cameras stand one behind the other, or look apart, so that rectified ones would see something else.
    #[error(
        "the {side} camera would have to turn by {degrees:.1}°, more than {limit}°, to look across the baseline: the rig is not a stereo rig"
    )]
    TooFarTurned {
        /// `left` or `right`.
        side: &'static str,
        /// By how much it would have to turn.
        degrees: f64,
        /// The most that is done.
        limit: f64,
    },
    /// The two cameras see nothing in common after rectification.
    #[error("the rectified cameras have no field of view in common")]
    NoOverlap,
    /// An image is not of the size its camera was calibrated for.
    #[error("the image is {}×{} px, its camera was calibrated for {}×{} px", image.0, image.1, expected.0, expected.1)]
    ImageSize {
        /// Width and height of the image.
        image: (usize, usize),
        /// Width and height of the camera's images.
        expected: (usize, usize),
    },
    /// The rectified image is larger than memory can address.
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

/// The most a camera is turned: beyond, a plane image sensor would see the scene at a grazing angle.
const MAX_TURN_DEGREES: f64 = 60.0;

/// One view of a rectified rig.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct RectifiedView {
    /// The camera that took the original.
    pub source: Camera,
    /// The camera that would have taken the rectified image.
    pub camera: Camera,
    /// Takes directions from the source's frame to the rectified one.
    pub rotation: Rotation3<f64>,
}

impl RectifiedView {
    /// One camera as it would be without distortion, looking where it does: square pixels, and of the picture as much as `options` say.
    ///
    /// # Errors
    /// [`RectifyError`] where the camera is none, an option is out of range, or the picture has no middle part that the lens reaches.
    pub fn undistorted(source: &Camera, options: &RectifyOptions) -> Result<Self, RectifyError> {
        source.validate().map_err(|error| RectifyError::Camera { side: "only", error })?;
        OptionError::check("alpha", options.alpha, "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
        let (width, height) = options.size.unwrap_or((source.width, source.height));
        OptionError::check("size", width.min(height) as f64, "at least 1×1 px", |v| v >= 1.0)?;
        let rotation = Rotation3::identity();
        let camera = common_camera([(*source, rotation); 2], (width, height), options.alpha)?;
        Ok(Self { source: *source, camera, rotation })
    }

    /// Where a pixel of the rectified image lies in the original; `None` where the original's camera does not look.
    pub fn source_pixel(&self, pixel: Point2<f64>) -> Option<Point2<f64>> {
        let n = self.camera.normalize(pixel);
        let ray = self.rotation.inverse_transform_point(&Point3::new(n.x, n.y, 1.0));
        if ray.z <= 0.0 {
            return None;
        }
        // Beyond its turning point a lens model folds rays from far outside back into the image.
        self.source.denormalize_in_range(Point2::new(ray.x / ray.z, ray.y / ray.z))
    }

    /// Where every pixel of the rectified image comes from, for many originals. The lens is asked for each pixel here, once.
    ///
    /// # Errors
    /// [`RectifyError::TooLarge`], [`RectifyError::Cancelled`].
    pub fn map(&self, progress: &dyn Progress) -> Result<WarpMap, RectifyError> {
        let size = (self.camera.width, self.camera.height);
        let stage = Stage::new(progress, "rectify", size.1)?;
        let stopped = AtomicBool::new(false);
        let source = |x: usize, y: usize| {
            // Once it was stopped, nothing is left to do for any pixel.
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

    /// The rectified image of an original, bilinear, and where it shows anything; black elsewhere. Of many originals, make the [`map`](Self::map) once.
    ///
    /// # Errors
    /// [`RectifyError::ImageSize`] where the image is not of the camera's size; [`RectifyError::Cancelled`].
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

    /// Why no image was made by a map.
    fn failed(&self, error: &WarpError) -> RectifyError {
        match *error {
            WarpError::SourceSize { got, expected } => RectifyError::ImageSize { image: got, expected },
            _ => RectifyError::TooLarge { width: self.camera.width, height: self.camera.height },
        }
    }

    /// How many px of the original the outermost pixel of the rectified image lies outside it; infinity where the camera does
    /// not look there at all, negative inside.
    fn beyond_the_border(&self) -> f64 {
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

    /// Where a pixel of the original lies in the rectified image; `None` behind the rectified camera.
    pub fn rectified_pixel(&self, pixel: Point2<f64>) -> Option<Point2<f64>> {
        let n = self.source.normalize(pixel);
        self.camera.project(&(self.rotation * Point3::new(n.x, n.y, 1.0)))
    }
}

/// A rectified rig: both views, and what makes depth of their disparities.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Rectification {
    /// The left (or upper) view.
    pub left: RectifiedView,
    /// The right (or lower) view.
    pub right: RectifiedView,
    /// Makes depth of disparities, in the unit of the rig.
    pub geometry: StereoGeometry,
    /// True where one camera stands above the other. The rectified images are then turned by a quarter, so that rows
    /// still coincide: their x axis points down in the scene.
    pub vertical: bool,
}

impl Rectification {
    /// Rectifies a rig.
    ///
    /// # Errors
    /// [`RectifyError`] with the reason why it cannot be done.
    pub fn new(rig: &StereoRig, options: &RectifyOptions) -> Result<Self, RectifyError> {
        let (x, baseline) = along_the_baseline(rig)?;
        OptionError::check("alpha", options.alpha, "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
        let center = rig.right_from_left.center();
        let vertical = center.y.abs() > center.x.abs();
        let along = if vertical { center.y } else { center.x };
        if along < 0.0 {
            return Err(RectifyError::Exchanged { distance: -along, vertical });
        }
        let rotations = rotations(x, &rig.right_from_left.rotation)?;

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

    /// `Q` of [`StereoGeometry::q`].
    pub fn q(&self) -> Matrix4<f64> {
        self.geometry.q()
    }

    /// Share of the pixels of each rectified image that the originals show, left and right, on a grid of every fourth.
    pub fn valid_area(&self) -> (f64, f64) {
        let share = |view: &RectifiedView| {
            let (w, h) = (view.camera.width, view.camera.height);
            let (mut seen, mut all) = (0usize, 0usize);
            for y in (0..h).step_by(4) {
                for x in (0..w).step_by(4) {
                    all += 1;
                    seen += usize::from(view.source_pixel(Point2::new(x as f64, y as f64)).is_some_and(|p| {
                        p.x >= 0.0
                            && p.y >= 0.0
                            && p.x <= view.source.width as f64 - 1.0
                            && p.y <= view.source.height as f64 - 1.0
                    }));
                }
            }
            seen as f64 / all.max(1) as f64
        };
        (share(&self.left), share(&self.right))
    }
}

/// The direction from the left camera's center to the right one's, in the left one's frame, and its length; the cameras are checked.
pub(crate) fn along_the_baseline(rig: &StereoRig) -> Result<(Vector3<f64>, f64), RectifyError> {
    for (side, camera) in [("left", &rig.left), ("right", &rig.right)] {
        camera.validate().map_err(|error| RectifyError::Camera { side, error })?;
    }
    let baseline = rig.baseline();
    let x = rig.right_from_left.center().coords.try_normalize(1e-12).filter(|_| baseline.is_finite());
    x.map(|x| (x, baseline)).ok_or(RectifyError::NoBaseline { baseline })
}

/// Rotations of both cameras to the common frame: x along the baseline, z as near to where both look on average as can be.
pub(crate) fn rotations(x: Vector3<f64>, relative: &Rotation3<f64>) -> Result<[Rotation3<f64>; 2], RectifyError> {
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

/// The border of what a camera sees, in the rectified frame: a closed polygon, from which parts that are behind are missing.
pub(crate) fn outline(camera: &Camera, rotation: &Rotation3<f64>) -> Vec<Point2<f64>> {
    // As many points per side as show the bend of a strong distortion.
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

/// The smallest rectangle around an outline.
pub(crate) fn around(outline: &[Point2<f64>]) -> Rect {
    let nothing = Rect { left: f64::INFINITY, top: f64::INFINITY, right: -f64::INFINITY, bottom: -f64::INFINITY };
    outline.iter().fold(nothing, |r, p| Rect {
        left: r.left.min(p.x),
        top: r.top.min(p.y),
        right: r.right.max(p.x),
        bottom: r.bottom.max(p.y),
    })
}

/// The sides of a closed polygon.
fn sides(outline: &[Point2<f64>]) -> impl Iterator<Item = (Point2<f64>, Point2<f64>)> {
    outline.iter().copied().zip(outline.iter().copied().cycle().skip(1))
}

/// How far the inside of a polygon reaches from `p` to the left and right of it, or, with `axis` 1, up and down; `None` outside.
fn reach(outline: &[Point2<f64>], p: Point2<f64>, axis: usize) -> Option<(f64, f64)> {
    let (along, across) = (axis, 1 - axis);
    let (mut before, mut behind, mut crossed) = (-f64::INFINITY, f64::INFINITY, 0);
    for (a, b) in sides(outline) {
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

/// By how much a rectangle around `middle` that reaches `half` to the sides can grow before it meets a polygon.
fn room(outline: &[Point2<f64>], middle: Point2<f64>, half: (f64, f64)) -> f64 {
    let mut least = f64::INFINITY;
    for (a, b) in sides(outline) {
        // In units of the rectangle; along the side, the larger of both is least at an end or where they are the same.
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

/// One camera for both views: between the largest that shows only what both see, and the smallest that shows all.
fn common_camera(
    sources: [(Camera, Rotation3<f64>); 2],
    (width, height): (usize, usize),
    alpha: f64,
) -> Result<Camera, RectifyError> {
    let outlines = sources.map(|(camera, rotation)| outline(&camera, &rotation));
    let [a, b] = [around(&outlines[0]), around(&outlines[1])];
    let middle = |left: f64, right: f64, top: f64, bottom: f64| Point2::new((left + right) / 2.0, (top + bottom) / 2.0);
    let both = middle(a.left.max(b.left), a.right.min(b.right), a.top.max(b.top), a.bottom.min(b.bottom));
    let (left, right) = (a.left.min(b.left), a.right.max(b.right));
    let (top, bottom) = (a.top.min(b.top), a.bottom.max(b.bottom));
    // How far both see from a point: the way to the nearer of their borders.
    let reach_of_both = |p: Point2<f64>, axis: usize| -> Option<(f64, f64)> {
        let ((a0, a1), (b0, b1)) = (reach(&outlines[0], p, axis)?, reach(&outlines[1], p, axis)?);
        Some((a0.max(b0), a1.min(b1)))
    };
    let (Some(x), Some(y)) = (reach_of_both(both, 0), reach_of_both(both, 1)) else {
        return Err(RectifyError::NoOverlap);
    };
    let inner = Point2::new(both.x + (x.0 + x.1) / 2.0, both.y + (y.0 + y.1) / 2.0);
    let inner = if reach_of_both(inner, 0).is_some() { inner } else { both };
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
    let [room_a, room_b] = [0, 1].map(|i: usize| room(&outlines[i], inner, (w / 2.0, h / 2.0)));
    let mut tight = (1.0 + ROUNDING) / room_a.min(room_b);
    // Between the points of its outline a border bends: by less and less of a pixel, until no pixel is outside.
    for _ in 0..20 {
        let beyond = sources.map(|(source, rotation)| {
            RectifiedView { source, camera: camera(tight, inner), rotation }.beyond_the_border()
        });
        let beyond = beyond[0].max(beyond[1]);
        if beyond <= 0.0 {
            break;
        }
        tight *= 1.0 + ROUNDING + (4.0 * beyond / w.min(h)).min(0.05);
    }
    let wide = (w / (right - left)).min(h / (bottom - top));
    let focal = tight + (wide - tight) * alpha;
    if !(focal.is_finite() && focal > 0.0) {
        return Err(RectifyError::NoOverlap);
    }
    Ok(camera(focal, inner + (middle(left, right, top, bottom) - inner) * alpha))
}

/// Of a focal length: far above what arithmetic loses, far below what a pixel shows.
const ROUNDING: f64 = 1e-12;

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Pose;
    use proptest::prelude::*;

    fn rig(angles: (f64, f64, f64), center: Vector3<f64>, k1: f64) -> StereoRig {
        let mut left = Camera::pinhole(640, 480, 520.0, 515.0, 322.0, 236.0);
        left.distortion = Distortion::radial_tangential4([k1, 0.05, 0.001, -0.001]);
        let mut right = Camera::pinhole(640, 480, 530.0, 533.0, 310.0, 245.0);
        right.distortion = Distortion::radial(k1 * 0.9, 0.03);
        let rotation = Rotation3::from_euler_angles(angles.0, angles.1, angles.2);
        StereoRig { left, right, right_from_left: Pose::new(rotation, -(rotation * center)) }
    }

    proptest! {
        #[test]
        fn a_scene_point_has_the_same_row_and_the_disparity_its_depth_says(
            angles in (-0.1..0.1f64, -0.1..0.1f64, -0.1..0.1f64),
            offset in (-0.02..0.02f64, -0.02..0.02f64),
            vertical in any::<bool>(),
            alpha in 0.0..1.0f64,
            k1 in -0.2..0.05f64,
            p in (-0.4..0.4f64, -0.3..0.3f64, 2.0..6.0f64),
        ) {
            let center = if vertical { Vector3::new(offset.0, 0.2, offset.1) } else { Vector3::new(0.2, offset.0, offset.1) };
            let rig = rig(angles, center, k1);
            let rectified = Rectification::new(&rig, &RectifyOptions { alpha, size: None }).unwrap();
            prop_assert_eq!(rectified.vertical, vertical);
            let point = Point3::new(p.0, p.1, p.2);
            let (Some(a), Some(b)) = (rig.left.project(&point), rig.right.project(&rig.right_from_left.transform(&point))) else {
                return Ok(());
            };
            let a = rectified.left.rectified_pixel(a).unwrap();
            let b = rectified.right.rectified_pixel(b).unwrap();
            // Undistorting stops at 1e-13 of the focal length; a thousand pixels lose three digits more.
            prop_assert!((a.y - b.y).abs() < 1e-8, "rows {} and {}", a.y, b.y);
            let depth = (rectified.left.rotation * point).z;
            prop_assert!((a.x - b.x - rectified.geometry.disparity(depth)).abs() < 1e-8);
        }

        #[test]
        fn rectified_and_original_pixels_map_to_each_other(
            angles in (-0.1..0.1f64, -0.1..0.1f64, -0.1..0.1f64), x in 100.0..540.0f64, y in 100.0..380.0f64,
        ) {
            let rig = rig(angles, Vector3::new(0.1, 0.0, 0.0), -0.1);
            let rectified = Rectification::new(&rig, &RectifyOptions::default()).unwrap();
            for view in [&rectified.left, &rectified.right] {
                let there = view.rectified_pixel(Point2::new(x, y)).unwrap();
                let back = view.source_pixel(there).unwrap();
                prop_assert!((back - Point2::new(x, y)).norm() < 1e-8);
            }
        }
    }

    #[test]
    fn alpha_0_leaves_no_hole_and_alpha_1_keeps_every_pixel() {
        let rig = rig((0.02, -0.03, 0.01), Vector3::new(0.1, 0.005, -0.002), -0.15);
        let tight = Rectification::new(&rig, &RectifyOptions::default()).unwrap();
        assert_eq!(tight.valid_area(), (1.0, 1.0));
        let wide = Rectification::new(&rig, &RectifyOptions { alpha: 1.0, size: None }).unwrap();
        for view in [wide.left, wide.right] {
            for corner in [(0.0, 0.0), (639.0, 0.0), (0.0, 479.0), (639.0, 479.0), (320.0, 0.0), (0.0, 240.0)] {
                let p = view.rectified_pixel(Point2::new(corner.0, corner.1)).unwrap();
                // Rounding at the very border.
                assert!(p.x > -1e-9 && p.y > -1e-9 && p.x < 639.0 + 1e-9 && p.y < 479.0 + 1e-9, "{corner:?} to {p}");
            }
        }
        assert!(wide.valid_area().0 < 0.99 && wide.geometry.focal < tight.geometry.focal);
    }

    #[test]
    fn a_rig_that_leans_shows_as_much_as_fits() {
        let camera = Camera::from_focal(641, 481, 500.0);
        for degrees in [0.0_f64, 2.0, 10.0, 30.0, 43.0, 50.0, 80.0] {
            let (sin, cos) = degrees.to_radians().sin_cos();
            let pose = Pose::new(Rotation3::identity(), -Vector3::new(0.1 * cos, 0.1 * sin, 0.0));
            let rig = StereoRig { left: camera, right: camera, right_from_left: pose };
            let rectified = Rectification::new(&rig, &RectifyOptions::default()).unwrap();
            assert_eq!(rectified.valid_area(), (1.0, 1.0), "{degrees}");
            // A rectangle of half the sides (w, h), turned, in one of (320, 240): each of its corners inside.
            let (w, h) = if rectified.vertical { (240.0, 320.0) } else { (320.0, 240.0) };
            let fits = (320.0 / (w * cos + h * sin)).min(240.0 / (w * sin + h * cos));
            // Undistorting is exact here; the border's points and a margin of 1e-9 are not.
            assert!(
                (rectified.geometry.focal / (500.0 / fits) - 1.0).abs() < 1e-8,
                "{degrees}: {}",
                rectified.geometry.focal
            );
        }
    }

    #[test]
    fn a_pair_that_is_rectified_stays_as_it_is() {
        let camera = Camera::from_focal(320, 240, 300.0);
        let pose = Pose::new(Rotation3::identity(), Vector3::new(-0.1, 0.0, 0.0));
        let rig = StereoRig { left: camera, right: camera, right_from_left: pose };
        let rectified = Rectification::new(&rig, &RectifyOptions::default()).unwrap();
        let p = rectified.left.source_pixel(Point2::new(17.0, 200.0)).unwrap();
        assert!((p - Point2::new(17.0, 200.0)).norm() < 1e-9);
        assert!((rectified.geometry.baseline - 0.1).abs() < 1e-15 && (rectified.geometry.focal - 300.0).abs() < 1e-9);
    }

    #[test]
    fn distances_are_told_as_people_read_them() {
        let text = |distance, vertical| RectifyError::Exchanged { distance, vertical }.to_string();
        assert_eq!(text(0.20000000000000004, true), "the second camera stands 0.2 above the first: they are exchanged");
        assert!(text(123456.7, false).contains(" 123500 left of"));
    }

    #[test]
    fn rigs_that_are_none_are_refused_with_the_reason() {
        let refuse =
            |angles, center| Rectification::new(&rig(angles, center, 0.0), &RectifyOptions::default()).unwrap_err();
        assert!(matches!(refuse((0.0, 0.0, 0.0), Vector3::zeros()), RectifyError::NoBaseline { baseline: 0.0 }));
        assert!(matches!(
            refuse((0.0, 0.0, 0.0), Vector3::new(-0.2, 0.0, 0.0)),
            RectifyError::Exchanged { vertical: false, .. }
        ));
        assert!(matches!(
            refuse((0.0, 0.0, 0.0), Vector3::new(0.0, -0.2, 0.0)),
            RectifyError::Exchanged { vertical: true, .. }
        ));
        assert!(matches!(refuse((0.0, 0.0, 0.0), Vector3::new(0.01, 0.0, 0.2)), RectifyError::TooFarTurned { .. }));
        assert!(matches!(refuse((0.0, 2.6, 0.0), Vector3::new(0.2, 0.0, 0.0)), RectifyError::TooFarTurned { .. }));
        let mut broken = rig((0.0, 0.0, 0.0), Vector3::new(0.2, 0.0, 0.0), 0.0);
        broken.right.fx = f64::NAN;
        assert!(matches!(
            Rectification::new(&broken, &RectifyOptions::default()),
            Err(RectifyError::Camera { side: "right", .. })
        ));
        let fine = rig((0.0, 0.0, 0.0), Vector3::new(0.2, 0.0, 0.0), 0.0);
        assert!(matches!(
            Rectification::new(&fine, &RectifyOptions { alpha: 1.5, size: None }),
            Err(RectifyError::Option(OptionError { name: "alpha", .. }))
        ));
    }
}
