//! `cv match` as a black box: every kind of features against the known geometry of generated pairs, guided matching, and saved features.

use crate::support::{done, fixture, json, refused, run};
use cv_core::{Matrix3, Vector3};
use std::{
    fs,
    path::{Path, PathBuf},
};

/// Creates a folder with the two images of a fixture as `a.jpg` and `b.jpg`; also returns its ground truth.
fn pair(name: &str) -> (tempfile::TempDir, serde_json::Value) {
    let folder = tempfile::tempdir().unwrap();
    for photo in ["a.jpg", "b.jpg"] {
        fs::copy(fixture(&format!("{name}/{photo}")), folder.path().join(photo)).unwrap();
    }
    let truth = fs::read_to_string(fixture(&format!("oracle/{name}.json"))).unwrap();
    (folder, serde_json::from_str(&truth).unwrap())
}

fn matrix(value: &serde_json::Value) -> Matrix3<f64> {
    Matrix3::from_fn(|i, j| value[i][j].as_f64().unwrap())
}

/// Reads the rows of a matches file: x1 y1 x2 y2 score.
fn rows(file: &Path) -> Vec<Vec<f64>> {
    let text = fs::read_to_string(file).unwrap();
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    lines.map(|line| line.split_whitespace().map(|number| number.parse().unwrap()).collect()).collect()
}

/// Returns the number of rows, and of those with a transfer error of at most `limit` pixels.
fn along(rows: &[Vec<f64>], homography: &Matrix3<f64>, limit: f64) -> (usize, usize) {
    let off = |row: &Vec<f64>| {
        let p = homography * Vector3::new(row[0], row[1], 1.0);
        (p.x / p.z - row[2]).hypot(p.y / p.z - row[3])
    };
    (rows.len(), rows.iter().filter(|row| off(row) <= limit).count())
}

#[test]
fn matches_of_every_feature_kind_agree_with_the_homography_of_a_plane() {
    let (folder, truth) = pair("plane");
    let homography = matrix(&truth["homography"]);
    for kind in [
        "--features sift",
        "--features sift --slanted always",
        "--features mops",
        "--features mops --corners shi-tomasi",
        "--features harris",
        "--features harris --corners shi-tomasi",
        "--features harris --spacing squares",
        "--features harris --spacing tiles",
        "--features harris --one-way --ratio 0.5",
    ] {
        let args: Vec<&str> = ["match", "a.jpg", "b.jpg", "-o", "m.txt"].into_iter().chain(kind.split(' ')).collect();
        let result = json(folder.path(), &args);
        // Tentative matches have outliers, but on a plane rotated by 0.1 rad most are inliers to 3 px, the usual threshold of
        // a homography.
        let (all, good) = along(&rows(&folder.path().join("m.txt")), &homography, 3.0);
        assert_eq!(result["matches"].as_u64().unwrap(), all as u64);
        assert!(all >= 100 && good * 10 >= all * 8, "{kind}: {good} of {all}");
        // Every detected point is described, dropped, or beyond the limit.
        for i in 0..2 {
            let count = |key: &str| result[key][i].as_u64().unwrap();
            let accounted = count("features") + count("dropped") + count("beyond_limit");
            // ASIFT adds features of the simulated views.
            assert!(count("found") == accounted || kind.contains("slanted"), "{kind}: {result}");
        }
    }
}

