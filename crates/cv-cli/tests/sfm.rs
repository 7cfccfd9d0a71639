//! `cv sfm` from outside, on walks through rooms that are known.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod support;

use cv_core::{Camera, Pose, RgbU8, SparseModel, Vector3};
use cv_io::colmap;
use cv_synth::{RenderOptions, Scene, direction_error, render, rotation_error};
use serde_json::Value;
use std::collections::BTreeMap;
use std::{fs, path::Path};
use support::{cv, json, refused, run, snapshot, strs};

const CAMERA: [usize; 2] = [400, 300];
const FOCAL: f64 = 330.0;

fn camera() -> Camera {
    Camera::from_focal(CAMERA[0], CAMERA[1], FOCAL)
}

/// Photographs from these places, as `NAME00.png` and so on, and their calibration matrix.
fn photographs(folder: &Path, name: &str, scene: &Scene, poses: &[Pose]) -> BTreeMap<String, Pose> {
    fs::create_dir_all(folder).unwrap();
    let mut truth = BTreeMap::new();
    for (i, pose) in poses.iter().enumerate() {
        let file = format!("{name}{i:02}.png");
        let options = RenderOptions { seed: i as u64, ..RenderOptions::default() };
        let image: RgbU8 = render(scene, &camera(), pose, &options).unwrap().image;
        cv_io::write_png(folder.join(&file), image.view()).unwrap();
        truth.insert(file, *pose);
    }
    let camera = camera();
    let matrix = format!("{FOCAL} 0 {}\n0 {FOCAL} {}\n0 0 1\n", camera.cx, camera.cy);
    fs::write(folder.join("../K.txt"), matrix).unwrap();
    truth
}

/// Over all pairs of a model's photographs the largest error of the relative rotation and of the direction between the centers, in degrees, and that of the distance
/// between the centers after the best scale, as a share of the largest distance.
fn worst(model: &SparseModel, truth: &BTreeMap<String, Pose>) -> [f64; 3] {
    let images: Vec<_> = model.images.values().collect();
    let (mut turn, mut direction, mut lengths) = (0.0f64, 0.0f64, Vec::new());
    for (i, a) in images.iter().enumerate() {
        for b in &images[i + 1..] {
            let found = Pose::relative(&a.pose, &b.pose);
            let known = Pose::relative(&truth[&a.name], &truth[&b.name]);
            turn = turn.max(rotation_error(&found.rotation, &known.rotation));
            direction = direction.max(direction_error(&found.translation, &known.translation));
            lengths.push([found.translation.norm(), known.translation.norm()]);
        }
    }
    let (product, square) = lengths.iter().fold((0.0, 0.0), |(p, s), [f, k]| (p + f * k, s + f * f));
    let longest = lengths.iter().map(|l| l[1]).fold(0.0, f64::max);
    let off = lengths.iter().map(|[f, k]| (f * product / square - k).abs() / longest).fold(0.0, f64::max);
    [turn.to_degrees(), direction.to_degrees(), off]
}

/// A pixel is an angle of 1/330, 0.17 degrees; keypoints of rendered photographs are found to a third of one, and each pose rests on a hundred of them or more. A pose
/// that is wrong is off by degrees. Centers are known to about a thousandth of the longest distance; of neighbors a tenth as far apart that is more than half a degree of direction.
fn is_true(model: &SparseModel, truth: &BTreeMap<String, Pose>) {
    let [turn, direction, off] = worst(model, truth);
    println!("{turn:.3} {direction:.3} {off:.4}");
    assert!(turn < 0.17 && direction < 1.0 && off < 0.005, "{turn} {direction} {off}");
}

fn used(value: &Value) -> Vec<bool> {
    value["images"].as_array().unwrap().iter().map(|image| image["used"].as_bool().unwrap()).collect()
}

fn reason(value: &Value, name: &str) -> String {
    let images = value["images"].as_array().unwrap();
    let image = images.iter().find(|image| image["path"].as_str().unwrap().ends_with(name)).unwrap();
    image["reason"].as_str().unwrap_or_else(|| panic!("{name}: {image}")).to_owned()
}

fn files(folder: &Path) -> Vec<String> {
    let names = snapshot(folder).into_iter();
    names.map(|(path, _)| path.strip_prefix(folder).unwrap().display().to_string()).collect()
}

