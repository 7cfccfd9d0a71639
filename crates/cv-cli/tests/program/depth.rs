//! `cv depth` and `cv eval disparity` as a black box.

use crate::support::{cv, done, json, refused, run};
use cv_core::{Camera, Image, RgbU8};
use cv_synth::{RenderOptions, Scene, StereoPair, stereo_pair};
use std::sync::LazyLock;

/// A small generated pair with ground truth.
static PAIR: LazyLock<StereoPair> = LazyLock::new(|| {
    let scene = Scene::room(5);
    let camera = Camera::from_focal(240, 180, 210.0);
    stereo_pair(&scene, &camera, &scene.viewpoint(), 0.25, &RenderOptions::draft()).unwrap()
});

/// Writes [`PAIR`] as files to a new folder.
fn pair() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let pair = &*PAIR;
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
    let scores = json(folder.path(), &[&eval[..], &["--error", "error.png", "--report", "scores"]].concat());
    let page = std::fs::read_to_string(at("scores/report.html")).unwrap();
    assert!(
        ["bad-0.5", "A95", "non-occluded", "The same for the true disparities"]
            .iter()
            .all(|words| page.contains(words))
    );
    assert_eq!(cv_io::read_rgb(at("error.png")).unwrap().size(), (240, 180));
    // A false sign, unit or row order would be wrong everywhere; a correct matcher is wrong only near depth discontinuities.
    assert!(scores["non_occluded"]["bad"]["2.0"].as_f64().unwrap() < 0.1, "{scores}");
    assert!(scores["all"]["pixels"].as_u64().unwrap() == 240 * 180);
}