#[test]
fn guided_matching_adds_inliers_and_removes_outliers() {
    let (folder, truth) = pair("plane");
    let homography = matrix(&truth["homography"]);
    let file = folder.path().join("m.txt");
    done(folder.path(), &["match", "a.jpg", "b.jpg", "-o", "m.txt"]);
    let (_, plain) = along(&rows(&file), &homography, 3.0);
    done(folder.path(), &["match", "a.jpg", "b.jpg", "-o", "m.txt", "--guided", "homography"]);
    // Within the 3 px of the estimate, plus the error of the estimate.
    let (all, guided) = along(&rows(&file), &homography, 3.5);
    assert!(guided == all && guided >= plain, "{guided} of {all}, {plain} before");

    let (folder, truth) = pair("two-view");
    let file = folder.path().join("m.txt");
    let (w, h) = cv_io::read_rgb(folder.path().join("a.jpg")).unwrap().size();
    let (f, center) = (truth["focal_px"].as_f64().unwrap(), [(w as f64 - 1.0) / 2.0, (h as f64 - 1.0) / 2.0]);
    let back = Matrix3::new(1.0 / f, 0.0, -center[0] / f, 0.0, 1.0 / f, -center[1] / f, 0.0, 0.0, 1.0);
    let t = Vector3::from_fn(|i, _| truth["translation_m"][i].as_f64().unwrap());
    let fundamental = back.transpose() * t.cross_matrix() * matrix(&truth["rotation"]) * back;
    // Sampson distance (Hartley & Zisserman, 11.9).
    let off = |row: &Vec<f64>| {
        let (a, b) = (Vector3::new(row[0], row[1], 1.0), Vector3::new(row[2], row[3], 1.0));
        let (l, m) = (fundamental * a, fundamental.transpose() * b);
        b.dot(&l).abs() / (l.x * l.x + l.y * l.y + m.x * m.x + m.y * m.y).sqrt()
    };
    let near = |limit: f64| {
        let rows = rows(&file);
        (rows.len(), rows.iter().filter(|row| off(row) <= limit).count())
    };
    done(folder.path(), &["match", "a.jpg", "b.jpg", "-o", "m.txt"]);
    let (_, plain) = near(1.0);
    done(folder.path(), &["match", "a.jpg", "b.jpg", "-o", "m.txt", "--guided", "fundamental"]);
    let (all, guided) = near(1.5);
    assert!(guided * 100 >= all * 98 && guided > plain, "{guided} of {all}, {plain} before");
}

#[test]
fn unrelated_photographs_have_no_model() {
    let (folder, _) = pair("plane");
    let (other, _) = pair("two-view");
    fs::copy(other.path().join("b.jpg"), folder.path().join("other.jpg")).unwrap();
    // The tentative matches have no common model, and a warning says so.
    let ran = done(folder.path(), &["match", "a.jpg", "other.jpg", "-o", "m.txt"]);
    assert!(ran.stderr.contains("no homography or fundamental matrix explains"), "{ran:?}");
    let value = json(folder.path(), &["match", "a.jpg", "other.jpg", "-o", "m.txt"]);
    assert!(value["model"].is_null() && value["agree"] == 0 && value["matches"].as_u64().unwrap() > 0, "{value}");
    let value = json(folder.path(), &["match", "a.jpg", "b.jpg", "-o", "m.txt"]);
    assert!(
        value["model"] == "homography" && 2 * value["agree"].as_u64().unwrap() > value["matches"].as_u64().unwrap()
    );
    // Guided matching and `cv estimate` are refused.
    for model in ["homography", "fundamental"] {
        let ran = refused(folder.path(), &["match", "a.jpg", "other.jpg", "-o", "guided.txt", "--guided", model]);
        assert!(
            ran.stderr.contains("no model for guided matching") && !folder.path().join("guided.txt").exists(),
            "{ran:?}"
        );
        fs::rename(folder.path().join("m.txt"), folder.path().join("right.txt")).unwrap();
        done(folder.path(), &["match", "a.jpg", "other.jpg", "-o", "m.txt"]);
        refused(folder.path(), &["estimate", model, "--matches", "m.txt"]);
    }
}

