//! Calibration files of every format.

use cv_core::{Camera, Distortion, DistortionModel, LensProjection, Point2, Pose, Rotation3, StereoRig, Vector3};
use cv_io::{
    ArrayCamera, CalibrationFormat, CameraArray, FormatError, RigFile, parse_camera, parse_camera_array, parse_rig,
    read_camera, read_rig, write_camera, write_rig,
};
use proptest::prelude::*;

/// As OpenCV 5's FileStorage writes it.
const OPENCV: &str = "%YAML 1.2
---
calibration_time: now
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 532.79999999999995, 0., 342.5, 0., 532.89999999999998,
       233.90000000000001, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -0.28000000000000003, 0.040000000000000001, 0.001,
       -0.00020000000000000001, 0.10000000000000001 ]
avg_reprojection_error: .Nan
";

fn example() -> Camera {
    Camera {
        distortion: Distortion::radial_tangential5([-0.28, 0.04, 0.001, -0.0002, 0.1]),
        ..Camera::pinhole(640, 480, 532.8, 532.9, 342.5, 233.9)
    }
}

#[test]
fn opencv_yaml_old_and_new() {
    assert_eq!(parse_camera(OPENCV, None).unwrap(), example());
    let old = OPENCV.replace("%YAML 1.2", "%YAML:1.0").replace("camera_matrix", "Camera_Matrix");
    assert_eq!(parse_camera(&old, Some((1, 1))).unwrap(), example());
}

#[test]
fn opencv_samples_without_a_size_use_the_image_size() {
    let text = "%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 500., 0., 320., 0., 500., 240., 0., 0., 1. ]\n";
    assert_eq!(parse_camera(text, Some((640, 480))).unwrap(), Camera::pinhole(640, 480, 500.0, 500.0, 320.0, 240.0));
    assert!(parse_camera(text, None).unwrap_err().to_string().contains("image size"));
}

#[test]
fn ros_camera_info() {
    let text = "image_width: 640\nimage_height: 480\ncamera_name: left\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [500, 0, 320, 0, 501, 240, 0, 0, 1]\ndistortion_model: equidistant\ndistortion_coefficients:\n  rows: 1\n  cols: 4\n  data: [0.1, 0.2, 0.3, 0.4]\n";
    let camera = parse_camera(text, None).unwrap();
    assert_eq!(camera.distortion, Distortion::fisheye4([0.1, 0.2, 0.3, 0.4]));
    assert_eq!((camera.fx, camera.fy, camera.cx, camera.cy), (500.0, 501.0, 320.0, 240.0));
}

#[test]
fn colmap_pixel_centers_are_converted() {
    let expected = Camera {
        distortion: Distortion::simple_radial(-0.16196),
        ..Camera::pinhole(2832, 2128, 2973.319797, 2973.319797, 1415.5, 1063.5)
    };
    for text in [
        "# world-to-camera poses by COLMAP (SIFT)\n# camera: SIMPLE_RADIAL 2832x2128 params 2973.319797 1416.000000 1064.000000 -0.161960 (pixel centers at +0.5)\n# name qw\nA.JPG 1 0 0 0\n",
        "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 SIMPLE_RADIAL 2832 2128 2973.319797 1416 1064 -0.16196\n",
        "SIMPLE_RADIAL 2832 2128 2973.319797 1416 1064 -0.16196",
    ] {
        assert_eq!(parse_camera(text, None).unwrap(), expected, "{text}");
    }
    let error = parse_camera("SIMPLE_RADIAL 2832 2128 2973.3 1416 1064", None).unwrap_err().to_string();
    assert!(error.contains("3 parameters"), "{error}");
    let error = parse_camera("1 THIN_PRISM_FISHEYE 9 9 1 1 1 1 1 1 1 1 1 1 1 1", None).unwrap_err().to_string();
    assert!(error.contains("THIN_PRISM_FISHEYE") && error.contains("OPENCV_FISHEYE"), "{error}");
}

