//! COLMAP's text: `cameras.txt`, `images.txt`, `points3D.txt`.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::str::SplitWhitespace;

use cv_core::nalgebra::UnitQuaternion;
use cv_core::{Camera, ModelImage, ModelPoint, Point2, Point3};

use super::{check_camera, pose_from_quaternion};
use crate::FormatError;
use crate::camera::{CENTER, model_line, parse_model};

/// Words of a line, with errors that name the expected field.
struct Words<'a>(SplitWhitespace<'a>, usize);

impl<'a> Words<'a> {
    fn next<T: std::str::FromStr>(&mut self, what: &str) -> Result<T, FormatError> {
        let Self(words, line) = self;
        let word = words.next().ok_or_else(|| FormatError::line(*line, format!("{what} is missing")))?;
        word.parse().map_err(|_| FormatError::line(*line, format!("{what}: “{word:.40}” is not one")))
    }

    fn rest<T: std::str::FromStr>(&mut self, what: &str) -> Result<Vec<T>, FormatError> {
        let line = self.1;
        let parse = |w: &str| w.parse().map_err(|_| FormatError::line(line, format!("{what}: “{w:.40}” is not one")));
        self.0.by_ref().map(parse).collect()
    }
}

/// Iterates over the lines that are not comments, with their numbers from 1. Empty lines are included: `images.txt` has them.
fn lines(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines().enumerate().map(|(i, l)| (i + 1, l.trim())).filter(|(_, l)| !l.starts_with('#'))
}

/// Parses `cameras.txt`.
///
/// # Errors
/// [`FormatError`] with the line, or for an unsupported camera model.
pub fn parse_cameras(text: &str) -> Result<BTreeMap<u32, Camera>, FormatError> {
    let mut cameras = BTreeMap::new();
    for (number, line) in lines(text).filter(|(_, l)| !l.is_empty()) {
        let mut words = Words(line.split_whitespace(), number);
        let id: u32 = words.next("a camera id")?;
        let model: String = words.next("a camera model")?;
        let (width, height) = (words.next("the width")?, words.next("the height")?);
        let camera = parse_model(&model, width, height, &words.rest("a parameter")?)?;
        check_camera(id, &camera).map_err(|reason| FormatError::line(number, reason))?;
        if cameras.insert(id, camera).is_some() {
            return Err(FormatError::line(number, format!("camera {id} occurs twice")));
        }
    }
    Ok(cameras)
}

/// Parses `images.txt`.
///
/// # Errors
/// [`FormatError::Line`].
pub fn parse_images(text: &str) -> Result<BTreeMap<u32, ModelImage>, FormatError> {
    let mut images = BTreeMap::new();
    let mut rest = lines(text);
    // Two lines per image, of which the second may be empty; empty lines before a first one are ignored.
    while let Some((number, line)) = rest.find(|(_, l)| !l.is_empty()) {
        let mut words = Words(line.split_whitespace(), number);
        let id: u32 = words.next("an image id")?;
        let mut q = [0.0; 4];
        for v in &mut q {
            *v = words.next("a quaternion component")?;
        }
        let mut t = [0.0; 3];
        for v in &mut t {
            *v = words.next("a translation component")?;
        }
        let pose = pose_from_quaternion(q, t)
            .ok_or_else(|| FormatError::line(number, "the pose is not finite, or its quaternion is zero"))?;
        let camera = words.next("a camera id")?;
        // Names may have spaces.
        let name = words.rest::<String>("a name")?.join(" ");
        if name.is_empty() {
            return Err(FormatError::line(number, "the image name is missing"));
        }
        let mut points = Vec::new();
        if let Some((number, line)) = rest.next() {
            let mut words = Words(line.split_whitespace(), number);
            while let Some(first) = words.0.next() {
                let x: f64 =
                    first.parse().map_err(|_| FormatError::line(number, format!("an x: “{first:.40}” is not one")))?;
                let y: f64 = words.next("a y")?;
                let point: i64 = words.next("a point id")?;
                points.push((Point2::new(x - CENTER, y - CENTER), u64::try_from(point).ok()));
            }
        }
        if images.insert(id, ModelImage { name, camera, pose, points }).is_some() {
            return Err(FormatError::line(number, format!("image {id} occurs twice")));
        }
    }
    Ok(images)
}

/// Parses `points3D.txt`.
///
/// # Errors
/// [`FormatError::Line`].
pub fn parse_points(text: &str) -> Result<BTreeMap<u64, ModelPoint>, FormatError> {
    let mut points = BTreeMap::new();
    for (number, line) in lines(text).filter(|(_, l)| !l.is_empty()) {
        let mut words = Words(line.split_whitespace(), number);
        let id: u64 = words.next("a point id")?;
        let position = Point3::new(words.next("an x")?, words.next("a y")?, words.next("a z")?);
        let color = [words.next("a red")?, words.next("a green")?, words.next("a blue")?];
        let error = words.next("an error")?;
        let track: Vec<u32> = words.rest("a track element")?;
        let (pairs, []) = track.as_chunks::<2>() else {
            return Err(FormatError::line(number, "the track has an odd count of numbers"));
        };
        let point = ModelPoint { position, color, error, track: pairs.iter().map(|&[i, p]| (i, p)).collect() };
        if points.insert(id, point).is_some() {
            return Err(FormatError::line(number, format!("point {id} occurs twice")));
        }
    }
    Ok(points)
}

/// Formats `cameras.txt`.
pub(super) fn cameras_text(cameras: &BTreeMap<u32, Camera>) -> Result<String, FormatError> {
    let mut text = String::from("# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n");
    for (id, camera) in cameras {
        let _ = writeln!(text, "{id} {}", model_line(camera)?);
    }
    Ok(text)
}

/// Formats `images.txt`.
pub(super) fn images_text(images: &BTreeMap<u32, ModelImage>) -> String {
    let mut text =
        String::from("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n");
    for (id, image) in images {
        let q = UnitQuaternion::from_rotation_matrix(&image.pose.rotation);
        let t = image.pose.translation;
        let _ = writeln!(
            text,
            "{id} {} {} {} {} {} {} {} {} {}",
            q.w, q.i, q.j, q.k, t.x, t.y, t.z, image.camera, image.name
        );
        for (i, (at, point)) in image.points.iter().enumerate() {
            let separator = if i == 0 { "" } else { " " };
            let _ = write!(text, "{separator}{} {} ", at.x + CENTER, at.y + CENTER);
            let _ = match point {
                Some(id) => write!(text, "{id}"),
                None => write!(text, "-1"),
            };
        }
        text.push('\n');
    }
    text
}

/// Formats `points3D.txt`.
pub(super) fn points_text(points: &BTreeMap<u64, ModelPoint>) -> String {
    let mut text = String::from("# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n");
    for (id, point) in points {
        let (p, [r, g, b]) = (point.position, point.color);
        let error = if point.error.is_finite() { point.error } else { -1.0 };
        let _ = write!(text, "{id} {} {} {} {r} {g} {b} {error}", p.x, p.y, p.z);
        point.track.iter().for_each(|(image, index)| {
            let _ = write!(text, " {image} {index}");
        });
        text.push('\n');
    }
    text
}