#[test]
fn saved_features_give_the_same_matches() {
    let (folder, _) = pair("plane");
    let at = |name: &str| -> PathBuf { folder.path().join(name) };
    for (kind, file) in [("sift", "a.rootsift.npy"), ("mops", "a.mops.npy"), ("harris", "a.patch.npy")] {
        let save = ["match", "a.jpg", "b.jpg", "-o", "m.txt", "--features", kind, "--slanted", "never"];
        let saved = json(folder.path(), &[&save[..], &["--save-features", kind]].concat());
        assert!(at(kind).join(file).exists());
        let load = ["match", "a.jpg", "b.jpg", "-o", "again.txt", "--load-features", kind];
        let loaded = json(folder.path(), &load);
        assert_eq!(saved["matches"], loaded["matches"]);
        assert_eq!(fs::read(at("m.txt")).unwrap(), fs::read(at("again.txt")).unwrap(), "{kind}");
    }
    // COLMAP's text format rounds descriptors to bytes and positions to the printed digits: nearly the same matches.
    for photo in ["a", "b"] {
        fs::remove_file(at("sift").join(format!("{photo}.keypoints.npy"))).unwrap();
    }
    let text = json(folder.path(), &["match", "a.jpg", "b.jpg", "-o", "m.txt", "--load-features", "sift"]);
    let plain = json(folder.path(), &["match", "a.jpg", "b.jpg", "--slanted", "never"]);
    let (text, plain) = (text["matches"].as_f64().unwrap(), plain["matches"].as_f64().unwrap());
    assert!((text / plain - 1.0).abs() < 0.05, "{text} and {plain}");
}

#[test]
fn incompatible_feature_files_are_refused() {
    let (folder, _) = pair("plane");
    let at = |name: &str| -> PathBuf { folder.path().join(name) };
    for kind in ["mops", "harris"] {
        done(folder.path(), &["match", "a.jpg", "b.jpg", "--features", kind, "--save-features", kind]);
    }
    let load = ["match", "a.jpg", "b.jpg", "--load-features", "mixed"];
    assert!(refused(folder.path(), &load).stderr.contains("mixed"));
    fs::create_dir(at("mixed")).unwrap();
    let take = |from: &str, to: &str| fs::copy(at(from), at("mixed").join(to)).unwrap();
    take("mops/a.keypoints.npy", "a.keypoints.npy");
    assert!(refused(folder.path(), &load).stderr.contains("no descriptors beside"));
    // Features of different kinds.
    take("mops/a.mops.npy", "a.mops.npy");
    take("harris/b.keypoints.npy", "b.keypoints.npy");
    take("harris/b.patch.npy", "b.patch.npy");
    let error = refused(folder.path(), &load).stderr;
    assert!(error.contains("mops") && error.contains("patch"), "{error}");
    // Descriptors of other keypoints.
    take("mops/b.mops.npy", "b.mops.npy");
    let error = refused(folder.path(), &load).stderr;
    assert!(error.contains("keypoints") && error.contains("are not "), "{error}");
    // A truncated file.
    let whole = fs::read(at("mops/b.mops.npy")).unwrap();
    take("mops/b.keypoints.npy", "b.keypoints.npy");
    fs::write(at("mixed/b.mops.npy"), &whole[..whole.len() / 2]).unwrap();
    refused(folder.path(), &load);
}

#[test]
fn the_report_counts_dropped_features() {
    let (folder, _) = pair("plane");
    let args = ["match", "a.jpg", "b.jpg", "--features", "harris", "--report", "out"];
    let result = json(folder.path(), &args);
    let html = fs::read_to_string(folder.path().join("out/report.html")).unwrap();
    for words in ["Tentative matches", "dropped near the border or in low-texture patches", "inliers", "<svg"] {
        assert!(html.contains(words), "{words}");
    }
    assert!(html.contains(&result["dropped"][0].to_string()) && result["dropped"][0].as_u64().unwrap() > 0);
}

#[test]
fn numbers_out_of_range_are_usage_errors() {
    let (folder, _) = pair("plane");
    for wrong in
        [["--ratio", "1.5"], ["--ratio", "NaN"], ["--max-features", "0"], ["--features", "orb"], ["--guided", "affine"]]
    {
        let args = [&["match", "a.jpg", "b.jpg"][..], &wrong].concat();
        assert_eq!(run(folder.path(), &args).code, Some(2), "{wrong:?}");
    }
}