#[test]
fn the_number_of_opencv_coefficients_determines_the_model() {
    let text = |k: &[f64], more: &str| {
        format!(
            "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\nK: [500, 0, 320, 0, 501, 240, 0, 0, 1]\nD: {k:?}\n{more}"
        )
    };
    let k: [f64; 12] = std::array::from_fn(|i| 0.01 * (i + 1) as f64);
    let read = |n: usize, more: &str| parse_camera(&text(&k[..n], more), None).map(|c| c.distortion);
    for (n, model) in [
        (4, DistortionModel::RadialTangential4),
        (5, DistortionModel::RadialTangential5),
        (8, DistortionModel::Rational8),
        (12, DistortionModel::ThinPrism12),
    ] {
        assert_eq!(read(n, "").unwrap(), Distortion::new(model, &k[..n]).unwrap());
    }
    let fisheye = Distortion::new(DistortionModel::Fisheye4, &k[..4]).unwrap();
    for more in ["fisheye_model: 1", "distortion_model: equidistant", "camera_model: fisheye"] {
        assert_eq!(read(4, more).unwrap(), fisheye, "{more}");
    }
    // A fisheye with zero coefficients is not a pinhole.
    assert_eq!(
        parse_camera(&text(&[0.0; 4], "fisheye_model: 1"), None).unwrap().distortion,
        Distortion::fisheye4([0.0; 4])
    );
    assert_eq!(parse_camera(&text(&[0.0; 5], ""), None).unwrap().distortion, Distortion::NONE);
    for n in [1, 3, 6, 7, 9] {
        let error = read(n, "").unwrap_err().to_string();
        assert!(error.contains("4 or 5 or 8 or 12 coefficients, not"), "{n}: {error}");
    }
    assert!(read(5, "fisheye_model: 1").is_err());
}

#[test]
fn colmap_models_map_to_lens_models() {
    let colmap = CalibrationFormat::from_name("colmap").unwrap();
    // As in COLMAP's `models.h`: focal lengths, principal point, parameters.
    for (line, distortion) in [
        ("SIMPLE_PINHOLE 9 9 5 4 4", Distortion::NONE),
        ("PINHOLE 9 9 5 6 4 4", Distortion::NONE),
        ("SIMPLE_RADIAL 9 9 5 4 4 0.1", Distortion::simple_radial(0.1)),
        ("RADIAL 9 9 5 4 4 0.1 0.2", Distortion::radial(0.1, 0.2)),
        ("OPENCV 9 9 5 6 4 4 0.1 0.2 0.3 0.4", Distortion::radial_tangential4([0.1, 0.2, 0.3, 0.4])),
        (
            "FULL_OPENCV 9 9 5 6 4 4 0.1 0.2 0.3 0.4 0.5 0.6 0.7 0.8",
            Distortion::rational8([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8]),
        ),
        ("SIMPLE_RADIAL_FISHEYE 9 9 5 4 4 0.1", Distortion::fisheye4([0.1, 0.0, 0.0, 0.0])),
        ("RADIAL_FISHEYE 9 9 5 4 4 0.1 0.2", Distortion::fisheye4([0.1, 0.2, 0.0, 0.0])),
        ("OPENCV_FISHEYE 9 9 5 6 4 4 0.1 0.2 0.3 0.4", Distortion::fisheye4([0.1, 0.2, 0.3, 0.4])),
    ] {
        let camera = parse_camera(line, None).unwrap();
        let fy = if line.contains(" 5 6 ") { 6.0 } else { 5.0 };
        assert_eq!(camera, Camera { distortion, ..Camera::pinhole(9, 9, 5.0, fy, 3.5, 3.5) });
        // The same model is the one with the fewest parameters that represents it.
        assert_eq!(colmap.camera_text(&camera, &[]).unwrap().lines().last().unwrap(), format!("1 {line}"));
        let [first, .., last] = line.split(' ').collect::<Vec<_>>()[..] else { unreachable!() };
        assert!(parse_camera(&format!("{line} {last}"), None).unwrap_err().to_string().contains(first));
    }
    let prism = Camera { distortion: Distortion::thin_prism12([0.1; 12]), ..Camera::from_focal(9, 9, 5.0) };
    assert!(matches!(colmap.camera_text(&prism, &[]), Err(FormatError::NotRepresentable { .. })));
}

