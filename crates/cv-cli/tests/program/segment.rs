//! `cv segment` as a black box.

use crate::support::{done, json, refused, run};
use cv_core::{Mask, RgbU8};
use std::fs;

/// Writes four images of an orange disc on gray and their masks to a new folder.
fn discs() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for part in ["train", "test"] {
        fs::create_dir(folder.path().join(part)).unwrap();
        for i in 0..2 {
            let inside = |x: usize, y: usize| (x as f64 - 40.0 - 9.0 * i as f64).hypot(y as f64 - 30.0) < 14.0;
            let photo = RgbU8::from_fn(96, 64, |x, y| {
                let shade = ((x * 7 + y * 13 + i) % 19) as u8;
                if inside(x, y) { [225, 100 + shade, 20 + shade] } else { [90 + shade; 3] }
            });
            let at = |name: String| folder.path().join(part).join(name);
            cv_io::write_png(at(format!("p{i}.png")), photo.view()).unwrap();
            let mask = Mask::from_fn(96, 64, |x, y| [inside(x, y)]);
            cv_io::write_png(at(format!("p{i}_mask.png")), mask.view()).unwrap();
        }
    }
    folder
}

#[test]
fn training_prediction_and_evaluation_of_discs_succeed() {
    let discs = discs();
    let folder = discs.path();
    let train = ["segment", "train", "--images", "train", "--masks", "train", "--model", "m.json"];
    let learned = json(folder, &[&train[..], &["--report", "r"]].concat());
    assert_eq!(learned["images"].as_array().unwrap().len(), 2);
    assert!(fs::read_to_string(folder.join("r/report.html")).unwrap().contains("Photographs"));
    let scored = json(folder, &["segment", "eval", "--model", "m.json", "--images", "test", "--masks", "test"]);
    for key in ["precision", "recall", "f1"] {
        // The disc's colors are unique; smoothing and opening remove a part of its border, 88 of 616 pixels.
        assert!(scored[key].as_f64().unwrap() > 0.95, "{key}: {scored}");
    }
    assert_eq!(scored["images"][1]["path"], "test/p1.png");
    let found = json(folder, &["segment", "predict", "--model", "m.json", "test/p0.png", "--out", "new/found"]);
    let share = found["images"][0]["fraction"].as_f64().unwrap();
    assert!((share - 616.0 / 6144.0).abs() < 0.01, "{share}");
    assert_eq!(cv_io::read_mask(folder.join("new/found/p0_mask.png")).unwrap().size(), (96, 64));
    // A disc of radius 14 around (40, 30), without a part of its border.
    let object = &found["images"][0];
    assert_eq!(object["found"], true);
    let number = |value: &serde_json::Value| value.as_f64().unwrap();
    assert!(number(&object["score"]) > 0.5, "{object}");
    for (key, i, truth, tolerance) in [
        ("center", 0, 40.0, 0.5),
        ("center", 1, 30.0, 0.5),
        ("axes", 0, 14.0, 1.0),
        ("axes", 1, 14.0, 1.0),
        ("box", 0, 27.0, 1.0),
        ("box", 1, 17.0, 1.0),
        ("box", 2, 27.0, 2.0),
        ("box", 3, 27.0, 2.0),
    ] {
        assert!((number(&object[key][i]) - truth).abs() <= tolerance, "{key} {i}: {object}");
    }
    assert!(
        (number(&object["area"]) - 616.0).abs() < 60.0 && number(&object["angle_degrees"]).abs() <= 90.0,
        "{object}"
    );
    // The model does not depend on the number of threads.
    done(folder, &["segment", "train", "--images", "train", "--masks", "train", "--model", "n.json", "--threads", "1"]);
    assert_eq!(fs::read(folder.join("m.json")).unwrap(), fs::read(folder.join("n.json")).unwrap());
}

#[test]
fn bad_masks_are_named() {
    let discs = discs();
    let folder = discs.path();
    for (name, mask, word) in [
        ("black", Mask::new(96, 64, [false]), "marks a pixel"),
        ("white", Mask::new(96, 64, [true]), "every pixel"),
        ("small", Mask::new(9, 6, [true]), "96×64"),
    ] {
        fs::create_dir(folder.join(name)).unwrap();
        cv_io::write_png(folder.join(name).join("p0.png"), mask.view()).unwrap();
        let ran =
            refused(folder, &["segment", "train", "--images", "train/p0.png", "--masks", name, "--model", "m.json"]);
        assert!(ran.stderr.contains(word) && ran.stderr.contains("try: "), "{}", ran.stderr);
    }
    fs::create_dir(folder.join("other")).unwrap();
    fs::copy(folder.join("train/p0.png"), folder.join("other/q.png")).unwrap();
    for masks in ["other", "missing"] {
        refused(folder, &["segment", "train", "--images", "train", "--masks", masks, "--model", "m.json"]);
    }
    assert!(!folder.join("m.json").exists());
}

