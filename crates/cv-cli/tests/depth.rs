//! `cv depth` and `cv eval disparity` from outside.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod support;

use cv_core::{Camera, Image, RgbU8};
use cv_synth::{RenderOptions, Scene, stereo_pair};
use support::{done, json, refused, run};

/// A small generated pair and its truth as files in a new folder.
fn pair() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene::room(5);
    let camera = Camera::from_focal(240, 180, 210.0);
    let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::default()).unwrap();
    let at = |name: &str| folder.path().join(name);
    cv_io::write_png(at("left.png"), pair.left.image.view()).unwrap();
    cv_io::write_png(at("right.png"), pair.right.image.view()).unwrap();
    cv_io::pfm::write(at("truth.pfm"), pair.disparity.view()).unwrap();
    cv_io::pfm::write(at("truth_right.pfm"), pair.disparity_right.view()).unwrap();
    cv_io::pfm::write(at("depth.pfm"), pair.left.depth.view()).unwrap();
    folder
}

#[test]
fn a_generated_pair_becomes_disparity_depth_and_cloud() {
    let folder = pair();
    let args = [
        "depth",
        "left.png",
        "right.png",
        "-o",
        "d.pfm",
        "--disparities",
        "48",
        "--focal",
        "210",
        "--baseline",
        "0.25",
        "--depth",
        "z.npy",
        "--cloud",
        "c.ply",
        "--report",
        "page",
    ];
    let value = json(folder.path(), &args);
    assert_eq!((value["width"].as_u64(), value["height"].as_u64()), (Some(240), Some(180)));
    assert!(value["valid_fraction"].as_f64().unwrap() > 0.99);
    assert!(value["seconds"]["match"].as_f64().unwrap() > 0.0);
    let at = |name: &str| folder.path().join(name);
    let disparity = cv_io::pfm::read(at("d.pfm")).unwrap();
    let depth = cv_io::npy::read(at("z.npy")).unwrap().to_gray().unwrap();
    // Z = f B / d, in f32.
    assert!((depth.at(120, 90)[0] - 210.0 * 0.25 / disparity.at(120, 90)[0]).abs() < 1e-5);
    let header = String::from_utf8_lossy(&std::fs::read(at("c.ply")).unwrap()[..200]).into_owned();
    assert!(header.contains("property uchar red"));
    assert!(std::fs::read_to_string(at("page/report.html")).unwrap().contains("near blue, far red"));

    let eval = ["eval", "disparity", "--estimate", "d.pfm", "--truth", "truth.pfm", "--truth-right", "truth_right.pfm"];
    let scores = json(folder.path(), &eval);
    // A wrong sign, unit or row order would be off everywhere; a sound matcher is wrong at a few outlines.
    assert!(scores["non_occluded"]["bad"]["2.0"].as_f64().unwrap() < 0.1, "{scores}");
    assert!(scores["all"]["pixels"].as_u64().unwrap() == 240 * 180);
}

#[test]
fn the_formats_hold_the_same_map() {
    let folder = pair();
    for name in ["d.pfm", "d.npy", "d.png"] {
        done(folder.path(), &["depth", "left.png", "right.png", "-o", name, "--disparities", "48", "--quiet"]);
    }
    for name in ["d.npy", "d.png"] {
        let scores = json(folder.path(), &["eval", "disparity", "--estimate", name, "--truth", "d.pfm"]);
        // KITTI stores steps of 1/256 px.
        assert!(scores["all"]["average_px"].as_f64().unwrap() <= 0.5 / 256.0, "{name}: {scores}");
        assert_eq!(scores["all"]["density"], 1.0, "{name}");
    }
}

