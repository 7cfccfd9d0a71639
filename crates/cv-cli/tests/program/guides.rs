//! The guides under `docs/` and the README: their commands run, commands with a stated failure fail with that message, and their links are valid.

use crate::support::done;
use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

/// The pages in the order of their execution: each may use the files of earlier ones.
const GUIDES: [&str; 12] = [
    "first-hour.md",
    "jobs/panorama.md",
    "jobs/depth.md",
    "jobs/rectification.md",
    "jobs/reconstruction.md",
    "jobs/many-views.md",
    "jobs/segmentation.md",
    "jobs/matching.md",
    "jobs/calibration.md",
    "parameters.md",
    "from-opencv.md",
    "when-it-fails.md",
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn read(path: &Path) -> String {
    fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Returns the fenced blocks of a page: the info string and the text.
fn blocks(page: &str) -> Vec<(String, String)> {
    let mut blocks = Vec::new();
    let mut lines = page.lines();
    while let Some(line) = lines.next() {
        if let Some(info) = line.strip_prefix("```") {
            let text: Vec<&str> = lines.by_ref().take_while(|line| !line.starts_with("```")).collect();
            blocks.push((info.to_owned(), text.join("\n")));
        }
    }
    blocks
}

/// Runs a block in a shell in which `cv` is this program. Returns the exit code and stderr.
fn shell(folder: &Path, text: &str) -> (Option<i32>, String) {
    let program = Path::new(env!("CARGO_BIN_EXE_cv")).parent().unwrap().to_owned();
    let path = std::env::var_os("PATH").unwrap_or_default();
    let path = std::env::join_paths(std::iter::once(program).chain(std::env::split_paths(&path))).unwrap();
    let output = Command::new("sh")
        .args(["-euc", text])
        .env("PATH", path)
        .current_dir(folder)
        .stdin(Stdio::null())
        .output()
        .unwrap();
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn every_command_of_the_guides_succeeds_with_the_stated_outputs() {
    let folder = tempfile::tempdir().unwrap();
    let mut commands = 0;
    for guide in GUIDES {
        let page = read(&root().join("docs").join(guide));
        let blocks = blocks(&page);
        for (i, (info, text)) in blocks.iter().enumerate() {
            if !matches!(info.as_str(), "sh" | "sh fails") {
                continue;
            }
            commands += text.lines().filter(|line| line.contains("cv ")).count();
            let (code, said) = shell(folder.path(), text);
            if info == "sh" {
                assert_eq!(code, Some(0), "{guide}:\n{text}\n{said}");
                assert!(!said.contains("warning: "), "{guide}:\n{text}\n{said}");
                continue;
            }
            // The expected message is in the next block.
            let promised = &blocks[i + 1];
            assert_eq!((code, promised.0.as_str()), (Some(1), "text"), "{guide}:\n{text}\n{said}");
            assert!(said.contains(promised.1.trim()), "{guide}:\n{text}\n{said}");
        }
    }
    assert!(commands >= 30, "{commands} commands: guides have gone");
    for page in [
        "pano-report",
        "depth-report",
        "motion-report",
        "walk-report",
        "rectify-report",
        "found-report",
        "match-report",
        "calibration-report",
    ] {
        assert!(folder.path().join(page).join("report.html").is_file(), "{page}");
    }
    assert!(
        !fs::read_dir(folder.path()).unwrap().any(|f| f.unwrap().file_name().to_string_lossy().contains("nothing"))
    );
}

#[test]
fn every_link_and_image_of_the_guides_exists() {
    let docs = root().join("docs");
    let architecture = ["architecture.md", "benchmarks.md", "real-data.md"].map(|name| docs.join(name));
    let pages: Vec<PathBuf> =
        GUIDES.iter().map(|guide| docs.join(guide)).chain(architecture).chain([root().join("README.md")]).collect();
    let mut links = 0;
    let mut linked = Vec::new();
    for page in &pages {
        let text = read(page);
        for link in text.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            if link.starts_with("http") || link.starts_with('#') {
                continue;
            }
            let target = page.parent().unwrap().join(link.split('#').next().unwrap());
            assert!(target.exists(), "{}: {link} leads nowhere", page.display());
            links += 1;
            linked.push(target.canonicalize().unwrap());
        }
    }
    assert!(links >= 30, "{links} links: guides have gone");
    // Every page and image must be linked, and the images' total size is limited.
    let mut bytes = 0;
    for folder in ["", "jobs", "pictures"] {
        for file in
            fs::read_dir(docs.join(folder)).unwrap().map(|entry| entry.unwrap().path()).filter(|path| path.is_file())
        {
            bytes += fs::metadata(&file).unwrap().len();
            assert!(linked.contains(&file.canonicalize().unwrap()), "nothing leads to {}", file.display());
        }
    }
    assert!(bytes < 2_000_000, "docs/ has {bytes} bytes");
    assert!(read(&root().join("README.md")).lines().count() < 200);
}

/// Returns the Rust sources below a folder, without integration tests, as one text.
fn sources(folder: &Path, text: &mut String) {
    for entry in fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
        if entry.is_dir() && !entry.ends_with("tests") {
            sources(&entry, text);
        } else if entry.extension().is_some_and(|ending| ending == "rs") {
            text.push_str(&read(&entry));
        }
    }
}

#[test]
fn the_messages_in_the_guide_to_failures_are_printed_by_the_program() {
    let mut code = String::new();
    sources(&root().join("crates"), &mut code);
    let page = read(&root().join("docs/when-it-fails.md"));
    let rows: Vec<&str> = page.lines().filter_map(|line| line.strip_prefix("| `")?.split('`').next()).collect();
    assert!(rows.len() > 30, "{rows:?}");
    for message in rows {
        for part in message.split('…').map(str::trim).filter(|part| part.len() > 3) {
            let part = part.trim_end_matches(" %)").trim_start_matches("%) ");
            assert!(code.contains(part), "no message of the program has “{part}”");
        }
    }
}

#[test]
fn the_options_in_the_tables_exist() {
    let folder = tempfile::tempdir().unwrap();
    let help: String = [
        "demo",
        "segment train",
        "segment predict",
        "segment eval",
        "panorama",
        "match",
        "estimate",
        "reconstruct",
        "sfm",
        "depth",
        "rectify",
        "calibrate mono",
        "calibrate stereo",
        "calibrate rig",
        "board",
        "calibration convert",
        "undistort",
        "eval disparity",
    ]
    .iter()
    .map(|command| done(folder.path(), &[&command.split(' ').collect::<Vec<_>>()[..], &["--help"]].concat()).stdout)
    .collect();
    let known: Vec<&str> = help.split(|c: char| !(c.is_ascii_alphanumeric() || c == '-')).collect();
    for guide in GUIDES {
        let page = read(&root().join("docs").join(guide));
        for word in page
            .split(|c: char| !(c.is_ascii_alphanumeric() || c == '-'))
            .filter(|w| w.starts_with("--") && w.len() > 3)
        {
            assert!(known.contains(&word), "{guide}: {word} is no option");
        }
    }
}
