//! Damaged inputs to the program, a few of each kind; `cargo xtask trust corrupt` does ten thousand.

use crate::support::{done, fixture, run, snapshot};
use cv_core::{GrayF32, RgbU8};
use cv_synth::corrupt;
use std::fs;

/// Number of damaged versions of each file.
const RUNS: u64 = 8;

#[test]
fn damaged_inputs_are_read_or_refused_without_a_crash() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    for side in ["left", "right"] {
        let photo = cv_io::read_rgb(fixture(&format!("stereo/{side}.jpg"))).unwrap();
        let part = RgbU8::from_fn(120, 80, |x, y| photo.at(2 * x + 100, 2 * y + 60));
        cv_io::write_png(folder.join(format!("{side}.png")), part.view()).unwrap();
        cv_io::write_jpeg(folder.join(format!("{side}.jpg")), part.view()).unwrap();
        let mask = part.map(|[r, _, _]| [r > 128]);
        cv_io::write_png(folder.join(format!("{side}_mask.png")), mask.view()).unwrap();
    }
    let map = GrayF32::from_fn(40, 30, |x, y| [(x + y) as f32 / 4.0]);
    cv_io::pfm::write(folder.join("map.pfm"), map.view()).unwrap();
    cv_io::npy::write(folder.join("map.npy"), &cv_io::npy::NpyArray::from_view(map.view())).unwrap();
    fs::write(folder.join("K.txt"), "120 0 60\n0 120 40\n0 0 1\n").unwrap();
    fs::write(folder.join("cv.toml.in"), "quiet = true\n[match]\nratio = 0.7\nfeatures = \"mops\"\n").unwrap();
    done(folder, &["match", "left.png", "right.png", "--features", "mops", "-o", "m.txt"]);
    done(
        folder,
        &["segment", "train", "--images", "left.png", "--masks", ".", "--components", "2", "-o", "model.json"],
    );
    let commands = [
        ("left.png", "depth left.png right.png -o out.pfm --disparities 32"),
        ("right.jpg", "match left.jpg right.jpg --features mops -o out.txt"),
        ("map.pfm", "eval disparity --estimate map.pfm --truth map.npy -o out.png"),
        ("map.npy", "eval disparity --estimate map.pfm --truth map.npy -o out.png"),
        ("m.txt", "estimate homography --matches m.txt"),
        ("K.txt", "estimate essential --matches m.txt --camera K.txt --size 120x80"),
        ("model.json", "segment predict --model model.json left.png -o found"),
        ("left_mask.png", "segment eval --model model.json --images left.png --masks ."),
        ("cv.toml.in", "match left.png right.png -o out.txt --config cv.toml.in"),
    ];
    for (input, args) in commands {
        let args: Vec<&str> = args.split(' ').collect();
        let whole = fs::read(folder.join(input)).unwrap();
        for seed in 0..RUNS {
            fs::write(folder.join(input), corrupt(&whole, seed)).unwrap();
            let before = snapshot(folder);
            let ran = run(folder, &args);
            let said = ran.stderr.lines().filter(|line| line.starts_with("error: ")).count();
            assert_eq!(said == 0, ran.code == Some(0), "{args:?} with {input} of seed {seed}: {ran:?}");
            if ran.code != Some(0) {
                assert!(snapshot(folder) == before, "{args:?} with {input} of seed {seed}");
            }
        }
        fs::write(folder.join(input), whole).unwrap();
    }
}
