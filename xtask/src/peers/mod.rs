//! Benchmarks of other systems and ours on the same inputs.
//!
//! One file per job; its scripts and the pinned versions live in `peers/` at the root, whose `.venv` is created on the
//! first run. Register a job with one line in `JOBS`; it returns its figures with their targets.

mod adjust;
mod calibration;
mod calibration_boards;
mod calibration_markers;
mod calibration_undistort;
mod feature_quality;
mod features;
mod geometry;
mod panorama;
mod panorama_border;
mod panorama_people;
mod panorama_truth;
mod sfm;
mod stereo;
mod stereo_groups;

use crate::checks::{self, Check};
use crate::process::check;
use anyhow::{Context, Result};
use std::{
    path::{Path, PathBuf},
    process::Command,
};

/// A job: from the Python interpreter of the peers and the data folder to its figures.
type Job = fn(&Path, &Path) -> Result<Vec<Check>>;

const JOBS: &[checks::Named<Job>] = &[
    ("stereo", stereo::run),
    ("stereo-groups", stereo_groups::run),
    ("features", features::run),
    ("geometry", geometry::run),
    ("adjust", adjust::run),
    ("calibration", calibration::run),
    ("sfm", sfm::run),
    ("panorama", panorama::run),
];

/// Runs all jobs, or the one named; true if ours meets every target.
pub(crate) fn run(only: Option<&str>) -> Result<bool> {
    let jobs = checks::select(JOBS, only)?;
    let Some(data) = crate::data_dir() else {
        println!(
            "peers: skipped, there is no data: set CV_DATA_DIR to the folder that holds it (see docs/real-data.md)"
        );
        return Ok(true);
    };
    let python = python()?;
    Ok(checks::run(&jobs, |job| job(&python, &data)))
}

/// Returns the Python interpreter with the peers installed: `CV_PEERS_PYTHON`, else that of `peers/.venv`, which is created if missing.
fn python() -> Result<PathBuf> {
    if let Some(python) = std::env::var_os("CV_PEERS_PYTHON") {
        return Ok(python.into());
    }
    let folder = crate::root().join("peers");
    let python = folder.join(".venv/bin/python");
    let stamp = folder.join(".venv/requirements.txt");
    let requirements = std::fs::read_to_string(folder.join("requirements.txt")).context("peers/requirements.txt")?;
    if std::fs::read_to_string(&stamp).is_ok_and(|installed| installed == requirements) {
        return Ok(python);
    }
    println!("creating peers/.venv");
    check(Command::new("python3").args(["-m", "venv"]).arg(folder.join(".venv")))?;
    check(Command::new(&python).args(["-m", "pip", "install", "--quiet", "-r"]).arg(folder.join("requirements.txt")))?;
    std::fs::write(stamp, requirements)?;
    Ok(python)
}

/// Builds our program with the release profile, unless it is up to date, and returns its path.
fn release_program() -> Result<PathBuf> {
    let target = crate::target_dir()?;
    check(
        Command::new("cargo")
            .args(["build", "--release", "--quiet", "--locked", "--package", "cv-cli", "--bin", "cv", "--target-dir"])
            .arg(&target),
    )?;
    Ok(target.join("release").join(format!("cv{}", std::env::consts::EXE_SUFFIX)))
}

/// Replaces the section under `## name` of `docs/benchmarks.md`, or adds it at the end.
pub(crate) fn write_section(name: &str, text: &str) -> Result<()> {
    let path = crate::root().join("docs/benchmarks.md");
    let page = std::fs::read_to_string(&path).unwrap_or_else(|_| "# Benchmarks\n".to_owned());
    cv_io::write_bytes(path, with_section(&page, name, text).as_bytes())?;
    Ok(())
}

fn with_section(page: &str, name: &str, text: &str) -> String {
    let title = format!("## {name}");
    let (mut before, mut after, mut inside, mut has_section) = (String::new(), String::new(), false, false);
    for line in page.lines() {
        if line.starts_with("## ") {
            inside = line == title;
            has_section |= inside;
        }
        if !inside {
            let part = if has_section { &mut after } else { &mut before };
            part.push_str(line);
            part.push('\n');
        }
    }
    let after = if after.is_empty() { String::new() } else { format!("\n{after}") };
    format!("{}\n\n{title}\n\n{}\n{after}", before.trim_end(), text.trim())
}

/// Returns the processor's name and the number of cores.
pub(crate) fn machine() -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = info.lines().find_map(|line| line.strip_prefix("model name")).unwrap_or(": unknown processor");
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    format!("{}, {cores} cores", name.trim_start_matches([' ', '\t', ':']))
}

/// Returns the load average of the last minute (runnable processes); “unknown” if the system has none.
pub(crate) fn machine_load() -> String {
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    load.split_whitespace().next().unwrap_or("unknown").to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_section_is_replaced_in_place_or_appended() {
        let page = with_section("# Page\n\nIntro.\n\n## A\n\nold\n\n## B\n\nkept\n", "A", "new\n");
        assert_eq!(page, "# Page\n\nIntro.\n\n## A\n\nnew\n\n## B\n\nkept\n");
        assert_eq!(with_section(&page, "A", "new"), page);
        assert_eq!(with_section("# Page\n", "C", "x"), "# Page\n\n## C\n\nx\n");
    }
}
