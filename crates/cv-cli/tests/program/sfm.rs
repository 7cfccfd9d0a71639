//! `cv sfm` as a black box, on rendered walks with known poses.

use crate::support::{cv, json, refused, run, snapshot, strs};
use cv_core::{Camera, Point3, Pose, RgbU8, SparseModel, Vector3};
use cv_io::{Metadata, colmap};
use cv_synth::{RenderOptions, Scene, direction_error, render, rotation_error};
use serde_json::Value;
use std::collections::BTreeMap;
use std::process::Stdio;
use std::{fs, path::Path, thread::sleep, time::Duration};

const CAMERA: [usize; 2] = [400, 300];
const FOCAL: f64 = 330.0;

fn camera() -> Camera {
    Camera::from_focal(CAMERA[0], CAMERA[1], FOCAL)
}

/// Renders photographs from these poses as `NAME00.png` and so on, and writes their calibration matrix.
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

/// Returns the largest errors over all pairs of a model's images: of the relative rotation and of the direction between the centers in degrees, and of the distance
/// between the centers after the best scale, relative to the largest distance.
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

/// A pixel is an angle of 1/330, 0.17°; keypoints of rendered photographs are localized to a third of that, and each pose depends on a hundred or more. A false pose
/// is off by degrees. Centers are accurate to about a thousandth of the largest distance; for neighbors at a tenth of it that is more than half a degree of direction.
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
fn a_walk_around_a_room_is_reconstructed_and_written_completely() {
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
    // The mean of the same errors is at most their RMS. Keypoints are accurate to a third of a pixel, and errors above four are rejected.
    assert!(0.0 < number("mean_reprojection_px") && number("mean_reprojection_px") < number("reprojection_rms_px"));
    assert!(number("reprojection_rms_px") < 1.0 && value["focal_px"][0].as_f64() == Some(FOCAL));
    assert!(value["seconds"]["features"].as_f64().is_some() && value["images"][0]["model"].as_u64() == Some(0));

    // The global solver handles known cameras, and the room has no repeated structure.
    assert!(value["solvers"][0] == "global" && value["refused_pairs"]["repeated"] == 0, "{value}");

    // The pinhole folder: the lens had no distortion, so the points are unchanged up to the larger focal length of a view without black corners.
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
    // The model's text has a quaternion, the transforms a matrix: they agree to rounding.
    assert!((image.pose.center().coords - center).norm() < 1e-9);
    let header = String::from_utf8_lossy(&fs::read(at("c.ply")).unwrap()[..200]).into_owned();
    assert!(header.contains(&format!("element vertex {}", model.points.len())), "{header}");
    let html = fs::read_to_string(at("page/report.html")).unwrap();
    assert!(html.contains("data-scene") && html.contains("walk11.png") && html.contains("points in common"));
    assert!(html.trim_end().ends_with("</html>") && !html.contains("not in the model"));

    // The files in another order, on one thread, with two files that are no images: the same bytes.
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

    // The binary format replaces the text.
    let ran = cv(folder.path()).args([&call[..], &["--format", "colmap-binary"]].concat()).output().unwrap();
    let said = String::from_utf8(ran.stderr).unwrap();
    assert!(
        ran.status.success() && said.contains("older model") && said.contains("warning: photos/walk05b.png"),
        "{said}"
    );
    assert_eq!(files(&at("model")), ["cameras.bin", "images.bin", "points3D.bin"]);
    let binary = colmap::read(at("model")).unwrap();
    // Numbers of the text format are exact, except for the conversion of half a pixel.
    assert!(binary.points == model.points && binary.images.len() == 12);
}

