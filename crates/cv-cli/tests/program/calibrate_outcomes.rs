//! Degenerate sets of photographs for `cv calibrate` and malformed calibration files, as a black box: each is refused for its own reason, and nothing is written.

use crate::support::{done, json, refused};
use cv_core::GrayU8;
use std::fs;
use std::path::Path;

/// Options of the marker board of most tests.
const BOARD: [&str; 8] = ["--kind", "aruco-grid", "--board", "3x2", "--marker", "30", "--dictionary", "4x4_50"];

/// Renders the sheet of a board at 60 pixels per inch.
fn sheet(folder: &Path, board: &[&str]) -> GrayU8 {
    done(folder, &[&["board", "-o", "sheet.png", "--dpi", "60"], board].concat());
    cv_io::read_gray_u8(folder.join("sheet.png")).unwrap()
}

/// Returns the messages of a calibration from three copies of an image.
fn messages_for(folder: &Path, image: &GrayU8, board: &[&str]) -> String {
    for name in ["a.png", "b.png", "c.png"] {
        cv_io::write_png(folder.join(name), image.view()).unwrap();
    }
    let arguments = [&["calibrate", "mono"], board, &["a.png", "b.png", "c.png", "-o", "camera.yaml"]].concat();
    let said = refused(folder, &arguments).stderr;
    assert!(!folder.join("camera.yaml").exists(), "{said}");
    said
}

#[test]
fn one_view_and_photographs_of_different_sizes_are_too_few() {
    let folder = tempfile::tempdir().unwrap();
    let photo = sheet(folder.path(), &BOARD);
    let view = photo.view();
    cv_io::write_png(folder.path().join("one.png"), view).unwrap();
    let part = view.crop(0, 10, view.width(), view.height() - 20).unwrap();
    cv_io::write_png(folder.path().join("other.png"), part).unwrap();
    let calibrate = |photos: &[&str]| {
        let arguments = [&["calibrate", "mono"], &BOARD[..], photos, &["-o", "camera.yaml"]].concat();
        refused(folder.path(), &arguments).stderr
    };
    let one = calibrate(&["one.png"]);
    assert!(one.contains("can be used on 1 photograph, 3 are needed"), "{one}");
    let sizes = calibrate(&["one.png", "other.png", "one.png"]);
    assert!(sizes.contains("2 photographs, 3 are needed"), "{sizes}");
    assert!(sizes.contains("702×476 px, the first photograph is 702×496 px"), "{sizes}");
    assert!(!folder.path().join("camera.yaml").exists());
}

#[test]
fn mirrored_boards_two_boards_and_dark_images_are_reported_differently() {
    let folder = tempfile::tempdir().unwrap();
    let photo = sheet(folder.path(), &BOARD);
    let (width, height) = photo.size();
    let mirrored = GrayU8::from_fn(width, height, |x, y| photo.at(width - 1 - x, y));
    let said = messages_for(folder.path(), &mirrored, &BOARD);
    assert!(said.contains("6 markers of 4x4_50, mirrored"), "{said}");
    let twice = GrayU8::from_fn(2 * width, height, |x, y| photo.at(x % width, y));
    let said = messages_for(folder.path(), &twice, &BOARD);
    assert!(said.contains("detected the board 2 times"), "{said}");
    // A dark image: white has level 4 of 255.
    let dark = photo.map(|[v]| [v / 60]);
    let said = messages_for(folder.path(), &dark, &BOARD);
    assert!(said.contains("no board was detected on any of 3 photographs"), "{said}");
    let said = messages_for(
        folder.path(),
        &sheet(folder.path(), &["--board", "9x6", "--square", "20"]).map(|[v]| [v / 60]),
        &["--board", "9x6"],
    );
    assert!(said.contains("no board was detected on any of 3 photographs"), "{said}");
}

#[test]
fn boards_with_a_rotational_symmetry_of_180_degrees_are_detected() {
    let folder = tempfile::tempdir().unwrap();
    for size in ["8x6", "7x7"] {
        let photo = sheet(folder.path(), &["--board", size, "--square", "20"]);
        // Detected in each, but fronto-parallel in all: the poses are refused, not the board.
        let said = messages_for(folder.path(), &photo, &["--board", size]);
        assert!(
            said.contains("do not determine the intrinsics: the largest tilt of the board is 0°"),
            "{size}: {said}"
        );
    }
}

#[test]
fn malformed_calibration_files_and_entity_bombs_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let camera = "schema: cv-camera/1\nwidth: 160\nheight: 120\nfx: 130.25\nfy: 131\ncx: 80\ncy: 59.5\n";
    fs::write(folder.path().join("good.yaml"), camera).unwrap();
    assert_eq!(json(folder.path(), &["calibration", "show", "good.yaml"])["camera"]["fx"], 130.25);
    let laughs = |count: usize| {
        (1..count).fold("<!DOCTYPE o [<!ENTITY a0 \"ha\">".to_owned(), |text, i| {
            format!("{text}<!ENTITY a{i} \"{}\">", format!("&a{};", i - 1).repeat(10))
        })
    };
    let anchors = (1..30).fold("a0: &a0 [1, 1]\n".to_owned(), |text, i| {
        format!("{text}a{i}: &a{i} [*a{0}, *a{0}, *a{0}, *a{0}, *a{0}, *a{0}, *a{0}, *a{0}]\n", i - 1)
    });
    for (name, text) in [
        ("cut.yaml", camera[..60].to_owned()),
        ("text.yaml", camera.replace("130.25", "wide")),
        ("none.yaml", camera.replace("130.25", ".nan")),
        ("brace.yaml", format!("{camera}distortion: {{[\n")),
        ("empty.yaml", String::new()),
        ("anchors.yaml", format!("{camera}{anchors}")),
        (
            "laughs.xml",
            format!("<?xml version=\"1.0\"?>{}]><opencv_storage><width>&a20;</width></opencv_storage>", laughs(21)),
        ),
    ] {
        fs::write(folder.path().join(name), text).unwrap();
        let said = refused(folder.path(), &["calibration", "show", name]).stderr;
        assert!(said.contains(name), "{name}: {said}");
    }
}
