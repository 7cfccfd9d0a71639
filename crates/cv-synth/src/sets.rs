//! Sets of images with ground truth, for each job.

use crate::error::SynthError;
use crate::render::{Rendered, render};
use crate::rng::Rng;
use crate::scene::Scene;
use crate::scenes::{Wall, path, walker};
use crate::sensor::RenderOptions;
use crate::truth::{plane_homography, rotation_homography};
use cv_core::{Camera, GrayF32, Mask, Point2, Pose};
use nalgebra::{Matrix3, Point3, Rotation3, Vector3};

/// A rectified pair.
#[derive(Debug, Clone)]
pub struct StereoPair {
    /// The left view.
    pub left: Rendered,
    /// The right view: the same orientation, `baseline` meters to the right.
    pub right: Rendered,
    /// Baseline in meters.
    pub baseline: f64,
    /// Disparity of the left view, `fx · baseline / Z`; NaN without a surface.
    pub disparity: GrayF32,
    /// Disparity of the right view, positive as well.
    pub disparity_right: GrayF32,
    /// Pixels of the left view that are visible in the right view too.
    pub visible: Mask,
}

impl StereoPair {
    /// Returns the pixels of the left view that are occluded in the right view, or out of its view.
    pub fn occluded(&self) -> Mask {
        Mask::from_fn(self.visible.width(), self.visible.height(), |x, y| {
            [!self.visible.at(x, y)[0] && self.disparity.at(x, y)[0].is_finite()]
        })
    }

    /// Returns another pair of photographs of the same views (see [`Rendered::retake`]).
    pub fn retake(&self, stops: f32, options: &RenderOptions) -> Self {
        let (left, right) = (self.left.retake(stops, options), self.right.retake(stops, &right_options(options)));
        Self { left, right, ..self.clone() }
    }
}

/// Renders a rectified pair; `pose` is that of the left camera.
///
/// # Errors
/// [`SynthError::Stereo`] for a camera with distortion or a baseline that is not positive; else as [`render`].
pub fn stereo_pair(
    scene: &Scene,
    camera: &Camera,
    pose: &Pose,
    baseline: f64,
    options: &RenderOptions,
) -> Result<StereoPair, SynthError> {
    if !(camera.distortion.is_none() && baseline > 0.0 && baseline.is_finite()) {
        return Err(SynthError::Stereo { baseline });
    }
    let right_pose = Pose::new(pose.rotation, pose.translation - Vector3::new(baseline, 0.0, 0.0));
    let left = render(scene, camera, pose, options)?;
    let right = render(scene, camera, &right_pose, &right_options(options))?;
    let disparity = |view: &Rendered| view.depth.map(|[z]| [(camera.fx * baseline / f64::from(z)) as f32]);
    let visible = scene.visible_in_both(&left, &right);
    Ok(StereoPair { disparity: disparity(&left), disparity_right: disparity(&right), left, right, baseline, visible })
}

/// Returns the options of the right image of a pair: its noise is its own.
fn right_options(options: &RenderOptions) -> RenderOptions {
    options.clone().with_seed(options.seed ^ 0x5117)
}

/// Two views of a plane.
#[derive(Debug, Clone)]
pub struct HomographyPair {
    /// First view.
    pub a: Rendered,
    /// Second view.
    pub b: Rendered,
    /// Maps pixels of `a` to pixels of `b`; entry (3, 3) is 1.
    pub homography: Matrix3<f64>,
}

/// Renders two views of a wall with posters: one frontal, one from up to `turn` radians to the side, with some roll and
/// another distance, in which the center of the first view is still visible. 0.3 suits upright features, 0.8 is hard
/// for all.
///
/// With a distorted camera, the homography relates undistorted pixels.
///
/// # Errors
/// As [`render`].
pub fn homography_pair(
    seed: u64,
    camera: &Camera,
    turn: f64,
    options: &RenderOptions,
) -> Result<HomographyPair, SynthError> {
    let scene = Scene::poster_wall(seed);
    let mut rng = Rng::new(seed, 50);
    let turn = if turn.is_finite() { turn.clamp(0.0, 1.2) } else { 0.0 };
    let first = scene.viewpoint();
    let target = Wall::center() + Vector3::new(rng.range(-0.25, 0.25), rng.range(-0.2, 0.2), 0.0);
    let (yaw, pitch) = (turn * rng.pick([-1.0, 1.0]) * rng.range(0.5, 1.0), turn * rng.range(-0.5, 0.5));
    let distance = Wall::Z * rng.range(0.9, 1.12);
    let away = Rotation3::from_euler_angles(pitch, yaw, 0.0) * Vector3::new(0.0, 0.0, -distance);
    let second = look_at(target + away, target, turn * rng.range(-0.35, 0.35));
    let a = render(&scene, camera, &first, options)?;
    let b = render(&scene, camera, &second, &options.clone().with_seed(options.seed ^ 0x40))?;
    // The wall's plane is 3 m from the first center.
    let homography = plane_homography((camera, &first), (camera, &second), &Wall::center(), &Vector3::z());
    Ok(HomographyPair { a, b, homography: homography.unwrap_or_else(Matrix3::identity) })
}

