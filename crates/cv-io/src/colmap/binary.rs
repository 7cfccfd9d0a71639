//! COLMAP's binary files: `cameras.bin`, `images.bin`, `points3D.bin`. Each begins with a count of its records; numbers are little-endian.

use std::collections::BTreeMap;

use cv_core::nalgebra::UnitQuaternion;
use cv_core::{Camera, ModelImage, ModelPoint, Point2, Point3};

use super::{check_camera, pose_from_quaternion};
use crate::camera::{CENTER, camera_by_id, model_of};
use crate::{FormatError, memory};

const NAME: &str = "COLMAP binary";
/// Upper bound of the memory of a parsed file relative to its size: a minimal image record of 74 bytes takes about 300 in a half-full tree.
const MEMORY_FACTOR: u64 = 5;

/// Reads little-endian values from the front of a slice.
struct ByteReader<'a>(&'a [u8]);

impl<'a> ByteReader<'a> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], FormatError> {
        let (taken, rest) = self.0.split_first_chunk().ok_or(FormatError::Truncated { format: NAME })?;
        self.0 = rest;
        Ok(*taken)
    }

    fn u32(&mut self) -> Result<u32, FormatError> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, FormatError> {
        self.take().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Result<f64, FormatError> {
        self.take().map(f64::from_le_bytes)
    }

    fn floats<const N: usize>(&mut self) -> Result<[f64; N], FormatError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64()?;
        }
        Ok(values)
    }

    /// Reads a count of records of at least `size` bytes each, and checks it against the remaining bytes: allocations for them stay within a few times
    /// the file size.
    fn count(&mut self, size: usize, what: &str) -> Result<usize, FormatError> {
        let count = self.u64()?;
        match usize::try_from(count) {
            Ok(count) if count <= self.0.len() / size => Ok(count),
            _ => {
                let reason = format!("{count} {what} are declared, but only {} bytes follow", self.0.len());
                Err(FormatError::corrupt(NAME, reason))
            }
        }
    }

    /// Reads a zero-terminated UTF-8 string.
    fn name(&mut self) -> Result<&'a str, FormatError> {
        let end = self.0.iter().position(|&byte| byte == 0).ok_or(FormatError::Truncated { format: NAME })?;
        let (name, rest) = self.0.split_at(end);
        self.0 = &rest[1..];
        std::str::from_utf8(name).map_err(|_| FormatError::corrupt(NAME, "an image name is not UTF-8"))
    }
}