#[test]
fn an_unknown_focal_length_is_estimated() {
    let folder = tempfile::tempdir().unwrap();
    let truth = photographs(&folder.path().join("photos"), "walk", &Scene::room(4), &Scene::room_walk(12));
    let ran = run(folder.path(), &["sfm", "photos", "-o", "model", "--json"]);
    let value: Value = serde_json::from_str(&ran.stdout).unwrap();
    assert_eq!(used(&value), [true; 12], "{value}");
    let focal = value["focal_px"][0].as_f64().unwrap();
    let [turn, direction, off] = worst(&colmap::read(folder.path().join("model")).unwrap(), &truth);
    // The walk is closed: a focal length error of 1 % would leave a gap of the 360°. Radial distortion, estimated with it, compensates some of it.
    assert!((focal / FOCAL - 1.0).abs() < 0.01, "{focal}");
    assert!(turn < 0.5 && direction < 1.0 && off < 0.01, "{turn} {direction} {off}");
    assert!(!ran.stderr.contains("do not determine the focal length"), "{ran:?}");

    // Without a rotation, focal length and depth are interchangeable.
    let pose = |i: usize| Pose::new(cv_core::Rotation3::identity(), Vector3::new(-0.3 * i as f64, 1.3, 0.0));
    let poses: Vec<Pose> = (0..5).map(pose).collect();
    photographs(&folder.path().join("aside"), "aside", &Scene::room(4), &poses);
    let ran = run(folder.path(), &["sfm", "aside", "-o", "aside-model"]);
    assert!(ran.code == Some(0) && ran.stderr.contains("do not determine the focal length"), "{ran:?}");
    // With it, nothing is said.
    let ran = run(folder.path(), &["sfm", "aside", "--camera", "K.txt", "--undistorted", "-o", "aside-known"]);
    assert!(ran.code == Some(0) && !ran.stderr.contains("focal length"), "{ran:?}");
}

#[test]
fn photographs_without_a_model_are_refused_with_the_reason() {
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
        assert!(ran.code == Some(2) && ran.stderr.contains("two or more are needed"), "{ran:?}");
    }
    // A duplicate counts once.
    for copy in ["b.png", "c.png"] {
        fs::copy(at("one/a00.png"), at("one").join(copy)).unwrap();
    }
    let said = call("one");
    assert!(said.contains("1 of 3 photographs") && said.contains("byte for byte, to one/a00.png"), "{said}");
    // One readable photograph.
    fs::write(at("one/b.png"), b"").unwrap();
    fs::remove_file(at("one/c.png")).unwrap();
    let said = call("one");
    assert!(
        said.contains("1 of 2 photographs") && said.contains("one/b.png: it cannot be read: the file is empty"),
        "{said}"
    );
    // Two unrelated photographs.
    photographs(&at("two"), "a", &scene, &walk[..1]);
    photographs(&at("two"), "b", &Scene::street(1, 4, 0), &Scene::street_walk(4, 3)[1..2]);
    assert!(call("two").contains("no two of 2 photographs have enough overlap"));
    // A pure rotation.
    let first = scene.viewpoint();
    let turned = |i: usize| {
        let turn = cv_core::Rotation3::from_axis_angle(&Vector3::y_axis(), 0.1 * i as f64);
        Pose::new(turn, Vector3::zeros()).compose(&first)
    };
    photographs(&at("turned"), "a", &scene, &(0..5).map(turned).collect::<Vec<_>>());
    let said = call("turned");
    assert!(said.contains("parallax") && said.contains("`cv panorama`"), "{said}");
}

#[test]
fn unrelated_photographs_are_not_registered() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let mut truth = photographs(&at("photos"), "room", &Scene::room(4), &Scene::room_walk(12)[..5]);
    for i in 0..5 {
        let scene = Scene::street(10 + i, 4, 0);
        truth.extend(photographs(&at("photos"), &format!("street{i}-"), &scene, &Scene::street_walk(4, 3)[1..2]));
    }
    // One too small for features.
    cv_io::write_png(at("photos/tiny.png"), RgbU8::new(3, 3, [9; 3]).view()).unwrap();
    fs::create_dir_all(at("model/1")).unwrap();
    fs::write(at("model/1/cameras.txt"), "").unwrap();
    let args = ["sfm", "photos", "--focal", "330", "-o", "model"];
    let ran = run(folder.path(), &args);
    assert!(ran.stderr.contains("model/1 contains a model that is not from this run"), "{}", ran.stderr);
    assert!(ran.stderr.contains("warning: only 5 of 11 photographs are in the model"), "{}", ran.stderr);
    let value = json(folder.path(), &args);
    assert_eq!(used(&value), [&[true; 5][..], &[false; 6]].concat(), "{value}");
    for i in 0..5 {
        assert!(reason(&value, &format!("street{i}-00.png")).contains("photographs in between"), "{value}");
    }
    assert!(reason(&value, "tiny.png").contains("3×3"), "{value}");
    let model = colmap::read(at("model")).unwrap();
    let [turn, direction, off] = worst(&model, &truth);
    // In five photographs of an open walk the focal length is less certain, and with it the rotations.
    assert!(turn < 1.0 && direction < 2.0 && off < 0.02, "{turn} {direction} {off}");
}