#[test]
fn a_kalibr_camchain_is_a_rig() {
    // The example of Kalibr's documentation, with irrelevant entries.
    let text = "cam0:\n  cam_overlaps: [1]\n  camera_model: pinhole\n  distortion_coeffs: [-0.28, 0.07, 0.0001, 0.00001]\n  distortion_model: radtan\n  intrinsics: [458.6, 457.2, 367.2, 248.3]\n  resolution: [752, 480]\n  rostopic: /cam0/image_raw\ncam1:\n  T_cn_cnm1:\n  - [1.0, 0.0, 0.0, -0.11]\n  - [0.0, 1.0, 0.0, 0.001]\n  - [0.0, 0.0, 1.0, 0.002]\n  - [0.0, 0.0, 0.0, 1.0]\n  camera_model: pinhole\n  distortion_coeffs: [-0.01, 0.02, -0.03, 0.01]\n  distortion_model: equidistant\n  intrinsics: [457.5, 456.1, 379.9, 255.2]\n  resolution: [752, 480]\n";
    let file = parse_rig(text, None).unwrap();
    let left = Camera {
        distortion: Distortion::radial_tangential4([-0.28, 0.07, 0.0001, 0.00001]),
        ..Camera::pinhole(752, 480, 458.6, 457.2, 367.2, 248.3)
    };
    assert_eq!(file.rig.left, left);
    assert_eq!(parse_camera(text, None).unwrap(), left);
    assert_eq!(file.rig.right.distortion, Distortion::fisheye4([-0.01, 0.02, -0.03, 0.01]));
    assert_eq!(file.rig.right_from_left, Pose::new(Rotation3::identity(), Vector3::new(-0.11, 0.001, 0.002)));
    assert_eq!(file.unit, "m");
    for (from, to, word) in [
        ("radtan", "fov", "fov"),
        ("pinhole", "omni", "omni"),
        ("0.0, 0.0, 0.0, 1.0]", "0.0, 0.0, 0.1, 1.0]", "last row"),
        ("- [1.0, 0.0", "- [2.0, 0.0", "rotation"),
        ("resolution: [752, 480]", "resolution: [752]", "resolution"),
        ("[-0.28, 0.07, 0.0001, 0.00001]", "[-0.28, 0.07]", "4 parameters, not 2"),
        ("cam1:", "cam2:", "cam1"),
    ] {
        let error = parse_rig(&text.replace(from, to), None).unwrap_err().to_string();
        assert!(error.contains(word), "{to}: {error}");
    }
    let millimeters = RigFile { unit: "mm".to_owned(), ..file };
    let kalibr = CalibrationFormat::from_name("kalibr").unwrap();
    assert!(matches!(kalibr.rig_text(&millimeters, &[]), Err(FormatError::NotRepresentable { .. })));
}

#[test]
fn bare_matrices() {
    let k = "2905.88 0 1416 \n0 2905.88 1064\n0 0 1";
    assert_eq!(
        parse_camera(k, Some((2832, 2128))).unwrap(),
        Camera::pinhole(2832, 2128, 2905.88, 2905.88, 1416.0, 1064.0)
    );
    assert!(parse_camera("[[1, 0, 2], [0, 1, 2], [0, 0, 1]]", Some((4, 4))).is_ok());
    assert!(parse_camera("1 0.5 2 0 1 2 0 0 1", Some((4, 4))).unwrap_err().to_string().contains("skew"));
    assert!(parse_camera("1 0 2 0 1 2 0 3 1", Some((4, 4))).is_err());
    assert!(parse_camera("-1 0 2 0 1 2 0 0 1", Some((4, 4))).is_err());
}

