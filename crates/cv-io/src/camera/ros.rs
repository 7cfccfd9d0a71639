//! Camera files of ROS's `camera_info_manager`. Read as OpenCV's, with the same keys.

use std::fmt::Write as _;

use cv_core::{Camera, DistortionModel};

use super::format::{Format, comments, simplest_distortion};
use super::opencv;
use crate::FormatError;

const NAME: &str = "ROS";

pub(super) const FORMAT: Format = Format {
    name: "ros",
    // Detected as OpenCV's format.
    matches: |_| false,
    camera: opencv::FORMAT.camera,
    rig: None,
    camera_text: Some(camera_text),
    rig_text: None,
    array: None,
    array_text: None,
};

fn camera_text(camera: &Camera, notes: &[&str]) -> Result<String, FormatError> {
    let known = DistortionModel::ALL.iter().copied().filter(|m| m.info().ros.is_some());
    let distortion = simplest_distortion(camera, NAME, known)?;
    let model = distortion.model().info().ros.unwrap_or_default();
    let mut text = comments(notes);
    let _ = writeln!(text, "image_width: {}\nimage_height: {}\ncamera_name: camera", camera.width, camera.height);
    let mut matrix = |name: &str, rows: usize, columns: usize, data: &[f64]| {
        let _ = writeln!(text, "{name}:\n  rows: {rows}\n  cols: {columns}\n  data: {data:?}");
    };
    let Camera { fx, fy, cx, cy, .. } = *camera;
    matrix("camera_matrix", 3, 3, &[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]);
    matrix("distortion_coefficients", 1, distortion.parameters().len(), distortion.parameters());
    matrix("rectification_matrix", 3, 3, &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
    matrix("projection_matrix", 3, 4, &[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]);
    let _ = writeln!(text, "distortion_model: {model}");
    Ok(text)
}