/// Parses the records of a file: a count, then the records by `record`, with distinct keys.
fn parse_records<K: Ord + Copy + std::fmt::Display, T>(
    bytes: &[u8],
    size: usize,
    what: &'static str,
    mut record: impl FnMut(&mut ByteReader<'_>) -> Result<(K, T), FormatError>,
) -> Result<BTreeMap<K, T>, FormatError> {
    memory::check_limit(
        memory::saturating_product(&[MEMORY_FACTOR, bytes.len() as u64]),
        memory::default_max_memory(),
        None,
    )?;
    let mut bytes = ByteReader(bytes);
    let count = bytes.count(size, what)?;
    let mut all = BTreeMap::new();
    for _ in 0..count {
        let (key, value) = record(&mut bytes)?;
        if all.insert(key, value).is_some() {
            return Err(FormatError::corrupt(NAME, format!("of the {what}, id {key} occurs twice")));
        }
    }
    if bytes.0.is_empty() {
        return Ok(all);
    }
    Err(FormatError::corrupt(NAME, format!("{} bytes follow the last of {count} {what}", bytes.0.len())))
}

/// Parses `cameras.bin`.
///
/// # Errors
/// [`FormatError`]: truncated, an impossible count, a repeated id, an unsupported camera model.
pub fn parse_cameras_binary(bytes: &[u8]) -> Result<BTreeMap<u32, Camera>, FormatError> {
    // The smallest record: SIMPLE_PINHOLE.
    parse_records(bytes, 4 + 4 + 8 + 8 + 3 * 8, "cameras", |bytes| {
        let id = bytes.u32()?;
        let model = bytes.take().map(i32::from_le_bytes)?;
        // A side beyond usize is refused with its number of pixels.
        let side = |side: u64| usize::try_from(side).unwrap_or(usize::MAX);
        let (width, height) = (side(bytes.u64()?), side(bytes.u64()?));
        let camera = camera_by_id(model, width, height, || bytes.f64())?;
        check_camera(id, &camera).map_err(|reason| FormatError::corrupt(NAME, reason))?;
        Ok((id, camera))
    })
}

/// Parses `images.bin`.
///
/// # Errors
/// [`FormatError`]: truncated, an impossible count, a repeated id, an invalid pose, a name that is empty or not UTF-8.
pub fn parse_images_binary(bytes: &[u8]) -> Result<BTreeMap<u32, ModelImage>, FormatError> {
    parse_records(bytes, 4 + 7 * 8 + 4 + 2 + 8, "images", |bytes| {
        let id = bytes.u32()?;
        let (q, t) = (bytes.floats()?, bytes.floats()?);
        let corrupt = |reason: &str| FormatError::corrupt(NAME, format!("image {id}: {reason}"));
        let pose =
            pose_from_quaternion(q, t).ok_or_else(|| corrupt("the pose is not finite, or its quaternion is zero"))?;
        let camera = bytes.u32()?;
        let name = bytes.name()?.to_owned();
        if name.is_empty() {
            return Err(corrupt("the name is missing"));
        }
        let count = bytes.count(3 * 8, "points of an image")?;
        let mut points = Vec::with_capacity(count);
        for _ in 0..count {
            let [x, y] = bytes.floats()?;
            // A negative id means no point.
            let point = u64::try_from(bytes.take().map(i64::from_le_bytes)?).ok();
            points.push((Point2::new(x - CENTER, y - CENTER), point));
        }
        Ok((id, ModelImage { name, camera, pose, points }))
    })
}

/// Parses `points3D.bin`.
///
/// # Errors
/// [`FormatError`]: truncated, an impossible count, a repeated id.
pub fn parse_points_binary(bytes: &[u8]) -> Result<BTreeMap<u64, ModelPoint>, FormatError> {
    parse_records(bytes, 8 + 3 * 8 + 3 + 8 + 8, "points", |bytes| {
        let id = bytes.u64()?;
        let position = Point3::from(bytes.floats()?);
        let color = bytes.take()?;
        let error = bytes.f64()?;
        let count = bytes.count(4 + 4, "observations of a point")?;
        let mut track = Vec::with_capacity(count);
        for _ in 0..count {
            track.push((bytes.u32()?, bytes.u32()?));
        }
        Ok((id, ModelPoint { position, color, error, track }))
    })
}

/// Encodes `cameras.bin`.
pub(super) fn cameras_bytes(cameras: &BTreeMap<u32, Camera>) -> Result<Vec<u8>, FormatError> {
    let mut bytes = (cameras.len() as u64).to_le_bytes().to_vec();
    for (id, camera) in cameras {
        let (model, parameters) = model_of(camera)?;
        bytes.extend(id.to_le_bytes());
        bytes.extend(model.id.to_le_bytes());
        bytes.extend((camera.width as u64).to_le_bytes());
        bytes.extend((camera.height as u64).to_le_bytes());
        floats(&mut bytes, &parameters);
    }
    Ok(bytes)
}

/// Encodes `images.bin`.
pub(super) fn images_bytes(images: &BTreeMap<u32, ModelImage>) -> Vec<u8> {
    let mut bytes = (images.len() as u64).to_le_bytes().to_vec();
    for (id, image) in images {
        let q = UnitQuaternion::from_rotation_matrix(&image.pose.rotation);
        let t = image.pose.translation;
        bytes.extend(id.to_le_bytes());
        floats(&mut bytes, &[q.w, q.i, q.j, q.k, t.x, t.y, t.z]);
        bytes.extend(image.camera.to_le_bytes());
        bytes.extend(image.name.as_bytes());
        bytes.push(0);
        bytes.extend((image.points.len() as u64).to_le_bytes());
        for (at, point) in &image.points {
            floats(&mut bytes, &[at.x + CENTER, at.y + CENTER]);
            bytes.extend(point.unwrap_or(u64::MAX).to_le_bytes());
        }
    }
    bytes
}

/// Encodes `points3D.bin`.
pub(super) fn points_bytes(points: &BTreeMap<u64, ModelPoint>) -> Vec<u8> {
    let mut bytes = (points.len() as u64).to_le_bytes().to_vec();
    for (id, point) in points {
        bytes.extend(id.to_le_bytes());
        floats(&mut bytes, point.position.coords.as_slice());
        bytes.extend(point.color);
        bytes.extend(if point.error.is_finite() { point.error } else { -1.0 }.to_le_bytes());
        bytes.extend((point.track.len() as u64).to_le_bytes());
        for (image, index) in &point.track {
            bytes.extend(image.to_le_bytes());
            bytes.extend(index.to_le_bytes());
        }
    }
    bytes
}

fn floats(bytes: &mut Vec<u8>, values: &[f64]) {
    bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
}