#[test]
fn every_output_format_has_the_same_map() {
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
fn frames_of_a_sequence_equal_single_pairs() {
    let folder = pair();
    let at = |name: &str| folder.path().join(name);
    for side in ["left", "right"] {
        std::fs::create_dir(at(side)).unwrap();
        for frame in ["f2.png", "f10.png"] {
            std::fs::copy(at(&format!("{side}.png")), at(side).join(frame)).unwrap();
        }
    }
    done(folder.path(), &["depth", "left.png", "right.png", "-o", "one.pfm", "--disparities", "48"]);
    // The folder is created with the first frame.
    let value = json(folder.path(), &["depth", "left", "right", "-o", "out", "--disparities", "48"]);
    assert_eq!(value["frames"], 2);
    assert!(value["frames_per_second"].as_f64().unwrap() > 0.0);
    let expected = std::fs::read(at("one.pfm")).unwrap();
    for name in ["out/f2.pfm", "out/f10.pfm"] {
        assert!(std::fs::read(at(name)).unwrap() == expected, "{name}");
    }
    done(folder.path(), &["depth", "left/f2*", "right/f2*", "-o", "out", "--disparities", "48"]);
    // The first frame of a sequence is a single pair; the same again has no noise to average.
    done(folder.path(), &["depth", "left", "right", "--sequence", "-o", "in-time", "--disparities", "48"]);
    for name in ["in-time/f2.pfm", "in-time/f10.pfm"] {
        assert!(std::fs::read(at(name)).unwrap() == expected, "{name}");
    }
    let one = run(folder.path(), &["depth", "left.png", "right.png", "-o", "d.pfm", "--sequence"]);
    assert!(one.code == Some(2) && one.stderr.contains("single pair"), "{}", one.stderr);
    refused(folder.path(), &["depth", "left/x*", "right/f2*", "-o", "out"]);
    refused(folder.path(), &["depth", "left", "right/f2*", "-o", "out"]);
    refused(folder.path(), &["depth", "left", "right", "-o", "one.pfm"]);
    refused(folder.path(), &["depth", "left", "right", "-o", "nowhere", "--disparities", "5000"]);
    assert!(!at("nowhere").exists());
}

/// Sequences have every output of a single pair.
#[test]
fn a_sequence_of_a_rig_has_every_output_of_each_frame() {
    let folder = pair();
    let at = |name: &str| folder.path().join(name);
    let camera = "{width: 240, height: 180, fx: 210, fy: 210, cx: 119.5, cy: 89.5, distortion: radial, coefficients: [-0.05, 0.01]}";
    let rig = format!(
        "schema: cv-rig/1\nunit: m\nleft: {camera}\nright: {camera}\nrotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n\
         translation: [-0.25, 0, 0]\n"
    );
    std::fs::write(at("rig.yaml"), rig).unwrap();
    for side in ["left", "right"] {
        std::fs::create_dir(at(side)).unwrap();
        for frame in 1..=2 {
            std::fs::copy(at(&format!("{side}.png")), at(side).join(format!("f{frame}.png"))).unwrap();
        }
    }
    let args = |names: [&'static str; 8]| {
        let [left, right, disparity, depth, cloud, confidence, matched, uncertainty] = names;
        let outputs = ["--depth", depth, "--cloud", cloud, "--confidence", confidence, "--matched", matched];
        let inputs = ["depth", left, right, "-o", disparity, "--uncertainty", uncertainty, "--rig", "rig.yaml"];
        [&inputs[..], &outputs, &["--disparities", "auto"]].concat()
    };
    let one =
        json(folder.path(), &args(["left.png", "right.png", "d.pfm", "z.pfm", "c.ply", "s.pfm", "m.png", "u.pfm"]));
    let frames = [&args(["left/f%d.png", "right", "d", "z", "c", "s", "m", "u"])[..], &["--report", "page"]].concat();
    let value = json(folder.path(), &frames);
    assert_eq!(value["frames"], 2);
    for key in ["disparities", "min_disparity", "width", "height"] {
        assert_eq!(value[key], one[key], "{key}");
    }
    for key in ["frames_per_second", "frames_per_second_with_files"] {
        assert!(value[key].as_f64().unwrap() > 0.0, "{value}");
    }
    for file in ["d.pfm", "z.pfm", "c.ply", "s.pfm", "m.png", "u.pfm"] {
        let (folder, ending) = file.split_once('.').unwrap();
        let expected = std::fs::read(at(file)).unwrap();
        for frame in ["f1", "f2"] {
            let name = format!("{folder}/{frame}.{ending}");
            assert!(std::fs::read(at(&name)).unwrap() == expected, "{name}");
        }
    }
    let page = std::fs::read_to_string(at("page/report.html")).unwrap();
    assert!(page.contains("left/f1.png") && page.contains("left/f2.png"));
    // Frames with the same output file.
    std::fs::copy(at("left.png"), at("left/f2.bmp")).unwrap();
    let text = refused(folder.path(), &["depth", "left", "right", "-o", "two", "--pair-by", "order"]).stderr;
    assert!(text.contains("left frames and") || text.contains("one file"), "{text}");
    assert!(!at("two").exists());
    // A frame of another size than its camera.
    cv_io::write_png(at("left/f2.png"), RgbU8::new(120, 90, [99; 3]).view()).unwrap();
    let text = refused(folder.path(), &["depth", "left/*.png", "right", "-o", "two", "--rig", "rig.yaml"]).stderr;
    assert!(text.contains("left/f2.png is 120×90 px"), "{text}");
}

#[test]
fn the_disparity_range_is_estimated_from_the_images() {
    let folder = pair();
    let value = json(folder.path(), &["depth", "left.png", "right.png", "-o", "d.pfm", "--disparities", "auto"]);
    assert!((20..=80).contains(&value["disparities"].as_u64().unwrap()), "{value}");
    let scores = json(folder.path(), &["eval", "disparity", "--estimate", "d.pfm", "--truth", "truth.pfm"]);
    // Over all pixels, occluded ones included: a truncated range would be wrong on many of them.
    assert!(scores["all"]["bad"]["2.0"].as_f64().unwrap() < 0.2, "{scores}");
}

#[test]
fn a_swapped_pair_is_refused_with_any_choice_of_the_range() {
    let folder = pair();
    for range in ["auto", "48"] {
        let depth =
            ["--disparities", range, "--focal", "210", "--baseline", "0.25", "--depth", "z.pfm", "--cloud", "c.ply"];
        let text =
            refused(folder.path(), &[&["depth", "right.png", "left.png", "-o", "d.pfm"], &depth[..]].concat()).stderr;
        assert!(text.contains("exchange"), "{text}");
        assert!(["d.pfm", "z.pfm", "c.ply"].iter().all(|name| !folder.path().join(name).exists()));
    }
    // An empty cloud is an error: the room ends at a few meters.
    let far = ["--disparities", "48", "--focal", "210", "--baseline", "0.25", "--near", "1000", "--cloud", "c.ply"];
    let text = refused(folder.path(), &[&["depth", "left.png", "right.png", "-o", "d.pfm"], &far[..]].concat()).stderr;
    assert!(text.contains("--near"), "{text}");
    assert!(!folder.path().join("c.ply").exists());
}

#[test]
fn a_small_vertical_disparity_is_corrected() {
    let folder = pair();
    let folder = folder.path();
    // A vertical disparity of 2 px at the center, 1.2 at the left border and 2.8 at the right one.
    let right = &PAIR.right.image;
    let lower = RgbU8::from_fn(240, 180, |x, y| {
        let at = (y as f64 - 2.0 - 1.6 * ((x as f64 + 0.5) / 240.0 - 0.5)).clamp(0.0, 178.999);
        let (row, part) = (at as usize, at.fract());
        let (a, b) = (right.at(x, row), right.at(x, row + 1));
        std::array::from_fn(|c| (f64::from(a[c]) * (1.0 - part) + f64::from(b[c]) * part + 0.5) as u8)
    });
    cv_io::write_png(folder.join("lower.png"), lower.view()).unwrap();
    let args = |right, map| ["depth", "left.png", right, "-o", map, "--disparities", "48"];
    let right_ones = |map: &str| {
        let d = cv_io::pfm::read(folder.join(map)).unwrap();
        let seen = (0..240 * 180).map(|i| (i % 240, i / 240)).filter(|&(x, y)| PAIR.visible.at(x, y)[0]);
        seen.filter(|&(x, y)| (d.at(x, y)[0] - PAIR.disparity.at(x, y)[0]).abs() <= 1.0).count() as f64
    };
    assert!(json(folder, &args("right.png", "aligned.pfm"))["vertical_offset"].is_null());
    let found = json(folder, &args("lower.png", "d.pfm"));
    let offset: Vec<f64> = (0..3).map(|i| found["vertical_offset"][i].as_f64().unwrap()).collect();
    // Features are localized to a few tenths of a pixel, and there are hundreds.
    assert!((offset[0] - 2.0).abs() < 0.15 && (offset[1] - 1.6).abs() < 0.3 && offset[2].abs() < 0.3, "{offset:?}");
    // Two interpolations blur the right image: a few percent more bad pixels.
    let (aligned, moved) = (right_ones("aligned.pfm"), right_ones("d.pfm"));
    assert!(moved > 0.95 * aligned, "{moved} of {aligned}");
    let as_it_is = [&args("lower.png", "none.pfm")[..], &["--no-align"]].concat();
    let (matched, raw) = (found["matched_fraction"].as_f64().unwrap(), run(folder, &as_it_is));
    assert!(matched > 0.5, "{matched}");
    assert!(raw.code != Some(0) || right_ones("none.pfm") < 0.8 * aligned, "nothing had to be aligned");
}

#[test]
fn sequences_with_unpaired_frames_are_refused() {
    let folder = pair();
    let at = |name: &str| folder.path().join(name);
    for (side, first) in [("left", 1), ("right", 2)] {
        std::fs::create_dir(at(side)).unwrap();
        for frame in first..first + 4 {
            std::fs::copy(at(&format!("{side}.png")), at(side).join(format!("frame_{frame:04}.png"))).unwrap();
        }
    }
    let frames = ["depth", "left", "right", "-o", "out", "--disparities", "48"];
    let text = refused(folder.path(), &frames).stderr;
    assert!(["frame_0001", "frame_0005", "--pair-by order"].iter().all(|part| text.contains(part)), "{text}");
    assert!(!at("out").exists());
    assert_eq!(json(folder.path(), &[&frames[..], &["--pair-by", "order"]].concat())["frames"], 4);
    // The common frames, by a pattern.
    let some = ["depth", "left/frame_%04d.png", "right/frame_000[x]*", "-o", "out"];
    refused(folder.path(), &some);
    let value = json(
        folder.path(),
        &["depth", "left/frame_0002*", "right/frame_%03d2.png", "-o", "two", "--disparities", "48"],
    );
    assert_eq!(value["frames"], 1);
    let two = run(folder.path(), &["depth", "left.png", "right.png", "-o", "d.pfm", "--pair-by", "name"]);
    assert_eq!(two.code, Some(2), "{two:?}");
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
fn a_disparity_range_far_from_zero_matches_objects_in_it() {
    let folder = pair();
    let at = |name: &str| folder.path().join(name);
    // 60 columns are cropped on the right of one image and on the left of the other, which adds 60 px to every disparity.
    const MORE: usize = 60;
    let [left, right] = ["left.png", "right.png"].map(|name| cv_io::read_rgb(at(name)).unwrap());
    let width = left.width() - MORE;
    let cut = |image: &RgbU8, from| RgbU8::from_fn(width, image.height(), |x, y| image.at(x + from, y));
    cv_io::write_png(at("a.png"), cut(&left, 0).view()).unwrap();
    cv_io::write_png(at("b.png"), cut(&right, MORE).view()).unwrap();
    let args = ["depth", "a.png", "b.png", "-o", "d.pfm", "--matched", "m.png", "--report", "r"];
    done(folder.path(), &[&args[..], &["--min-disparity", "60", "--disparities", "48"]].concat());
    done(
        folder.path(),
        &["depth", "left.png", "right.png", "-o", "plain.pfm", "--matched", "p.png", "--disparities", "48"],
    );
    let truth = cv_io::pfm::read(at("truth.pfm")).unwrap();
    // Pixels with a match inside the cropped image: all, those matched, and those within 1 px.
    let count = |disparity: &str, mask: &str, more: usize| {
        let (map, mask) = (cv_io::pfm::read(at(disparity)).unwrap(), cv_io::read_gray_u8(at(mask)).unwrap());
        let [mut all, mut kept, mut good] = [0.0f64; 3];
        for (y, x) in (0..map.height()).flat_map(|y| (0..width).map(move |x| (y, x))) {
            if truth.at(x, y)[0] + MORE as f32 <= x as f32 {
                all += 1.0;
                if mask.at(x, y)[0] == 255 {
                    kept += 1.0;
                    good += f64::from((map.at(x, y)[0] - truth.at(x, y)[0] - more as f32).abs() <= 1.0);
                }
            }
        }
        (kept / all, good / kept)
    };
    let (far, plain) = (count("d.pfm", "m.png", MORE), count("plain.pfm", "p.png", 0));
    // The same images with a shifted range, and a border that differs by five columns: one in forty.
    assert!(plain.0 > 0.8 && (far.0 - plain.0).abs() < 0.025 && (far.1 - plain.1).abs() < 0.025, "{far:?} {plain:?}");
    let page = std::fs::read_dir(at("r")).unwrap().map(|e| e.unwrap().path());
    let page = page.into_iter().find(|p| p.extension().is_some_and(|e| e == "html")).unwrap();
    assert!(std::fs::read_to_string(page).unwrap().contains("Fractional parts of disparities"));
}

#[test]
fn invalid_requests_are_refused_with_the_reason_and_nothing_is_written() {
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

#[test]
fn confidence_matched_mask_and_uncertainty_are_written() {
    let folder = pair();
    let ran = done(
        folder.path(),
        &[
            "depth",
            "left.png",
            "right.png",
            "-o",
            "d.pfm",
            "--focal",
            "210",
            "--baseline",
            "0.25",
            "--confidence",
            "c.pfm",
            "--matched",
            "m.png",
            "--uncertainty",
            "u.pfm",
            "--disparities",
            "70",
        ],
    );
    // Refused before the computation.
    assert!(ran.stderr.contains("240×180 px at 70 disparities takes ") && ran.stderr.contains("MiB"), "{ran:?}");
    let read = |name: &str| cv_io::pfm::read(folder.path().join(name)).unwrap();
    let (d, c, u) = (read("d.pfm"), read("c.pfm"), read("u.pfm"));
    let m = cv_io::read_gray_u8(folder.path().join("m.png")).unwrap();
    let mut matched = 0;
    for (x, y) in (0..180).flat_map(|y| (0..240).map(move |x| (x, y))) {
        let is_matched = m.at(x, y)[0] == 255;
        matched += usize::from(is_matched);
        let (confidence, bar) = (c.at(x, y)[0], u.at(x, y)[0]);
        // Every pixel has a disparity, also at the left border; filled pixels have no confidence.
        assert!(d.at(x, y)[0].is_finite() && bar > 0.0);
        assert!(if is_matched { (0.0..=1.0).contains(&confidence) } else { confidence == 0.0 });
    }
    assert!(matched > 240 * 180 / 2 && matched < 240 * 180);
}

#[test]
fn costs_penalties_ranges_and_memory_are_options() {
    let folder = pair();
    let score = |more: &[&str]| {
        done(folder.path(), &[&["depth", "left.png", "right.png", "-o", "d.pfm"], more].concat());
        let scores = json(folder.path(), &["eval", "disparity", "--estimate", "d.pfm", "--truth", "truth.pfm"]);
        scores["all"]["bad"]["2.0"].as_f64().unwrap()
    };
    for more in [
        &["--blend", "gray"] as &[&str],
        &["--blend", "gradient", "--census", "7"],
        &["--smoothing", "none", "--census", "9"],
        &["--smoothing", "wls", "--lambda", "10"],
        &["--min-disparity", "-13", "--disparities", "77", "--paths", "4"],
        &["--min-disparity", "3", "--disparities", "61"],
        &["--max-memory", "6", "--disparities", "64"],
    ] {
        // Occluded pixels are included, as in the test of the estimated range above.
        let bad = score(more);
        assert!(bad < 0.2, "{more:?}: {bad}");
    }
    refused(folder.path(), &["depth", "left.png", "right.png", "-o", "x.pfm", "--max-memory", "1"]);
}

#[test]
fn gray_and_16_bit_images_match_like_color() {
    let folder = pair();
    let at = |name: &str| folder.path().join(name);
    for side in ["left", "right"] {
        let rgb = cv_io::read_rgb(at(&format!("{side}.png"))).unwrap();
        let gray = rgb.map(|[r, g, b]| [((u32::from(r) * 299 + u32::from(g) * 587 + u32::from(b) * 114) / 1000) as u8]);
        cv_io::write_png(at(&format!("{side}8.png")), gray.view()).unwrap();
        cv_io::write_png(at(&format!("{side}16.png")), gray.map(|[v]| [u16::from(v) * 257]).view()).unwrap();
    }
    for bits in ["8", "16"] {
        let (left, right, out) = (format!("left{bits}.png"), format!("right{bits}.png"), format!("d{bits}.pfm"));
        done(folder.path(), &["depth", &left, &right, "-o", &out]);
    }
    // 16-bit images with the values of the 8-bit ones give the same map.
    assert!(std::fs::read(at("d8.pfm")).unwrap() == std::fs::read(at("d16.pfm")).unwrap());
    let scores = json(folder.path(), &["eval", "disparity", "--estimate", "d16.pfm", "--truth", "truth.pfm"]);
    assert!(scores["all"]["bad"]["2.0"].as_f64().unwrap() < 0.2, "{scores}");
}

#[test]
fn images_that_are_no_rectified_pair_are_refused_with_a_remedy() {
    let folder = pair();
    cv_io::write_png(folder.path().join("gray.png"), RgbU8::new(240, 180, [99; 3]).view()).unwrap();
    for (left, right) in [("gray.png", "gray.png"), ("gray.png", "right.png")] {
        let ran = refused(folder.path(), &["depth", left, right, "-o", "out.pfm"]);
        assert!(ran.stderr.contains("matched and confirmed") && ran.stderr.contains("different scenes"), "{ran:?}");
    }
    let ran = refused(folder.path(), &["depth", "right.png", "left.png", "-o", "out.pfm"]);
    assert!(ran.stderr.contains("left and right are exchanged") && ran.stderr.contains("exchange the two"), "{ran:?}");
    assert!(!folder.path().join("out.pfm").exists());
}

/// Returns the peak resident memory of a command in KiB.
#[cfg(target_os = "linux")]
fn peak_of_frames(frames: usize, more: &[&str]) -> f64 {
    let folder = pair();
    for side in ["left", "right"] {
        std::fs::create_dir(folder.path().join(side)).unwrap();
        for frame in 0..frames {
            let to = folder.path().join(format!("{side}/{frame}.png"));
            std::fs::copy(folder.path().join(format!("{side}.png")), to).unwrap();
        }
    }
    std::fs::create_dir(folder.path().join("out")).unwrap();
    let mut child = cv(folder.path())
        .args(["depth", "left", "right", "-o", "out", "--quiet", "--threads", "2"])
        .args(more)
        .spawn()
        .unwrap();
    let status = format!("/proc/{}/status", child.id());
    let mut peak = 0.0f64;
    while child.try_wait().unwrap().is_none() {
        // The process ended between the two calls.
        let text = std::fs::read_to_string(&status).unwrap_or_default();
        let line = text.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap_or("0");
        peak = peak.max(line.trim().trim_end_matches(" kB").trim().parse().unwrap_or(0.0));
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    assert_eq!(std::fs::read_dir(folder.path().join("out")).unwrap().count(), frames);
    peak
}

#[test]
#[cfg(target_os = "linux")]
fn memory_does_not_grow_with_the_number_of_frames() {
    let whole = ["--focal", "210", "--baseline", "0.25", "--depth", "z", "--cloud", "c", "--disparities", "64"];
    for more in [&[][..], &whole] {
        let (few, many) = (peak_of_frames(6, more), peak_of_frames(60, more));
        // A frame has buffers of 9 MB and images of 0.3 MB: 54 further frames would add at least 16 MB if any of it
        // were retained.
        assert!(few > 1000.0 && many < few + 8192.0, "{few} and {many} KiB");
    }
}
