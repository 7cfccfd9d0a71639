//! Kalibr's `camchain.yaml`: `cam0`, `cam1`, …, each with the motion from its predecessor.

use std::fmt::Write as _;

use cv_core::{Camera, Distortion, DistortionModel, Pose, StereoRig};
use saphyr::Yaml;

use super::format::{Format, ReadContext, comments, simplest_distortion};
use super::yaml::{get, load, numbers, pose, required, size_of};
use super::{ArrayCamera, CameraArray, RigFile};
use crate::FormatError;

const NAME: &str = "Kalibr";

pub(super) const FORMAT: Format = Format {
    name: "kalibr",
    matches: |text| text.lines().any(|l| l.trim_end() == "cam0:"),
    camera: |text, _| parse_one(&load(text)?, "cam0"),
    rig: Some(rig),
    camera_text: Some(camera_text),
    rig_text: Some(rig_text),
    array: Some(array),
    array_text: Some(array_text),
};

fn parse_one(document: &Yaml<'_>, key: &str) -> Result<Camera, FormatError> {
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
    // A pinhole may have zeros as coefficients.
    let context =
        if coefficients.iter().all(|v| *v == 0.0) && lens.parameter_count() == 0 { &[] } else { &coefficients[..] };
    let distortion = Distortion::new(lens, context).map_err(|e| FormatError::corrupt(NAME, e.to_string()))?;
    let [fx, fy, cx, cy] = required(map, NAME, &["intrinsics"])?;
    let size = get(map, &["resolution"]).and_then(|v| v.as_sequence()).and_then(|v| match v.as_slice() {
        [w, h] => Some((size_of(w)?, size_of(h)?)),
        _ => None,
    });
    let (width, height) = size.ok_or_else(|| FormatError::corrupt(NAME, "resolution is not two sizes"))?;
    Ok(Camera { distortion, ..Camera::pinhole(width, height, fx, fy, cx, cy) })
}

fn rig(text: &str, _: &ReadContext) -> Result<RigFile, FormatError> {
    let document = load(text)?;
    let [left, right] = [parse_one(&document, "cam0")?, parse_one(&document, "cam1")?];
    let right_from_left = from_previous(&document, "cam1")?;
    // Kalibr's boards are in meters.
    Ok(RigFile { rig: StereoRig { left, right, right_from_left }, unit: "m".to_owned() })
}

/// Parses the motion from the preceding camera to this one.
fn from_previous(document: &Yaml<'_>, key: &str) -> Result<Pose, FormatError> {
    let map = get(document, &[key]).ok_or_else(|| FormatError::missing(NAME, key))?;
    let m: [f64; 16] = required(map, NAME, &["T_cn_cnm1"])?;
    let [r0, r1, r2, last] = [0, 4, 8, 12].map(|i| [m[i], m[i + 1], m[i + 2], m[i + 3]]);
    if last != [0.0, 0.0, 0.0, 1.0] {
        return Err(FormatError::corrupt(NAME, "the last row of T_cn_cnm1 is not 0 0 0 1"));
    }
    let rotation = [r0[0], r0[1], r0[2], r1[0], r1[1], r1[2], r2[0], r2[1], r2[2]];
    pose(NAME, rotation, [r0[3], r1[3], r2[3]])
}

fn array(text: &str, _: &ReadContext) -> Result<CameraArray, FormatError> {
    let document = load(text)?;
    let mut cameras = vec![ArrayCamera {
        name: "cam0".to_owned(),
        camera: parse_one(&document, "cam0")?,
        from_first: Pose::identity(),
    }];
    loop {
        let name = format!("cam{}", cameras.len());
        if get(&document, &[name.as_str()]).is_none() {
            return Ok(CameraArray { cameras, unit: "m".to_owned() });
        }
        let before = cameras.last().map_or(Pose::identity(), |c| c.from_first);
        let from_first = from_previous(&document, &name)?.compose(&before);
        cameras.push(ArrayCamera { camera: parse_one(&document, &name)?, from_first, name });
    }
}

fn array_text(file: &CameraArray, notes: &[&str]) -> Result<String, FormatError> {
    in_meters(&file.unit)?;
    let mut text = comments(notes);
    let mut before = Pose::identity();
    for (i, ArrayCamera { camera, from_first, .. }) in file.cameras.iter().enumerate() {
        push_camera(&mut text, &format!("cam{i}"), camera)?;
        if i > 0 {
            push_motion(&mut text, &from_first.compose(&before.inverse()));
        }
        before = *from_first;
    }
    Ok(text)
}

/// Checks that lengths are meters, Kalibr's unit.
fn in_meters(unit: &str) -> Result<(), FormatError> {
    if ["", "m"].contains(&unit) {
        return Ok(());
    }
    Err(FormatError::NotRepresentable { format: NAME, what: format!("a rig whose unit is {unit}, not the meter") })
}

fn camera_text(camera: &Camera, notes: &[&str]) -> Result<String, FormatError> {
    let mut text = comments(notes);
    push_camera(&mut text, "cam0", camera)?;
    Ok(text)
}

fn rig_text(file: &RigFile, notes: &[&str]) -> Result<String, FormatError> {
    in_meters(&file.unit)?;
    let mut text = comments(notes);
    push_camera(&mut text, "cam0", &file.rig.left)?;
    push_camera(&mut text, "cam1", &file.rig.right)?;
    push_motion(&mut text, &file.rig.right_from_left);
    Ok(text)
}

fn push_motion(text: &mut String, motion: &Pose) {
    text.push_str("  T_cn_cnm1:\n");
    for (r, t) in motion.rotation.matrix().row_iter().zip(motion.translation.iter()) {
        let _ = writeln!(text, "  - [{:?}, {:?}, {:?}, {t:?}]", r[0], r[1], r[2]);
    }
    text.push_str("  - [0.0, 0.0, 0.0, 1.0]\n");
}

fn push_camera(text: &mut String, key: &str, camera: &Camera) -> Result<(), FormatError> {
    let known = DistortionModel::ALL.iter().copied().filter(|m| m.info().kalibr.is_some());
    let distortion = simplest_distortion(camera, NAME, known)?;
    let name = distortion.model().info().kalibr.unwrap_or_default();
    let Camera { width, height, fx, fy, cx, cy, .. } = camera;
    let _ = writeln!(text, "{key}:\n  camera_model: pinhole\n  intrinsics: [{fx:?}, {fy:?}, {cx:?}, {cy:?}]");
    let _ = writeln!(text, "  distortion_model: {name}\n  distortion_coeffs: {:?}", distortion.parameters());
    let _ = writeln!(text, "  resolution: [{width}, {height}]");
    Ok(())
}
