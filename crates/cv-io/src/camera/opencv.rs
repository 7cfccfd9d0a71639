//! Cameras and rigs of OpenCV's FileStorage and of ROS.
//!
//! Keys are not standardized: the lists below are those of OpenCV's samples and tutorials, ROS's `camera_info`,
//! and widely copied examples.

use std::fmt::Write as _;

use cv_core::{Camera, Distortion, DistortionModel, LensProjection, StereoRig};
use saphyr::Yaml;

use super::format::{Format, ReadContext, comments, simplest_distortion};
use super::matrix::pinhole;
use super::yaml::{get, load, number, numbers, pose, required, size_of};
use super::{RigFile, no_size};
use crate::FormatError;

const NAME: &str = "OpenCV YAML";
const MATRIX_KEYS: [&str; 11] = [
    "camera_matrix",
    "cameraMatrix",
    "Camera_Matrix",
    "CameraMatrix",
    "intrinsic_matrix",
    "intrinsics",
    "K",
    "M",
    "mtx",
    "M1",
    "K1",
];
const COEFFICIENT_KEYS: [&str; 12] = [
    "distortion_coefficients",
    "distCoeffs",
    "Distortion_Coefficients",
    "dist_coeffs",
    "DistCoeffs",
    "distortion",
    "dist_coeff",
    "D",
    "dist",
    "kc",
    "D1",
    "distCoeffs1",
];

pub(super) const FORMAT: Format = Format {
    name: "opencv",
    matches: |text| text.starts_with("%YAML") || text.contains(':'),
    camera: |text, context| camera(&load(text)?, context),
    rig: Some(|text, context| rig(&load(text)?, context)),
    camera_text: Some(camera_text),
    rig_text: Some(rig_text),
    array: None,
    array_text: None,
};

fn camera(document: &Yaml<'_>, context: &ReadContext) -> Result<Camera, FormatError> {
    let mut names: Vec<&str> = MATRIX_KEYS.to_vec();
    names.extend(["cameraMatrix1", "camera_matrix_1", "left_camera_matrix"]);
    parse_one(document, &names, &COEFFICIENT_KEYS, context)
}

fn rig(document: &Yaml<'_>, context: &ReadContext) -> Result<RigFile, FormatError> {
    let left = parse_one(
        document,
        &[
            "M1",
            "K1",
            "cameraMatrix1",
            "camera_matrix_1",
            "left_camera_matrix",
            "K_left",
            "mtxL",
            "mtx_left",
            "cameraMatrixL",
        ],
        &[
            "D1",
            "distCoeffs1",
            "dist_coeffs_1",
            "left_distortion_coefficients",
            "D_left",
            "distL",
            "dist_left",
            "distCoeffsL",
        ],
        context,
    )?;
    let right = parse_one(
        document,
        &[
            "M2",
            "K2",
            "cameraMatrix2",
            "camera_matrix_2",
            "right_camera_matrix",
            "K_right",
            "mtxR",
            "mtx_right",
            "cameraMatrixR",
        ],
        &[
            "D2",
            "distCoeffs2",
            "dist_coeffs_2",
            "right_distortion_coefficients",
            "D_right",
            "distR",
            "dist_right",
            "distCoeffsR",
        ],
        context,
    )?;
    let r = required(document, NAME, &["R", "rotation", "rotation_matrix", "Rot"])?;
    let t = required(document, NAME, &["T", "translation", "translation_vector", "Trns", "t"])?;
    Ok(RigFile { rig: StereoRig { left, right, right_from_left: pose(NAME, r, t)? }, unit: String::new() })
}

fn parse_one(
    document: &Yaml<'_>,
    matrix: &[&str],
    coefficients: &[&str],
    context: &ReadContext,
) -> Result<Camera, FormatError> {
    let m: [f64; 9] = required(document, NAME, matrix)?;
    let (width, height) = image_size(document)?.or(context.size).ok_or_else(|| no_size(NAME))?;
    let mut camera = pinhole(NAME, m, (width, height), context)?;
    let k = match get(document, coefficients) {
        None => Vec::new(),
        Some(v) => {
            numbers(v).ok_or_else(|| FormatError::corrupt(NAME, "the distortion coefficients are not numbers"))?
        }
    };
    camera.distortion = distortion(&k, projection_of(document)?)?;
    Ok(camera)
}

fn image_size(document: &Yaml<'_>) -> Result<Option<(usize, usize)>, FormatError> {
    let side = |keys: &[&str]| get(document, keys);
    if let (Some(w), Some(h)) = (
        side(&["image_width", "image_Width", "imageWidth", "width", "Image_Width"]),
        side(&["image_height", "image_Height", "imageHeight", "height", "Image_Height"]),
    ) {
        return match (size_of(w), size_of(h)) {
            (Some(w), Some(h)) => Ok(Some((w, h))),
            _ => Err(FormatError::corrupt(NAME, "the image width and height are not sizes")),
        };
    }
    match side(&["image_size", "imageSize", "img_size", "size", "Size"]).and_then(numbers).as_deref() {
        Some(&[w, h]) if w >= 1.0 && h >= 1.0 && w <= 1e6 && h <= 1e6 => Ok(Some((w as usize, h as usize))),
        Some(_) => Err(FormatError::corrupt(NAME, "the image size is not two numbers")),
        None => Ok(None),
    }
}

