//! COLMAP's sparse models: cameras, images and points in three files of one folder, as text (`cameras.txt`, `images.txt`, `points3D.txt`) or
//! binary (`cameras.bin`, …).
//!
//! In COLMAP's convention the center of the top-left pixel is (0.5, 0.5). Principal points and image points are converted to our convention,
//! pixel centers at integers, when read, and back when written. Poses are world to camera in both.

mod binary;
mod text;

use std::collections::BTreeMap;
use std::path::Path;

use cv_core::nalgebra::{Quaternion, UnitQuaternion};
use cv_core::{Camera, Pose, SparseModel, Vector3};

pub use binary::{parse_cameras_binary, parse_images_binary, parse_points_binary};
pub use text::{parse_cameras, parse_images, parse_points};

use crate::files::{read_bytes, read_text, write_bytes};
use crate::{DEFAULT_MAX_PIXELS, FormatError, IoError, write_together};

const NAME: &str = "COLMAP";

/// Reads the model in a folder: the binary one where `cameras.bin` and `images.bin` exist, as COLMAP does, else the text. The file of points is
/// optional.
///
/// # Errors
/// [`IoError`] for the file that cannot be read or parsed.
pub fn read(folder: impl AsRef<Path>) -> Result<SparseModel, IoError> {
    let folder = folder.as_ref();
    if ["cameras.bin", "images.bin"].iter().all(|name| folder.join(name).exists()) {
        fn part<T>(path: &Path, parse: impl Fn(&[u8]) -> Result<T, FormatError>) -> Result<T, IoError> {
            parse(&read_bytes(path)?).map_err(|reason| IoError::reading(path, reason))
        }
        let points = folder.join("points3D.bin");
        return Ok(SparseModel {
            cameras: part(&folder.join("cameras.bin"), parse_cameras_binary)?,
            images: part(&folder.join("images.bin"), parse_images_binary)?,
            points: if points.exists() { part(&points, parse_points_binary)? } else { BTreeMap::new() },
        });
    }
    fn part<T>(path: &Path, parse: impl Fn(&str) -> Result<T, FormatError>) -> Result<T, IoError> {
        parse(&read_text(path)?).map_err(|reason| IoError::reading(path, reason))
    }
    let points = folder.join("points3D.txt");
    Ok(SparseModel {
        cameras: part(&folder.join("cameras.txt"), parse_cameras)?,
        images: part(&folder.join("images.txt"), parse_images)?,
        points: if points.exists() { part(&points, parse_points)? } else { BTreeMap::new() },
    })
}

/// Writes a model as text into an existing folder: all three files or none. An existing binary model stays, and readers prefer it.
///
/// # Errors
/// [`FormatError::NotRepresentable`] where COLMAP has no model for a camera's lens, where an image's camera, or a track's image or point, is not in
/// the model, or a name has a line break; else as [`crate::write_atomic`].
pub fn write(folder: impl AsRef<Path>, model: &SparseModel) -> Result<(), IoError> {
    let cameras = check_model(model).and_then(|()| text::cameras_text(&model.cameras));
    let cameras = cameras.map_err(|reason| IoError::writing(folder.as_ref(), reason))?;
    write_together(&folder, &["cameras.txt", "images.txt", "points3D.txt"], |folder| {
        write_bytes(folder.join("cameras.txt"), cameras.as_bytes())?;
        write_bytes(folder.join("images.txt"), text::images_text(&model.images).as_bytes())?;
        write_bytes(folder.join("points3D.txt"), text::points_text(&model.points).as_bytes())
    })
}

/// Writes a model in binary into an existing folder: all three files or none. A third of the text's size, and numbers are exact.
///
/// # Errors
/// As [`write()`].
pub fn write_binary(folder: impl AsRef<Path>, model: &SparseModel) -> Result<(), IoError> {
    let cameras = check_model(model).and_then(|()| binary::cameras_bytes(&model.cameras));
    let cameras = cameras.map_err(|reason| IoError::writing(folder.as_ref(), reason))?;
    write_together(&folder, &["cameras.bin", "images.bin", "points3D.bin"], |folder| {
        write_bytes(folder.join("cameras.bin"), &cameras)?;
        write_bytes(folder.join("images.bin"), &binary::images_bytes(&model.images))?;
        write_bytes(folder.join("points3D.bin"), &binary::points_bytes(&model.points))
    })
}