#[test]
fn bad_models_and_arguments_are_refused() {
    let discs = discs();
    let folder = discs.path();
    for (text, word) in [
        ("", "empty"),
        ("[", "not a segmentation model"),
        ("{\"schema\": 9}", "schema 9"),
        ("{}", "no schema"),
        ("{\"schema\": 1}", "missing field"),
    ] {
        fs::write(folder.join("bad.json"), text).unwrap();
        let ran = refused(folder, &["segment", "predict", "--model", "bad.json", "test", "--out", "found"]);
        assert!(ran.stderr.contains(word), "{}", ran.stderr);
    }
    let train = ["segment", "train", "--images", "train", "--masks", "train", "--model", "m.json"];
    for wrong in [["--components", "0"], ["--smoothing", "nan"], ["--space", "cmyk"], ["--open", "5000"]] {
        assert_eq!(run(folder, &[&train[..], &wrong[..]].concat()).code, Some(2), "{wrong:?}");
    }
    // A prediction overwrites neither a hand-drawn mask nor another prediction of the same run.
    done(folder, &train);
    let drawn = fs::read(folder.join("test/p0_mask.png")).unwrap();
    for images in ["test", "test/p0.png"] {
        let ran = refused(folder, &["segment", "predict", "--model", "m.json", images, "--out", "test"]);
        assert!(ran.stderr.contains("overwritten"), "{}", ran.stderr);
    }
    assert_eq!(fs::read(folder.join("test/p0_mask.png")).unwrap(), drawn);
}

#[test]
fn an_object_of_the_same_color_and_another_shape_is_not_detected() {
    let discs = discs();
    let folder = discs.path();
    done(folder, &["segment", "train", "--images", "train", "--masks", "train", "--model", "m.json"]);
    // A bar of the disc's color, 48 by 8 pixels, without a disc.
    let scene = |bar: bool| {
        RgbU8::from_fn(96, 64, |x, y| {
            let shade = ((x * 7 + y * 13) % 19) as u8;
            let inside = bar && (24..72).contains(&x) && (28..36).contains(&y);
            if inside { [225, 100 + shade, 20 + shade] } else { [90 + shade; 3] }
        })
    };
    cv_io::write_png(folder.join("bar.png"), scene(true).view()).unwrap();
    cv_io::write_png(folder.join("none.png"), scene(false).view()).unwrap();
    let predict = ["segment", "predict", "--model", "m.json", "bar.png", "none.png"];
    let found = json(folder, &[&predict[..], &["--out", "f", "--report", "r"]].concat());
    let [bar, none] = [0, 1].map(|i| &found["images"][i]);
    assert!(bar["found"] == false && bar["score"].as_f64().unwrap() < 1e-3 && bar["box"].is_null(), "{bar}");
    assert!(bar["fraction"] == 0.0 && bar["objects"][0]["axis_ratio"].as_f64().unwrap() < 0.25, "{bar}");
    assert!(none["found"] == false && none["score"].is_null() && none["objects"].as_array().unwrap().is_empty());
    let mask = cv_io::read_mask(folder.join("f/bar_mask.png")).unwrap();
    assert!(mask.as_slice().iter().all(|&m| !m));
    assert!(fs::read_to_string(folder.join("r/report.html")).unwrap().contains("not found"));
    let ran = done(folder, &[&predict[..], &["--out", "g"]].concat());
    assert!(ran.stderr.contains("found in 0") && ran.stderr.contains("bar.png"), "{}", ran.stderr);
    let all = json(folder, &[&predict[..], &["--out", "h", "--min-score", "0"]].concat());
    assert!(all["images"][0]["found"] == true && all["images"][1]["found"] == false, "{all}");
    for wrong in ["-1", "1.5", "nan"] {
        let least = format!("--min-score={wrong}");
        assert_eq!(run(folder, &[&predict[..], &["--out", "i", &least]].concat()).code, Some(2), "{wrong}");
    }
    // A model of an older version without object statistics: no score, every object is detected.
    let text = fs::read_to_string(folder.join("m.json")).unwrap();
    let mut model: serde_json::Value = serde_json::from_str(&text).unwrap();
    assert!(model.as_object_mut().unwrap().remove("objects").is_some());
    fs::write(folder.join("m.json"), model.to_string()).unwrap();
    let old = json(folder, &[&predict[..], &["--out", "j"]].concat());
    let bar = &old["images"][0];
    assert!(bar["found"] == true && bar["score"].is_null() && bar["fraction"].as_f64().unwrap() > 0.05, "{bar}");
}
