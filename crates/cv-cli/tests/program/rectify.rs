//! `cv rectify` as a black box.

use crate::support::{done, json, refused, run, snapshot};
use cv_core::{Camera, Pose, Rotation3, StereoRig, Vector3};
use cv_io::RigFile;
use cv_synth::{RenderOptions, Scene, render};

/// Renders two photographs of a room by a rig with a second camera rotated by about a degree, and writes the rig's file.
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
        cv_io::pfm::write(folder.path().join(name).with_extension("pfm"), view.depth.view()).unwrap();
    }
    let write = |name: &str, relative: Pose| {
        let rig = StereoRig { left: camera, right: camera, right_from_left: relative };
        cv_io::write_rig(folder.path().join(name), &RigFile { rig, unit: "m".to_owned() }, &[]).unwrap();
    };
    write("rig.yaml", relative);
    write("exchanged.yaml", relative.inverse());
    write("none.yaml", Pose::new(turn, Vector3::zeros()));
    folder
}

#[test]
fn a_rotated_rig_is_rectified_and_its_quality_printed() {
    for vertical in [false, true] {
        let folder = rig(vertical);
        let run = |more: &[&str]| {
            json(folder.path(), &[&["rectify", "a.png", "b.png", "--rig", "rig.yaml", "--out", "out"], more].concat())
        };
        let tight = run(&[]);
        assert_eq!(tight["vertical"], vertical);
        // Features are localized to a few tenths of a pixel; the rotation alone moves rows by several pixels.
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
fn invalid_rigs_are_refused_and_nothing_is_written() {
    let folder = rig(false);
    let refuse = |rig: &str, more: &[&str]| {
        refused(folder.path(), &[&["rectify", "a.png", "b.png", "--rig", rig, "--out", "out"], more].concat()).stderr
    };
    assert!(refuse("exchanged.yaml", &[]).contains("left of the first: they are exchanged"));
    assert!(refuse("exchanged.yaml", &[]).contains("and --exchange"));
    assert!(refuse("rig.yaml", &["--exchange"]).contains("leave out --exchange"));
    let none = refuse("none.yaml", &[]);
    assert!(none.contains("zero"), "{none}");
    for more in [["--alpha", "2"], ["--alpha", "nan"], ["--size", "640"]] {
        let ran = run(
            folder.path(),
            &[&["rectify", "a.png", "b.png", "--rig", "rig.yaml", "--out", "out"], &more[..]].concat(),
        );
        assert!(ran.code == Some(2) && ran.stderr.contains(more[0]), "{ran:?}");
    }
    // The message names the photograph, and the missing entry of an incomplete calibration.
    cv_io::write_png(folder.path().join("small.png"), cv_core::RgbU8::new(160, 120, [90; 3]).view()).unwrap();
    for command in [["rectify", "a.png", "small.png", "--out", "out"], ["depth", "a.png", "small.png", "-o", "d.pfm"]] {
        let small = refused(folder.path(), &[&command[..], &["--rig", "rig.yaml"]].concat()).stderr;
        assert!(small.contains("small.png is 160×120 px") && small.contains("320×240"), "{small}");
        std::fs::write(folder.path().join("part.yml"), "%YAML:1.0\n---\nM1: [9, 0, 1, 0, 9, 1, 0, 0, 1]\n").unwrap();
        let part = refused(folder.path(), &[&command[..], &["--rig", "part.yml"]].concat()).stderr;
        assert!(part.contains("there is no M2") && part.contains("cv rectify --help"), "{part}");
    }
    assert!(!folder.path().join("out").exists());
    // One of four files cannot be written: none is.
    std::fs::create_dir_all(folder.path().join("out/rig.yaml")).unwrap();
    assert!(refuse("rig.yaml", &[]).contains("is a folder"));
    assert_eq!(std::fs::read_dir(folder.path().join("out")).unwrap().count(), 1);
}

#[test]
fn inputs_are_never_overwritten() {
    let folder = rig(false);
    std::fs::rename(folder.path().join("a.png"), folder.path().join("left.png")).unwrap();
    std::fs::create_dir(folder.path().join("calibration")).unwrap();
    std::fs::copy(folder.path().join("rig.yaml"), folder.path().join("calibration/rig.yaml")).unwrap();
    let before = snapshot(folder.path());
    // The input photograph as output; the calibration by another path to its folder.
    for (left, rig, out, named) in [
        ("left.png", "none.yaml", ".", "left.png"),
        ("b.png", "calibration/rig.yaml", "./calibration/../calibration", "rig.yaml"),
    ] {
        let ran = refused(folder.path(), &["rectify", left, "b.png", "--rig", rig, "--out", out]);
        assert!(ran.stderr.contains(named) && ran.stderr.contains("would be overwritten"), "{ran:?}");
    }
    assert!(snapshot(folder.path()) == before);
}

#[test]
fn photographs_inconsistent_with_the_rig_and_without_features_have_different_errors() {
    for vertical in [false, true] {
        let folder = rig(vertical);
        let rectify = |a: &str, b: &str| {
            let ran = run(folder.path(), &["rectify", a, b, "--rig", "rig.yaml", "--out", "out", "--json"]);
            (ran.code, serde_json::from_str::<serde_json::Value>(&ran.stdout).unwrap(), ran.stderr)
        };
        // Swapped photographs: the rotation of the cameras moves rows in the opposite direction, by more than twice its five pixels.
        let (code, value, stderr) = rectify("b.png", "a.png");
        assert_eq!(code, Some(1));
        assert!(stderr.contains("vertical disparity of features") && stderr.contains("in its order"), "{stderr}");
        assert!(value["vertical_residual_px"].is_null() && value["fault"].is_string(), "{value}");
        // No features: no evidence against the calibration.
        cv_io::write_png(folder.path().join("flat.png"), cv_core::RgbU8::new(320, 240, [90; 3]).view()).unwrap();
        let (code, value, _) = rectify("flat.png", "flat.png");
        assert!(code == Some(0) && value["vertical_residual_px"].is_null() && value["fault"].is_null(), "{value}");
    }
    // A rig without rotation, its photographs swapped: rows agree, disparities are negative.
    let folder = rig(false);
    let straight = Pose::new(Rotation3::identity(), Vector3::new(-0.25, 0.0, 0.0));
    let camera = Camera::from_focal(320, 240, 280.0);
    let file =
        RigFile { rig: StereoRig { left: camera, right: camera, right_from_left: straight }, unit: String::new() };
    cv_io::write_rig(folder.path().join("straight.yaml"), &file, &[]).unwrap();
    done(folder.path(), &["rectify", "a.png", "b.png", "--rig", "rig.yaml", "--out", "out"]);
    let ran = refused(
        folder.path(),
        &["rectify", "out/right.png", "out/left.png", "--rig", "straight.yaml", "--out", "again"],
    );
    assert!(ran.stderr.contains("left and right are exchanged"), "{ran:?}");
}

#[test]
fn the_rig_file_in_the_help_is_valid() {
    let folder = rig(false);
    let help = done(folder.path(), &["rectify", "--help"]).stdout;
    let file: Vec<&str> = help
        .lines()
        .skip_while(|l| !l.starts_with("Our rig file"))
        .skip(1)
        .take_while(|l| l.starts_with("  "))
        .collect();
    std::fs::write(folder.path().join("help.yaml"), file.join("\n").replace("\n  ", "\n").trim_start()).unwrap();
    let ran = refused(folder.path(), &["rectify", "a.png", "b.png", "--rig", "help.yaml", "--out", "out"]);
    // A valid rig of another image size.
    assert!(ran.stderr.contains("calibrated for 640×480 px"), "{ran:?}");
}

/// Reads the positions of a binary PLY of colored points.
fn positions(path: &std::path::Path) -> Vec<[f64; 3]> {
    let bytes = std::fs::read(path).unwrap();
    let header = b"end_header\n";
    let start = bytes.windows(header.len()).position(|w| w == header).unwrap() + header.len();
    let points: Vec<[f64; 3]> = bytes[start..]
        .chunks_exact(15)
        .map(|p| [0, 4, 8].map(|i| f64::from(f32::from_le_bytes([p[i], p[i + 1], p[i + 2], p[i + 3]]))))
        .collect();
    assert!(points.len() * 15 == bytes.len() - start);
    points
}

#[test]
fn depth_by_a_rig_is_accurate_in_the_left_camera_frame() {
    let camera = Camera::from_focal(320, 240, 280.0);
    for vertical in [false, true] {
        let folder = rig(vertical);
        let truth = cv_io::pfm::read(folder.path().join("a.pfm")).unwrap();
        // In the file's order, and with a file in the other order.
        for more in [&["--rig", "rig.yaml"][..], &["--rig", "exchanged.yaml", "--exchange"]] {
            let args =
                ["depth", "a.png", "b.png", "-o", "d.pfm", "--cloud", "c.ply", "--disparities", "64", "--no-fill"];
            let ran = done(folder.path(), &[&args, more].concat());
            assert_eq!(ran.stderr.contains("the rig is vertical"), vertical, "{ran:?}");
            let points = positions(&folder.path().join("c.ply"));
            let right = points.iter().filter(|[x, y, z]| {
                let p = camera.project(&cv_core::Point3::new(*x, *y, *z)).unwrap();
                let (x, y) = (p.x.round(), p.y.round());
                let seen = x >= 0.0 && y >= 0.0 && x < 320.0 && y < 240.0;
                // A disparity is accurate to half a pixel, at fifteen pixels and more in this scene.
                seen && (f64::from(truth.at(x as usize, y as usize)[0]) - z).abs() < 0.04 * z
            });
            // The rest are pixels beside depth discontinuities.
            let share = right.count() as f64 / points.len() as f64;
            assert!(share > 0.9 && points.len() > 40_000, "{share} of {}", points.len());
        }
    }
}

#[test]
fn depth_by_a_rig_uses_the_full_bit_depth() {
    let folder = rig(false);
    let at = |name: &str| folder.path().join(name);
    for name in ["a", "b"] {
        // All texture is in the lower byte: rounded to 8 bits the images are constant.
        let deep = cv_io::read_rgb(at(&format!("{name}.png"))).unwrap().map(|p| p.map(|v| 0x4e00 + u16::from(v)));
        cv_io::write_png(at(&format!("{name}16.png")), deep.view()).unwrap();
    }
    let depth = |a: &str, b: &str| {
        let args = ["depth", a, b, "--rig", "rig.yaml", "-o", "d.pfm", "--disparities", "64", "--report", "page"];
        done(folder.path(), &[&args[..], &["--json"]].concat());
        cv_io::pfm::read(at("d.pfm")).unwrap()
    };
    let (bytes, deep) = (depth("a.png", "b.png"), depth("a16.png", "b16.png"));
    let near = bytes.as_slice().iter().zip(deep.as_slice()).filter(|(a, b)| (**a - **b).abs() < 1.0).count();
    // The intensities are 1/257 of the original ones, so that adaptive penalties and edge-preserving smoothing differ, and with them the filling.
    assert!(near * 10 > bytes.as_slice().len() * 8, "{near} of {}", bytes.as_slice().len());
    assert!(std::fs::read_to_string(at("page/report.html")).unwrap().contains("invalid gray"));
    // The size of the rectified photographs is that of `cv rectify --size`.
    let args = ["depth", "a.png", "b.png", "--rig", "rig.yaml", "-o", "d.pfm", "--disparities", "64"];
    done(folder.path(), &[&args[..], &["--size", "200x150"]].concat());
    assert_eq!(cv_io::pfm::read(at("d.pfm")).unwrap().size(), (200, 150));
    assert_eq!(run(folder.path(), &["depth", "a.png", "b.png", "-o", "d.pfm", "--size", "200x150"]).code, Some(2));
}

#[test]
fn a_depth_png_is_in_millimeters_for_every_unit_of_the_rig() {
    let folder = rig(false);
    let at = |name: &str| folder.path().join(name);
    let in_meters = cv_io::read_rig(at("rig.yaml"), None).unwrap();
    let mut in_millimeters = RigFile { unit: "mm".to_owned(), ..in_meters };
    in_millimeters.rig.right_from_left.translation *= 1000.0;
    cv_io::write_rig(at("mm.yaml"), &in_millimeters, &[]).unwrap();
    let depth = |rig: &str| {
        let args = ["depth", "a.png", "b.png", "--rig", rig, "-o", "d.pfm", "--disparities", "64", "--depth", "z.png"];
        done(folder.path(), &args);
        cv_io::depth_mm::read(at("z.png")).unwrap()
    };
    let (m, mm) = (depth("rig.yaml"), depth("mm.yaml"));
    // Quantization to a millimeter, with rounding.
    let near = m.as_slice().iter().zip(mm.as_slice()).filter(|(a, b)| (**a - **b).abs() < 0.0015).count();
    assert!(near * 100 > m.as_slice().len() * 99, "{near} of {}", m.as_slice().len());
}
