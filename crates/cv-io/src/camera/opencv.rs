//! Cameras and rigs as OpenCV's programs and ROS write them.
//!
//! There is no one naming: each list below holds the names seen in OpenCV's samples and tutorials, ROS's `camera_info`,
//! and the answers people copy from.

use cv_core::{Camera, Distortion, StereoRig};
use saphyr::Yaml;

use super::yaml::{get, number, numbers, pose, required, size_of};
use super::{RigFile, from_matrix, no_size};
use crate::FormatError;

const NAME: &str = "OpenCV YAML";
const MATRIX: [&str; 11] = [
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
const COEFFICIENTS: [&str; 12] = [
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

pub(super) fn camera(document: &Yaml<'_>, size: Option<(usize, usize)>) -> Result<Camera, FormatError> {
    let mut names: Vec<&str> = MATRIX.to_vec();
    names.extend(["cameraMatrix1", "camera_matrix_1", "left_camera_matrix"]);
    one(document, &names, &COEFFICIENTS, size)
}

pub(super) fn rig(document: &Yaml<'_>, size: Option<(usize, usize)>) -> Result<RigFile, FormatError> {
    let left = one(
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
        size,
    )?;
    let right = one(
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
        size,
    )?;
    let r = required(document, NAME, &["R", "rotation", "rotation_matrix", "Rot"])?;
    let t = required(document, NAME, &["T", "translation", "translation_vector", "Trns", "t"])?;
    Ok(RigFile { rig: StereoRig { left, right, right_from_left: pose(NAME, r, t)? }, unit: String::new() })
}

fn one(
    document: &Yaml<'_>,
    matrix: &[&str],
    coefficients: &[&str],
    size: Option<(usize, usize)>,
) -> Result<Camera, FormatError> {
    let m: [f64; 9] = required(document, NAME, matrix)?;
    let (width, height) = image_size(document)?.or(size).ok_or_else(|| no_size(NAME))?;
    let mut camera = from_matrix(NAME, m, width, height)?;
    let k = match get(document, coefficients) {
        None => Vec::new(),
        Some(v) => {
            numbers(v).ok_or_else(|| FormatError::corrupt(NAME, "the distortion coefficients are not numbers"))?
        }
    };
    let model = get(document, &["distortion_model", "camera_model", "model"]).and_then(|m| m.as_str()).unwrap_or("");
    let fisheye = ["fisheye", "equidistant", "kannala_brandt"].contains(&model.to_lowercase().as_str())
        // OpenCV's calibration sample writes its flag.
        || get(document, &["fisheye_model"]).and_then(number).is_some_and(|v| v != 0.0);
    camera.distortion = distortion(&k, fisheye)?;
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
            _ => Err(FormatError::corrupt(NAME, "the picture's width and height are not sizes")),
        };
    }
    match side(&["image_size", "imageSize", "img_size", "size", "Size"]).and_then(numbers).as_deref() {
        Some(&[w, h]) if w >= 1.0 && h >= 1.0 && w <= 1e6 && h <= 1e6 => Ok(Some((w as usize, h as usize))),
        Some(_) => Err(FormatError::corrupt(NAME, "the picture's size is not two numbers")),
        None => Ok(None),
    }
}

/// OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 τx τy; for a fisheye k1 k2 k3 k4.
fn distortion(k: &[f64], fisheye: bool) -> Result<Distortion, FormatError> {
    if k.iter().all(|v| *v == 0.0) {
        return Ok(Distortion::None);
    }
    if fisheye {
        return match *k {
            [k1, k2, k3, k4] => Ok(Distortion::Fisheye { k1, k2, k3, k4 }),
            _ => Err(FormatError::corrupt(NAME, format!("a fisheye has four coefficients, not {}", k.len()))),
        };
    }
    let (main, rest) = k.split_at(k.len().min(5));
    if rest.iter().any(|v| *v != 0.0) {
        return Err(FormatError::unsupported(NAME, "a rational, thin prism or tilted lens model"));
    }
    match *main {
        [k1, k2, p1, p2] => Ok(Distortion::BrownConrady { k1, k2, p1, p2, k3: 0.0 }),
        [k1, k2, p1, p2, k3] => Ok(Distortion::BrownConrady { k1, k2, p1, p2, k3 }),
        _ => Err(FormatError::corrupt(
            NAME,
            format!("{} distortion coefficients (4, 5, 8, 12 or 14 are usual)", k.len()),
        )),
    }
}