/// Returns the pose of a camera at `eye` that looks at `target`, rolled clockwise by `roll`.
fn look_at(eye: Point3<f64>, target: Point3<f64>, roll: f64) -> Pose {
    let level = Pose::look_at(eye, target, Vector3::y()).unwrap_or_else(Pose::identity);
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), -roll);
    Pose::new(turn * level.rotation, turn * level.translation)
}

/// Options of [`panorama_views`].
#[derive(Debug, Clone, PartialEq)]
pub struct PanoramaSetOptions {
    /// Number of views. Default 5.
    pub views: usize,
    /// Overlap of neighboring images, as a ratio of the width, 0.1 to 0.9. Default 0.45.
    pub overlap: f64,
    /// Largest deviation of an exposure from the mean, in stops. Default 0.35.
    pub exposure_spread: f32,
    /// Largest pitch, roll and yaw error of a hand-held camera, in radians. Default 0.02.
    pub shake: f64,
    /// Whether a person walks through. Default false.
    pub walker: bool,
}

impl Default for PanoramaSetOptions {
    fn default() -> Self {
        Self { views: 5, overlap: 0.45, exposure_spread: 0.35, shake: 0.02, walker: false }
    }
}

/// Views from one center.
#[derive(Debug, Clone)]
pub struct PanoramaViews {
    /// The views, from left to right.
    pub views: Vec<Rendered>,
    /// Exposure of each view in stops.
    pub exposures: Vec<f32>,
    /// Mask of the person in each view; empty without one.
    pub walker: Vec<Mask>,
}

impl PanoramaViews {
    /// Returns the homography from pixels of view `from` to pixels of view `to`; entry (3, 3) is 1. `None` if there is
    /// no such view.
    pub fn homography(&self, from: usize, to: usize) -> Option<Matrix3<f64>> {
        let (a, b) = (self.views.get(from)?, self.views.get(to)?);
        Some(rotation_homography((&a.camera, &a.pose), (&b.camera, &b.pose)))
    }

    /// Transfers a pixel of view `from` to view `to`, inside its image or not, distortion included; `None` if it is
    /// behind the camera, or there is no such view.
    pub fn transfer(&self, from: usize, to: usize, pixel: Point2<f64>) -> Option<Point2<f64>> {
        let (a, b) = (self.views.get(from)?, self.views.get(to)?);
        let n = a.camera.normalize(pixel);
        let ray = Pose::relative(&a.pose, &b.pose).rotation * Point3::new(n.x, n.y, 1.0);
        b.camera.project(&ray).filter(|p| p.x.is_finite() && p.y.is_finite())
    }
}

