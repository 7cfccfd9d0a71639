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

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Distortion, ModelImage, ModelPoint, Point2, Point3, Rotation3};
    use proptest::prelude::*;

    fn through_text(model: &SparseModel) -> Result<SparseModel, FormatError> {
        Ok(SparseModel {
            cameras: parse_cameras(&text::cameras_text(&model.cameras)?)?,
            images: parse_images(&text::images_text(&model.images))?,
            points: parse_points(&text::points_text(&model.points))?,
        })
    }

    fn through_binary(model: &SparseModel) -> Result<SparseModel, FormatError> {
        Ok(SparseModel {
            cameras: parse_cameras_binary(&binary::cameras_bytes(&model.cameras)?)?,
            images: parse_images_binary(&binary::images_bytes(&model.images))?,
            points: parse_points_binary(&binary::points_bytes(&model.points))?,
        })
    }

    proptest! {
        #[test]
        fn models_round_trip(r in prop::array::uniform3(-3.0..3.0f64), t in prop::array::uniform3(-1e3..1e3f64), xy in prop::array::uniform2(0.0..4000.0f64), k in -0.5..0.5f64) {
            let camera = Camera { distortion: Distortion::radial_tangential5([k, 0.1, 0.0, 0.01, k]), ..Camera::pinhole(4000, 3000, 2500.0, 2501.0, xy[0], xy[1]) };
            let pose = Pose::new(Rotation3::from_euler_angles(r[0], r[1], r[2]), Vector3::from(t));
            let image = ModelImage { name: "a b.jpg".into(), camera: 7, pose, points: vec![(Point2::new(xy[0], xy[1]), Some(9)), (Point2::new(1.0, 2.0), None)] };
            let point = ModelPoint { position: Point3::from(t), color: [1, 2, 3], error: 0.5, track: vec![(3, 0)] };
            let model = SparseModel { cameras: [(7, camera)].into(), images: [(3, image.clone())].into(), points: [(9, point.clone())].into() };
            for binary in [false, true] {
                check_model(&model).unwrap();
                let back = if binary { through_binary(&model) } else { through_text(&model) }.unwrap();
                prop_assert_eq!(&back.points[&9], &point);
                let b = &back.images[&3];
                prop_assert_eq!((&b.name, b.camera, b.points[1]), (&image.name, 7, image.points[1]));
                // Half a pixel added and taken away costs the last bits of a number up to 4000; a rotation through a quaternion likewise.
                prop_assert!((b.points[0].0 - image.points[0].0).norm() < 1e-11);
                prop_assert!((b.pose.rotation.matrix() - pose.rotation.matrix()).norm() < 1e-13);
                prop_assert_eq!(b.pose.translation, pose.translation);
                let c = &back.cameras[&7];
                prop_assert!((c.cx - camera.cx).abs() < 1e-11 && c.distortion.simplified() == camera.distortion.simplified() && c.fx == camera.fx);
            }
        }
    }

    #[test]
    fn models_with_dangling_references_are_not_written() {
        let folder = tempfile::tempdir().unwrap();
        let image = ModelImage { name: "a".into(), camera: 1, pose: Pose::identity(), points: vec![] };
        let mut model = SparseModel { images: [(1, image)].into(), ..SparseModel::default() };
        assert!(write(folder.path(), &model).is_err());
        model.cameras.insert(1, Camera::from_focal(4, 4, 4.0));
        assert!(write(folder.path(), &model).is_ok());
        let point = ModelPoint { position: Point3::origin(), color: [0; 3], error: f64::NAN, track: vec![(1, 0)] };
        model.points.insert(1, point);
        assert!(write(folder.path(), &model).unwrap_err().to_string().contains("point 1"));
    }

    #[test]
    fn the_binary_model_is_preferred() {
        let folder = tempfile::tempdir().unwrap();
        let model =
            |focal| SparseModel { cameras: [(1, Camera::from_focal(4, 4, focal))].into(), ..SparseModel::default() };
        let focal = || read(folder.path()).unwrap().cameras[&1].fx;
        write(folder.path(), &model(5.0)).unwrap();
        assert_eq!(focal(), 5.0);
        write_binary(folder.path(), &model(6.0)).unwrap();
        assert_eq!(focal(), 6.0);
        // An incomplete binary model is ignored.
        std::fs::remove_file(folder.path().join("images.bin")).unwrap();
        assert_eq!(focal(), 5.0);
        std::fs::remove_file(folder.path().join("images.txt")).unwrap();
        assert!(read(folder.path()).unwrap_err().to_string().contains("images.txt"));
    }

    #[test]
    fn a_model_replaces_one_of_the_other_format() {
        let folder = tempfile::tempdir().unwrap();
        let model =
            |focal| SparseModel { cameras: [(1, Camera::from_focal(4, 4, focal))].into(), ..SparseModel::default() };
        let focal = || read(folder.path()).unwrap().cameras[&1].fx;
        let names = || {
            let files = std::fs::read_dir(folder.path()).unwrap();
            let mut names: Vec<_> = files.map(|f| f.unwrap().file_name().into_string().unwrap()).collect();
            names.sort();
            names
        };
        for name in ["notes.txt", "frames.bin"] {
            std::fs::write(folder.path().join(name), "x").unwrap();
        }
        for (focal_px, format, replaced) in [
            (5.0, ModelFormat::Binary, true),
            (6.0, ModelFormat::Text, true),
            (7.0, ModelFormat::Text, false),
            (8.0, ModelFormat::Binary, true),
        ] {
            assert_eq!(replace(folder.path(), &model(focal_px), format).unwrap(), replaced);
            assert_eq!(focal(), focal_px);
            let ending = format.extension();
            let mut wanted = ["cameras", "images", "points3D"].map(|stem| format!("{stem}.{ending}")).to_vec();
            wanted.push("notes.txt".to_owned());
            wanted.sort();
            assert_eq!(names(), wanted);
        }
        // A failed write leaves the existing model.
        let image = ModelImage { name: "a".into(), camera: 9, pose: Pose::identity(), points: vec![] };
        let wrong = SparseModel { images: [(1, image)].into(), ..SparseModel::default() };
        assert!(replace(folder.path(), &wrong, ModelFormat::Text).is_err());
        assert_eq!(focal(), 8.0);
    }

    #[test]
    fn a_camera_with_too_many_pixels_is_refused() {
        let text = format!("1 PINHOLE {} 2 1 1 1 1\n", DEFAULT_MAX_PIXELS);
        assert!(parse_cameras(&text).unwrap_err().to_string().contains("pixels"));
        assert!(parse_cameras(&text.replace(" 2 ", " 1 ")).is_ok());
    }
}
