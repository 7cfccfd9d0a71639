//! `cv estimate` as a black box: the three models, and degenerate matches.

use crate::support::{json, refused, run};
use std::{fs, path::Path};

/// Returns matches of a camera with a focal length of 800 px that moves to the right and rotates by 0.1 rad about the vertical; every fifth is an outlier.
fn two_views(flat: bool) -> Vec<[f64; 4]> {
    let mut state = 5u32;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(state >> 8) / f64::from(1 << 24)
    };
    let (sin, cos) = 0.1f64.sin_cos();
    let mut rows = Vec::new();
    while rows.len() < 200 {
        let (u, v) = (640.0 * random(), 480.0 * random());
        let z = if flat { 6.0 } else { 4.0 + 6.0 * random() };
        let (x, y) = ((u - 319.5) / 800.0 * z, (v - 239.5) / 800.0 * z);
        // Rotation about y, then a translation by one unit to the left: the camera moved to the right.
        let (p, r) = (cos * x + sin * z - 1.0, -sin * x + cos * z);
        let seen = [800.0 * p / r + 319.5, 800.0 * y / r + 239.5];
        if rows.len() % 5 == 4 {
            rows.push([u, v, 640.0 * random(), 480.0 * random()]);
        } else {
            rows.push([u, v, seen[0], seen[1]]);
        }
    }
    rows
}

fn write(folder: &Path, name: &str, rows: &[[f64; 4]]) {
    let text: String = rows.iter().map(|r| format!("{} {} {} {}\n", r[0], r[1], r[2], r[3])).collect();
    fs::write(folder.join(name), text).unwrap();
}

#[test]
fn an_essential_matrix_gives_the_pose() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), "m.txt", &two_views(false));
    let args = ["estimate", "essential", "--matches", "m.txt", "--focal", "800", "--size", "640x480"];
    let result = json(folder.path(), &args);
    let at = |key: &str, i: usize, j: usize| result[key][i][j].as_f64().unwrap();
    // The inliers are exact: the rest are outliers within a pixel of their epipolar lines, with small weights.
    assert!((at("rotation", 0, 2) - 0.1f64.sin()).abs() < 1e-3 && (at("rotation", 1, 1) - 1.0).abs() < 1e-3);
    assert!((result["translation"][0].as_f64().unwrap() + 1.0).abs() < 1e-3);
    assert!(result["inliers"].as_array().unwrap().len() >= 160);
    // bᵀ E a = 0 with a = (0, 0, 1), which the rotation alone maps to (tan 0.1, 0, 1): E of a sideways motion has no entry there.
    assert!(at("model", 0, 0).abs() < 1e-2);
    // The same with a camera file.
    fs::write(folder.path().join("k.txt"), "800 0 319.5\n0 800 239.5\n0 0 1\n").unwrap();
    let again =
        json(folder.path(), &["estimate", "essential", "--matches", "m.txt", "--camera", "k.txt", "--size", "640x480"]);
    assert_eq!(again["inliers"], result["inliers"]);
    assert_eq!(run(folder.path(), &["estimate", "essential", "--matches", "m.txt"]).code, Some(2));
    assert_eq!(run(folder.path(), &["estimate", "homography", "--matches", "m.txt", "--focal", "5"]).code, Some(2));
}

#[test]
fn planes_give_homographies_and_scenes_with_depth_fundamental_matrices() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), "deep.txt", &two_views(false));
    write(folder.path(), "flat.txt", &two_views(true));
    let deep = json(folder.path(), &["estimate", "fundamental", "--matches", "deep.txt"]);
    assert!(deep["inliers"].as_array().unwrap().len() >= 160);
    let flat = json(folder.path(), &["estimate", "homography", "--matches", "flat.txt"]);
    assert!(flat["inliers"].as_array().unwrap().len() >= 160);
    // Exact matches of a plane leave the epipole undetermined.
    let exact: Vec<_> = two_views(true).into_iter().enumerate().filter(|(i, _)| i % 5 != 4).map(|r| r.1).collect();
    write(folder.path(), "flat.txt", &exact);
    let said = refused(folder.path(), &["estimate", "fundamental", "--matches", "flat.txt"]).stderr;
    assert!(said.contains("a plane"), "{said}");
}

/// Returns deterministic pseudorandom numbers from `low` to `high`.
fn numbers(low: f64, high: f64) -> impl FnMut() -> f64 {
    let mut state = 9u32;
    move || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        low + (high - low) * f64::from(state >> 8) / f64::from(1 << 24)
    }
}

