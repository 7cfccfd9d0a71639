//! `transforms.json`: cameras and poses as Nerfstudio and instant-ngp read them.
//!
//! Theirs is OpenGL's camera, x right, y up, looking along −z, and camera to world; the center of the top-left pixel is at (0.5, 0.5). The world
//! stays as it is: no `applied_transform`.

use std::fmt::Write as _;
use std::path::Path;

use cv_core::{Camera, DistortionModel, Matrix3, SparseModel};

use crate::camera::CENTER;
use crate::files::write_bytes;
use crate::{FormatError, IoError};

const NAME: &str = "transforms.json";

/// A lens by its name in the file, and the names of its numbers.
type Lens = (DistortionModel, &'static str, [&'static str; 4]);

/// The lenses both programs know. All pictures of a file have the same.
const LENSES: [Lens; 2] = [
    (DistortionModel::RadialTangential4, "OPENCV", ["k1", "k2", "p1", "p2"]),
    (DistortionModel::Fisheye4, "OPENCV_FISHEYE", ["k1", "k2", "k3", "k4"]),
];

/// A model's cameras and poses as the text of a `transforms.json`. `folder` stands before each picture's name, `images` say; empty: nothing does.
///
/// The intrinsics stand above the frames where one camera took all pictures, else in each frame. Points are not part of the format.
///
/// # Errors
/// [`FormatError::NotRepresentable`]: a picture whose camera is not there, a pose that is not finite, a lens beyond Brown–Conrady's first four numbers and the equidistant fisheye's four, or
/// perspective and fisheye lenses in one model.
pub fn transforms_json(model: &SparseModel, folder: &str) -> Result<String, FormatError> {
    let not = |what: String| FormatError::NotRepresentable { format: NAME, what };
    let mut used = Vec::new();
    for (id, image) in &model.images {
        if !model.cameras.contains_key(&image.camera) {
            return Err(not(format!("picture {id}, whose camera {} is not there", image.camera)));
        }
        let pose = &image.pose;
        if !pose.rotation.matrix().iter().chain(pose.translation.iter()).all(|v| v.is_finite()) {
            return Err(not(format!("picture {id}, whose pose is not finite")));
        }
        used.push(image.camera);
    }
    used.sort_unstable();
    used.dedup();
    let cameras: Vec<(u32, &Camera)> = used.iter().filter_map(|id| Some((*id, model.cameras.get(id)?))).collect();
    for (id, camera) in &cameras {
        camera.validate().map_err(|e| not(format!("camera {id}: {e}")))?;
    }
    let held =
        LENSES.iter().find(|lens| cameras.iter().all(|(_, camera)| camera.distortion.converted(lens.0).is_some()));
    let Some(lens) = held else {
        let lenses: Vec<&str> = cameras.iter().map(|(_, camera)| camera.distortion.model().info().name).collect();
        return Err(not(format!("cameras with these lenses: {}", lenses.join(", "))));
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
        // Y and Z of the camera's frame change their sign.
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

/// A string of JSON.
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

    /// Two pictures: from (1, 2, 3), which looks along the world's X with the world's Z up, and from the origin, whose axes are the world's.
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
    fn the_cameras_axes_are_those_of_opengl_in_the_world() {
        let json = parsed(&model(), "images/");
        assert_eq!(json["camera_model"].as_str(), Some("OPENCV"));
        let values = ["w", "h", "fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"].map(|key| number(&json[key]));
        assert_eq!(values, [640.0, 480.0, 500.0, 501.0, 320.0, 239.75, -0.1, 0.0, 0.0, 0.0]);
        let frame = &json["frames"][0];
        assert_eq!(frame["file_path"].as_str(), Some("images/a \"1\".jpg"));
        assert!(frame.as_mapping_get("fl_x").is_none());
        // Right is the world's −Y, up its Z, and back, against the looking direction, its −X.
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
    fn cameras_that_differ_stand_in_the_frames() {
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
    fn lenses_and_what_hangs_in_the_air() {
        let with = |distortion| {
            let mut model = model();
            model.cameras.get_mut(&1).unwrap().distortion = distortion;
            transforms_json(&model, "")
        };
        let fisheye = with(Distortion::new(DistortionModel::Fisheye4, &[0.1, 0.2, 0.3, 0.4]).unwrap()).unwrap();
        assert!(fisheye.contains("OPENCV_FISHEYE") && fisheye.contains("\"k4\": 0.4"), "{fisheye}");
        // The third radial number has no place.
        assert!(with(Distortion::radial_tangential5([0.1, 0.0, 0.0, 0.0, 0.0])).is_ok());
        let error = with(Distortion::radial_tangential5([0.1, 0.0, 0.0, 0.0, 0.2])).unwrap_err();
        assert!(matches!(error, FormatError::NotRepresentable { .. }), "{error}");
        let mut model = model();
        model.images.get_mut(&2).unwrap().camera = 5;
        assert!(transforms_json(&model, "").unwrap_err().to_string().contains("camera 5"));
    }
}
