//! Calibration files of cameras and rigs in several formats, detected by content.
//!
//! # Adding a calibration format
//!
//! A format is one file of this folder with a [`format::Format`]: its name, its detection, the readers of cameras and rigs, and, where we write
//! it, the writers. Add the file's `mod` and its line in [`FORMATS`]; detection, validation and the choice of a format to write use the table.
//! The names of lens models come from the table of lenses ([`cv_core::LensInfo`]): no format lists lens models itself, so that a new lens is
//! available in all of them.

mod colmap;
mod format;
mod kalibr;
mod matrix;
mod mrcal;
mod opencv;
mod opencv_xml;
mod own;
mod ros;
mod yaml;

pub(crate) use colmap::{CENTER, camera_by_id, model_line, model_of, parse_model};

use std::path::Path;

use cv_core::{Camera, Pose, StereoRig};

use crate::files::{read_text, write_bytes};
use crate::{FormatError, IoError};
use format::{Format, ReadContext};

/// The table of formats, in the order of detection: specific before general ones.
const FORMATS: &[&Format] = &[
    &own::FORMAT,
    &opencv_xml::FORMAT,
    &mrcal::FORMAT,
    &kalibr::FORMAT,
    &colmap::FORMAT,
    &matrix::FORMAT,
    &ros::FORMAT,
    &opencv::FORMAT,
];

const EXPECTED: &str = "a camera: YAML (ours, OpenCV's, ROS's or Kalibr's), OpenCV's XML, mrcal's model, a COLMAP camera line, or the nine numbers of a calibration matrix";

/// A format of calibration files.
#[derive(Clone, Copy)]
pub struct CalibrationFormat(&'static Format);

impl CalibrationFormat {
    /// Our own YAML, which [`write_camera`] and [`write_rig`] write; numbers round-trip exactly.
    pub const OWN: Self = Self(&own::FORMAT);

    /// Iterates over all formats.
    pub fn all() -> impl Iterator<Item = Self> {
        FORMATS.iter().map(|f| Self(f))
    }

    /// Returns the format of a name: `own`, `opencv`, `colmap`, ….
    pub fn from_name(name: &str) -> Option<Self> {
        Self::all().find(|f| f.name() == name)
    }

    /// Returns its name.
    pub fn name(self) -> &'static str {
        self.0.name
    }

    /// Whether cameras can be written in it, not only read.
    pub fn writes_cameras(self) -> bool {
        self.0.camera_text.is_some()
    }

    /// Whether rigs can be written in it.
    pub fn writes_rigs(self) -> bool {
        self.0.rig_text.is_some()
    }

    /// Formats a camera. `notes` become comment lines.
    ///
    /// # Errors
    /// [`FormatError::NotRepresentable`] where [`Camera::validate`] fails or the format does not have the lens model;
    /// [`FormatError::Unsupported`] where the format can only be read.
    pub fn camera_text(self, camera: &Camera, notes: &[&str]) -> Result<String, FormatError> {
        let write = self.0.camera_text.ok_or_else(|| FormatError::unsupported(self.0.name, "writing a camera"))?;
        write(&writable(camera, self.0.name)?, notes)
    }

    /// Whether rigs of more than two cameras can be written in it.
    pub fn writes_arrays(self) -> bool {
        self.0.array_text.is_some()
    }

    /// Formats a rig of any number of cameras. `notes` become comment lines.
    ///
    /// # Errors
    /// As [`Self::rig_text`]; [`FormatError::NotRepresentable`], which lists the formats that support them, where this one does not.
    pub fn array_text(self, file: &CameraArray, notes: &[&str]) -> Result<String, FormatError> {
        let not = |what: String| FormatError::NotRepresentable { format: self.0.name, what };
        let Some(write) = self.0.array_text else {
            let names: Vec<&str> = Self::all().filter(|f| f.writes_arrays()).map(Self::name).collect();
            return Err(not(format!("a rig of {} cameras, which {} hold", file.cameras.len(), names.join(" and "))));
        };
        if file.cameras.len() < 2 {
            return Err(not("a rig of less than two cameras".to_owned()));
        }
        for ArrayCamera { camera, from_first, .. } in &file.cameras {
            writable(camera, self.0.name)?;
            if !from_first.rotation.matrix().iter().chain(from_first.translation.iter()).all(|v| v.is_finite()) {
                return Err(not("a motion that is not finite".to_owned()));
            }
        }
        write(file, notes)
    }

    /// Formats a stereo rig. `notes` become comment lines.
    ///
    /// # Errors
    /// As [`Self::camera_text`]; also for a motion that is not finite.
    pub fn rig_text(self, file: &RigFile, notes: &[&str]) -> Result<String, FormatError> {
        let write = self.0.rig_text.ok_or_else(|| FormatError::unsupported(self.0.name, "writing a rig"))?;
        writable(&file.rig.left, self.0.name)?;
        writable(&file.rig.right, self.0.name)?;
        let motion = &file.rig.right_from_left;
        if !motion.rotation.matrix().iter().chain(motion.translation.iter()).all(|v| v.is_finite()) {
            let what = "a motion that is not finite".to_owned();
            return Err(FormatError::NotRepresentable { format: self.0.name, what });
        }
        write(file, notes)
    }
}

