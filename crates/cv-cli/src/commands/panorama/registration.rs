//! The files of `--registration` and `--save-registration`: JSON, or Hugin projects.

use crate::frame::{Context, Explain, Failure, Output};
use cv_pipeline::PanoramaResult;
use cv_pipeline::panorama_types::{PhotoSample, Registration};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// The extensions of registration files.
pub(super) const ENDINGS: &[&str] = &["json", "pto"];
/// Largest error in pixels of a converted distortion model without a warning: the accuracy of a good registration.
const MAX_LENS_ERROR_PX: f64 = 0.1;

fn is_pto(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("pto"))
}

/// Reads a registration.
pub(super) fn read(path: &Path, context: &Context) -> Result<Registration, Failure> {
    let bytes = cv_io::read_bytes(path)?;
    if is_pto(path) {
        let read = Registration::from_pto(&String::from_utf8_lossy(&bytes));
        let read = read.during(path.display()).advice("a Hugin project of rectilinear photographs from one place")?;
        warn_of_lens_error(path, read.lens_error_px, context);
        return Ok(read.content);
    }
    const SAVE: &str = "name a file written by cv panorama --save-registration";
    let none = format!("{} is no registration file", path.display());
    // Parsed as a generic value first: another version is reported as such, not as a missing field.
    let value: Result<Value, _> = serde_json::from_slice(&bytes);
    let value = value.during(&none).advice(SAVE)?;
    Registration::check_schema(value["schema"].as_u64()).during(path.display()).advice(SAVE)?;
    serde_json::from_value(value).during(&none).advice(SAVE)
}

/// Writes a registration.
pub(super) fn write<T: PhotoSample>(
    path: &Path,
    result: &PanoramaResult<T>,
    photographs: &[PathBuf],
    context: &Context,
) -> Result<(), Failure> {
    let text = if is_pto(path) {
        let names: Vec<String> = photographs.iter().map(|photo| path_in_project(path, photo)).collect();
        let made = result.registration(&names)?.to_pto(&result.canvas, result.size);
        let made = made.during(path.display()).advice("a file that ends in .json")?;
        warn_of_lens_error(path, made.lens_error_px, context);
        made.content
    } else {
        let names: Vec<String> = photographs.iter().map(|path| path.display().to_string()).collect();
        let text = serde_json::to_string(&result.registration(&names)?);
        text.during("cannot write the registration as JSON")? + "\n"
    };
    context.write(Output::File(path, ENDINGS), |path| cv_io::write_bytes(path, text.as_bytes()))
}

/// Returns the path of a photograph as Hugin resolves it: relative to the folder of the project, or absolute.
fn path_in_project(project: &Path, photo: &Path) -> String {
    let here = project.parent().is_none_or(|folder| folder.as_os_str().is_empty());
    let path = if here { photo.to_owned() } else { std::path::absolute(photo).unwrap_or_else(|_| photo.to_owned()) };
    path.display().to_string()
}

fn warn_of_lens_error(path: &Path, error: f64, context: &Context) {
    if error > MAX_LENS_ERROR_PX {
        context.warn(format!(
            "{}: the two distortion models differ by up to {error:.2} px at the borders of the photographs",
            path.display()
        ));
    }
}