/// Renders views of the living room from its middle by a camera that rotates to the right, with the given overlap.
///
/// # Errors
/// As [`render`].
pub fn panorama_views(
    seed: u64,
    camera: &Camera,
    panorama: &PanoramaSetOptions,
    options: &RenderOptions,
) -> Result<PanoramaViews, SynthError> {
    let scene = Scene::room(seed);
    let mut rng = Rng::new(seed, 51);
    let center = Point3::new(rng.range(-0.3, 0.3), -1.5, rng.range(1.6, 2.2));
    let field = 2.0 * (camera.width as f64 / (2.0 * camera.fx)).atan();
    let step = field * (1.0 - panorama.overlap.clamp(0.1, 0.9));
    let n = panorama.views;
    let mut set = PanoramaViews { views: Vec::new(), exposures: Vec::new(), walker: Vec::new() };
    for i in 0..n {
        let shake = panorama.shake.abs();
        let mut jitter = || rng.range(-shake, shake);
        let yaw = step * (i as f64 - (n as f64 - 1.0) / 2.0) + jitter();
        let (pitch, roll) = (0.06 + jitter(), jitter());
        let direction = Vector3::new(yaw.sin() * pitch.cos(), pitch.sin(), yaw.cos() * pitch.cos());
        let pose = look_at(center, center + direction, roll);
        let exposure = panorama.exposure_spread * rng.range32(-1.0, 1.0);
        let taken = RenderOptions { exposure: options.exposure + exposure, ..options.clone() }
            .with_seed(options.seed ^ i as u64);
        let view = if panorama.walker {
            let (foot, yaw, phase) = path(i, n, seed);
            let peopled = walker(&scene, foot, yaw, phase, seed);
            let view = render(&peopled, camera, &pose, &taken)?;
            set.walker.push(view.mask(peopled.object_id("person").unwrap_or(u32::MAX)));
            view
        } else {
            set.walker.push(Mask::new(camera.width, camera.height, [false]));
            render(&scene, camera, &pose, &taken)?
        };
        set.exposures.push(exposure);
        set.views.push(view);
    }
    Ok(set)
}

/// Two views of a room from different centers.
#[derive(Debug, Clone)]
pub struct TwoView {
    /// The scene, for further ground truth ([`Scene::correspondences`], [`Scene::visible_in_both`]).
    pub scene: Scene,
    /// First view.
    pub a: Rendered,
    /// Second view.
    pub b: Rendered,
    /// Relative pose from the camera frame of `a` to that of `b`, in meters: `x_b = R x_a + t`.
    pub relative: Pose,
}

/// Renders two views of the living room with a baseline of `baseline` meters, mostly sideways, both looking at its
/// middle.
///
/// # Errors
/// As [`render`].
pub fn two_view(seed: u64, camera: &Camera, baseline: f64, options: &RenderOptions) -> Result<TwoView, SynthError> {
    let scene = Scene::room(seed);
    let mut rng = Rng::new(seed, 52);
    let eye = Point3::new(rng.range(-0.6, 0.6), -rng.range(1.3, 1.6), rng.range(0.6, 1.0));
    let side = rng.pick([-1.0, 1.0]);
    let direction = Vector3::new(side, rng.range(-0.15, 0.15), rng.range(-0.25, 0.35)).normalize();
    let baseline = if baseline.is_finite() { baseline } else { 0.0 };
    let target = |rng: &mut Rng| Point3::new(rng.range(-0.4, 0.4), rng.range(-1.1, -0.8), rng.range(5.0, 6.5));
    let first = look_at(eye, target(&mut rng), rng.range(-0.02, 0.02));
    let second = look_at(eye + direction * baseline, target(&mut rng), rng.range(-0.03, 0.03));
    let a = render(&scene, camera, &first, options)?;
    let b = render(&scene, camera, &second, &options.clone().with_seed(options.seed ^ 0x2E))?;
    Ok(TwoView { relative: Pose::relative(&first, &second), scene, a, b })
}

/// An image of an orange ball.
#[derive(Debug, Clone)]
pub struct BallPhoto {
    /// The image.
    pub view: Rendered,
    /// The mask of the ball.
    pub mask: Mask,
    /// Distance from the camera to the ball's center in meters.
    pub distance: f64,
}

/// Renders images of an orange ball of 10 cm radius at increasing distances (0.6 to 2.6 m) in one room, each from
/// another viewpoint and with a slightly different exposure.
///
/// # Errors
/// As [`render`].
pub fn ball_photos(
    seed: u64,
    count: usize,
    camera: &Camera,
    options: &RenderOptions,
) -> Result<Vec<BallPhoto>, SynthError> {
    let mut rng = Rng::new(seed, 53);
    (0..count)
        .map(|i| {
            let distance = 0.6 + 2.0 * (i as f64 + rng.unit()) / count as f64;
            let scene = Scene::ball_at(seed, seed.wrapping_add(1000 + i as u64), distance);
            let exposure = options.exposure + rng.range32(-0.25, 0.25);
            let taken = RenderOptions { exposure, ..options.clone() }.with_seed(options.seed ^ i as u64);
            let view = render(&scene, camera, &scene.viewpoint(), &taken)?;
            let mask = view.mask(scene.object_id("ball").unwrap_or(u32::MAX));
            Ok(BallPhoto { view, mask, distance })
        })
        .collect()
}