/// Name, matches, and the message of each model in the order homography, fundamental, essential; empty if the model is estimated.
type Case<'a> = (&'a str, &'a [[f64; 4]], [&'a str; 3]);

fn random(n: usize, low: f64, high: f64) -> Vec<[f64; 4]> {
    let mut number = numbers(low, high);
    (0..n).map(|_| std::array::from_fn(|_| number())).collect()
}

#[test]
fn degenerate_matches_are_refused_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let good = two_views(false);
    let exact: Vec<_> = two_views(true).into_iter().enumerate().filter(|(i, _)| i % 5 != 4).map(|r| r.1).collect();
    let line: Vec<[f64; 4]> = (0..30).map(f64::from).map(|i| [i, 2.0 * i, i + 3.0, 2.0 * i]).collect();
    let mut noise = numbers(-0.3, 0.3);
    let nearly: Vec<[f64; 4]> =
        line.iter().map(|m| [20.0 * m[0], 20.0 * m[1] + noise(), 9.0 * m[2], 9.0 * m[3]]).collect();
    let mut nan = good.clone();
    nan[7][2] = f64::NAN;
    let mut infinite = good.clone();
    infinite[9][1] = f64::INFINITY;
    let cases: [Case<'_>; 12] = [
        ("three", &good[..3], ["3 matches are too few"; 3]),
        ("seven", &good[..7], ["no more than expected by chance", "7 matches are too few", "expected by chance"]),
        (
            "seven wrong ones",
            &random(7, 0.0, 480.0),
            ["expected by chance", "7 matches are too few", "expected by chance"],
        ),
        ("one again and again", &[good[0]; 30], ["too few distinct"; 3]),
        ("three again and again", &good[..3].repeat(10), ["too few distinct"; 3]),
        ("a line", &line, ["on a line"; 3]),
        ("nearly a line", &nearly, ["on a line"; 3]),
        ("a plane", &exact, ["", "a plane", ""]),
        ("NaN", &nan, [""; 3]),
        ("infinite", &infinite, [""; 3]),
        ("up to 1e9", &random(300, -1e9, 1e9), ["expected by chance", "expected by chance", "on a line"]),
        (
            "beyond 1e9",
            &random(300, 1e9, 1e9 + 480.0),
            ["expected by chance", "expected by chance", "too few distinct"],
        ),
    ];
    let readable = |name: &str| !matches!(name, "NaN" | "infinite");
    for (name, rows, reasons) in cases {
        write(folder.path(), "m.txt", rows);
        for (model, reason) in ["homography", "fundamental", "essential"].into_iter().zip(reasons) {
            let mut args = vec!["estimate", model, "--matches", "m.txt"];
            if model == "essential" {
                args.extend(["--focal", "800", "--size", "640x480"]);
            }
            if reason.is_empty() && readable(name) {
                assert!(json(folder.path(), &args)["inliers"].as_array().unwrap().len() >= 5, "{name}, {model}");
            } else {
                let said = refused(folder.path(), &args).stderr;
                assert!(said.contains(reason) && !said.contains("panic"), "{name}, {model}: {said}");
            }
        }
    }
    // One coordinate of extreme size is an outlier like any other.
    let mut wild = good;
    wild[4][0] = 1e9;
    write(folder.path(), "m.txt", &wild);
    assert!(
        json(folder.path(), &["estimate", "fundamental", "--matches", "m.txt"])["inliers"].as_array().unwrap().len()
            >= 158
    );
}

#[test]
fn random_matches_have_no_significant_model() {
    let folder = tempfile::tempdir().unwrap();
    write(folder.path(), "wrong.txt", &random(300, 0.0, 480.0));
    write(folder.path(), "right.txt", &two_views(false));
    for model in ["homography", "fundamental", "essential"] {
        let mut args = vec!["estimate", model, "--matches", "wrong.txt"];
        if model == "essential" {
            args.extend(["--focal", "800", "--size", "640x480"]);
        }
        let said = refused(folder.path(), &args).stderr;
        assert!(said.contains("no more than expected by chance; at least "), "{model}: {said}");
        args[3] = "right.txt";
        if model != "homography" {
            // Significance: 160 inliers beside 40 outliers occur by chance in one set of 10^100.
            assert!(json(folder.path(), &args)["log10_false_alarms"].as_f64().unwrap() < -100.0, "{model}");
        }
    }
}
