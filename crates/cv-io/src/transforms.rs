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

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Distortion, ModelImage, Point3, Pose, Vector3};
    use saphyr::{LoadableYamlNode, Yaml};

    /// Two images: from (1, 2, 3), looking along the world's X with the world's Z up, and from the origin with the world's axes.
    fn model() -> SparseModel {
        let pose = Pose::look_at(Point3::new(1.0, 2.0, 3.0), Point3::new(6.0, 2.0, 3.0), -Vector3::z()).unwrap();
        let image = |name: &str, pose| ModelImage { name: name.into(), camera: 1, pose, points: vec![] };
        let camera = Camera {
            distortion: Distortion::simple_radial(-0.1),
            ..Camera::pinhole(640, 480, 500.0, 501.0, 319.5, 239.25)
        };
        SparseModel {
            cameras: [(1, camera)].into(),
            images: [(1, image("a \"1\".jpg", pose)), (2, image("b.jpg", Pose::identity()))].into(),
            ..SparseModel::default()
        }
    }

    /// JSON is YAML.
    fn parsed(model: &SparseModel, folder: &str) -> Yaml<'static> {
        let text = transforms_json(model, folder).unwrap();
        Yaml::load_from_str(&text.leak()[..]).unwrap().remove(0)
    }

    fn number(yaml: &Yaml<'_>) -> f64 {
        yaml.as_floating_point().or_else(|| yaml.as_integer().map(|i| i as f64)).unwrap()
    }

    #[test]
    fn poses_have_opengls_camera_axes() {
        let json = parsed(&model(), "images/");
        assert_eq!(json["camera_model"].as_str(), Some("OPENCV"));
        let values = ["w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"].map(|key| number(&json[key]));
        assert_eq!(values, [640.0, 480.0, 500.0, 501.0, 320.0, 239.75, -0.1, 0.0, 0.0, 0.0]);
        let frame = &json["frames"][0];
        assert_eq!(frame["file_path"].as_str(), Some("images/a \"1\".jpg"));
        assert!(frame.as_mapping_get("fl_x").is_none());
        // Right is the world's −Y, up its Z, and back, opposite to the viewing direction, its −X.
        let expected = [[0.0, 0.0, -1.0, 1.0], [-1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]];
        for (r, row) in expected.iter().enumerate() {
            for (c, value) in row.iter().enumerate() {
                // A rotation there and back: the last bits.
                assert!((number(&frame["transform_matrix"][r][c]) - value).abs() < 1e-14, "{r} {c} {frame:?}");
            }
        }
        let second = &json["frames"][1]["transform_matrix"];
        assert_eq!([0, 1, 2].map(|i| number(&second[i][i])), [1.0, -1.0, -1.0]);
    }

    #[test]
    fn different_cameras_are_written_per_frame() {
        let mut several = model();
        several.cameras.insert(9, Camera::from_focal(320, 240, 250.0));
        assert!(
            transforms_json(&several, "").unwrap().find("fl_x") < transforms_json(&several, "").unwrap().find("frames")
        );
        several.images.get_mut(&2).unwrap().camera = 9;
        let json = parsed(&several, "");
        assert!(json.as_mapping_get("fl_x").is_none());
        assert_eq!((number(&json["frames"][0]["fl_x"]), number(&json["frames"][1]["fl_x"])), (500.0, 250.0));
        assert_eq!((number(&json["frames"][0]["k1"]), number(&json["frames"][1]["k1"])), (-0.1, 0.0));
    }

    #[test]
    fn unsupported_lenses_and_missing_cameras_are_refused() {
        let with = |distortion| {
            let mut model = model();
            model.cameras.get_mut(&1).unwrap().distortion = distortion;
            transforms_json(&model, "")
        };
        let fisheye = with(Distortion::new(DistortionModel::Fisheye4, &[0.1, 0.2, 0.3, 0.4]).unwrap()).unwrap();
        assert!(fisheye.contains("OPENCV_FISHEYE") && fisheye.contains("\"k4\": 0.4"), "{fisheye}");
        // The format has no k3.
        assert!(with(Distortion::radial_tangential5([0.1, 0.0, 0.0, 0.0, 0.0])).is_ok());
        let error = with(Distortion::radial_tangential5([0.1, 0.0, 0.0, 0.0, 0.2])).unwrap_err();
        assert!(matches!(error, FormatError::NotRepresentable { .. }), "{error}");
        let mut model = model();
        model.images.get_mut(&2).unwrap().camera = 5;
        assert!(transforms_json(&model, "").unwrap_err().to_string().contains("camera 5"));
    }
}
