//! `cv calibrate`, `cv undistort` and `cv calibration` from outside. What they do when all is well the guides show.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod support;

use cv_core::{GrayU8, RgbU8};
use std::fs;
use support::{json, refused, run};

#[test]
fn what_is_no_board_is_said_to_be_none_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let gray = GrayU8::new(160, 120, [90]);
    for name in ["a1.png", "a2.png", "b1.png"] {
        cv_io::write_png(folder.path().join(name), gray.view()).unwrap();
    }
    let mono = refused(folder.path(), &["calibrate", "mono", "a1.png", "a2.png", "-o", "out/cam.yaml"]);
    assert!(mono.stderr.contains("no board was found on any of 2 photographs"), "{}", mono.stderr);
    let stereo = ["calibrate", "stereo", "--left", "a1.png", "a2.png", "--right", "b1.png", "-o", "out/rig.yaml"];
    assert!(refused(folder.path(), &stereo).stderr.contains("no board"));
    assert!(!folder.path().join("out").exists());
    fs::write(folder.path().join("bad.png"), "no picture").unwrap();
    let bad = refused(folder.path(), &["calibrate", "mono", "a1.png", "bad.png", "-o", "cam.yaml"]);
    assert!(bad.stderr.contains("bad.png"), "{}", bad.stderr);
    for wrong in [["--board", "9"], ["--board", "2x2"], ["--square", "-1"], ["--lens", "round"], ["--outliers", "1"]] {
        let args = [&["calibrate", "mono", "a1.png", "-o", "cam.yaml"], &wrong[..]].concat();
        assert_ne!(run(folder.path(), &args).code, Some(0), "{wrong:?}");
    }
}

#[test]
fn a_camera_goes_through_every_format_and_takes_the_lens_out() {
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
        support::done(folder.path(), &["calibration", "convert", "cam.yaml", "-o", file, "--format", format]);
        assert_eq!(shown(file), truth, "{format}");
    }
    let photo = RgbU8::from_fn(160, 120, |x, y| [(x * 3 % 256) as u8, (y * 2) as u8, 128]);
    cv_io::write_png(folder.path().join("photo.png"), photo.view()).unwrap();
    let done =
        json(folder.path(), &["undistort", "photo.png", "--camera", "cam.yaml", "-o", "straight", "--alpha", "0"]);
    assert_eq!(done["width"], 160);
    let straight = cv_io::read_rgb(folder.path().join("straight/photo.png")).unwrap();
    // Every pixel shows something: blue is the same everywhere, and black where the lens does not reach.
    assert!(straight.size() == (160, 120) && straight.as_slice().chunks(3).all(|p| p[2].abs_diff(128) <= 1));
    // Its camera has no lens to take out.
    assert_eq!(shown("straight/camera.yaml")["lens"], "none");
    let again = run(folder.path(), &["undistort", "photo.png", "--camera", "cam.yaml", "-o", "."]);
    assert_eq!(again.code, Some(1), "{}", again.stderr);
}
