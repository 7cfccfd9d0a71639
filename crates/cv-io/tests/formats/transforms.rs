//! Models as `transforms.json`.

use cv_core::{Camera, Distortion, DistortionModel, ModelImage, Point3, Pose, SparseModel, Vector3};
use cv_io::{FormatError, transforms_json};
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