/// Returns a little-endian EXIF block with a GPS position: degrees north and east, meters above sea level.
fn exif_of(north: f64, east: f64, height: f64) -> Vec<u8> {
    // The only entry of the first directory points to the GPS directory at 26; its values follow.
    let mut block = b"II*\0\x08\0\0\0\x01\0".to_vec();
    let entry = |block: &mut Vec<u8>, tag: u16, kind: u16, count: u32, value: [u8; 4]| {
        block.extend(tag.to_le_bytes());
        block.extend(kind.to_le_bytes());
        block.extend(count.to_le_bytes());
        block.extend(value);
    };
    entry(&mut block, 0x8825, 4, 1, 26u32.to_le_bytes());
    block.extend([0; 4]);
    block.extend(6u16.to_le_bytes());
    let values = 26 + 2 + 6 * 12 + 4;
    entry(&mut block, 1, 2, 2, *b"N\0\0\0");
    entry(&mut block, 2, 5, 3, (values as u32).to_le_bytes());
    entry(&mut block, 3, 2, 2, *b"E\0\0\0");
    entry(&mut block, 4, 5, 3, (values as u32 + 24).to_le_bytes());
    entry(&mut block, 5, 1, 1, [0; 4]);
    entry(&mut block, 6, 5, 1, (values as u32 + 48).to_le_bytes());
    block.extend([0; 4]);
    for degrees in [north, east] {
        let whole = degrees.floor();
        // A ten-millionth of a second is 3 µm.
        let seconds = (degrees - whole) * 3600.0;
        for (numerator, denominator) in [(whole as u32, 1u32), (0, 1), ((seconds * 1e6).round() as u32, 1_000_000)] {
            block.extend(numerator.to_le_bytes());
            block.extend(denominator.to_le_bytes());
        }
    }
    block.extend(((height * 1e4).round() as u32).to_le_bytes());
    block.extend(10_000u32.to_le_bytes());
    block
}

/// Converts to the georeferenced frame of the room: Y of its world is down; X is east here, Z north.
fn east_north_up(p: Point3<f64>) -> Vector3<f64> {
    Vector3::new(p.x, p.z, -p.y)
}

/// Returns the largest error of a model's camera centers, relative to that of the first photograph.
fn off_by(model: &SparseModel, truth: &BTreeMap<String, Pose>) -> f64 {
    let first = east_north_up(truth["walk00.png"].center());
    let off = |image: &cv_core::ModelImage| {
        (image.pose.center().coords - (east_north_up(truth[&image.name].center()) - first)).norm()
    };
    model.images.values().map(off).fold(0.0, f64::max)
}

