//! `transforms.json`: cameras and poses as Nerfstudio and instant-ngp read them.
//!
//! Poses are camera to world with OpenGL's camera frame: x right, y up, looking along −z; the center of the top-left pixel is at (0.5, 0.5). The
//! world frame is unchanged: no `applied_transform`.

use std::fmt::Write as _;
use std::path::Path;

use cv_core::{Camera, DistortionModel, Matrix3, SparseModel};

use crate::camera::CENTER;
use crate::files::write_bytes;
use crate::{FormatError, IoError};

const NAME: &str = "transforms.json";

/// A lens model, its name in the file, and the names of its parameters.
type Lens = (DistortionModel, &'static str, [&'static str; 4]);

/// The lens models that both programs support. All images of a file have the same.
const LENSES: [Lens; 2] = [
    (DistortionModel::RadialTangential4, "OPENCV", ["k1", "k2", "p1", "p2"]),
    (DistortionModel::Fisheye4, "OPENCV_FISHEYE", ["k1", "k2", "k3", "k4"]),
];

/// Formats a model's cameras and poses as the text of a `transforms.json`. `folder`, such as `images`, is prepended to each image name; empty
/// for none.
///
/// The intrinsics are global where one camera took all images, else in each frame. Points are not part of the format.
///
/// # Errors
/// [`FormatError::NotRepresentable`]: an image whose camera is missing, a pose that is not finite, a lens that needs more than Brown–Conrady's k1,
/// k2, p1, p2 or the equidistant fisheye's four parameters, or perspective and fisheye lenses in one model.
pub fn transforms_json(model: &SparseModel, folder: &str) -> Result<String, FormatError> {
    let not_representable = |what: String| FormatError::NotRepresentable { format: NAME, what };
    let mut used = Vec::new();
    for (id, image) in &model.images {
        if !model.cameras.contains_key(&image.camera) {
            return Err(not_representable(format!("image {id}, whose camera {} is missing", image.camera)));
        }
        let pose = &image.pose;
        if !pose.rotation.matrix().iter().chain(pose.translation.iter()).all(|v| v.is_finite()) {
            return Err(not_representable(format!("image {id}, whose pose is not finite")));
        }
        used.push(image.camera);
    }
    used.sort_unstable();
    used.dedup();
    let cameras: Vec<(u32, &Camera)> = used.iter().filter_map(|id| Some((*id, model.cameras.get(id)?))).collect();
    for (id, camera) in &cameras {
        camera.validate().map_err(|e| not_representable(format!("camera {id}: {e}")))?;
    }
    let lens_entry =
        LENSES.iter().find(|lens| cameras.iter().all(|(_, camera)| camera.distortion.converted(lens.0).is_some()));
    let Some(lens) = lens_entry else {
        let lenses: Vec<&str> = cameras.iter().map(|(_, camera)| camera.distortion.model().info().name).collect();
        return Err(not_representable(format!("cameras with these lenses: {}", lenses.join(", "))));
    };
    let mut text = format!("{{\n  \"camera_model\": \"{}\",\n", lens.1);
    let common = if let [(_, camera)] = &cameras[..] { Some(*camera) } else { None };
    if let Some(camera) = common {
        let _ = writeln!(text, "  {},", intrinsics(camera, lens));
    }
    text.push_str("  \"frames\": [");
    for (i, image) in model.images.values().enumerate() {
        let path = if folder.is_empty() {
            image.name.clone()
        } else {
            format!("{}/{}", folder.trim_end_matches('/'), image.name)
        };
        let _ = write!(text, "{}\n    {{\"file_path\": {}, ", if i == 0 { "" } else { "," }, quoted(&path));
        if let (None, Some(camera)) = (common, model.cameras.get(&image.camera)) {
            let _ = write!(text, "{}, ", intrinsics(camera, lens));
        }
        let inverse = image.pose.inverse();
        // The Y and Z axes of the camera frame change their sign.
        let axes = inverse.rotation.matrix() * Matrix3::from_diagonal(&[1.0, -1.0, -1.0].into());
        let t = inverse.translation;
        let rows = (0..3).map(|r| format!("[{}, {}, {}, {}]", axes[(r, 0)], axes[(r, 1)], axes[(r, 2)], t[r]));
        let rows: Vec<String> = rows.chain(["[0, 0, 0, 1]".to_owned()]).collect();
        let _ = write!(text, "\"transform_matrix\": [{}]}}", rows.join(", "));
    }
    text.push_str("\n  ]\n}\n");
    Ok(text)
}

/// Writes [`transforms_json`].
///
/// # Errors
/// As there and as [`crate::write_atomic`].
pub fn write_transforms(path: impl AsRef<Path>, model: &SparseModel, folder: &str) -> Result<(), IoError> {
    let text = transforms_json(model, folder).map_err(|reason| IoError::writing(path.as_ref(), reason))?;
    write_bytes(path, text.as_bytes())
}

fn intrinsics(camera: &Camera, (model, _, names): &Lens) -> String {
    let mut text = format!(
        "\"w\": {}, \"h\": {}, \"fl_x\": {}, \"fl_y\": {}, \"cx\": {}, \"cy\": {}",
        camera.width,
        camera.height,
        camera.fx,
        camera.fy,
        camera.cx + CENTER,
        camera.cy + CENTER
    );
    if let Some(lens) = camera.distortion.converted(*model) {
        for (name, value) in names.iter().zip(lens.parameters()) {
            let _ = write!(text, ", \"{name}\": {value}");
        }
    }
    text
}

/// Quotes text as a JSON string.
fn quoted(text: &str) -> String {
    let mut quoted = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => quoted.extend(['\\', c]),
            c if c < ' ' => {
                let _ = write!(quoted, "\\u{:04x}", u32::from(c));
            }
            c => quoted.push(c),
        }
    }
    quoted.push('"');
    quoted
}
