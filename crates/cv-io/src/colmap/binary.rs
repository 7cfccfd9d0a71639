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

#[cfg(test)]
mod tests {
    use super::*;

    /// A file by the format's definition (COLMAP's manual, “Output format”), field by field.
    macro_rules! file {
        ($($value:expr),* $(,)?) => {{
            let mut bytes = Vec::<u8>::new();
            $(bytes.extend($value.to_le_bytes());)*
            bytes
        }};
    }

    fn cameras() -> Vec<u8> {
        // SIMPLE_RADIAL is number 2: f, cx, cy, k.
        file![1u64, 7u32, 2i32, 3072u64, 2304u64, 2559.81f64, 1536.0f64, 1152.0f64, -0.0218531f64]
    }

    fn images() -> Vec<u8> {
        let mut bytes = file![2u64, 3u32, 0.6f64, 0.8f64, 0.0f64, 0.0f64, 1.0f64, -2.0f64, 3.5f64, 7u32];
        bytes.extend(b"a b.jpg\0");
        bytes.extend(file![2u64, 2362.5f64, 248.25f64, 9u64, 1.5f64, 2.5f64, u64::MAX]);
        bytes.extend(file![4u32, 1.0f64, 0.0f64, 0.0f64, 0.0f64, 0.0f64, 0.0f64, 0.0f64, 7u32]);
        bytes.extend(b"c\0");
        bytes.extend(file![0u64]);
        bytes
    }

    fn points() -> Vec<u8> {
        file![1u64, 9u64, 1.5f64, -0.25f64, 4.0f64, 115u8, 121u8, 122u8, 1.25f64, 2u64, 3u32, 0u32, 4u32, 5u32]
    }

    #[test]
    fn fields_are_parsed_by_the_definition() {
        let camera = &parse_cameras_binary(&cameras()).unwrap()[&7];
        assert_eq!((camera.width, camera.height, camera.fx, camera.fy), (3072, 2304, 2559.81, 2559.81));
        assert_eq!((camera.cx, camera.cy, camera.distortion.parameters()), (1535.5, 1151.5, &[-0.0218531][..]));
        let all = parse_images_binary(&images()).unwrap();
        let first = &all[&3];
        assert_eq!((all.len(), &first.name[..], first.camera, &all[&4].name[..]), (2, "a b.jpg", 7, "c"));
        assert_eq!(first.points, [(Point2::new(2362.0, 247.75), Some(9)), (Point2::new(1.0, 2.0), None)]);
        assert_eq!(first.pose.translation.as_slice(), [1.0, -2.0, 3.5]);
        // A rotation about x by twice the angle whose cosine is 0.6: its sine is 0.96 and its cosine -0.28.
        let r = first.pose.rotation.matrix();
        assert!((r[(2, 1)] - 0.96).abs() < 1e-15 && (r[(1, 1)] + 0.28).abs() < 1e-15 && r[(0, 0)] == 1.0, "{r}");
        let point = &parse_points_binary(&points()).unwrap()[&9];
        assert_eq!((point.position, point.color, point.error), (Point3::new(1.5, -0.25, 4.0), [115, 121, 122], 1.25));
        assert_eq!(point.track, [(3, 0), (4, 5)]);
    }

    #[test]
    fn files_round_trip_to_the_same_bytes() {
        assert_eq!(cameras_bytes(&parse_cameras_binary(&cameras()).unwrap()).unwrap(), cameras());
        assert_eq!(points_bytes(&parse_points_binary(&points()).unwrap()), points());
        // All but the first quaternion, which a rotation matrix rounds.
        let written = images_bytes(&parse_images_binary(&images()).unwrap());
        assert_eq!((&written[..12], &written[44..]), (&images()[..12], &images()[44..]));
    }

    #[test]
    fn truncated_files_and_trailing_bytes_are_refused() {
        fn held<T: std::fmt::Debug>(whole: &[u8], parse: impl Fn(&[u8]) -> Result<T, FormatError>) {
            for end in 0..whole.len() {
                let error = parse(&whole[..end]).unwrap_err();
                assert!(matches!(error, FormatError::Truncated { .. } | FormatError::Corrupt { .. }), "{end}: {error}");
            }
            let mut longer = whole.to_vec();
            longer.push(0);
            let error = parse(&longer).unwrap_err();
            assert!(error.to_string().contains("1 bytes follow"), "{error}");
        }
        held(&cameras(), parse_cameras_binary);
        held(&images(), parse_images_binary);
        held(&points(), parse_points_binary);
    }

    #[test]
    fn impossible_counts_are_refused_before_allocation() {
        fn refused<T: std::fmt::Debug>(mut bytes: Vec<u8>, at: usize, parse: impl Fn(&[u8]) -> Result<T, FormatError>) {
            // The last would need more than 2^63 bytes.
            for count in [1u64 << 20, 1 << 60, u64::MAX] {
                bytes[at..at + 8].copy_from_slice(&count.to_le_bytes());
                let error = parse(&bytes).unwrap_err();
                assert!(error.to_string().contains(&format!("{count} ")), "{error}");
            }
        }
        refused(cameras(), 0, parse_cameras_binary);
        refused(images(), 0, parse_images_binary);
        // After id, pose, camera and the name of eight bytes.
        refused(images(), 8 + 4 + 56 + 4 + 8, parse_images_binary);
        refused(points(), 0, parse_points_binary);
        refused(points(), 8 + 8 + 24 + 3 + 8, parse_points_binary);
    }

    #[test]
    fn invalid_cameras_and_poses_are_refused() {
        let reason = |bytes: Vec<u8>| parse_cameras_binary(&bytes).unwrap_err().to_string();
        // FOV, which is not supported.
        assert!(reason(file![1u64, 7u32, 7i32, 4u64, 4u64, 1.0f64, 2.0f64, 2.0f64]).contains("number 7"));
        let twice =
            file![2u64, 7u32, 0i32, 4u64, 4u64, 1.0f64, 2.0f64, 2.0f64, 7u32, 0i32, 4u64, 4u64, 1.0f64, 2.0f64, 2.0f64];
        assert!(reason(twice).contains("twice"));
        assert!(reason(file![1u64, 7u32, 0i32, u64::MAX, 4u64, 1.0f64, 2.0f64, 2.0f64]).contains("camera 7"));
        assert!(reason(file![1u64, 7u32, 0i32, 4u64, 4u64, f64::NAN, 2.0f64, 2.0f64]).contains("camera 7"));
        let mut zero = images();
        zero[12..44].fill(0);
        assert!(parse_images_binary(&zero).unwrap_err().to_string().contains("quaternion"));
    }
}