#[test]
fn models_are_aligned_to_gps_known_positions_and_distances() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let truth = photographs(&at("photos"), "walk", &Scene::room(4), &Scene::room_walk(12));
    // Features and pairs are computed once for the same photographs.
    let call = "sfm photos --camera K.txt --undistorted --features 2000 -o model --keep --resume";
    let call: Vec<&str> = call.split(' ').collect();
    let with = |more: &[&str]| {
        let value = json(folder.path(), &[&call[..], more].concat());
        assert_eq!(used(&value), [true; 12], "{value}");
        (value, colmap::read(at("model")).unwrap())
    };
    // Without positions: the vertical is estimated. The walk looks down a little, equally in all directions.
    let (value, model) = with(&[]);
    assert_eq!(
        (value["alignment"]["by"].as_str(), value["alignment"]["unit"].as_str()),
        (Some("photographs"), Some("arbitrary"))
    );
    let up = |model: &SparseModel| {
        let turn = |image: &cv_core::ModelImage| {
            let down = truth[&image.name].rotation * Vector3::y();
            (image.pose.rotation * -Vector3::z() - down).norm()
        };
        model.images.values().map(turn).fold(0.0, f64::max)
    };
    // The walk is an ellipse: more of its photographs look along the room.
    assert!(up(&model) < 0.03, "{}", up(&model));

    // A measured distance between two photographs.
    let apart = |a: &str, b: &str| (truth[a].center() - truth[b].center()).norm();
    let tape = format!("{:.4}", apart("walk02.png", "walk08.png"));
    let (value, model) = with(&["--distance", "walk02.png", "photos/walk08.png", &tape, "--covariance", "sigma.json"]);
    let sigma: Value = serde_json::from_str(&fs::read_to_string(at("sigma.json")).unwrap()).unwrap();
    let images = sigma["images"].as_array().unwrap();
    assert_eq!(
        (images.len(), sigma["points"].as_array().unwrap().len(), sigma["unit"].as_str()),
        (12, model.points.len(), Some("m"))
    );
    // A third of a pixel at 330 px is an angle of 0.001; a camera observes a hundred or more points at some meters: standard deviations
    // from tenths of a millimeter to some millimeters, and zero for the first camera.
    let deviation = |image: &Value| (0..3).map(|i| image["center"][i].as_f64().unwrap()).fold(0.0, f64::max);
    assert!(
        images.iter().all(|i| deviation(i) < 0.01) && images.iter().filter(|i| deviation(i) > 1e-4).count() >= 10,
        "{images:?}"
    );
    assert!(images.iter().any(|i| deviation(i) < 1e-12 && i["name"] == sigma["exact"]["pose_of"]));
    assert_eq!((value["alignment"]["by"].as_str(), value["alignment"]["unit"].as_str()), (Some("distance"), Some("m")));
    let center = |name: &str| model.images.values().find(|image| image.name == name).unwrap().pose.center();
    // Centers are accurate to a thousandth of the room.
    let found = (center("walk01.png") - center("walk06.png")).norm();
    assert!((found / apart("walk01.png", "walk06.png") - 1.0).abs() < 0.005 && up(&model) < 0.03, "{found}");

    // A list of positions, with an outlier and an unknown photograph.
    let first = east_north_up(truth["walk00.png"].center());
    let mut list = "photo,x,y,z\n".to_owned();
    for (i, (name, pose)) in truth.iter().enumerate() {
        let place =
            east_north_up(pose.center()) - first + if i == 4 { Vector3::new(1.0, 1.0, 0.0) } else { Vector3::zeros() };
        list += &format!("{name},{},{},{}\n", place.x, place.y, place.z);
    }
    fs::write(at("places.csv"), format!("{list}other.png,0,0,0\n")).unwrap();
    let ran = run(folder.path(), &[&call[..], &["--known", "places.csv", "--report", "page"]].concat());
    assert!(ran.stderr.contains("walk04.png by 1.4 m") && ran.stderr.contains("such as “other.png”"), "{}", ran.stderr);
    // Centers are accurate to a thousandth of the room, which is three meters.
    let off = off_by(&colmap::read(at("model")).unwrap(), &truth);
    assert!(off < 0.02, "{off}");
    let html = fs::read_to_string(at("page/report.html")).unwrap();
    assert!(html.contains("in the frame of places.csv, in meters, by 11 photographs"), "{}", ran.stderr);

    // Positions in the files: the lengths of a degree at 47.255° follow from the radii of WGS 84, M = 6,361,920 m and N = 6,389,700 m.
    let (lat, lon) = (47.255f64, 8.51f64);
    let (along, across) = (6_361_920.0f64.to_radians(), 6_389_700.0f64.to_radians() * lat.to_radians().cos());
    for (i, (name, pose)) in truth.iter().enumerate() {
        let image = cv_io::read_rgb(at("photos").join(name)).unwrap();
        let wrong = if i == 7 { 9.0 } else { 0.0 };
        let place = east_north_up(pose.center());
        let exif = exif_of(lat + (place.y + wrong) / along, lon + place.x / across, 412.0 + place.z);
        let metadata = Metadata { exif: Some(exif), ..Metadata::default() };
        cv_io::write_png_with(at("photos").join(name), image.view(), &metadata).unwrap();
    }
    let (value, model) = with(&[]);
    let alignment = &value["alignment"];
    assert_eq!(
        (alignment["by"].as_str(), alignment["differ"][0].as_str()),
        (Some("gps"), Some("walk07.png")),
        "{alignment}"
    );
    assert!((alignment["origin"]["latitude"].as_f64().unwrap() - lat).abs() < 1e-4, "{alignment}");
    let off = off_by(&model, &truth);
    assert!(off < 0.02, "{off}");
    // The measured distance contradicts the scale of the positions and takes precedence; without positions there is no contradiction.
    let wrong = ["--distance", "walk02.png", "walk08.png", "7.5"];
    let ran = run(folder.path(), &[&call[..], &wrong].concat());
    assert!(
        ran.stderr.contains("contradict it") || ran.stderr.contains("shorter than by --distance"),
        "{}",
        ran.stderr
    );
    let (value, _) = with(&["--ignore-gps"]);
    assert_eq!(value["alignment"]["by"].as_str(), Some("photographs"));
}

