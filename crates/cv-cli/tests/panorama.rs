//! `cv panorama` from outside: what its options change in the file.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod support;

use cv_core::RgbU8;
use support::{done, fixture, json, run, strs};

#[test]
fn alpha_is_transparent_where_no_photograph_reaches() {
    let folder = tempfile::tempdir().unwrap();
    let views: Vec<String> =
        (0..3).map(|i| fixture(&format!("panorama/view{i}.jpg")).to_str().unwrap().to_owned()).collect();
    let args = |more: &[&str]| -> Vec<String> {
        let words = ["panorama"].into_iter().chain(strs(&views)).chain(["--projection", "cylindrical"]);
        words.chain(more.iter().copied()).map(str::to_owned).collect()
    };
    done(folder.path(), &strs(&args(&["-o", "plain.png"])));
    done(folder.path(), &strs(&args(&["-o", "alpha.PNG", "--alpha"])));
    let plain = cv_io::read_rgb(folder.path().join("plain.png")).unwrap();
    let file = std::fs::File::open(folder.path().join("alpha.PNG")).unwrap();
    let mut reader = png::Decoder::new(std::io::BufReader::new(file)).read_info().unwrap();
    assert_eq!(reader.output_color_type(), (png::ColorType::Rgba, png::BitDepth::Eight));
    let mut alpha = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut alpha).unwrap();
    assert_eq!(alpha.len(), plain.width() * plain.height() * 4);
    let mut clear = 0;
    for (p, a) in plain.pixels().zip(alpha.chunks_exact(4)) {
        assert_eq!(p, a[..3]);
        match a {
            [0, 0, 0, 0] => clear += 1,
            [_, _, _, 255] => {}
            other => panic!("neither there nor not there: {other:?}"),
        }
    }
    // A cylinder bends the upper and lower edges of photographs: some of the box around them is empty, most is not.
    assert!(clear > 100 && 4 * clear < plain.width() * plain.height(), "{clear}");
    assert_eq!(run(folder.path(), &strs(&args(&["-o", "pano.jpg", "--alpha"]))).code, Some(2));
    assert!(!folder.path().join("pano.jpg").exists());
}

#[test]
fn a_photograph_on_its_side_changes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let mut sizes = Vec::new();
    for turned in [None, Some(0), Some(1), Some(2)] {
        let mut args = vec!["panorama".to_owned()];
        for i in 0..3 {
            let photo = cv_io::read_rgb(fixture(&format!("panorama/view{i}.jpg"))).unwrap();
            let (w, h) = photo.size();
            let side = RgbU8::from_fn(h, w, |x, y| photo.at(w - 1 - y, x));
            let path = folder.path().join(format!("{i}.png"));
            cv_io::write_png(&path, if turned == Some(i) { side.view() } else { photo.view() }).unwrap();
            args.push(path.to_str().unwrap().to_owned());
        }
        args.extend(["-o", "p.png"].map(str::to_owned));
        let value = json(folder.path(), &strs(&args));
        assert!(value["images"].as_array().unwrap().iter().all(|image| image["used"] == true), "{value}");
        sizes.push([0, 1].map(|i| value["size"][i].as_f64().unwrap()));
    }
    // The features of a photograph and of the same on its side differ a little, and so does where the horizon is put.
    for size in &sizes[1..] {
        assert!((0..2).all(|i| (size[i] / sizes[0][i] - 1.0).abs() < 0.05), "{sizes:?}");
    }
}

#[test]
fn the_mode_is_taken_told_and_checked() {
    let folder = tempfile::tempdir().unwrap();
    // One flat picture, two parts of it: what a camera shows that was slid along a wall.
    let wall = cv_io::read_rgb(fixture("panorama/view1.jpg")).unwrap();
    let (w, h) = wall.size();
    let wide = 2 * w / 3;
    for (i, left) in [0, w - wide].into_iter().enumerate() {
        let part = wall.view().crop(left, 0, wide, h).unwrap();
        cv_io::write_png(folder.path().join(format!("{i}.png")), part).unwrap();
    }
    let told = |mode: &str| json(folder.path(), &["panorama", "0.png", "1.png", "-o", "p.png", "--mode", mode]);
    let value = told("plane");
    assert_eq!((value["mode"].as_str(), value["projection"].as_str()), (Some("plane"), Some("plane")));
    let size = [0, 1].map(|i| value["size"][i].as_f64().unwrap());
    // The wall again: half a per cent for what matches of a tenth of a pixel leave of its frame.
    assert!((size[0] / w as f64 - 1.0).abs() < 0.005 && (size[1] / h as f64 - 1.0).abs() < 0.005, "{size:?} {w} {h}");
    assert_eq!(told("rotation")["mode"], "rotation");
    assert_eq!(run(folder.path(), &["panorama", "0.png", "1.png", "-o", "q.png", "--mode", "flat"]).code, Some(2));
}
