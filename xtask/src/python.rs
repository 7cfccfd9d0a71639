//! Builds the wheel of the Python package, installs it into a new virtual environment and runs its tests there.

use crate::process::check;
use crate::{root, target_dir};
use anyhow::{Context, Result, ensure};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

/// Oldest supported version of Python.
const MIN_PYTHON: (u32, u32) = (3, 10);

/// Platform tag of a wheel for every Linux with glibc 2.17 or later: maturin assigns it only if no newer symbol is used.
const MIN_LINUX_TAG: &str = "manylinux_2_17";

/// Builds the wheel and the program and runs `python/tests` on them: in the test profile, which reuses compiled crates, or in the release profile, on Linux against an old libc by zig.
/// Prints a message and succeeds if this machine has no suitable Python.
pub(crate) fn run(release: bool) -> Result<bool> {
    let (python, target) = (std::env::var("CV_PYTHON").unwrap_or_else(|_| "python3".to_owned()), target_dir()?);
    if let Err(reason) = check_python(&python) {
        println!("python: skipped: {reason:#} (CV_PYTHON names another one)");
        return Ok(true);
    }
    let folder = target.join("python");
    let environment = folder.join("venv");
    check(Command::new(&python).args(["-m", "venv", "--clear"]).arg(&environment))?;
    let programs = environment.join(if cfg!(windows) { "Scripts" } else { "bin" });
    let interpreter = programs.join(format!("python{}", std::env::consts::EXE_SUFFIX));
    let pip = |arguments: &[&str]| {
        let mut command = Command::new(&interpreter);
        // No bytecode compilation at installation: for all of Ray and SciPy it takes two minutes.
        command
            .args(["-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile"])
            .args(arguments);
        command
    };
    let sources = root().join("python");
    check(pip(&["-r"]).arg(sources.join("requirements.txt")))?;
    // Installed in parallel with the build of the wheel.
    let mut peers_install = pip(&["-r"]).arg(sources.join("requirements-peers.txt")).spawn().context("pip")?;
    let wheels = folder.join("wheels");
    if wheels.is_dir() {
        std::fs::remove_dir_all(&wheels)?;
    }
    let mut maturin = Command::new(programs.join("maturin"));
    maturin.args(["build", "--locked", "--quiet", "--interpreter"]).arg(&interpreter).arg("--out").arg(&wheels);
    maturin.env("CARGO_TARGET_DIR", &target).current_dir(&sources);
    let old_linux = release && cfg!(target_os = "linux");
    maturin.args(if release { &["--release"][..] } else { &["--profile", "dev"] });
    if old_linux {
        check(pip(&["-r"]).arg(sources.join("requirements-release.txt")))?;
        maturin.args(["--zig", "--compatibility", MIN_LINUX_TAG]).env("CARGO_ZIGBUILD_PYTHON_PATH", &interpreter);
    }
    if is_free_threaded(&interpreter)? {
        // Free-threaded Python has no stable ABI before 3.15.
        maturin.arg("--no-default-features");
    }
    check(&mut maturin)?;
    let wheel_files: Vec<PathBuf> = std::fs::read_dir(&wheels)?.map(|e| Ok(e?.path())).collect::<Result<_>>()?;
    let [wheel] = &wheel_files[..] else { anyhow::bail!("{} wheels in {}", wheel_files.len(), wheels.display()) };
    println!("python: {} has {} bytes", wheel.display(), std::fs::metadata(wheel)?.len());
    ensure!(!old_linux || wheel.to_string_lossy().contains(MIN_LINUX_TAG), "the wheel is not for {MIN_LINUX_TAG}");
    // Some peers do not support every Python and system.
    if !peers_install.wait().context("pip")?.success() {
        println!("python: some peers could not be installed");
    }
    check(pip(&["--no-deps"]).arg(wheel))?;
    let program = built_program(release, &target)?;
    let tests = |mark: &str| {
        let mut command = Command::new(&interpreter);
        command.args(["-m", "pytest", "-q", "-rs", "-p", "no:cacheprovider", "-m", mark]).arg(sources.join("tests"));
        command.env("EPIPOLE_FIXTURES", root().join("fixtures")).env("EPIPOLE_PROGRAM", &program).current_dir(&folder);
        // Every process of a cluster imports Ray: 2 s with bytecode, 8 s without.
        command.env_remove("PYTHONDONTWRITEBYTECODE").env("PYTHONPYCACHEPREFIX", environment.join("bytecode"));
        command
    };
    // The processes of a cluster mostly wait for each other: the others use the processors meanwhile.
    let cluster = tests("cluster").stdout(Stdio::piped()).spawn().context("pytest")?;
    let others = tests("not cluster").status().context("pytest")?;
    let cluster = cluster.wait_with_output().context("pytest")?;
    print!("{}", String::from_utf8_lossy(&cluster.stdout));
    Ok(others.success() && cluster.status.success())
}

/// Builds the program, with which the tests compare the package, in the profile of the wheel, and returns its path. Its features are those of the whole workspace, as in `.ci/run`.
fn built_program(release: bool, target: &Path) -> Result<PathBuf> {
    let mut build = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    build.args(["build", "--quiet", "--locked", "--workspace", "--features", "cv-pipeline/serde", "--bin", "cv"]);
    if release {
        build.arg("--release");
    }
    check(build.env("CARGO_TARGET_DIR", target).current_dir(root()))?;
    let profile = if release { "release" } else { "debug" };
    Ok(target.join(profile).join(format!("cv{}", std::env::consts::EXE_SUFFIX)))
}

/// Returns whether a Python is free-threaded.
fn is_free_threaded(python: &Path) -> Result<bool> {
    let script = "import sysconfig; print(sysconfig.get_config_var('Py_GIL_DISABLED') or 0)";
    let output = Command::new(python).args(["-c", script]).output().context("Python does not run")?;
    Ok(String::from_utf8_lossy(&output.stdout).trim() == "1")
}

/// Checks that a Python is installed and supported.
fn check_python(python: &str) -> Result<()> {
    let script = "import sys, venv; print(sys.version_info[0], sys.version_info[1])";
    let output =
        Command::new(python).args(["-c", script]).output().with_context(|| format!("{python} does not run"))?;
    ensure!(output.status.success(), "{python} has no module venv");
    let text = String::from_utf8_lossy(&output.stdout);
    let numbers: Vec<u32> = text.split_whitespace().flat_map(str::parse).collect();
    let [major, minor] = numbers[..] else { anyhow::bail!("{python} does not report its version") };
    ensure!((major, minor) >= MIN_PYTHON, "{python} is {major}.{minor}, older than {}.{}", MIN_PYTHON.0, MIN_PYTHON.1);
    Ok(())
}