#[test]
fn a_stereo_rig_of_opencv() {
    let matrix = |name: &str, rows: usize, cols: usize, data: &str| {
        format!("{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]\n")
    };
    let k = "500., 0., 320., 0., 500., 240., 0., 0., 1.";
    let text = format!(
        "%YAML:1.0\n---\n{}{}{}{}{}{}",
        matrix("M1", 3, 3, k),
        matrix("D1", 1, 14, "0.1, 0., 0., 0., 0., 0., 0., 0., 0., 0., 0., 0., 0., 0."),
        matrix("M2", 3, 3, k),
        matrix("D2", 1, 5, "0., 0., 0., 0., 0."),
        matrix("R", 3, 3, "1., 0., 0., 0., 1., 0., 0., 0., 1."),
        matrix("T", 3, 1, "-3.3, 0.1, 0.2")
    );
    let file = parse_rig(&text, Some((640, 480))).unwrap();
    assert_eq!(file.rig.left.distortion, Distortion::simple_radial(0.1));
    assert_eq!(file.rig.right.distortion, Distortion::NONE);
    assert_eq!(file.rig.right_from_left, Pose::new(Rotation3::identity(), Vector3::new(-3.3, 0.1, 0.2)));
    let rational = text.replace("0.1, 0., 0., 0., 0., 0., 0.", "0.1, 0., 0., 0., 0., 0.5, 0.");
    let expected = Distortion::rational8([0.1, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0]);
    assert_eq!(parse_rig(&rational, Some((640, 480))).unwrap().rig.left.distortion, expected);
    let tilted = text.replace("0., 0., 0. ]\nM2", "0., 0.1, 0. ]\nM2");
    assert!(parse_rig(&tilted, Some((640, 480))).unwrap_err().to_string().contains("14 coefficients"));
    let bent =
        text.replace("data: [ 1., 0., 0., 0., 1., 0., 0., 0., 1. ]", "data: [ 2., 0., 0., 0., 1., 0., 0., 0., 1. ]");
    assert!(parse_rig(&bent, Some((640, 480))).unwrap_err().to_string().contains("rotation"));
    let missing = text.replace("T: !!", "Q: !!");
    assert!(parse_rig(&missing, Some((640, 480))).unwrap_err().to_string().contains("no T"));
}

#[test]
fn invalid_entries_are_reported() {
    let good = "schema: cv-camera/1\nwidth: 4\nheight: 3\nfx: 5\nfy: 5\ncx: 1.5\ncy: 1\n";
    assert_eq!(parse_camera(good, None).unwrap(), Camera::pinhole(4, 3, 5.0, 5.0, 1.5, 1.0));
    for (from, to, word) in [
        ("fx: 5", "f: 5", "“f”"),
        ("fx: 5\n", "", "fx"),
        ("fx: 5", "fx: five", "fx is not a number"),
        ("fx: 5", "fx: -5", "focal"),
        ("fx: 5", "fx: .inf", "focal"),
        ("cx: 1.5", "cx: .nan", "finite"),
        ("width: 4", "width: 4.5", "width"),
        ("width: 4", "width: 99999999999", "width"),
        ("cv-camera/1", "cv-camera/9", "cv-camera/9"),
        ("cy: 1\n", "cy: 1\ndistortion: radial\n", "2 coefficients, not 0"),
        ("cy: 1\n", "cy: 1\ndistortion: odd\n", "“odd”"),
        ("cy: 1\n", "cy: [1\n", "YAML"),
    ] {
        let text = good.replace(from, to);
        let error = parse_camera(&text, None).unwrap_err().to_string();
        assert!(error.contains(word), "{to:?}: {error}");
    }
    assert!(parse_camera(&good.replace("cy: 1\n", "cy: 1\nx-serial: 17\n"), None).is_ok());
}