/// Format of a model's files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ModelFormat {
    /// `cameras.txt`, `images.txt`, `points3D.txt`.
    #[default]
    Text,
    /// `cameras.bin`, `images.bin`, `points3D.bin`.
    Binary,
}

cv_core::named!(ModelFormat {
    Text = "colmap-text": "text: to be read by people, too",
    Binary = "colmap-binary": "binary: a third of the size",
});

impl ModelFormat {
    fn extension(self) -> &'static str {
        match self {
            Self::Text => "txt",
            Self::Binary => "bin",
        }
    }
}

/// Writes a model into an existing folder and replaces an older one: after writing, the older model's files of the other format, and its files of
/// rigs and frames (COLMAP 3.12), are removed. Otherwise readers might read the older model: COLMAP prefers binary files. Returns whether
/// such files existed.
///
/// # Errors
/// As [`write()`]; [`IoError`] for a file that cannot be removed.
pub fn replace(folder: impl AsRef<Path>, model: &SparseModel, format: ModelFormat) -> Result<bool, IoError> {
    let folder = folder.as_ref();
    let other = match format {
        ModelFormat::Text => {
            write(folder, model)?;
            ModelFormat::Binary
        }
        ModelFormat::Binary => {
            write_binary(folder, model)?;
            ModelFormat::Text
        }
    };
    let models = ["cameras", "images", "points3D", "rigs", "frames"].map(|stem| (stem, other));
    let mut found = false;
    for (stem, format) in models.into_iter().chain([("rigs", format), ("frames", format)]) {
        let path = folder.join(stem).with_extension(format.extension());
        match std::fs::remove_file(&path) {
            Ok(()) => found = true,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
            Err(error) => return Err(IoError::writing(&path, error)),
        }
    }
    Ok(found)
}

/// Validates a camera, including its number of pixels, which bounds allocations for its images.
fn check_camera(id: u32, camera: &Camera) -> Result<(), String> {
    camera.validate().map_err(|e| format!("camera {id}: {e}"))?;
    let (width, height) = (camera.width as u64, camera.height as u64);
    match width.checked_mul(height) {
        Some(pixels) if pixels <= DEFAULT_MAX_PIXELS => Ok(()),
        _ => Err(format!("camera {id}: {width}×{height} is more than {DEFAULT_MAX_PIXELS} pixels")),
    }
}

/// Checks that a model is consistent and round-trips.
fn check_model(model: &SparseModel) -> Result<(), FormatError> {
    find_problem(model).map_or(Ok(()), |what| Err(FormatError::NotRepresentable { format: NAME, what }))
}

fn find_problem(model: &SparseModel) -> Option<String> {
    for (id, camera) in &model.cameras {
        if let Err(what) = check_camera(*id, camera) {
            return Some(what);
        }
    }
    for (id, image) in &model.images {
        if !model.cameras.contains_key(&image.camera) {
            return Some(format!("image {id}, whose camera {} is missing", image.camera));
        }
        // Names with other white space, or with a zero byte, do not round-trip.
        let blanks = image.name.split_whitespace().collect::<Vec<_>>().join(" ") != image.name;
        if image.name.is_empty() || image.name.contains('\0') || blanks {
            return Some(format!("the name of image {id}: {:?}", image.name));
        }
    }
    for (id, point) in &model.points {
        // Point ids are signed in the images file.
        if i64::try_from(*id).is_err() {
            return Some(format!("the point id {id}"));
        }
        let exists =
            |&(image, index): &(u32, u32)| model.images.get(&image).is_some_and(|i| (index as usize) < i.points.len());
        if let Some((image, index)) = point.track.iter().find(|t| !exists(t)) {
            return Some(format!("point {id}, observed as point {index} of image {image}, which is missing"));
        }
    }
    None
}

/// Makes a pose of COLMAP's quaternion (w first) and translation; `None` where they are invalid.
fn pose_from_quaternion(q: [f64; 4], t: [f64; 3]) -> Option<Pose> {
    let quaternion = Quaternion::new(q[0], q[1], q[2], q[3]);
    let is_valid = quaternion.norm() > 1e-9 && quaternion.norm().is_finite() && t.iter().all(|v| v.is_finite());
    is_valid.then(|| Pose::new(UnitQuaternion::from_quaternion(quaternion).to_rotation_matrix(), Vector3::from(t)))
}
