//! mrcal's `.cameramodel`: a dictionary in Python's notation, which is also YAML flow style.

use std::fmt::Write as _;

use cv_core::{Camera, Distortion, DistortionModel, LensProjection};

use super::format::{Format, comments, simplest_distortion};
use super::yaml::{get, load, numbers, required};
use crate::FormatError;

const NAME: &str = "mrcal";
/// Names of mrcal's models, with their number of distortion parameters.
const MODELS: [(&str, usize); 5] = [
    ("LENSMODEL_PINHOLE", 0),
    ("LENSMODEL_OPENCV4", 4),
    ("LENSMODEL_OPENCV5", 5),
    ("LENSMODEL_OPENCV8", 8),
    ("LENSMODEL_OPENCV12", 12),
];

pub(super) const FORMAT: Format = Format {
    name: "mrcal",
    matches: |text| text.contains("LENSMODEL_"),
    camera: |text, _| camera(text),
    rig: None,
    camera_text: Some(camera_text),
    rig_text: None,
    array: None,
    array_text: None,
};

/// Iterates over OpenCV's perspective lens models.
fn lenses() -> impl Iterator<Item = DistortionModel> {
    DistortionModel::ALL.iter().copied().filter(|m| {
        let info = m.info();
        info.projection == LensProjection::Perspective && (info.opencv || info.parameters.is_empty())
    })
}

fn camera(text: &str) -> Result<Camera, FormatError> {
    let document = load(text)?;
    let name = get(&document, &["lensmodel"]).and_then(|v| v.as_str());
    let name = name.ok_or_else(|| FormatError::missing(NAME, "lensmodel"))?;
    let Some((_, count)) = MODELS.iter().find(|(model, _)| *model == name) else {
        let known: Vec<&str> = MODELS.iter().map(|m| m.0).collect();
        return Err(FormatError::unsupported(NAME, format!("the model {name} (it is one of {})", known.join(", "))));
    };
    let all =
        get(&document, &["intrinsics"]).and_then(numbers).ok_or_else(|| FormatError::missing(NAME, "intrinsics"))?;
    let [fx, fy, cx, cy, rest @ ..] = &all[..] else {
        return Err(FormatError::corrupt(NAME, "intrinsics are fewer than four numbers"));
    };
    let lens = lenses().find(|m| m.parameter_count() == *count).filter(|_| rest.len() == *count);
    let distortion = lens.and_then(|lens| Distortion::new(lens, rest).ok());
    let distortion =
        distortion.ok_or_else(|| FormatError::corrupt(NAME, format!("{name} does not have {} numbers", all.len())))?;
    let [w, h]: [f64; 2] = required(&document, NAME, &["imagersize"])?;
    let side = |v: f64| (v.fract() == 0.0 && (1.0..=1e6).contains(&v)).then_some(v as usize);
    let (Some(width), Some(height)) = (side(w), side(h)) else {
        return Err(FormatError::corrupt(NAME, "imagersize is not two sizes"));
    };
    Ok(Camera { distortion, ..Camera::pinhole(width, height, *fx, *fy, *cx, *cy) })
}

fn camera_text(camera: &Camera, notes: &[&str]) -> Result<String, FormatError> {
    let distortion = simplest_distortion(camera, NAME, lenses())?;
    let count = distortion.parameters().len();
    let model = MODELS.iter().find(|m| m.1 == count).map_or("", |m| m.0);
    let mut text = comments(notes);
    let focal = [camera.fx, camera.fy, camera.cx, camera.cy];
    let all: Vec<String> = focal.iter().chain(distortion.parameters()).map(|v| format!("{v:?}")).collect();
    let _ = write!(
        text,
        "{{\n    'lensmodel':  '{model}',\n\n    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n    'intrinsics': [ {}, ],\n\n    # extrinsics are rt_fromref\n    'extrinsics': [ 0, 0, 0, 0, 0, 0, ],\n\n    'imagersize': [ {}, {}, ]\n}}\n",
        all.join(", "),
        camera.width,
        camera.height
    );
    Ok(text)
}
