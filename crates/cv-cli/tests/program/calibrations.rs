//! Cameras and rigs in the file formats of other programs.

use crate::support::{Ran, json, refused, run, strs};
use cv_core::RgbU8;
use serde_json::Value;
use std::{fs, path::Path};

/// Returns matches of points in two cameras with a baseline of 0.1, 640×480 px and a focal length of 500 px.
fn write_matches(folder: &Path) {
    let view = |[x, y, z]: [f64; 3]| (500.0 * x / z + 320.0, 500.0 * y / z + 240.0);
    let row = |i: u32| {
        let [a, b, c] = [37, 53, 71].map(|step| f64::from(i * step % 97) / 97.0 - 0.5);
        let ((x, y), (u, v)) = (view([a, b, 2.0 + c]), view([a - 0.1, b + 0.02, 2.0 + c]));
        format!("{x} {y} {u} {v}\n")
    };
    fs::write(folder.join("m.txt"), (0..60).map(row).collect::<String>()).unwrap();
}

/// Returns the message of `cv estimate` for a camera file.
fn estimate(folder: &Path, camera: &str, more: &[&str]) -> Ran {
    fs::write(folder.join("camera.txt"), camera).unwrap();
    run(folder, &[&["estimate", "essential", "--matches", "m.txt", "--camera", "camera.txt"], more].concat())
}

const KALIBR: &str = "cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.002, 0.0001, 0.0002]
  distortion_model: radtan
  intrinsics: [150.0, 150.0, 99.5, 74.5]
  resolution: [200, 150]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.12]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.01, 0.002, 0.0001, 0.0002]
  distortion_model: radtan
  intrinsics: [150.0, 150.0, 99.5, 74.5]
  resolution: [200, 150]
  rostopic: /cam1/image_raw
";

fn opencv_matrix(name: &str, rows: usize, data: &[f64]) -> String {
    let cols = data.len() / rows;
    format!("{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: {data:?}\n")
}

/// Returns OpenCV's `intrinsics.yml` and `extrinsics.yml` with a rational lens.
fn opencv_files() -> [String; 2] {
    let k = [150.0, 0.0, 99.5, 0.0, 150.0, 74.5, 0.0, 0.0, 1.0];
    let d = [0.1, -0.05, 0.0, 0.0, 0.01, 0.12, -0.04, 0.01];
    let intrinsics = ["M1", "D1", "M2", "D2"].into_iter().map(|name| match name.starts_with('M') {
        true => opencv_matrix(name, 3, &k),
        false => opencv_matrix(name, 1, &d),
    });
    let one = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let extrinsics =
        [opencv_matrix("R", 3, &one), opencv_matrix("T", 3, &[-0.12, 0.0, 0.0]), opencv_matrix("R1", 3, &one)];
    let head = "%YAML:1.0\n---\n";
    [format!("{head}{}", intrinsics.collect::<String>()), format!("{head}{}", extrinsics.concat())]
}

/// Rectifies a small pair with rig files of these contents.
fn rectify_args(folder: &Path, files: &[&str]) -> Vec<String> {
    let photo = RgbU8::from_fn(200, 150, |x, y| [((x / 7 * 37 + y / 5 * 91) % 251) as u8; 3]);
    cv_io::write_png(folder.join("left.png"), photo.view()).unwrap();
    cv_io::write_png(folder.join("right.png"), photo.view()).unwrap();
    let mut args = ["rectify", "left.png", "right.png", "-o", "out"].map(str::to_owned).to_vec();
    for (i, text) in files.iter().enumerate() {
        fs::write(folder.join(format!("rig{i}.yml")), text).unwrap();
        args.extend(["--rig".to_owned(), format!("rig{i}.yml")]);
    }
    args
}

fn rectified(files: &[&str]) -> Value {
    let folder = tempfile::tempdir().unwrap();
    // Images without features: the calibration cannot be checked.
    json(folder.path(), &strs(&rectify_args(folder.path(), files)))
}

#[test]
fn rigs_of_kalibr_and_opencv_in_two_files_are_read() {
    let [intrinsics, extrinsics] = opencv_files();
    let both = rectified(&[&intrinsics, &extrinsics]);
    let kalibr = rectified(&[KALIBR]);
    for value in [&both, &kalibr] {
        assert!((value["baseline"].as_f64().unwrap() - 0.12).abs() < 1e-9, "{value}");
        assert_eq!((value["width"].as_u64(), value["height"].as_u64()), (Some(200), Some(150)));
    }
    // The files in the other order and merged into one give the same rig.
    for files in [&[&extrinsics[..], &intrinsics][..], &[&format!("{intrinsics}{}", &extrinsics[14..])]] {
        let value = rectified(files);
        assert_eq!((&value["q"], &value["focal_px"]), (&both["q"], &both["focal_px"]));
    }
    // All eight coefficients are used.
    let plain = intrinsics.replace("0.12, -0.04, 0.01]", "0.0, 0.0, 0.0]");
    assert_ne!(rectified(&[&plain, &extrinsics])["focal_px"], both["focal_px"]);
}