#[test]
fn malicious_yaml_is_refused() {
    let deep = format!("%YAML:1.0\n---\na: {}", "[".repeat(200_000));
    let blocks = format!("%YAML:1.0\n---\n{}x", "- ".repeat(200_000));
    let marks = format!("%YAML:1.0\n---\n{}x", "? ".repeat(200_000));
    let laughs = "%YAML:1.0\n---\na: &a [x,x,x,x,x,x,x,x,x]\nb: &b [*a,*a,*a,*a,*a,*a,*a,*a,*a]\nc: &c [*b,*b,*b,*b,*b,*b,*b,*b,*b]\nd: &d [*c,*c,*c,*c,*c,*c,*c,*c,*c]\ne: &e [*d,*d,*d,*d,*d,*d,*d,*d,*d]\nK: [*e,*e,*e,*e,*e,*e,*e,*e,*e]\n";
    let stairs: String = (0..3000).map(|i| format!("{}a:\n", " ".repeat(i))).collect();
    for text in [&deep[..], &blocks, &marks, laughs, &stairs] {
        assert!(parse_camera(text, None).is_err());
    }
}

fn distortions() -> impl Strategy<Value = Distortion> {
    let k = prop::num::f64::NORMAL | prop::num::f64::ZERO;
    (0..DistortionModel::ALL.len(), prop::array::uniform12(k)).prop_map(|(i, k)| {
        let model = DistortionModel::ALL[i];
        Distortion::new(model, &k[..model.parameter_count()]).unwrap()
    })
}

prop_compose! {
    fn cameras()(
        w in 1usize..9000,
        h in 1usize..9000,
        f in 1e-3..1e6f64,
        a in 0.5..2.0f64,
        cx in -1e4..1e4f64,
        cy in -1e4..1e4f64,
        distortion in distortions(),
    ) -> Camera {
        Camera { width: w, height: h, fx: f, fy: f * a, cx, cy, distortion }
    }
}

#[test]
fn only_our_own_format_and_kalibr_support_three_cameras() {
    let camera = Camera {
        distortion: Distortion::radial_tangential4([-0.2, 0.05, 0.001, 0.0]),
        ..Camera::from_focal(640, 480, 500.0)
    };
    let mount = |turn: f64, x: f64| {
        Pose::new(Rotation3::from_euler_angles(0.0, turn, 0.01 * x), Vector3::new(x, 0.002, 0.1 * turn))
    };
    let one = |name: &str, camera, from_first| ArrayCamera { name: name.to_owned(), camera, from_first };
    let cameras = vec![
        one("left", camera, Pose::identity()),
        one("mid", Camera { cx: 300.5, ..camera }, mount(0.1, -0.25)),
        one("far \"3\"", camera, mount(-0.2, -0.5)),
    ];
    let file = CameraArray { cameras, unit: "m".to_owned() };
    let mut supporting = Vec::new();
    for format in CalibrationFormat::all().filter(|f| f.writes_rigs()) {
        let text = match format.array_text(&file, &["three"]) {
            Ok(text) => text,
            Err(error) => {
                assert!(error.to_string().contains("a rig of 3 cameras, which own and kalibr hold"), "{error}");
                continue;
            }
        };
        supporting.push(format.name());
        let back = parse_camera_array(&text).unwrap();
        assert_eq!(back.unit, "m");
        for (a, b) in back.cameras.iter().zip(&file.cameras) {
            assert_eq!(a.camera, b.camera);
            // Kalibr's motions are from one camera to the next: products of two rotations and lengths below one.
            assert!((a.from_first.matrix() - b.from_first.matrix()).norm() < 1e-14, "{text}");
        }
        // A stereo rig is the first two.
        let pair = parse_rig(&text, None).unwrap().rig;
        assert!((pair.right_from_left.matrix() - file.cameras[1].from_first.matrix()).norm() < 1e-14);
    }
    assert_eq!(supporting, ["own", "kalibr"]);
    let millimeters = CameraArray { unit: "mm".to_owned(), ..file.clone() };
    let kalibr = CalibrationFormat::from_name("kalibr").unwrap();
    assert!(kalibr.array_text(&millimeters, &[]).unwrap_err().to_string().contains("unit is mm"));
    let own = CalibrationFormat::OWN.array_text(&file, &[]).unwrap();
    for (from, to) in [
        ("translation: [0.0, 0.0, 0.0]", "translation: [0.0, 0.5, 0.0]"),
        ("name: \"mid\"", "nick: mid"),
        ("cameras:", "kameras:"),
    ] {
        assert!(own.contains(from) && parse_camera_array(&own.replacen(from, to, 1)).is_err(), "{to}");
    }
}

