//! Our own YAML: `schema: cv-camera/1`, `schema: cv-rig/1` of two cameras, `schema: cv-rig/2` of any number.

use std::fmt::Write as _;

use cv_core::{Camera, Distortion, DistortionModel, Pose, StereoRig};
use saphyr::Yaml;

use super::format::{Format, comments, printable};
use super::yaml::{get, load, number, numbers, pose, required, size_of};
use super::{ArrayCamera, CameraArray, RigFile};
use crate::FormatError;

const NAME: &str = "cv-camera/1";
const RIG: &str = "cv-rig/1";
const CAMERA_KEYS: [&str; 9] = ["schema", "width", "height", "fx", "fy", "cx", "cy", "distortion", "coefficients"];
const ARRAY: &str = "cv-rig/2";
const ARRAY_KEYS: [&str; 3] = ["schema", "unit", "cameras"];
/// Additional keys of a camera in a multi-camera rig.
const MOUNT_KEYS: [&str; 3] = ["name", "rotation", "translation"];
const RIG_KEYS: [&str; 6] = ["schema", "unit", "left", "right", "rotation", "translation"];

pub(super) const FORMAT: Format = Format {
    name: "own",
    matches: |text| text.lines().any(|l| l.starts_with("schema:")),
    camera: |text, _| camera(&load(text)?),
    rig: Some(|text, _| rig(&load(text)?)),
    camera_text: Some(camera_text),
    rig_text: Some(rig_text),
    array: Some(|text, _| array(&load(text)?)),
    array_text: Some(array_text),
};

fn camera(document: &Yaml<'_>) -> Result<Camera, FormatError> {
    check_schema(document, NAME)?;
    check_keys(document, NAME, &CAMERA_KEYS)?;
    camera_fields(document)
}

fn rig(document: &Yaml<'_>) -> Result<RigFile, FormatError> {
    if check_schema(document, ARRAY).is_ok() {
        let CameraArray { cameras, unit } = array(document)?;
        let [left, right, ..] = cameras.as_slice() else {
            return Err(FormatError::corrupt(ARRAY, "it has less than two cameras"));
        };
        let right_from_left = right.from_first.compose(&left.from_first.inverse());
        return Ok(RigFile { rig: StereoRig { left: left.camera, right: right.camera, right_from_left }, unit });
    }
    check_schema(document, RIG)?;
    check_keys(document, RIG, &RIG_KEYS)?;
    let side = |key| {
        let map = get(document, &[key]).ok_or_else(|| FormatError::missing(RIG, key))?;
        check_keys(map, NAME, &CAMERA_KEYS)?;
        camera_fields(map)
    };
    let right_from_left =
        pose(RIG, required(document, RIG, &["rotation"])?, required(document, RIG, &["translation"])?)?;
    let unit = get(document, &["unit"]).and_then(|u| u.as_str()).unwrap_or("").to_owned();
    Ok(RigFile { rig: StereoRig { left: side("left")?, right: side("right")?, right_from_left }, unit })
}

/// Parses any number of cameras, in the frame of the first.
fn array(document: &Yaml<'_>) -> Result<CameraArray, FormatError> {
    check_schema(document, ARRAY)?;
    check_keys(document, ARRAY, &ARRAY_KEYS)?;
    let list = get(document, &["cameras"]).ok_or_else(|| FormatError::missing(ARRAY, "cameras"))?;
    let list = list.as_sequence().ok_or_else(|| FormatError::corrupt(ARRAY, "cameras is not a list"))?;
    let known: Vec<&str> = CAMERA_KEYS.iter().chain(&MOUNT_KEYS).copied().collect();
    let one = |map: &Yaml<'_>| {
        check_keys(map, ARRAY, &known)?;
        let name = get(map, &["name"]).and_then(|n| n.as_str());
        let name = name.ok_or_else(|| FormatError::missing(ARRAY, "name"))?.to_owned();
        let from_first = pose(ARRAY, required(map, ARRAY, &["rotation"])?, required(map, ARRAY, &["translation"])?)?;
        Ok(ArrayCamera { name, camera: camera_fields(map)?, from_first })
    };
    let cameras = list.iter().map(one).collect::<Result<Vec<_>, FormatError>>()?;
    // Tolerance for rounded numbers.
    let is_not_identity = |first: &ArrayCamera| (first.from_first.matrix() - Pose::identity().matrix()).norm() > 1e-6;
    if cameras.first().is_some_and(is_not_identity) {
        return Err(FormatError::corrupt(ARRAY, "the pose of the first camera is not the identity"));
    }
    let unit = get(document, &["unit"]).and_then(|u| u.as_str()).unwrap_or("").to_owned();
    Ok(CameraArray { cameras, unit })
}