#[test]
fn an_incomplete_opencv_rig_names_the_missing_file() {
    let [intrinsics, extrinsics] = opencv_files();
    for half in [&intrinsics, &extrinsics] {
        let folder = tempfile::tempdir().unwrap();
        let ran = refused(folder.path(), &strs(&rectify_args(folder.path(), &[half])));
        assert!(ran.stderr.contains("there is no ") && ran.stderr.contains("--rig extrinsics.yml"), "{ran:?}");
    }
    let folder = tempfile::tempdir().unwrap();
    let ran = run(folder.path(), &strs(&rectify_args(folder.path(), &[&intrinsics, &extrinsics, &extrinsics])));
    assert!(ran.code == Some(2) && ran.stderr.contains("3 times"), "{ran:?}");
}

#[test]
fn a_bare_matrix_takes_the_size_of_the_photographs_and_only_a_small_skew() {
    let folder = tempfile::tempdir().unwrap();
    write_matches(folder.path());
    let size = ["--size", "640x480"];
    let k = |skew: &str| format!("500 {skew} 320\n0 500 240\n0 0 1\n");
    let ran = estimate(folder.path(), &k("0"), &size);
    assert!(ran.code == Some(0) && !ran.stderr.contains("skew"), "{ran:?}");
    // 240 rows from the principal point: 0.1 · 240 / 500 = 0.048 px.
    let ran = estimate(folder.path(), &k("0.1"), &size);
    assert!(ran.code == Some(0) && ran.stderr.contains("skew of 0.1 px is ignored"), "{ran:?}");
    assert!(ran.stderr.contains("0.048 px"), "{ran:?}");
    let ran = estimate(folder.path(), &k("2.5"), &size);
    assert!(ran.code == Some(1) && ran.stderr.contains("skew of 2.5") && ran.stderr.contains("1.20 px"), "{ran:?}");
    // Matches do not have an image size.
    let ran = estimate(folder.path(), &k("0"), &[]);
    assert!(ran.code == Some(1) && ran.stderr.contains("--size 640x480"), "{ran:?}");
    // Photographs do.
    let photo = RgbU8::new(640, 480, [90; 3]);
    for name in ["a.png", "b.png"] {
        cv_io::write_png(folder.path().join(name), photo.view()).unwrap();
    }
    let ran = refused(folder.path(), &["reconstruct", "a.png", "b.png", "--camera", "camera.txt", "-o", "c.ply"]);
    assert!(ran.stderr.contains("features") && !ran.stderr.contains("size"), "{ran:?}");
}

#[test]
fn an_unknown_lens_model_is_refused_with_the_list_of_known_ones() {
    let folder = tempfile::tempdir().unwrap();
    write_matches(folder.path());
    let size = ["--size", "640x480"];
    let ros = |model: &str| {
        format!(
            "image_width: 640\nimage_height: 480\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [500, 0, 320, 0, 500, 240, 0, 0, 1]\n\
             distortion_model: {model}\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [0, 0, 0, 0, 0]\n"
        )
    };
    assert_eq!(estimate(folder.path(), &ros("plumb_bob"), &[]).code, Some(0));
    let own = "schema: cv-camera/1\nwidth: 640\nheight: 480\nfx: 500\nfy: 500\ncx: 320\ncy: 240\ndistortion: fov\n";
    for (file, unknown, known) in [
        (ros("double_sphere"), "double_sphere", "plumb_bob"),
        (KALIBR.replace("radtan", "fov"), "fov", "equidistant"),
        (KALIBR.replace("pinhole", "omni"), "omni", "pinhole"),
        ("1 FOV 640 480 500 500 320 240 0.9\n".to_owned(), "FOV", "SIMPLE_RADIAL"),
        (own.to_owned(), "fov", "rational8"),
    ] {
        let ran = estimate(folder.path(), &file, &size);
        assert!(ran.code == Some(1) && ran.stderr.contains(unknown) && ran.stderr.contains(known), "{ran:?}");
    }
}