#[test]
fn a_walk_around_a_room_is_as_it_was_and_written_whole() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let truth = photographs(&at("photos"), "walk", &Scene::room(4), &Scene::room_walk(12));
    let call = ["sfm", "photos", "--camera", "K.txt", "--undistorted", "-o", "model"];
    let others = [
        "--cloud",
        "c.ply",
        "--transforms",
        "t/transforms.json",
        "--pinhole",
        "flat",
        "--report",
        "page",
        "--threads",
        "2",
    ];
    let value = json(folder.path(), &[&call[..], &others].concat());

    assert_eq!(used(&value), [true; 12], "{value}");
    let model = colmap::read(at("model")).unwrap();
    assert_eq!(model.images.len(), 12);
    is_true(&model, &truth);
    assert_eq!(files(&at("model")), ["cameras.txt", "images.txt", "points3D.txt"]);
    assert_eq!((value["models"].as_u64(), value["points"].as_u64()), (Some(1), Some(model.points.len() as u64)));
    let observations: usize = model.points.values().map(|p| p.track.len()).sum();
    assert_eq!(value["observations"].as_u64(), Some(observations as u64));
    let number = |key: &str| value[key].as_f64().unwrap();
    assert!((number("mean_track_length") - observations as f64 / model.points.len() as f64).abs() < 1e-9);
    // Both of the same errors: no mean is above the root of the mean square. Keypoints are good to a third of a pixel, and no error above four is kept.
    assert!(0.0 < number("mean_reprojection_px") && number("mean_reprojection_px") < number("reprojection_rms_px"));
    assert!(number("reprojection_rms_px") < 1.0 && value["focal_px"][0].as_f64() == Some(FOCAL));
    assert!(value["seconds"]["features"].as_f64().is_some() && value["images"][0]["model"].as_u64() == Some(0));

    // Known cameras are placed all at once, and no two places of the room look alike.
    assert!(value["solvers"][0] == "global" && value["refused_pairs"]["repeated"] == 0, "{value}");

    // The pinhole folder: the lens had no distortion, so that its points are where they were, up to the larger focal length of a view without black corners.
    let flat = colmap::read(at("flat/sparse")).unwrap();
    assert_eq!((flat.images.len(), flat.points.len()), (12, model.points.len()));
    for image in flat.images.values() {
        let size = cv_io::read_rgb(at("flat/images").join(&image.name)).unwrap().size();
        let camera = &flat.cameras[&image.camera];
        assert!(camera.distortion.is_none() && size == (camera.width, camera.height), "{camera:?}");
    }
    is_true(&flat, &truth);

    // Camera to world with y up and z back: the fourth column is the center.
    let text = fs::read_to_string(at("t/transforms.json")).unwrap();
    let transforms: Value = serde_json::from_str(&text).unwrap();
    let frames = transforms["frames"].as_array().unwrap();
    assert_eq!((frames.len(), frames[3]["file_path"].as_str()), (12, Some("../photos/walk03.png")));
    let image = model.images.values().find(|image| image.name == "walk03.png").unwrap();
    let center = Vector3::from_fn(|i, _| frames[3]["transform_matrix"][i][3].as_f64().unwrap());
    // The text of the model has a quaternion, that of the transforms a matrix: they agree to rounding.
    assert!((image.pose.center().coords - center).norm() < 1e-9);
    let header = String::from_utf8_lossy(&fs::read(at("c.ply")).unwrap()[..200]).into_owned();
    assert!(header.contains(&format!("element vertex {}", model.points.len())), "{header}");
    let html = fs::read_to_string(at("page/report.html")).unwrap();
    assert!(html.contains("data-scene") && html.contains("walk11.png") && html.contains("points in common"));
    assert!(html.trim_end().ends_with("</html>") && !html.contains("not in the model"));

    // The files named one by one in another order, on one thread, with two that are no photographs among them: the same bytes.
    fs::write(at("photos/walk05b.png"), b"no photograph").unwrap();
    let mut reversed: Vec<String> = truth.keys().rev().map(|name| format!("photos/{name}")).collect();
    reversed.extend(["photos/walk05b.png".to_owned(), "photos/walk99.png".to_owned()]);
    let again = ["--camera", "K.txt", "--undistorted", "-o", "again", "--threads", "1"];
    let args = [&["sfm"], &strs(&reversed)[..], &again].concat();
    let value = json(folder.path(), &args);
    assert_eq!(used(&value).iter().filter(|used| **used).count(), 12);
    assert!(
        reason(&value, "walk05b.png").contains("cannot be read")
            && reason(&value, "walk99.png").contains("cannot be read")
    );
    let bytes = |name: &str| snapshot(&at(name)).into_iter().map(|(_, bytes)| bytes).collect::<Vec<_>>();
    assert!(bytes("model") == bytes("again"), "another order or number of threads");

    // In the other form, in place of the first.
    let ran = cv(folder.path()).args([&call[..], &["--format", "colmap-binary"]].concat()).output().unwrap();
    let said = String::from_utf8(ran.stderr).unwrap();
    assert!(
        ran.status.success() && said.contains("older model") && said.contains("warning: photos/walk05b.png"),
        "{said}"
    );
    assert_eq!(files(&at("model")), ["cameras.bin", "images.bin", "points3D.bin"]);
    let binary = colmap::read(at("model")).unwrap();
    // Numbers of text are as exact, but for the half pixel that is added and taken away.
    assert!(binary.points == model.points && binary.images.len() == 12);
}

