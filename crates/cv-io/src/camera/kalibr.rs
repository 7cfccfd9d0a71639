//! Cameras and rigs as Kalibr writes them (`camchain.yaml`): `cam0`, `cam1`, …, each with the motion from the one before it.

use std::fmt::Write as _;

use cv_core::{Camera, Distortion, DistortionModel, StereoRig};
use saphyr::Yaml;

use super::RigFile;
use super::format::{Format, Given, comments, smallest};
use super::yaml::{get, load, numbers, pose, required, size_of};
use crate::FormatError;

const NAME: &str = "Kalibr";

pub(super) const FORMAT: Format = Format {
    name: "kalibr",
    is: |text| text.lines().any(|l| l.trim_end() == "cam0:"),
    camera: |text, _| one(&load(text)?, "cam0"),
    rig: Some(rig),
    camera_text: Some(camera_text),
    rig_text: Some(rig_text),
};

fn one(document: &Yaml<'_>, key: &str) -> Result<Camera, FormatError> {
    let map = get(document, &[key]).ok_or_else(|| FormatError::missing(NAME, key))?;
    let word = |key| get(map, &[key]).and_then(|v| v.as_str()).ok_or_else(|| FormatError::missing(NAME, key));
    if word("camera_model")? != "pinhole" {
        let what = format!("the camera model {} (it is pinhole)", word("camera_model")?);
        return Err(FormatError::unsupported(NAME, what));
    }
    let name = word("distortion_model")?;
    let lens = DistortionModel::ALL.iter().find(|m| m.info().kalibr == Some(name));
    let lens = *lens.ok_or_else(|| {
        let names: Vec<&str> = DistortionModel::ALL.iter().filter_map(|m| m.info().kalibr).collect();
        FormatError::unsupported(NAME, format!("the distortion model {name} (it is one of {})", names.join(", ")))
    })?;
    let coefficients = get(map, &["distortion_coeffs"]).and_then(numbers);
    let coefficients = coefficients.ok_or_else(|| FormatError::missing(NAME, "distortion_coeffs"))?;
    // For a pinhole zeros may stand there.
    let given =
        if coefficients.iter().all(|v| *v == 0.0) && lens.parameter_count() == 0 { &[] } else { &coefficients[..] };
    let distortion = Distortion::new(lens, given).map_err(|e| FormatError::corrupt(NAME, e.to_string()))?;
    let [fx, fy, cx, cy] = required(map, NAME, &["intrinsics"])?;
    let size = get(map, &["resolution"]).and_then(|v| v.as_sequence()).and_then(|v| match v.as_slice() {
        [w, h] => Some((size_of(w)?, size_of(h)?)),
        _ => None,
    });
    let (width, height) = size.ok_or_else(|| FormatError::corrupt(NAME, "resolution is not two sizes"))?;
    Ok(Camera { distortion, ..Camera::pinhole(width, height, fx, fy, cx, cy) })
}

fn rig(text: &str, _: &Given) -> Result<RigFile, FormatError> {
    let document = load(text)?;
    let [left, right] = [one(&document, "cam0")?, one(&document, "cam1")?];
    let second = get(&document, &["cam1"]).ok_or_else(|| FormatError::missing(NAME, "cam1"))?;
    let m: [f64; 16] = required(second, NAME, &["T_cn_cnm1"])?;
    let [r0, r1, r2, last] = [0, 4, 8, 12].map(|i| [m[i], m[i + 1], m[i + 2], m[i + 3]]);
    if last != [0.0, 0.0, 0.0, 1.0] {
        return Err(FormatError::corrupt(NAME, "the last row of T_cn_cnm1 is not 0 0 0 1"));
    }
    let rotation = [r0[0], r0[1], r0[2], r1[0], r1[1], r1[2], r2[0], r2[1], r2[2]];
    let right_from_left = pose(NAME, rotation, [r0[3], r1[3], r2[3]])?;
    // Kalibr's boards are in meters.
    Ok(RigFile { rig: StereoRig { left, right, right_from_left }, unit: "m".to_owned() })
}

fn camera_text(camera: &Camera, notes: &[&str]) -> Result<String, FormatError> {
    let mut text = comments(notes);
    push(&mut text, "cam0", camera)?;
    Ok(text)
}

fn rig_text(file: &RigFile, notes: &[&str]) -> Result<String, FormatError> {
    if !["", "m"].contains(&file.unit.as_str()) {
        let what = format!("a rig whose unit is {}, not the meter", file.unit);
        return Err(FormatError::NotRepresentable { format: NAME, what });
    }
    let mut text = comments(notes);
    push(&mut text, "cam0", &file.rig.left)?;
    push(&mut text, "cam1", &file.rig.right)?;
    text.push_str("  T_cn_cnm1:\n");
    let motion = &file.rig.right_from_left;
    for (r, t) in motion.rotation.matrix().row_iter().zip(motion.translation.iter()) {
        let _ = writeln!(text, "  - [{:?}, {:?}, {:?}, {t:?}]", r[0], r[1], r[2]);
    }
    text.push_str("  - [0.0, 0.0, 0.0, 1.0]\n");
    Ok(text)
}

fn push(text: &mut String, key: &str, camera: &Camera) -> Result<(), FormatError> {
    let known = DistortionModel::ALL.iter().copied().filter(|m| m.info().kalibr.is_some());
    let distortion = smallest(camera, NAME, known)?;
    let name = distortion.model().info().kalibr.unwrap_or_default();
    let Camera { width, height, fx, fy, cx, cy, .. } = camera;
    let _ = writeln!(text, "{key}:\n  camera_model: pinhole\n  intrinsics: [{fx:?}, {fy:?}, {cx:?}, {cy:?}]");
    let _ = writeln!(text, "  distortion_model: {name}\n  distortion_coeffs: {:?}", distortion.parameters());
    let _ = writeln!(text, "  resolution: [{width}, {height}]");
    Ok(())
}
