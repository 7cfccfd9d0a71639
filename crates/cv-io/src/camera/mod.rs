//! Cameras and stereo rigs in files of several origins, told apart by content.

mod colmap_line;
mod opencv;
mod own;
mod yaml;

pub(crate) use colmap_line::{model_parameters, parse_model};

use std::path::Path;

use cv_core::{Camera, StereoRig};

use crate::files::{read_text, write_bytes};
use crate::{FormatError, IoError};

const EXPECTED: &str =
    "a camera: YAML (ours, OpenCV's or ROS's), a COLMAP camera line, or the nine numbers of a calibration matrix";

/// A stereo rig as a file has it.
#[derive(Debug, Clone, PartialEq)]
pub struct RigFile {
    /// The rig.
    pub rig: StereoRig,
    /// The unit of the rig's translation, and so of every depth: “m”, “mm”, “squares”. Empty where the file does not say.
    pub unit: String,
}

/// Parses a camera.
///
/// Understood, by content: our own YAML (`schema: cv-camera/1`); OpenCV's FileStorage and ROS's `camera_info` YAML (under any of
/// their usual names for the matrix and the coefficients); a COLMAP camera, as in `cameras.txt` (`1 SIMPLE_RADIAL 640 480 …`), alone or
/// behind `# camera:`; a calibration matrix of three rows of three numbers.
///
/// COLMAP's principal points have pixel centers at +0.5 and are brought to ours, at integers; all others are taken as they are.
///
/// `size` is used where the text has no picture size (a bare matrix, OpenCV's sample programs); else it is ignored.
///
/// # Errors
/// [`FormatError`] with the line or the entry that is wrong or absent, or for a distortion model without an equal here.
pub fn parse_camera(text: &str, size: Option<(usize, usize)>) -> Result<Camera, FormatError> {
    let camera = match kind(text)? {
        Kind::Own => own::camera(&yaml::load(text)?)?,
        Kind::OpenCv => opencv::camera(&yaml::load(text)?, size)?,
        Kind::Colmap => colmap_line::find(text)?,
        Kind::Matrix => matrix(text, size)?,
    };
    checked(camera)
}

/// Reads a camera; see [`parse_camera`].
///
/// # Errors
/// [`IoError`]: cannot be read as text, or as [`parse_camera`].
pub fn read_camera(path: impl AsRef<Path>, size: Option<(usize, usize)>) -> Result<Camera, IoError> {
    let path = path.as_ref();
    parse_camera(&read_text(path)?, size).map_err(|reason| IoError::reading(path, reason))
}

/// Writes a camera as our own YAML; every number reads back to the same value. `notes` become comment lines.
///
/// # Errors
/// [`FormatError::NotRepresentable`] where [`Camera::validate`] fails; else as [`crate::write_atomic`].
pub fn write_camera(path: impl AsRef<Path>, camera: &Camera, notes: &[&str]) -> Result<(), IoError> {
    let path = path.as_ref();
    let text = own::camera_text(camera, notes).map_err(|reason| IoError::writing(path, reason))?;
    write_bytes(path, text.as_bytes())
}

/// Parses a stereo rig: our own YAML (`schema: cv-rig/1`) or OpenCV's, with both cameras, R and T in one file.
///
/// # Errors
/// As [`parse_camera`]; also where R is not a rotation to within 1e-3.
pub fn parse_rig(text: &str, size: Option<(usize, usize)>) -> Result<RigFile, FormatError> {
    let file = match kind(text)? {
        Kind::Own => own::rig(&yaml::load(text)?)?,
        Kind::OpenCv => opencv::rig(&yaml::load(text)?, size)?,
        Kind::Colmap | Kind::Matrix => {
            return Err(FormatError::UnknownFormat { expected: "a stereo rig: YAML, ours or OpenCV's" });
        }
    };
    checked(file.rig.left)?;
    checked(file.rig.right)?;
    let t = &file.rig.right_from_left.translation;
    if !(t.norm() > 0.0 && t.norm().is_finite()) {
        return Err(FormatError::corrupt("rig", "the translation between the cameras is zero or not finite"));
    }
    Ok(file)
}

/// Reads a stereo rig; see [`parse_rig`].
///
/// # Errors
/// [`IoError`]: cannot be read as text, or as [`parse_rig`].
pub fn read_rig(path: impl AsRef<Path>, size: Option<(usize, usize)>) -> Result<RigFile, IoError> {
    let path = path.as_ref();
    parse_rig(&read_text(path)?, size).map_err(|reason| IoError::reading(path, reason))
}

