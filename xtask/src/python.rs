//! The Python package: its wheel in a virtual environment of its own, and its tests there.

use crate::{peers, root, target_dir};
use anyhow::{Context, Result, ensure};
use std::path::PathBuf;
use std::process::Command;

/// The oldest Python that the wheel is for.
const OLDEST: (u32, u32) = (3, 10);

/// Builds the wheel in the profile of the tests, whose crates are compiled already, and runs `python/tests` on it. Says so where this machine has no Python for it.
pub(crate) fn run() -> Result<bool> {
    let (python, target) = (std::env::var("CV_PYTHON").unwrap_or_else(|_| "python3".to_owned()), target_dir()?);
    if let Err(reason) = usable(&python) {
        println!("python: skipped: {reason:#} (CV_PYTHON names another one)");
        return Ok(true);
    }
    let folder = target.join("python");
    let environment = folder.join("venv");
    peers::check(Command::new(&python).args(["-m", "venv", "--clear"]).arg(&environment))?;
    let programs = environment.join(if cfg!(windows) { "Scripts" } else { "bin" });
    let own = programs.join(format!("python{}", std::env::consts::EXE_SUFFIX));
    let pip = |arguments: &[&str]| {
        let mut command = Command::new(&own);
        command.args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check"]).args(arguments);
        command
    };
    let sources = root().join("python");
    peers::check(pip(&["-r"]).arg(sources.join("requirements.txt")))?;
    // While the wheel is built.
    let mut others = pip(&["-r"]).arg(sources.join("requirements-peers.txt")).spawn().context("pip")?;
    let wheels = folder.join("wheels");
    if wheels.is_dir() {
        std::fs::remove_dir_all(&wheels)?;
    }
    peers::check(
        Command::new(programs.join("maturin"))
            .args(["build", "--profile", "dev", "--locked", "--quiet", "--interpreter"])
            .arg(&own)
            .arg("--out")
            .arg(&wheels)
            .env("CARGO_TARGET_DIR", &target)
            .current_dir(&sources),
    )?;
    let made: Vec<PathBuf> = std::fs::read_dir(&wheels)?.map(|e| Ok(e?.path())).collect::<Result<_>>()?;
    let [wheel] = &made[..] else { anyhow::bail!("{} wheels in {}", made.len(), wheels.display()) };
    println!("python: {} has {} bytes", wheel.display(), std::fs::metadata(wheel)?.len());
    // Not for every Python, nor for every system.
    if !others.wait().context("pip")?.success() {
        println!("python: without some of its peers");
    }
    peers::check(pip(&["--no-deps"]).arg(wheel))?;
    let program = target.join("debug").join(format!("cv{}", std::env::consts::EXE_SUFFIX));
    let mut tests = Command::new(&own);
    tests.args(["-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider"]).arg(sources.join("tests")).current_dir(&folder);
    tests.env("EPIPOLE_FIXTURES", root().join("fixtures"));
    if program.is_file() {
        tests.env("EPIPOLE_PROGRAM", program);
    }
    let status = tests.status().context("pytest")?;
    Ok(status.success())
}

/// Whether a Python is there that the wheel is for.
fn usable(python: &str) -> Result<()> {
    let asked = "import sys, venv; print(sys.version_info[0], sys.version_info[1])";
    let told = Command::new(python).args(["-c", asked]).output().with_context(|| format!("{python} does not run"))?;
    ensure!(told.status.success(), "{python} has no module venv");
    let text = String::from_utf8_lossy(&told.stdout);
    let numbers: Vec<u32> = text.split_whitespace().flat_map(str::parse).collect();
    let [major, minor] = numbers[..] else { anyhow::bail!("{python} does not tell its version") };
    ensure!((major, minor) >= OLDEST, "{python} is {major}.{minor}, older than {}.{}", OLDEST.0, OLDEST.1);
    Ok(())
}