fn array_text(file: &CameraArray, notes: &[&str]) -> Result<String, FormatError> {
    let mut text = comments(notes);
    let _ = writeln!(text, "schema: {ARRAY}\nunit: \"{}\"", strip_unquotable(&file.unit));
    text.push_str("# x_camera = rotation · x_first + translation, translation in the unit above\ncameras:\n");
    for ArrayCamera { name, camera, from_first } in &file.cameras {
        let _ = writeln!(text, "  - name: \"{}\"", strip_unquotable(name));
        push_camera(&mut text, camera, "    ");
        text.push_str("    rotation:\n");
        for row in from_first.rotation.matrix().row_iter() {
            let _ = writeln!(text, "      - [{:?}, {:?}, {:?}]", row[0], row[1], row[2]);
        }
        let t = &from_first.translation;
        let _ = writeln!(text, "    translation: [{:?}, {:?}, {:?}]", t.x, t.y, t.z);
    }
    Ok(text)
}

/// Removes characters that are not allowed in a quoted string.
fn strip_unquotable(text: &str) -> String {
    text.chars().filter(|&c| printable(c) && !matches!(c, '"' | '\\')).collect()
}

fn check_schema(document: &Yaml<'_>, expected: &'static str) -> Result<(), FormatError> {
    match get(document, &["schema"]).and_then(|s| s.as_str()) {
        Some(found) if found == expected => Ok(()),
        Some(found) => Err(FormatError::unsupported(expected, format!("the schema “{found}”"))),
        None => Err(FormatError::missing(expected, "schema")),
    }
}

/// Refuses unknown keys, so that a misspelled key is not taken as absent. Keys that begin with `x-` are free for extensions.
fn check_keys(map: &Yaml<'_>, format: &'static str, known: &[&str]) -> Result<(), FormatError> {
    let keys = map.as_mapping().into_iter().flatten().map(|(key, _)| key.as_str().unwrap_or("?"));
    match keys.into_iter().find(|key| !known.contains(key) && !key.starts_with("x-")) {
        Some(key) => Err(FormatError::corrupt(format, format!("unknown entry “{key}”"))),
        None => Ok(()),
    }
}

fn camera_fields(map: &Yaml<'_>) -> Result<Camera, FormatError> {
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
    let _ = writeln!(text, "schema: {RIG}\nunit: \"{}\"\nleft:", strip_unquotable(&file.unit));
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
    // Debug formatting of f64 is the shortest that round-trips exactly, and always has a decimal point or exponent.
    let _ = writeln!(text, "{indent}fx: {:?}\n{indent}fy: {:?}", camera.fx, camera.fy);
    let _ = writeln!(text, "{indent}# principal point, center of the top-left pixel at (0, 0)");
    let _ = writeln!(text, "{indent}cx: {:?}\n{indent}cy: {:?}", camera.cx, camera.cy);
    if !k.is_empty() {
        let _ = writeln!(text, "{indent}# coefficients: {}", lens.parameters.join(", "));
    }
    let _ = writeln!(text, "{indent}distortion: {}\n{indent}coefficients: {k:?}", lens.name);
}