#[test]
fn invalid_positions_are_refused_before_the_computation() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["a.png", "b.png", "c.png"] {
        fs::write(folder.path().join(name), name).unwrap();
    }
    fs::write(folder.path().join("places.txt"), "a.png 0 0 0\nb.png 1 0 0\nx.png 0 1 0\n").unwrap();
    fs::write(folder.path().join("broken.txt"), "a.png 0 0 0\nb.png 1 0\n").unwrap();
    let call = |code: i32, more: &[&str], says: &str| {
        let ran = run(folder.path(), &[&["sfm", "a.png", "b.png", "c.png", "-o", "model"], more].concat());
        assert!(ran.code == Some(code) && ran.stderr.contains(says), "{more:?}: {ran:?}");
    };
    call(1, &["--known", "places.txt"], "2 of the photographs");
    call(1, &["--known", "broken.txt"], "line 2");
    call(2, &["--distance", "a.png", "b.png"], "two photographs and their distance");
    call(2, &["--distance", "a.png", "x.png", "1"], "“x.png” is none of the photographs");
    call(2, &["--distance", "a.png", "a.png", "1"], "named twice");
    call(2, &["--distance", "a.png", "b.png", "-1"], "");
}

#[test]
fn a_resumed_run_gives_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    photographs(&at("photos"), "walk", &Scene::room(4), &Scene::room_walk(12)[..7]);
    let call = |output: &'static str| {
        ["sfm", "photos", "--camera", "K.txt", "--undistorted", "--features", "3000", "-o", output, "--threads", "1"]
    };
    let whole = json(folder.path(), &call("whole"));
    assert_eq!((used(&whole), whole["resumed"]["features"].as_u64()), (vec![true; 7], Some(0)));
    let model = |name: &str| {
        files(&at(name)).into_iter().map(|file| fs::read(at(name).join(file)).unwrap()).collect::<Vec<_>>()
    };
    let truth = model("whole");
    assert_eq!(files(&at("whole")), ["cameras.txt", "images.txt", "points3D.txt"]);

    let kept = || match fs::read_dir(at("model/.cv-sfm")) {
        Ok(entries) => entries
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .filter(|n| !n.starts_with('.'))
            .collect(),
        Err(_) => Vec::new(),
    };
    // After one photograph, after some, after all.
    for least in [1, 4, 7] {
        let mut child =
            cv(folder.path()).args(call("model")).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        while kept().len() < least && child.try_wait().unwrap().is_none() {
            sleep(Duration::from_millis(1));
        }
        child.kill().unwrap();
        child.wait().unwrap();
        let found = kept().iter().filter(|name| name.ends_with(".features")).count();
        assert!(found >= least && !at("model/images.txt").exists(), "{found}");
        let value = json(folder.path(), &[&call("model")[..], &["--resume"]].concat());
        assert_eq!(value["resumed"]["features"].as_u64(), Some(found as u64));
        assert!(model("model") == truth, "killed after {least}");
        assert!(!at("model/.cv-sfm").exists());
        fs::remove_dir_all(at("model")).unwrap();
    }

    // With all files kept, features and pairs are reused.
    let keep = [&call("model")[..], &["--keep"]].concat();
    json(folder.path(), &keep);
    assert_eq!(kept().len(), 8);
    let again = [&keep[..], &["--resume"]].concat();
    let value = json(folder.path(), &again);
    assert_eq!((value["resumed"]["features"].as_u64(), value["resumed"]["pairs"].as_bool()), (Some(7), Some(true)));
    // Damaged, truncated and foreign files are computed again, with a message.
    let names: Vec<String> = kept().into_iter().filter(|name| name.ends_with(".features")).collect();
    let path = |i: usize| at("model/.cv-sfm").join(&names[i]);
    let mut bytes = fs::read(path(0)).unwrap();
    bytes[4000] ^= 1;
    fs::write(path(0), &bytes).unwrap();
    fs::write(path(1), &bytes[..5000]).unwrap();
    fs::copy(path(2), path(3)).unwrap();
    fs::write(at("model/.cv-sfm/pairs"), "").unwrap();
    let ran = run(folder.path(), &again);
    assert_eq!(ran.stderr.matches("it is recomputed").count(), 4, "{}", ran.stderr);
    let models = ["cameras.txt", "images.txt", "points3D.txt"].map(|file| fs::read(at("model").join(file)).unwrap());
    assert!(models[..] == truth[..]);
    // Other options reuse nothing; other photographs reuse the common ones.
    let fewer: Vec<&str> = again.iter().map(|word| if *word == "3000" { "2500" } else { word }).collect();
    let value = json(folder.path(), &fewer);
    assert_eq!((value["resumed"]["features"].as_u64(), value["resumed"]["pairs"].as_bool()), (Some(0), Some(false)));
    fs::remove_file(at("photos/walk06.png")).unwrap();
    let value = json(folder.path(), &again);
    assert_eq!((value["resumed"]["features"].as_u64(), value["resumed"]["pairs"].as_bool()), (Some(6), Some(false)));
    // Without --resume the state is reported, left alone, and removed at the end.
    let ran = run(folder.path(), &call("model"));
    assert!(ran.stderr.contains("--resume continues it") && !at("model/.cv-sfm").exists(), "{}", ran.stderr);
}

