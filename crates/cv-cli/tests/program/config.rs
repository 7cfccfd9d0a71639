//! Options from a configuration file.

use crate::support::{done, run};
use std::{fs, path::Path};

/// Writes matches with a common translation.
fn folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let row = |i: u32| (f64::from(i * 37 % 97), f64::from(i * 53 % 89));
    let rows: String = (0..40).map(row).map(|(x, y)| format!("{x} {y} {} {y}\n", x + 7.0)).collect();
    fs::write(folder.path().join("m.txt"), rows).unwrap();
    folder
}

fn config(folder: &Path, text: &str) {
    fs::write(folder.join("cv.toml"), text).unwrap();
}

const ESTIMATE: [&str; 4] = ["estimate", "homography", "--matches", "m.txt"];

#[test]
fn the_command_line_overrides_the_configuration_file() {
    let folder = folder();
    let folder = folder.path();
    let said = |more: &[&str]| done(folder, &[&ESTIMATE[..], more].concat()).stderr;
    config(folder, "threads = 1\n[estimate]\nthreshold = 0.5\n[match]\nratio = 0.7\n");
    assert!(said(&[]).contains("within 0.5 px") && said(&[]).contains("cv.toml: --threshold=0.5 --threads=1"));
    assert!(said(&["--threshold", "2"]).contains("within 2 px"));
    fs::write(folder.join("other.toml"), "[estimate]\nthreshold = 1.5\n").unwrap();
    assert!(said(&["--config", "other.toml"]).contains("within 1.5 px"));
    // Paths are relative to the folder of the configuration file.
    let out = tempfile::tempdir().unwrap();
    fs::copy(folder.join("m.txt"), out.path().join("m.txt")).unwrap();
    assert!(done(out.path(), &ESTIMATE).stderr.contains("within 3 px"));
    // Required options and flags are allowed.
    config(folder, "json = true\n[estimate]\nmatches = \"m.txt\"\n");
    let ran = done(folder, &ESTIMATE[..2]);
    assert!(serde_json::from_str::<serde_json::Value>(&ran.stdout).unwrap()["inliers"].as_array().unwrap().len() == 40);
    // Entries that conflict with the command line are ignored.
    config(folder, "[estimate]\ncamera = \"no-such-file\"\n");
    let ran = run(folder, &["estimate", "essential", "--matches", "m.txt", "--focal", "50", "--size", "100x90"]);
    assert!(!ran.stderr.contains("no-such-file"), "{ran:?}");
}

#[test]
fn errors_of_the_configuration_file_name_the_entry() {
    let folder = folder();
    for (text, word) in [
        ("[estimate]\ntreshold = 1\n", "“treshold”"),
        ("[estimat]\nthreshold = 1\n", "“estimat”"),
        ("threshold = 1\n", "“threshold”"),
        ("[segment.train]\nspaces = \"hsv\"\n", "“spaces”"),
        ("[estimate]\nthreshold = \"wide\"\n", "wide"),
        ("[match]\none-way = 3\n[estimate]\nthreshold = \"wide\"\n", "wide"),
        ("quiet = 1\n", "true or false"),
        ("config = \"b.toml\"\n", "“config”"),
    ] {
        config(folder.path(), text);
        let ran = run(folder.path(), &ESTIMATE);
        assert!(ran.code == Some(2) && ran.stdout.is_empty() && ran.stderr.contains(word), "{text}: {ran:?}");
    }
    config(folder.path(), "not valid TOML");
    assert!(run(folder.path(), &ESTIMATE).stderr.contains("cv.toml is not valid TOML"));
    let ran = run(folder.path(), &[&ESTIMATE[..], &["--config", "missing.toml"]].concat());
    assert!(ran.code == Some(1) && ran.stderr.contains("missing.toml"), "{ran:?}");
}

#[test]
fn the_effective_configuration_is_printed_as_a_valid_file() {
    let folder = folder();
    let folder = folder.path();
    config(folder, "threads = 2\n[depth]\ndisparities = \"auto\"\nno-fill = true\n");
    let text = done(folder, &["depth", "--print-config", "--near", "0.5"]).stdout;
    let lines: Vec<&str> = text.lines().collect();
    for line in ["threads = 2", "[depth]", "disparities = \"auto\"", "near = 0.5", "no-fill = true", "# offset = 0"] {
        assert!(lines.contains(&line), "{line}: {text}");
    }
    assert!(!text.contains("print-config"));
    // The printed file gives the same configuration.
    fs::write(folder.join("again.toml"), &text).unwrap();
    assert_eq!(done(folder, &["depth", "--print-config", "--config", "again.toml"]).stdout, text);
}