#[test]
fn without_a_camera_the_focal_length_is_found() {
    let folder = tempfile::tempdir().unwrap();
    let truth = photographs(&folder.path().join("photos"), "walk", &Scene::room(4), &Scene::room_walk(12));
    let value = json(folder.path(), &["sfm", "photos", "-o", "model", "--quiet"]);
    assert_eq!(used(&value), [true; 12], "{value}");
    let focal = value["focal_px"][0].as_f64().unwrap();
    let [turn, direction, off] = worst(&colmap::read(folder.path().join("model")).unwrap(), &truth);
    // The walk comes around: a focal length off by a hundredth would leave a gap of the 360 degrees. Radial distortion, which is estimated with it, takes up some of it.
    assert!((focal / FOCAL - 1.0).abs() < 0.01, "{focal}");
    assert!(turn < 0.5 && direction < 1.0 && off < 0.01, "{turn} {direction} {off}");
}

#[test]
fn what_makes_no_model_is_refused_with_its_reason() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (scene, walk) = (Scene::room(4), Scene::room_walk(12));
    let call = |folder_: &str| {
        let ran = refused(folder.path(), &["sfm", folder_, "--camera", "K.txt", "--undistorted", "-o", "model"]);
        assert!(!at("model").exists(), "{folder_}");
        ran.stderr
    };
    // One, by name or in a folder.
    photographs(&at("one"), "a", &scene, &walk[..1]);
    for name in ["one", "one/a00.png"] {
        let ran = run(folder.path(), &["sfm", name, "-o", "model"]);
        assert!(ran.code == Some(2) && ran.stderr.contains("two at least"), "{ran:?}");
    }
    // The same one twice is one.
    for copy in ["b.png", "c.png"] {
        fs::copy(at("one/a00.png"), at("one").join(copy)).unwrap();
    }
    let said = call("one");
    assert!(said.contains("1 of 3 photographs") && said.contains("byte for byte, as one/a00.png"), "{said}");
    // One that can be read.
    fs::write(at("one/b.png"), b"").unwrap();
    fs::remove_file(at("one/c.png")).unwrap();
    let said = call("one");
    assert!(
        said.contains("1 of 2 photographs") && said.contains("one/b.png: it cannot be read: the file is empty"),
        "{said}"
    );
    // Two of different places.
    photographs(&at("two"), "a", &scene, &walk[..1]);
    photographs(&at("two"), "b", &Scene::street(1, 4, 0), &Scene::street_walk(4, 3)[1..2]);
    assert!(call("two").contains("of 2 photographs no two show enough of the same"));
    // A camera that only turned.
    let first = scene.viewpoint();
    let turned = |i: usize| {
        let turn = cv_core::Rotation3::from_axis_angle(&Vector3::y_axis(), 0.1 * i as f64);
        Pose::new(turn, Vector3::zeros()).compose(&first)
    };
    photographs(&at("turned"), "a", &scene, &(0..5).map(turned).collect::<Vec<_>>());
    let said = call("turned");
    assert!(said.contains("two places") && said.contains("`cv panorama`"), "{said}");
}

#[test]
fn photographs_of_something_else_are_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let mut truth = photographs(&at("photos"), "room", &Scene::room(4), &Scene::room_walk(12)[..5]);
    for i in 0..5 {
        let scene = Scene::street(10 + i, 4, 0);
        truth.extend(photographs(&at("photos"), &format!("street{i}-"), &scene, &Scene::street_walk(4, 3)[1..2]));
    }
    // One too small to look at.
    cv_io::write_png(at("photos/tiny.png"), RgbU8::new(3, 3, [9; 3]).view()).unwrap();
    fs::create_dir_all(at("model/1")).unwrap();
    fs::write(at("model/1/cameras.txt"), "").unwrap();
    let args = ["sfm", "photos", "--focal", "330", "-o", "model"];
    let ran = run(folder.path(), &args);
    assert!(ran.stderr.contains("model/1 holds a model that is not of this run"), "{}", ran.stderr);
    assert!(ran.stderr.contains("warning: only 5 of 11 photographs are in the model"), "{}", ran.stderr);
    let value = json(folder.path(), &args);
    assert_eq!(used(&value), [&[true; 5][..], &[false; 6]].concat(), "{value}");
    for i in 0..5 {
        assert!(reason(&value, &format!("street{i}-00.png")).contains("photographs in between"), "{value}");
    }
    assert!(reason(&value, "tiny.png").contains("3×3"), "{value}");
    let model = colmap::read(at("model")).unwrap();
    let [turn, direction, off] = worst(&model, &truth);
    // Five photographs that do not come around leave the focal length less certain, and with it the turns.
    assert!(turn < 1.0 && direction < 2.0 && off < 0.02, "{turn} {direction} {off}");
}
