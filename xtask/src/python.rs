//! The Python package: its wheel in a virtual environment of its own, and its tests there.

use crate::{peers, root, target_dir};
use anyhow::{Context, Result, ensure};
use std::path::{Path, PathBuf};
use std::process::Command;

/// The oldest Python that the wheel is for.
const OLDEST: (u32, u32) = (3, 10);

/// What the name of a wheel has that runs on every Linux from glibc 2.17 on: maturin gives it only where no newer symbol is used.
const OLDEST_LINUX: &str = "manylinux_2_17";

/// Builds the wheel and runs `python/tests` on it: in the profile of the tests, whose crates are compiled already, or as it is released, on Linux against an old libc by zig.
/// Says so where this machine has no Python for it.
pub(crate) fn run(release: bool) -> Result<bool> {
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
        // Byte code is compiled for the modules that are imported: that of all of Ray and SciPy takes two minutes.
        command
            .args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile"])
            .args(arguments);
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
    let mut maturin = Command::new(programs.join("maturin"));
    maturin.args(["build", "--locked", "--quiet", "--interpreter"]).arg(&own).arg("--out").arg(&wheels);
    maturin.env("CARGO_TARGET_DIR", &target).current_dir(&sources);
    let old_linux = release && cfg!(target_os = "linux");
    maturin.args(if release { &["--release"][..] } else { &["--profile", "dev"] });
    if old_linux {
        peers::check(pip(&["-r"]).arg(sources.join("requirements-release.txt")))?;
        maturin.args(["--zig", "--compatibility", OLDEST_LINUX]).env("CARGO_ZIGBUILD_PYTHON_PATH", &own);
    }
    if without_gil(&own)? {
        // These have no stable interface before 3.15.
        maturin.arg("--no-default-features");
    }
    peers::check(&mut maturin)?;
    let made: Vec<PathBuf> = std::fs::read_dir(&wheels)?.map(|e| Ok(e?.path())).collect::<Result<_>>()?;
    let [wheel] = &made[..] else { anyhow::bail!("{} wheels in {}", made.len(), wheels.display()) };
    println!("python: {} has {} bytes", wheel.display(), std::fs::metadata(wheel)?.len());
    ensure!(!old_linux || wheel.to_string_lossy().contains(OLDEST_LINUX), "the wheel is not for {OLDEST_LINUX}");
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

/// Whether a Python is a free-threaded one.
fn without_gil(python: &Path) -> Result<bool> {
    let asked = "import sysconfig; print(sysconfig.get_config_var('Py_GIL_DISABLED') or 0)";
    let told = Command::new(python).args(["-c", asked]).output().context("Python does not run")?;
    Ok(String::from_utf8_lossy(&told.stdout).trim() == "1")
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
