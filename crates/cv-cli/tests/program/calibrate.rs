//! `cv calibrate`, `cv undistort` and `cv calibration` as a black box. The guides test their ordinary use.

use crate::support::{done, json, refused, run};
use cv_core::{GrayU8, RgbU8};
use std::fs;

#[test]
fn photographs_without_a_board_are_refused_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let gray = GrayU8::new(160, 120, [90]);
    for name in ["a1.png", "a2.png", "b1.png"] {
        cv_io::write_png(folder.path().join(name), gray.view()).unwrap();
    }
    let mono = refused(folder.path(), &["calibrate", "mono", "a1.png", "a2.png", "-o", "out/cam.yaml"]);
    assert!(mono.stderr.contains("no board was detected on any of 2 photographs"), "{}", mono.stderr);
    let stereo = ["calibrate", "stereo", "--left", "a1.png", "a2.png", "--right", "b1.png", "-o", "out/rig.yaml"];
    assert!(refused(folder.path(), &stereo).stderr.contains("no board"));
    assert!(!folder.path().join("out").exists());
    fs::write(folder.path().join("bad.png"), "no image").unwrap();
    let bad = refused(folder.path(), &["calibrate", "mono", "a1.png", "bad.png", "-o", "cam.yaml"]);
    assert!(bad.stderr.contains("bad.png"), "{}", bad.stderr);
    for wrong in [["--board", "9"], ["--board", "2x2"], ["--square", "-1"], ["--lens", "round"], ["--outliers", "1"]] {
        let args = [&["calibrate", "mono", "a1.png", "-o", "cam.yaml"], &wrong[..]].concat();
        assert_ne!(run(folder.path(), &args).code, Some(0), "{wrong:?}");
    }
}

#[test]
fn a_camera_round_trips_through_every_format_and_undistorts() {
    let folder = tempfile::tempdir().unwrap();
    let camera = "schema: cv-camera/1\nwidth: 160\nheight: 120\nfx: 130.25\nfy: 131\ncx: 80\ncy: 59.5\n\
                  distortion: radial_tangential4\ncoefficients: [-0.2, 0.05, 0.001, -0.002]\n";
    fs::write(folder.path().join("cam.yaml"), camera).unwrap();
    let shown = |file: &str| json(folder.path(), &["calibration", "show", file])["camera"].clone();
    let truth = shown("cam.yaml");
    assert_eq!((truth["fx"].as_f64(), truth["lens"].as_str()), (Some(130.25), Some("radial_tangential4")));
    for (format, file) in [
        ("own", "own.yaml"),
        ("opencv", "cv.yml"),
        ("opencv-xml", "cv.xml"),
        ("ros", "ros.yaml"),
        ("kalibr", "chain.yaml"),
        ("colmap", "cameras.txt"),
        ("mrcal", "cam.cameramodel"),
    ] {
        done(folder.path(), &["calibration", "convert", "cam.yaml", "-o", file, "--format", format]);
        assert_eq!(shown(file), truth, "{format}");
    }
    let photo = RgbU8::from_fn(160, 120, |x, y| [(x * 3 % 256) as u8, (y * 2) as u8, 128]);
    cv_io::write_png(folder.path().join("photo.png"), photo.view()).unwrap();
    let done =
        json(folder.path(), &["undistort", "photo.png", "--camera", "cam.yaml", "-o", "straight", "--alpha", "0"]);
    assert_eq!(done["width"], 160);
    let straight = cv_io::read_rgb(folder.path().join("straight/photo.png")).unwrap();
    // A constant image: blue is the same at every pixel, and black where the lens has no ray.
    assert!(straight.size() == (160, 120) && straight.as_slice().chunks(3).all(|p| p[2].abs_diff(128) <= 1));
    // The undistorted camera has no distortion.
    assert_eq!(shown("straight/camera.yaml")["lens"], "none");
    let again = run(folder.path(), &["undistort", "photo.png", "--camera", "cam.yaml", "-o", "."]);
    assert_eq!(again.code, Some(1), "{}", again.stderr);
}

#[test]
fn boards_are_drawn_deterministically_in_every_format() {
    let folder = tempfile::tempdir().unwrap();
    let draw = |file: &str, more: &[&str]| {
        let args = [&["board", "-o", file, "--board", "9x6", "--square", "20"], more].concat();
        let told = json(folder.path(), &args);
        assert_eq!((told["points"].as_u64(), told["options"].as_str()), (Some(54), Some("--board 9x6 --square 20")));
        fs::read(folder.path().join(file)).unwrap()
    };
    for (file, begins) in [("a.pdf", &b"%PDF-1.4"[..]), ("a.svg", b"<svg "), ("a.png", b"\x89PNG")] {
        let first = draw(file, &[]);
        assert!(first.starts_with(begins) && first == draw(file, &[]), "{file}");
    }
    // The pHYs chunk: 11811 dots per meter in both directions.
    let png = draw("a.png", &["--paper", "letter"]);
    let at = png.windows(4).position(|w| w == b"pHYs").unwrap();
    assert_eq!(png[at + 4..at + 13], [0, 0, 0x2e, 0x23, 0, 0, 0x2e, 0x23, 1]);
    let large = refused(folder.path(), &["board", "-o", "b.pdf", "--board", "9x6", "--square", "40"]);
    assert!(large.stderr.contains("--square 25.4 at most"), "{}", large.stderr);
    for wrong in [&["--kind", "charuco"][..], &["--dpi", "300"], &["--marker", "3"], &["--paper", "a9"]] {
        let args = [&["board", "-o", "c.pdf", "--board", "9x6", "--square", "20"], wrong].concat();
        assert_eq!(run(folder.path(), &args).code, Some(2), "{wrong:?}");
    }
    assert!(!folder.path().join("b.pdf").exists() && !folder.path().join("c.pdf").exists());
}

#[test]
fn a_board_sheet_or_a_single_camera_is_refused_as_a_rig() {
    let folder = tempfile::tempdir().unwrap();
    let board = ["--kind", "aprilgrid", "--board", "3x2", "--marker", "40"];
    done(folder.path(), &[&["board", "-o", "1.png", "--dpi", "60"], &board[..]].concat());
    let rig = [&["calibrate", "rig", "-o", "rig.yaml", "--cameras", "1.png", "1.png", "1.png"], &board[..]].concat();
    // The board is detected in all three photographs, and the single view is too few.
    let said = refused(folder.path(), &rig).stderr;
    assert!(said.contains("on 1 photograph, 3 are needed"), "{said}");
    let one = [&["calibrate", "rig", "-o", "rig.yaml", "--cameras", "1.png"], &board[..]].concat();
    assert_eq!(run(folder.path(), &one).code, Some(2));
}