proptest! {
    #[test]
    fn cameras_round_trip_exactly(camera in cameras(), note in ".*") {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("camera.yaml");
        write_camera(&path, &camera, &[&note]).unwrap();
        prop_assert_eq!(read_camera(&path, None).unwrap(), camera);
    }

    #[test]
    fn rigs_round_trip_exactly(
        left in cameras(),
        right in cameras(),
        r in prop::array::uniform3(-3.0..3.0f64),
        t in prop::array::uniform3(-1e3..1e3f64),
        unit in ".*",
    ) {
        let right_from_left = Pose::new(Rotation3::from_euler_angles(r[0], r[1], r[2]), Vector3::from(t));
        let file = RigFile { rig: StereoRig { left, right, right_from_left }, unit: "squares".into() };
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.yaml");
        write_rig(&path, &file, &["a note"]).unwrap();
        prop_assert_eq!(read_rig(&path, None).unwrap(), file.clone());
        // Any unit at all still gives a file that reads.
        write_rig(&path, &RigFile { unit, ..file.clone() }, &[]).unwrap();
        prop_assert_eq!(read_rig(&path, None).unwrap().rig, file.rig);
    }

    #[test]
    fn every_format_round_trips_the_lens(camera in cameras(), other in cameras(), r in prop::array::uniform3(-3.0..3.0f64)) {
        for format in CalibrationFormat::all().filter(|f| f.writes_cameras()) {
            let Ok(text) = format.camera_text(&camera, &["a note: 1"]) else {
                // No model of the format is this lens.
                let info = camera.distortion.model().info();
                let known = match format.name() {
                    "colmap" => info.opencv && info.name != "thin_prism12",
                    "kalibr" => info.kalibr.is_some(),
                    "mrcal" => info.projection == LensProjection::Perspective,
                    "ros" => info.ros.is_some(),
                    _ => true,
                };
                prop_assert!(!known, "{} {}", format.name(), info.name);
                continue;
            };
            let back = parse_camera(&text, None).unwrap();
            prop_assert_eq!(back.distortion.simplified(), camera.distortion.simplified(), "{}", text);
            prop_assert_eq!((back.width, back.height, back.fx, back.fy), (camera.width, camera.height, camera.fx, camera.fy));
            // COLMAP's half pixel costs the last bits of a number up to 10⁴.
            prop_assert!((Point2::new(back.cx, back.cy) - Point2::new(camera.cx, camera.cy)).norm() < 1e-11);
        }
        let right = Camera { width: camera.width, height: camera.height, ..other };
        let right_from_left = Pose::new(Rotation3::from_euler_angles(r[0], r[1], r[2]), Vector3::x());
        let file = RigFile { rig: StereoRig { left: camera, right, right_from_left }, unit: String::new() };
        for format in CalibrationFormat::all().filter(|f| f.writes_rigs()) {
            let Ok(text) = format.rig_text(&file, &[]) else {
                let projections = [camera, right].map(|c| c.distortion.model().info().projection);
                let mixed = format.name().starts_with("opencv") && projections[0] != projections[1];
                prop_assert!(mixed || format.name() == "kalibr" && [camera, right].iter().any(|c| format.camera_text(c, &[]).is_err()));
                continue;
            };
            let back = parse_rig(&text, None).unwrap();
            prop_assert_eq!(back.rig.right_from_left, file.rig.right_from_left);
            prop_assert_eq!(back.rig.right.distortion.simplified(), right.distortion.simplified());
        }
    }
}