impl std::fmt::Debug for CalibrationFormat {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("CalibrationFormat").field(&self.0.name).finish()
    }
}

/// A stereo rig of a file, with its unit.
#[derive(Debug, Clone, PartialEq)]
pub struct RigFile {
    /// The rig.
    pub rig: StereoRig,
    /// The unit of the translation, and so of every depth: “m”, “mm”, “squares”. Empty where the file does not specify it.
    pub unit: String,
}

impl RigFile {
    /// Returns the meters per unit of the translation; `None` where the unit is not m, cm or mm.
    pub fn meters_per_unit(&self) -> Option<f64> {
        match self.unit.trim() {
            "m" => Some(1.0),
            "cm" => Some(0.01),
            "mm" => Some(0.001),
            _ => None,
        }
    }
}

/// A camera of a multi-camera rig.
#[derive(Debug, Clone, PartialEq)]
pub struct ArrayCamera {
    /// Its name.
    pub name: String,
    /// The camera.
    pub camera: Camera,
    /// Motion from the first camera's frame to this one's.
    pub from_first: Pose,
}

/// A multi-camera rig of a file: two or more rigidly mounted cameras.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraArray {
    /// The cameras; the first one's pose is the identity.
    pub cameras: Vec<ArrayCamera>,
    /// The unit of the translations, as in [`RigFile`].
    pub unit: String,
}

/// A deviation of the parsed camera from its file.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum CalibrationNote {
    /// A small skew was ignored: the image axes are taken to be orthogonal.
    SkewLeftOut {
        /// The skew of the matrix, in px.
        skew: f64,
        /// Maximum displacement of a pixel by ignoring it, in px.
        px: f64,
    },
    /// The file has no distortion (a bare calibration matrix); that of the camera is none.
    DistortionUnknown,
}

impl std::fmt::Display for CalibrationNote {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::SkewLeftOut { skew, px } => {
                write!(f, "the skew of {skew} px is ignored, which moves no pixel by more than {px:.3} px")
            }
            Self::DistortionUnknown => f.write_str("the file has no lens distortion"),
        }
    }
}

/// Parses a camera.
///
/// Formats, detected by content: our own YAML (`schema: cv-camera/1`); OpenCV's FileStorage (YAML, JSON and XML) and ROS's `camera_info` YAML
/// (with any of their usual names of the matrix and the coefficients); mrcal's `.cameramodel` with one of OpenCV's lens models; the first camera
/// of Kalibr's `camchain.yaml`; a COLMAP camera, as in `cameras.txt` (`1 SIMPLE_RADIAL 640 480 …`), alone or after `# camera:`; a calibration
/// matrix of three rows of three numbers.
///
/// COLMAP's principal points, with pixel centers at +0.5, are converted to pixel centers at integers; all others are unchanged.
///
/// `size` is used where the text has no image size (a bare matrix, OpenCV's sample programs), and ignored otherwise. A skew that moves no
/// pixel by more than a quarter pixel is ignored.
///
/// # Errors
/// [`FormatError`] with the invalid or missing line or entry, or for an unsupported distortion model.
pub fn parse_camera(text: &str, size: Option<(usize, usize)>) -> Result<Camera, FormatError> {
    camera_and_notes(text, size).map(|(camera, _)| camera)
}

