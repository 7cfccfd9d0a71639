//! `cv reconstruct` as a black box.

use crate::support::{fixture, json, refused, run};
use cv_core::{Camera, Pose, RgbU8, Vector3};
use cv_synth::{RenderOptions, Scene, render};
use std::{fs, path::Path};

/// Returns the number of points in the header of a PLY file.
fn points(path: &Path) -> u64 {
    let bytes = fs::read(path).unwrap();
    let header = String::from_utf8_lossy(&bytes[..bytes.len().min(400)]).into_owned();
    let line = header.lines().find(|line| line.starts_with("element vertex")).unwrap();
    line.rsplit(' ').next().unwrap().parse().unwrap()
}

fn two_views(folder: &Path) {
    for name in ["a.jpg", "b.jpg"] {
        fs::copy(fixture("two-view").join(name), folder.join(name)).unwrap();
    }
}

#[test]
fn a_dense_cloud_is_written_with_the_sparse_one() {
    let folder = tempfile::tempdir().unwrap();
    two_views(folder.path());
    let args =
        ["reconstruct", "a.jpg", "b.jpg", "--focal", "440", "-o", "s.ply", "--dense", "d.ply", "--report", "out"];
    let value = json(folder.path(), &args);
    let (sparse, dense) = (points(&folder.path().join("s.ply")), points(&folder.path().join("d.ply")));
    assert_eq!((value["points"].as_u64(), value["dense_points"].as_u64()), (Some(sparse), Some(dense)));
    assert!(dense > 50 * sparse, "{value}");
    let range = [0, 1].map(|i| value["dense_disparities"][i].as_i64().unwrap());
    assert!(range[0] < range[1] && value["dense_coverage"].as_f64().unwrap() > 0.3, "{value}");
    assert!(value["seconds"]["dense_match"].as_f64().unwrap() > 0.0 && value["dense_size"][0].as_u64().unwrap() > 100);
    let html = fs::read_to_string(folder.path().join("out/report.html")).unwrap();
    assert!(html.contains("The dense cloud") && html.matches("class=\"cloud\" data-scene").count() == 2);
    // At reduced size, with hole filling: other numbers of points.
    let small = json(folder.path(), &[&args[..9], &["--dense-size", "200"]].concat());
    let filled = json(folder.path(), &[&args[..9], &["--dense-fill"]].concat());
    assert!(small["dense_points"].as_u64() < Some(dense) && filled["dense_points"].as_u64() > Some(dense));
}

#[test]
fn the_dense_cloud_is_the_same_on_any_number_of_threads() {
    let folder = tempfile::tempdir().unwrap();
    two_views(folder.path());
    let args = ["reconstruct", "a.jpg", "b.jpg", "--focal", "440", "-o", "s.ply", "--dense", "d.ply", "--threads"];
    let bytes = ["1", "3"].map(|threads| {
        json(folder.path(), &[&args[..], &[threads]].concat());
        fs::read(folder.path().join("d.ply")).unwrap()
    });
    assert!(bytes[0] == bytes[1]);
}

/// Renders photographs of a room from each pose as a.png and b.png.
fn photographs(folder: &Path, scene: &Scene, poses: [Pose; 2]) {
    let camera = Camera::from_focal(480, 360, 420.0);
    for (name, pose) in ["a.png", "b.png"].iter().zip(poses) {
        let image: RgbU8 = render(scene, &camera, &pose, &RenderOptions::draft()).unwrap().image;
        cv_io::write_png(folder.join(name), image.view()).unwrap();
    }
}

#[test]
fn a_pair_without_a_dense_cloud_is_refused_and_nothing_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let scene = Scene::room(3);
    let first = scene.viewpoint();
    let ahead = Pose::new(first.rotation, first.translation - Vector3::new(0.03, 0.0, 0.6));
    photographs(folder.path(), &scene, [first, ahead]);
    let args = ["reconstruct", "a.png", "b.png", "--focal", "420", "-o", "s.ply", "--dense", "d.ply"];
    let said = refused(folder.path(), &args).stderr;
    assert!(said.contains("cannot be rectified") && said.contains("sideways"), "{said}");
    assert!(!folder.path().join("s.ply").exists() && !folder.path().join("d.ply").exists());
    // The sparse cloud alone is possible.
    json(folder.path(), &args[..7]);
    let usage = run(folder.path(), &["reconstruct", "a.png", "b.png", "-o", "s.ply", "--dense-size", "900"]);
    assert_eq!(usage.code, Some(2), "{usage:?}");
    let tiny = refused(folder.path(), &[&args[..], &["--dense-size", "7"]].concat()).stderr;
    assert!(tiny.contains("at least 32"), "{tiny}");
}

#[test]
fn an_estimated_focal_length_is_reported_with_its_standard_deviation() {
    let folder = tempfile::tempdir().unwrap();
    two_views(folder.path());
    let args = ["reconstruct", "a.jpg", "b.jpg", "-o", "s.ply", "--report", "out"];
    let said = run(folder.path(), &args).stderr;
    let value = json(folder.path(), &args);
    let (focal, deviation) = (value["focal_px"][0].as_f64().unwrap(), value["focal_deviation"].as_f64().unwrap());
    // The true focal length is 440 px; the error is below three standard deviations in all but 0.3 % of cases. If the matches exclude none of the tried focal lengths, up to
    // eight steps of 5 %, the standard deviation is half of that range, 0.24.
    assert!((focal / 440.0 - 1.0).abs() < 3.0 * deviation && deviation < 0.2, "{focal} {deviation}");
    assert!(said.contains(&format!("focal length {focal:.0} px ± {:.1} %", 100.0 * deviation)), "{said}");
    // A warning at 5 % or more, also in the report.
    let doubtful = deviation > 0.05;
    let html = fs::read_to_string(folder.path().join("out/report.html")).unwrap();
    assert!(
        said.contains("warning: the focal length") == doubtful
            && html.contains("The focal length has a standard deviation") == doubtful
    );
    // A given focal length is an initial value, accurate to a few percent.
    let given = json(folder.path(), &[&args[..], &["--focal", "430"]].concat());
    let (focal, deviation) = (given["focal_px"][0].as_f64().unwrap(), given["focal_deviation"].as_f64().unwrap());
    assert!((focal - 440.0).abs() < 10.0 && deviation < 0.05, "{focal}");
    // A calibration matrix does not determine distortion; no standard deviation is printed for a complete camera.
    fs::write(folder.path().join("K.txt"), "440 0 239.5\n0 440 179.5\n0 0 1\n").unwrap();
    let matrix = [&args[..], &["--camera", "K.txt"]].concat();
    let said = run(folder.path(), &matrix).stderr;
    assert!(said.contains("--undistorted") && said.contains("±"), "{said}");
    let said = run(folder.path(), &[&matrix[..], &["--undistorted"]].concat()).stderr;
    assert!(!said.contains("±") && !said.contains("warning"), "{said}");
}