#[test]
fn mrcal_files_are_parsed() {
    let text = "{\n    'lensmodel':  'LENSMODEL_OPENCV8',\n\n    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n    \
        'intrinsics': [ 1761.181055, 1761.250444, 1965.706996, 1087.518797, -0.01266096516, 0.03590794372, -0.0002547045941, 0.0005275929652, \
        0.01968883397, 0.01482863541, -0.0562239888, 0.0500223357,],\n    # extrinsics are rt_fromref\n    'extrinsics': [ 2e-2, -3e-1, -1e-2,  1., 2, -3., ],\n    \
        'imagersize': [ 4000, 2200,],\n}\n";
    let camera = parse_camera(text, None).unwrap();
    assert_eq!((camera.width, camera.height, camera.fx), (4000, 2200, 1761.181055));
    assert_eq!(camera.distortion.parameters()[7], 0.0500223357);
    for (from, to) in
        [("OPENCV8", "OPENCV5"), ("OPENCV8", "SPLINED_STEREOGRAPHIC"), ("4000,", "4000.5,"), ("imagersize", "size")]
    {
        assert!(parse_camera(&text.replace(from, to), None).is_err(), "{to}");
    }
}

const OPENCV_XML: &str = "<?xml version=\"1.0\"?>\n<opencv_storage>\n<calibration_time>\"Mon 01 Jan 2024\"</calibration_time>\n\
    <!-- a <comment> -->\n<image_width>640</image_width>\n<image_height>480</image_height>\n\
    <camera_matrix type_id=\"opencv-matrix\">\n  <rows>3</rows>\n  <cols>3</cols>\n  <dt>d</dt>\n  <data>\n    5.3e+02 0. 3.425e+02 0. 5.31e+02\n    2.33e+02 0. 0. 1.</data></camera_matrix>\n\
    <distortion_coefficients type_id=\"opencv-matrix\">\n  <rows>5</rows>\n  <cols>1</cols>\n  <dt>d</dt>\n  <data>\n    -0.28 0.06 1e-3 -2e-4 0.1</data></distortion_coefficients>\n\
    <avg_reprojection_error>0.2</avg_reprojection_error>\n</opencv_storage>\n";

#[test]
fn opencv_xml_files_are_parsed() {
    let camera = parse_camera(OPENCV_XML, None).unwrap();
    assert_eq!((camera.width, camera.height, camera.fx, camera.cy), (640, 480, 530.0, 233.0));
    assert_eq!(camera.distortion.parameters(), [-0.28, 0.06, 1e-3, -2e-4, 0.1]);
}

#[test]
fn malformed_files_and_entity_bombs_are_refused() {
    let bomb = OPENCV_XML.replacen("<opencv_storage>", "<!DOCTYPE a [<!ENTITY b \"c\">]><opencv_storage>", 1);
    assert!(matches!(parse_camera(&bomb, None), Err(FormatError::Unsupported { .. })));
    for (from, to) in [("</data>", ""), ("<rows>3</rows>", ""), ("5.3e+02 ", ""), ("opencv_storage", "storage")] {
        assert!(parse_camera(&OPENCV_XML.replace(from, to), None).is_err(), "{from}");
    }
    for cut in 1..OPENCV_XML.len() {
        // Truncation never panics.
        let _ = parse_camera(OPENCV_XML.get(..cut).unwrap_or_default(), None);
    }
}