#[test]
fn photographs_are_added_to_a_model() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let walk = Scene::room_walk(12);
    let mut truth = photographs(&at("photos"), "walk", &Scene::room(4), &walk[..8]);
    let call = ["sfm", "photos", "--features", "3000", "--format", "colmap-binary", "-o", "model"];
    json(
        folder.path(),
        &[&call[..], &["--camera", "K.txt", "--undistorted", "--distance", "walk00.png", "walk04.png", "3.0"]].concat(),
    );
    let first = colmap::read(at("model")).unwrap();
    // In an arbitrary frame.
    let mut moved = first.clone();
    let to = Pose::new(cv_core::Rotation3::from_euler_angles(0.3, 1.0, -0.4), Vector3::new(5.0, 6.0, 7.0));
    for image in moved.images.values_mut() {
        image.pose = image.pose.compose(&to.inverse());
    }
    moved.points.values_mut().for_each(|point| point.position = to.transform(&point.position));
    fs::create_dir(at("start")).unwrap();
    colmap::write(at("start"), &moved).unwrap();

    truth.extend(photographs(&at("photos"), "then", &Scene::room(4), &walk[8..]));
    let value = json(folder.path(), &[&call[..], &["--from", "start"]].concat());
    assert_eq!((used(&value), value["models"].as_u64()), (vec![true; 12], Some(1)), "{value}");
    assert_eq!((value["alignment"]["by"].as_str(), value["alignment"]["agree"].as_u64()), (Some("model"), Some(8)));
    let more = colmap::read(at("model")).unwrap();
    is_true(&more, &truth);
    // The lens is the same to the last digit of the text, and the frame changes by no more than eight poses do with new photographs: each of the two
    // models is within a hundredth of a meter of the truth.
    assert_eq!(more.cameras.values().map(|c| c.fx).collect::<Vec<_>>(), [FOCAL]);
    for image in moved.images.values() {
        let now = more.images.values().find(|other| other.name == image.name).unwrap();
        let off = (now.pose.center() - image.pose.center()).norm();
        assert!(off < 0.02, "{}: {off}", image.name);
    }

    let refuse = |args: &[&str], says: &str| {
        let ran = run(folder.path(), &[&["sfm"], args].concat());
        assert!(ran.code != Some(0) && ran.stderr.contains(says), "{args:?}: {ran:?}");
    };
    refuse(&["photos", "-o", "new", "--from", "nowhere"], "nowhere");
    let then = ["photos/then00.png", "photos/then01.png", "-o", "new", "--from", "start"];
    refuse(&then, "0 of the 8 photographs of the model start are among the arguments");
    refuse(&["photos", "-o", "new", "--from", "start", "--focal", "330"], "cannot be used with");
    assert!(!at("new").exists());
}