/// Determines the projection of the lens from a document.
fn projection_of(document: &Yaml<'_>) -> Result<LensProjection, FormatError> {
    // OpenCV's calibration sample writes its flag.
    let mut fisheye = get(document, &["fisheye_model"]).and_then(number).is_some_and(|v| v != 0.0);
    for key in ["distortion_model", "camera_model", "model_type", "model"] {
        let Some(name) = get(document, &[key]).and_then(|m| m.as_str()) else { continue };
        match projection(&name.to_lowercase()) {
            Some(projection) => fisheye |= projection == LensProjection::Fisheye,
            // “model” may be the camera's product name.
            None if key == "model" => {}
            None => {
                let known: Vec<&str> =
                    DistortionModel::ALL.iter().filter_map(|m| m.info().ros).chain(FISHEYE_NAMES).collect();
                let what = format!("the {key} {name} (it is pinhole or one of {})", known.join(", "));
                return Err(FormatError::unsupported(NAME, what));
            }
        }
    }
    Ok(if fisheye { LensProjection::Fisheye } else { LensProjection::Perspective })
}

/// Further names in use besides ROS's and Kalibr's.
const FISHEYE_NAMES: [&str; 2] = ["fisheye", "kannala_brandt"];
const PERSPECTIVE_NAMES: [&str; 9] =
    ["", "pinhole", "perspective", "opencv", "standard", "brown", "brown_conrady", "rational", "thin_prism"];

/// Maps a model's name to its projection.
fn projection(name: &str) -> Option<LensProjection> {
    let named = DistortionModel::ALL.iter().map(|m| m.info()).find(|i| [i.ros, i.kalibr].contains(&Some(name)));
    match named {
        Some(info) => Some(info.projection),
        None if FISHEYE_NAMES.contains(&name) => Some(LensProjection::Fisheye),
        None => PERSPECTIVE_NAMES.contains(&name).then_some(LensProjection::Perspective),
    }
}

/// Iterates over the lens models whose parameters are OpenCV's coefficients.
fn lenses(projection: LensProjection) -> impl Iterator<Item = DistortionModel> {
    DistortionModel::ALL.iter().copied().filter(move |m| m.info().opencv && m.info().projection == projection)
}

/// Converts OpenCV's coefficients, whose number determines the model. Simplified to a smaller model where coefficients are zero: OpenCV's
/// samples write fourteen zeros for a pinhole.
fn distortion(k: &[f64], projection: LensProjection) -> Result<Distortion, FormatError> {
    if k.iter().all(|v| *v == 0.0) && projection == LensProjection::Perspective {
        return Ok(Distortion::NONE);
    }
    // The tilted model's fourteen coefficients are the thin prism's twelve and two tilt angles.
    let max_count = lenses(projection).map(|m| m.parameter_count()).max().unwrap_or(0);
    let (known, tilt) = k.split_at(k.len().min(max_count));
    if tilt.iter().any(|v| *v != 0.0) {
        return Err(FormatError::unsupported(NAME, format!("a lens with {} coefficients", k.len())));
    }
    let lens = lenses(projection).find(|m| m.parameter_count() == known.len());
    match lens.map(|lens| Distortion::new(lens, known)) {
        Some(Ok(distortion)) => Ok(distortion.simplified()),
        _ => {
            let counts: Vec<String> = lenses(projection).map(|m| m.parameter_count().to_string()).collect();
            let kind = if projection == LensProjection::Fisheye { "a fisheye" } else { "a lens" };
            let reason = format!("{kind} has {} coefficients, not {}", counts.join(" or "), k.len());
            Err(FormatError::corrupt(NAME, reason))
        }
    }
}

fn camera_text(camera: &Camera, notes: &[&str]) -> Result<String, FormatError> {
    let mut text = format!("%YAML:1.0\n---\n{}", comments(notes));
    let _ = writeln!(text, "image_width: {}\nimage_height: {}", camera.width, camera.height);
    push_lens(&mut text, camera, ["camera_matrix", "distortion_coefficients"])?;
    push_projection(&mut text, camera);
    Ok(text)
}

fn rig_text(file: &RigFile, notes: &[&str]) -> Result<String, FormatError> {
    let StereoRig { left, right, right_from_left } = &file.rig;
    let (size, other) = ((left.width, left.height), (right.width, right.height));
    let kind = |camera: &Camera| camera.distortion.model().info().projection;
    if size != other || kind(left) != kind(right) {
        let what = "a rig of two cameras of different sizes, or of a fisheye and another lens".to_owned();
        return Err(FormatError::NotRepresentable { format: NAME, what });
    }
    let mut text = format!("%YAML:1.0\n---\n{}", comments(notes));
    let _ = writeln!(text, "image_width: {}\nimage_height: {}", left.width, left.height);
    push_lens(&mut text, left, ["M1", "D1"])?;
    push_lens(&mut text, right, ["M2", "D2"])?;
    push_matrix(&mut text, "R", 3, right_from_left.rotation.matrix().transpose().as_slice());
    push_matrix(&mut text, "T", 1, right_from_left.translation.as_slice());
    push_projection(&mut text, left);
    Ok(text)
}

/// Writes the flag of OpenCV's calibration sample for a fisheye.
fn push_projection(text: &mut String, camera: &Camera) {
    if camera.distortion.model().info().projection == LensProjection::Fisheye {
        text.push_str("fisheye_model: 1\n");
    }
}

fn push_lens(text: &mut String, camera: &Camera, [matrix, coefficients]: [&str; 2]) -> Result<(), FormatError> {
    let distortion = simplest_distortion(camera, NAME, lenses(camera.distortion.model().info().projection))?;
    push_matrix(text, matrix, 3, camera.matrix().transpose().as_slice());
    push_matrix(text, coefficients, 1, distortion.parameters());
    Ok(())
}

fn push_matrix(text: &mut String, name: &str, columns: usize, values: &[f64]) {
    let rows = values.len() / columns;
    let _ =
        writeln!(text, "{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: {values:?}");
}