/// Writes a stereo rig as our own YAML. `notes` become comment lines.
///
/// # Errors
/// As [`write_camera`].
pub fn write_rig(path: impl AsRef<Path>, file: &RigFile, notes: &[&str]) -> Result<(), IoError> {
    let path = path.as_ref();
    let text = own::rig_text(file, notes).map_err(|reason| IoError::writing(path, reason))?;
    write_bytes(path, text.as_bytes())
}

enum Kind {
    Own,
    OpenCv,
    Colmap,
    Matrix,
}

fn kind(text: &str) -> Result<Kind, FormatError> {
    if text.trim().is_empty() {
        return Err(FormatError::Empty);
    }
    if text.trim_start().starts_with("<?xml") || text.trim_start().starts_with("<opencv_storage") {
        return Err(FormatError::unsupported("OpenCV's XML", "this way of storing a camera (its YAML is)"));
    }
    if text.lines().any(|l| l.starts_with("schema:")) {
        return Ok(Kind::Own);
    }
    if colmap_line::find(text).is_ok() {
        return Ok(Kind::Colmap);
    }
    let words = || text.lines().filter(|l| !l.trim_start().starts_with('#')).flat_map(numbers_of);
    if words().all(|w| w.parse::<f64>().is_ok()) && words().count() == 9 {
        return Ok(Kind::Matrix);
    }
    if text.starts_with("%YAML") || text.contains(':') {
        return Ok(Kind::OpenCv);
    }
    // A COLMAP line that is nearly right deserves its own reason.
    match colmap_line::find(text) {
        Err(error @ FormatError::Line { .. }) => Err(error),
        _ => Err(FormatError::UnknownFormat { expected: EXPECTED }),
    }
}

/// The words of a row of a matrix, without brackets.
fn numbers_of(line: &str) -> impl Iterator<Item = &str> {
    line.split([' ', '\t', ',', ';', '[', ']', '\r']).filter(|w| !w.is_empty())
}

fn checked(camera: Camera) -> Result<Camera, FormatError> {
    camera.validate().map_err(|e| FormatError::corrupt("camera", e.to_string()))?;
    // Any product of sides and channels must fit; no sensor is near this.
    if camera.width > 1 << 20 || camera.height > 1 << 20 {
        let reason = format!("a picture of {}×{} pixels is not plausible", camera.width, camera.height);
        return Err(FormatError::corrupt("camera", reason));
    }
    if camera.width == 0 || camera.height == 0 {
        return Err(FormatError::corrupt("camera", "the size of the picture is zero"));
    }
    Ok(camera)
}

fn no_size(format: &'static str) -> FormatError {
    FormatError::missing(format, "picture size")
}

/// The bare calibration matrix.
fn matrix(text: &str, size: Option<(usize, usize)>) -> Result<Camera, FormatError> {
    let mut m = [0.0; 9];
    let words = text.lines().filter(|l| !l.trim_start().starts_with('#')).flat_map(numbers_of);
    for (cell, word) in m.iter_mut().zip(words) {
        *cell = word
            .parse()
            .map_err(|_| FormatError::corrupt("calibration matrix", format!("“{word}” is not a number")))?;
    }
    let (width, height) = size.ok_or_else(|| no_size("calibration matrix"))?;
    from_matrix("calibration matrix", m, width, height)
}

/// A pinhole from the nine numbers of K.
fn from_matrix(format: &'static str, m: [f64; 9], width: usize, height: usize) -> Result<Camera, FormatError> {
    let [fx, skew, cx, zero, fy, cy, a, b, one] = m;
    let scale = fx.abs().max(fy.abs());
    if one == 0.0 || ![zero, a, b].iter().all(|v| v.abs() <= 1e-9 * scale) {
        return Err(FormatError::corrupt(format, "it does not have the form (fx 0 cx; 0 fy cy; 0 0 1)"));
    }
    if skew.abs() > 1e-6 * scale {
        return Err(FormatError::unsupported(format, format!("a skew of {skew}")));
    }
    Ok(Camera::pinhole(width, height, fx / one, fy / one, cx / one, cy / one))
}

#[cfg(test)]
mod tests;
