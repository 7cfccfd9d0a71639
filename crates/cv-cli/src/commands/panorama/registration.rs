//! The files of `--registration` and `--save-registration`: ours as JSON, or projects of Hugin's.

use crate::frame::{Context, Explain, Failure, Output};
use cv_pipeline::PanoramaResult;
use cv_pipeline::panorama_types::{PhotoSample, Registration};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// The endings of a file of `--save-registration`.
pub(super) const ENDINGS: &[&str] = &["json", "pto"];
/// Pixels by which a lens may be off before it is worth a warning: what photographs are aligned to at best.
const LENS: f64 = 0.1;

fn is_pto(path: &Path) -> bool {
    path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("pto"))
}

/// Reads where each photograph looks.
pub(super) fn read(path: &Path, context: &Context) -> Result<Registration, Failure> {
    let bytes = cv_io::read_bytes(path)?;
    if is_pto(path) {
        let read = Registration::from_pto(&String::from_utf8_lossy(&bytes));
        let read =
            read.during(path.display()).advice("a project of Hugin's, of rectilinear photographs from one place")?;
        tell_lens(path, read.lens_error_px, context);
        return Ok(read.content);
    }
    const SAVE: &str = "name a file that cv panorama --save-registration has written";
    let none = format!("{} is no registration", path.display());
    // By way of a value: one of another version says so, not which of its fields is missing.
    let value: Result<Value, _> = serde_json::from_slice(&bytes);
    let value = value.during(&none).advice(SAVE)?;
    Registration::check_schema(value["schema"].as_u64()).during(path.display()).advice(SAVE)?;
    serde_json::from_value(value).during(&none).advice(SAVE)
}

/// Writes where each photograph looks.
pub(super) fn write<T: PhotoSample>(
    path: &Path,
    result: &PanoramaResult<T>,
    photographs: &[PathBuf],
    context: &Context,
) -> Result<(), Failure> {
    let text = if is_pto(path) {
        let names: Vec<String> = photographs.iter().map(|photo| from_folder_of(path, photo)).collect();
        let made = result.registration(&names)?.to_pto(&result.canvas, result.image.size());
        let made = made.during(path.display()).advice("a file that ends in .json")?;
        tell_lens(path, made.lens_error_px, context);
        made.content
    } else {
        let names: Vec<String> = photographs.iter().map(|path| path.display().to_string()).collect();
        let text = serde_json::to_string(&result.registration(&names)?);
        text.during("cannot write the registration as JSON")? + "\n"
    };
    context.write(Output::File(path, ENDINGS), |path| cv_io::write_bytes(path, text.as_bytes()))
}

/// A photograph as Hugin looks for it: from the folder of the project on.
fn from_folder_of(project: &Path, photo: &Path) -> String {
    let here = project.parent().is_none_or(|folder| folder.as_os_str().is_empty());
    let path = if here { photo.to_owned() } else { std::path::absolute(photo).unwrap_or_else(|_| photo.to_owned()) };
    path.display().to_string()
}

fn tell_lens(path: &Path, error: f64, context: &Context) {
    if error > LENS {
        context.warn(format!(
            "{}: the two models of the lens differ, by up to {error:.2} px at the borders of the photographs",
            path.display()
        ));
    }
}