fn camera_and_notes(text: &str, size: Option<(usize, usize)>) -> Result<(Camera, Vec<CalibrationNote>), FormatError> {
    let context = ReadContext::new(size);
    let camera = checked((format_of(text)?.camera)(text, &context)?)?;
    Ok((camera, context.into_notes()))
}

/// Reads a camera; see [`parse_camera`].
///
/// # Errors
/// [`IoError`]: cannot be read as text, or as [`parse_camera`].
pub fn read_camera(path: impl AsRef<Path>, size: Option<(usize, usize)>) -> Result<Camera, IoError> {
    read_camera_with_notes(path, size).map(|(camera, _)| camera)
}

/// Reads a camera, with notes on deviations from the file; see [`parse_camera`].
///
/// # Errors
/// As [`read_camera`].
pub fn read_camera_with_notes(
    path: impl AsRef<Path>,
    size: Option<(usize, usize)>,
) -> Result<(Camera, Vec<CalibrationNote>), IoError> {
    let path = path.as_ref();
    camera_and_notes(&read_text(path)?, size).map_err(|reason| IoError::reading(path, reason))
}

/// Writes a camera as our own YAML; numbers round-trip exactly. `notes` become comment lines.
///
/// # Errors
/// [`FormatError::NotRepresentable`] where [`Camera::validate`] fails; else as [`crate::write_atomic`].
pub fn write_camera(path: impl AsRef<Path>, camera: &Camera, notes: &[&str]) -> Result<(), IoError> {
    let path = path.as_ref();
    let text = CalibrationFormat::OWN.camera_text(camera, notes).map_err(|reason| IoError::writing(path, reason))?;
    write_bytes(path, text.as_bytes())
}

/// Parses a stereo rig: our own YAML (`schema: cv-rig/1`, and the first two cameras of `cv-rig/2`); OpenCV's, with both cameras, R and T in one
/// file; the first two cameras of Kalibr's `camchain.yaml`.
///
/// # Errors
/// As [`parse_camera`]; also where R is not a rotation to within 1e-3.
pub fn parse_rig(text: &str, size: Option<(usize, usize)>) -> Result<RigFile, FormatError> {
    rig_and_notes(text, size).map(|(file, _)| file)
}

fn rig_and_notes(text: &str, size: Option<(usize, usize)>) -> Result<(RigFile, Vec<CalibrationNote>), FormatError> {
    let Some(read) = format_of(text)?.rig else {
        return Err(FormatError::UnknownFormat { expected: "a stereo rig: YAML, ours, OpenCV's or Kalibr's" });
    };
    let context = ReadContext::new(size);
    let file = read(text, &context)?;
    checked(file.rig.left)?;
    checked(file.rig.right)?;
    let t = &file.rig.right_from_left.translation;
    if !(t.norm() > 0.0 && t.norm().is_finite()) {
        return Err(FormatError::corrupt("rig", "the translation between the cameras is zero or not finite"));
    }
    Ok((file, context.into_notes()))
}

/// Reads a stereo rig; see [`parse_rig`].
///
/// # Errors
/// [`IoError`]: cannot be read as text, or as [`parse_rig`].
pub fn read_rig(path: impl AsRef<Path>, size: Option<(usize, usize)>) -> Result<RigFile, IoError> {
    read_rig_with_notes(&[path], size).map(|(file, _)| file)
}

/// Reads a stereo rig from one or several files (OpenCV's sample writes `intrinsics.yml` and `extrinsics.yml`), with notes on deviations from
/// them; see [`parse_rig`].
///
/// # Errors
/// As [`read_rig`], with the first path where the combined content is invalid.
pub fn read_rig_with_notes(
    paths: &[impl AsRef<Path>],
    size: Option<(usize, usize)>,
) -> Result<(RigFile, Vec<CalibrationNote>), IoError> {
    let texts = paths.iter().map(|path| read_text(path.as_ref())).collect::<Result<Vec<_>, _>>()?;
    rig_and_notes(&concatenate_documents(texts), size)
        .map_err(|reason| IoError::reading(paths.first().map_or(Path::new(""), AsRef::as_ref), reason))
}

