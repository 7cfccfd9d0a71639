//! `cv rectify` from outside.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod support;

use cv_core::{Camera, Pose, Rotation3, StereoRig, Vector3};
use cv_io::RigFile;
use cv_synth::{RenderOptions, Scene, render};
use support::{json, refused, snapshot};

/// Two photographs of a room by a rig whose second camera is turned by a degree or so, and the rig's file.
fn rig(vertical: bool) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene::room(4);
    let camera = Camera::from_focal(320, 240, 280.0);
    let first = scene.viewpoint();
    let turn = Rotation3::from_euler_angles(0.015, -0.02, 0.01);
    let aside = if vertical { Vector3::new(0.0, 0.25, 0.0) } else { Vector3::new(0.25, 0.0, 0.0) };
    let relative = Pose::new(turn, -(turn * aside));
    let second =
        Pose::new(relative.rotation * first.rotation, relative.rotation * first.translation + relative.translation);
    for (name, pose) in [("a.png", first), ("b.png", second)] {
        let view = render(&scene, &camera, &pose, &RenderOptions::default()).unwrap();
        cv_io::write_png(folder.path().join(name), view.image.view()).unwrap();
    }
    let write = |name: &str, relative: Pose| {
        let rig = StereoRig { left: camera, right: camera, right_from_left: relative };
        cv_io::write_rig(folder.path().join(name), &RigFile { rig, unit: "m".to_owned() }, &[]).unwrap();
    };
    write("rig.yaml", relative);
    write("exchanged.yaml", Pose::new(turn, turn * aside));
    write("none.yaml", Pose::new(turn, Vector3::zeros()));
    folder
}

#[test]
fn a_turned_rig_is_rectified_with_a_printed_quality() {
    for vertical in [false, true] {
        let folder = rig(vertical);
        let run = |more: &[&str]| {
            json(folder.path(), &[&["rectify", "a.png", "b.png", "--rig", "rig.yaml", "--out", "out"], more].concat())
        };
        let tight = run(&[]);
        assert_eq!(tight["vertical"], vertical);
        // Features are placed to a few tenths of a pixel; the turn alone moves rows by several pixels.
        assert!(tight["vertical_residual_px"]["median"].as_f64().unwrap() < 0.5, "{tight}");
        assert_eq!(tight["valid_area"]["left"], 1.0, "{tight}");
        let wide = run(&["--alpha", "1", "--size", "400x300"]);
        assert!(wide["valid_area"]["left"].as_f64().unwrap() < 1.0, "{wide}");
        assert_eq!((wide["width"].as_u64(), wide["height"].as_u64()), (Some(400), Some(300)));
        let mut names: Vec<_> =
            std::fs::read_dir(folder.path().join("out")).unwrap().map(|e| e.unwrap().file_name()).collect();
        names.sort();
        assert_eq!(names, ["left.png", "q.txt", "rig.yaml", "right.png"]);
        assert_eq!(cv_io::read_rgb(folder.path().join("out/right.png")).unwrap().size(), (400, 300));
    }
}

#[test]
fn rigs_that_are_none_are_refused_and_nothing_is_written() {
    let folder = rig(false);
    let refuse = |rig: &str, more: &[&str]| {
        refused(folder.path(), &[&["rectify", "a.png", "b.png", "--rig", rig, "--out", "out"], more].concat()).stderr
    };
    assert!(refuse("exchanged.yaml", &[]).contains("exchange the two"));
    let none = refuse("none.yaml", &[]);
    assert!(none.contains("zero"), "{none}");
    assert!(refuse("rig.yaml", &["--alpha", "2"]).contains("alpha"));
    assert!(!folder.path().join("out").exists());
    // One of four files cannot be written: none is.
    std::fs::create_dir_all(folder.path().join("out/rig.yaml")).unwrap();
    assert!(refuse("rig.yaml", &[]).contains("is a folder"));
    assert_eq!(std::fs::read_dir(folder.path().join("out")).unwrap().count(), 1);
}

#[test]
fn what_is_read_is_never_written_over() {
    let folder = rig(false);
    std::fs::rename(folder.path().join("a.png"), folder.path().join("left.png")).unwrap();
    std::fs::create_dir(folder.path().join("calibration")).unwrap();
    std::fs::copy(folder.path().join("rig.yaml"), folder.path().join("calibration/rig.yaml")).unwrap();
    let before = snapshot(folder.path());
    // The photograph in the folder itself; the calibration by another way to its folder.
    for (left, rig, out, named) in [
        ("left.png", "none.yaml", ".", "left.png"),
        ("b.png", "calibration/rig.yaml", "./calibration/../calibration", "rig.yaml"),
    ] {
        let ran = refused(folder.path(), &["rectify", left, "b.png", "--rig", rig, "--out", out]);
        assert!(ran.stderr.contains(named) && ran.stderr.contains("would be written over"), "{ran:?}");
    }
    assert!(snapshot(folder.path()) == before);
}