/// Reads the positions of a binary PLY with colors.
fn positions_and_normals(bytes: &[u8]) -> Vec<[[f32; 3]; 2]> {
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let header = String::from_utf8_lossy(&bytes[..end]).into_owned();
    let names: Vec<&str> =
        header.lines().filter(|l| l.starts_with("property")).filter_map(|l| l.split(' ').next_back()).collect();
    assert_eq!(names, ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"], "{header}");
    let number = |p: &[u8], i: usize| f32::from_le_bytes(p[4 * i..4 * i + 4].try_into().unwrap());
    bytes[end..].chunks_exact(27).map(|p| [[0, 1, 2], [3, 4, 5]].map(|at| at.map(|i| number(p, i)))).collect()
}

#[test]
fn points_of_a_dense_cloud_are_on_the_surfaces() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let (scene, walk) = (Scene::room(4), Scene::room_walk(48));
    let truth = photographs(&at("photos"), "walk", &scene, &walk[..6]);
    // In the frame of the room, Z up.
    let place = |(name, pose): (&String, &Pose)| {
        let p = east_north_up(pose.center());
        format!("{name} {} {} {}\n", p.x, p.y, p.z)
    };
    fs::write(at("places.txt"), truth.iter().map(place).collect::<String>()).unwrap();
    let call = "sfm photos --camera K.txt --undistorted --known places.txt -o model --keep --resume";
    let call: Vec<&str> = call.split(' ').collect();
    let value =
        json(folder.path(), &[&call[..], &["--dense", "dense.ply", "--dense-size", "320", "--threads", "2"]].concat());
    let cloud = positions_and_normals(&fs::read(at("dense.ply")).unwrap());
    assert_eq!(value["dense_points"].as_u64(), Some(cloud.len() as u64));
    assert!(value["dense_pairs"].as_u64().unwrap() >= 6, "{value}");
    // Of at most one point for each of 460,000 pixels.
    assert!(cloud.len() > 40_000, "{}", cloud.len());
    let depths: Vec<_> = walk[..6]
        .iter()
        .map(|pose| (pose, render(&scene, &camera(), pose, &RenderOptions::default()).unwrap().depth))
        .collect();
    let (mut right, mut facing) = (0, 0);
    for [p, n] in &cloud {
        let world = Point3::new(f64::from(p[0]), -f64::from(p[2]), f64::from(p[1]));
        let normal = Vector3::new(f64::from(n[0]), -f64::from(n[2]), f64::from(n[1]));
        let off = |(pose, depth): &(&Pose, cv_core::GrayF32)| {
            let local = pose.transform(&world);
            let pixel = camera().project(&local)?;
            let inside = (0.0..399.0).contains(&pixel.x) && (0.0..299.0).contains(&pixel.y);
            let seen = f64::from(depth.get(pixel.x.round() as usize, pixel.y.round() as usize)?[0]);
            inside.then_some((local.z / seen - 1.0).abs())
        };
        let least = depths.iter().filter_map(off).fold(f64::INFINITY, f64::min);
        right += usize::from(least < 0.05);
        facing += usize::from(depths.iter().any(|(pose, _)| normal.dot(&(pose.center() - world)) > 0.0));
    }
    let share = right as f64 / cloud.len() as f64;
    // The baseline of neighbors is 0.15 to 0.2 m: objects at 5 m have a disparity of eight pixels, of which 0.4 px are 5 %. Pixels at
    // depth discontinuities blend foreground and background in both views.
    assert!(share > 0.95 && facing == cloud.len(), "{share}");
    let other = [&call[..], &["--dense", "again.ply", "--dense-size", "320", "--threads", "1"]].concat();
    json(folder.path(), &other);
    assert!(fs::read(at("dense.ply")).unwrap() == fs::read(at("again.ply")).unwrap(), "another number of threads");

    // A single pair has no confirmation: the error is reported, and the model is still written.
    let two = ["sfm", "photos/walk00.png", "photos/walk03.png", "--camera", "K.txt", "--undistorted", "-o", "two"];
    let ran = refused(folder.path(), &[&two[..], &["--dense", "two.ply"]].concat());
    assert!(ran.stderr.contains("is confirmed by another pair; try: three or more photographs"), "{}", ran.stderr);
    assert!(at("two/images.txt").exists() && !at("two.ply").exists());
}