/// Concatenates the entries of several YAML documents to one.
fn concatenate_documents(texts: Vec<String>) -> String {
    let mut texts = texts.into_iter();
    let mut all = texts.next().unwrap_or_default();
    for text in texts {
        all.push('\n');
        let entries =
            text.lines().filter(|line| !(line.starts_with("%YAML") || ["---", "..."].contains(&line.trim_end())));
        entries.for_each(|line| {
            all.push_str(line);
            all.push('\n');
        });
    }
    all
}

/// Parses a multi-camera rig: our own YAML (`schema: cv-rig/2`) and Kalibr's `camchain.yaml`.
///
/// # Errors
/// As [`parse_rig`].
pub fn parse_camera_array(text: &str) -> Result<CameraArray, FormatError> {
    let Some(read) = format_of(text)?.array else {
        return Err(FormatError::UnknownFormat { expected: "a rig of cameras: YAML, ours or Kalibr's" });
    };
    let file = read(text, &ReadContext::new(None))?;
    for camera in &file.cameras {
        checked(camera.camera)?;
    }
    if file.cameras.len() < 2 {
        return Err(FormatError::corrupt("rig", "it has less than two cameras"));
    }
    Ok(file)
}

/// Reads a multi-camera rig; see [`parse_camera_array`].
///
/// # Errors
/// [`IoError`]: cannot be read as text, or as [`parse_camera_array`].
pub fn read_camera_array(path: impl AsRef<Path>) -> Result<CameraArray, IoError> {
    let path = path.as_ref();
    parse_camera_array(&read_text(path)?).map_err(|reason| IoError::reading(path, reason))
}

/// Writes a multi-camera rig as our own YAML. `notes` become comment lines.
///
/// # Errors
/// As [`write_camera`].
pub fn write_camera_array(path: impl AsRef<Path>, file: &CameraArray, notes: &[&str]) -> Result<(), IoError> {
    let path = path.as_ref();
    let text = CalibrationFormat::OWN.array_text(file, notes).map_err(|reason| IoError::writing(path, reason))?;
    write_bytes(path, text.as_bytes())
}

/// Writes a stereo rig as our own YAML. `notes` become comment lines.
///
/// # Errors
/// As [`write_camera`].
pub fn write_rig(path: impl AsRef<Path>, file: &RigFile, notes: &[&str]) -> Result<(), IoError> {
    let path = path.as_ref();
    let text = CalibrationFormat::OWN.rig_text(file, notes).map_err(|reason| IoError::writing(path, reason))?;
    write_bytes(path, text.as_bytes())
}

fn format_of(text: &str) -> Result<&'static Format, FormatError> {
    if text.trim().is_empty() {
        return Err(FormatError::Empty);
    }
    let found = FORMATS.iter().copied().find(|f| (f.matches)(text));
    found.ok_or(FormatError::UnknownFormat { expected: EXPECTED })
}

fn writable(camera: &Camera, format: &'static str) -> Result<Camera, FormatError> {
    checked(*camera).map_err(|e| FormatError::NotRepresentable { format, what: e.to_string() })
}

fn checked(camera: Camera) -> Result<Camera, FormatError> {
    camera.validate().map_err(|e| FormatError::corrupt("camera", e.to_string()))?;
    // So that products of sides and channels do not overflow; far above any sensor.
    if camera.width > 1 << 20 || camera.height > 1 << 20 {
        let reason = format!("an image of {}×{} pixels is not plausible", camera.width, camera.height);
        return Err(FormatError::corrupt("camera", reason));
    }
    if camera.width == 0 || camera.height == 0 {
        return Err(FormatError::corrupt("camera", "the image size is zero"));
    }
    Ok(camera)
}

fn no_size(format: &'static str) -> FormatError {
    FormatError::missing(format, "image size")
}
