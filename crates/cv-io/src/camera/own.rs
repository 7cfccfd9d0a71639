//! Our own YAML: `schema: cv-camera/1` and `schema: cv-rig/1`.

use std::fmt::Write as _;

use cv_core::{Camera, Distortion, DistortionModel, StereoRig};
use saphyr::Yaml;

use super::RigFile;
use super::format::{Format, comments, printable};
use super::yaml::{get, load, number, numbers, pose, required, size_of};
use crate::FormatError;

const NAME: &str = "cv-camera/1";
const RIG: &str = "cv-rig/1";
const CAMERA_KEYS: [&str; 9] = ["schema", "width", "height", "fx", "fy", "cx", "cy", "distortion", "coefficients"];
const RIG_KEYS: [&str; 6] = ["schema", "unit", "left", "right", "rotation", "translation"];

pub(super) const FORMAT: Format = Format {
    name: "own",
    is: |text| text.lines().any(|l| l.starts_with("schema:")),
    camera: |text, _| camera(&load(text)?),
    rig: Some(|text, _| rig(&load(text)?)),
    camera_text: Some(camera_text),
    rig_text: Some(rig_text),
};

fn camera(document: &Yaml<'_>) -> Result<Camera, FormatError> {
    schema(document, NAME)?;
    fields(document)
}

fn rig(document: &Yaml<'_>) -> Result<RigFile, FormatError> {
    schema(document, RIG)?;
    known_keys(document, RIG, &RIG_KEYS)?;
    let side = |key| get(document, &[key]).ok_or_else(|| FormatError::missing(RIG, key)).and_then(fields);
    let right_from_left =
        pose(RIG, required(document, RIG, &["rotation"])?, required(document, RIG, &["translation"])?)?;
    let unit = get(document, &["unit"]).and_then(|u| u.as_str()).unwrap_or("").to_owned();
    Ok(RigFile { rig: StereoRig { left: side("left")?, right: side("right")?, right_from_left }, unit })
}

fn schema(document: &Yaml<'_>, expected: &'static str) -> Result<(), FormatError> {
    match get(document, &["schema"]).and_then(|s| s.as_str()) {
        Some(found) if found == expected => Ok(()),
        Some(found) => Err(FormatError::unsupported(expected, format!("the schema “{found}” in its place"))),
        None => Err(FormatError::missing(expected, "schema")),
    }
}

/// A misspelt key must not pass for an absent one. Keys that begin with `x-` are anybody's.
fn known_keys(map: &Yaml<'_>, format: &'static str, known: &[&str]) -> Result<(), FormatError> {
    let keys = map.as_mapping().into_iter().flatten().map(|(key, _)| key.as_str().unwrap_or("?"));
    match keys.into_iter().find(|key| !known.contains(key) && !key.starts_with("x-")) {
        Some(key) => Err(FormatError::corrupt(format, format!("unknown entry “{key}”"))),
        None => Ok(()),
    }
}

fn fields(map: &Yaml<'_>) -> Result<Camera, FormatError> {
    known_keys(map, NAME, &CAMERA_KEYS)?;
    let entry = |key| get(map, &[key]).ok_or_else(|| FormatError::missing(NAME, key));
    let real = |key| {
        entry(key).and_then(|v| number(v).ok_or_else(|| FormatError::corrupt(NAME, format!("{key} is not a number"))))
    };
    let side = |key| {
        entry(key).and_then(|v| size_of(v).ok_or_else(|| FormatError::corrupt(NAME, format!("{key} is not a size"))))
    };
    let model = match get(map, &["distortion"]) {
        None => "none",
        Some(v) => v.as_str().ok_or_else(|| FormatError::corrupt(NAME, "distortion is not a word"))?,
    };
    let k = match get(map, &["coefficients"]) {
        None => Vec::new(),
        Some(v) => numbers(v).ok_or_else(|| FormatError::corrupt(NAME, "coefficients is not a list of numbers"))?,
    };
    let Some(lens) = DistortionModel::from_name(model) else {
        let names: Vec<&str> = DistortionModel::ALL.iter().map(|m| m.info().name).collect();
        let what = format!("the distortion “{model}” (it is one of {})", names.join(", "));
        return Err(FormatError::unsupported(NAME, what));
    };
    let distortion = Distortion::new(lens, &k).map_err(|e| {
        FormatError::corrupt(NAME, format!("distortion {model} has {} coefficients, not {}", e.needed, e.got))
    })?;
    Ok(Camera {
        width: side("width")?,
        height: side("height")?,
        fx: real("fx")?,
        fy: real("fy")?,
        cx: real("cx")?,
        cy: real("cy")?,
        distortion,
    })
}

fn camera_text(camera: &Camera, notes: &[&str]) -> Result<String, FormatError> {
    let mut text = comments(notes);
    let _ = writeln!(text, "schema: {NAME}");
    push_camera(&mut text, camera, "");
    Ok(text)
}

fn rig_text(file: &RigFile, notes: &[&str]) -> Result<String, FormatError> {
    let mut text = comments(notes);
    let quoted: String = file.unit.chars().filter(|&c| printable(c) && !matches!(c, '"' | '\\')).collect();
    let _ = writeln!(text, "schema: {RIG}\nunit: \"{quoted}\"\nleft:");
    push_camera(&mut text, &file.rig.left, "  ");
    text.push_str("right:\n");
    push_camera(&mut text, &file.rig.right, "  ");
    let r = file.rig.right_from_left.rotation.matrix();
    let t = &file.rig.right_from_left.translation;
    text.push_str("# x_right = rotation · x_left + translation, translation in the unit above\nrotation:\n");
    for row in r.row_iter() {
        let _ = writeln!(text, "  - [{:?}, {:?}, {:?}]", row[0], row[1], row[2]);
    }
    let _ = writeln!(text, "translation: [{:?}, {:?}, {:?}]", t.x, t.y, t.z);
    Ok(text)
}

fn push_camera(text: &mut String, camera: &Camera, indent: &str) {
    let (lens, k) = (camera.distortion.model().info(), camera.distortion.parameters());
    let _ = writeln!(text, "{indent}width: {}\n{indent}height: {}", camera.width, camera.height);
    // Debug formatting of f64 is the shortest that reads back to the same bits, and always looks like a number.
    let _ = writeln!(text, "{indent}fx: {:?}\n{indent}fy: {:?}", camera.fx, camera.fy);
    let _ = writeln!(text, "{indent}# principal point, center of the top-left pixel at (0, 0)");
    let _ = writeln!(text, "{indent}cx: {:?}\n{indent}cy: {:?}", camera.cx, camera.cy);
    if !k.is_empty() {
        let _ = writeln!(text, "{indent}# coefficients: {}", lens.parameters.join(", "));
    }
    let _ = writeln!(text, "{indent}distortion: {}\n{indent}coefficients: {k:?}", lens.name);
}