#[test]
fn frames_come_out_as_pairs_do() {
    let folder = pair();
    let at = |name: &str| folder.path().join(name);
    for side in ["left", "right"] {
        std::fs::create_dir(at(side)).unwrap();
        for frame in ["f2.png", "f10.png"] {
            std::fs::copy(at(&format!("{side}.png")), at(side).join(frame)).unwrap();
        }
    }
    std::fs::create_dir(at("out")).unwrap();
    done(folder.path(), &["depth", "left.png", "right.png", "-o", "one.pfm", "--disparities", "48"]);
    let value = json(folder.path(), &["depth", "left", "right", "-o", "out", "--disparities", "48"]);
    assert_eq!(value["frames"], 2);
    assert!(value["frames_per_second"].as_f64().unwrap() > 0.0);
    let expected = std::fs::read(at("one.pfm")).unwrap();
    for name in ["out/f2.pfm", "out/f10.pfm"] {
        assert!(std::fs::read(at(name)).unwrap() == expected, "{name}");
    }
    done(folder.path(), &["depth", "left/f2*", "right/f2*", "-o", "out", "--disparities", "48"]);
    refused(folder.path(), &["depth", "left/x*", "right/f2*", "-o", "out"]);
    refused(folder.path(), &["depth", "left", "right/f2*", "-o", "out"]);
    refused(folder.path(), &["depth", "left", "right", "-o", "nowhere"]);
}

#[test]
fn the_range_can_be_found_from_the_pictures() {
    let folder = pair();
    let value = json(folder.path(), &["depth", "left.png", "right.png", "-o", "d.pfm", "--disparities", "auto"]);
    assert!((20..=80).contains(&value["disparities"].as_u64().unwrap()), "{value}");
    let scores = json(folder.path(), &["eval", "disparity", "--estimate", "d.pfm", "--truth", "truth.pfm"]);
    // All pixels, hidden ones included: a range that cuts things off would be wrong on all of them.
    assert!(scores["all"]["bad"]["2.0"].as_f64().unwrap() < 0.2, "{scores}");
}

#[test]
fn the_result_is_the_same_for_any_number_of_threads() {
    let folder = pair();
    let maps = ["1", "2", "4"].map(|threads| {
        done(folder.path(), &["depth", "left.png", "right.png", "-o", "d.pfm", "--threads", threads]);
        std::fs::read(folder.path().join("d.pfm")).unwrap()
    });
    assert!(maps[0] == maps[1] && maps[0] == maps[2]);
}

#[test]
fn what_cannot_be_done_is_said_and_nothing_is_written() {
    let folder = pair();
    let at = |name: &str| folder.path().join(name);
    cv_io::write_png(at("dot.png"), RgbU8::new(1, 1, [9; 3]).view()).unwrap();
    cv_io::write_png(at("small.png"), Image::<u8, 1>::new(100, 100, [9]).view()).unwrap();
    let depth = |left, right, more: &[&'static str]| {
        refused(folder.path(), &[&["depth", left, right, "-o", "out.pfm"], more].concat()).stderr
    };
    assert!(depth("left.png", "small.png", &[]).contains("240×180"));
    assert!(depth("dot.png", "dot.png", &[]).contains("1×1"));
    assert!(depth("left.png", "right.png", &["--disparities", "0"]).contains("0 disparities"));
    assert!(depth("left.png", "right.png", &["--disparities", "5000"]).contains("5000"));
    assert!(depth("left.png", "right.png", &["--min-disparity", "900"]).contains("900"));
    assert!(depth("left.png", "right.png", &["--near", "3", "--far", "2"]).contains("empty"));
    assert!(depth("left.png", "nothing.png", &[]).contains("nothing.png"));
    assert!(!at("out.pfm").exists());
    let usage = |args: &[&str]| {
        let ran = run(folder.path(), args);
        assert_eq!(ran.code, Some(2), "{args:?}: {ran:?}");
    };
    usage(&["depth", "left.png", "right.png"]);
    usage(&["depth", "left.png", "right.png", "-o", "out.txt"]);
    usage(&["depth", "left.png", "right.png", "-o", "d.pfm", "--depth", "z.pfm"]);
    usage(&["depth", "left.png", "right.png", "-o", "d.pfm", "--focal", "100"]);
    usage(&["depth", "left.png", "right.png", "-o", "d.pfm", "--paths", "5"]);
    refused(
        folder.path(),
        &["eval", "disparity", "--estimate", "truth.pfm", "--truth", "small.png", "--truth-scale", "1"],
    );
    usage(&["eval", "disparity", "--estimate", "truth.pfm", "--truth", "truth.pfm", "--truth-scale", "0"]);
}
