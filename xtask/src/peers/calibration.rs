//! Calibration by OpenCV, by mrcal if it is installed, and ours on the same photographs and corners. Writes the section “Calibration” of `docs/benchmarks.md`.

use super::calibration_boards as boards;
use super::calibration_markers as markers;
use super::calibration_undistort as undistort;
use crate::checks::Check;
use anyhow::{Context, Result, ensure};
use cv_core::{GrayF32, ImageView};
use cv_features::{BoardSize, Chessboard, ChessboardOptions, find_chessboard};
use cv_pipeline::calibration::{CalibrateOptions, LensChoice};
use cv_pipeline::{BoardCalibration, BoardCalibrationOptions, BoardChoice, Silent, calibrate};
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::ffi::OsStr;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Instant;

/// Result of OpenCV with one detector on the pairs.
#[derive(Debug, Deserialize)]
struct Pairs {
    detector: String,
    found: usize,
    of: usize,
    seconds: f64,
    rms: [f64; 2],
    /// RMS of the rig in pixels.
    stereo: f64,
    holdout: [f64; 2],
    baseline: f64,
    dy: [f64; 2],
    version: String,
}

/// Result of one system on the wide-angle lens.
#[derive(Debug, Deserialize)]
struct Wide {
    detector: String,
    found: usize,
    of: usize,
    seconds: f64,
    coefficients: usize,
    rms: f64,
    holdout: f64,
    #[serde(default)]
    outliers: usize,
}

/// Runs the script of the peers and parses its output, one JSON value per line.
pub(super) fn run_script<T: DeserializeOwned>(python: &Path, arguments: &[&dyn AsRef<OsStr>]) -> Result<Vec<T>> {
    let script = crate::root().join("peers/calibration_opencv.py");
    let mut command = Command::new(python);
    command.arg(&script).args(arguments.iter().map(|a| a.as_ref()));
    let output = command.output().context("cannot start Python")?;
    ensure!(output.status.success(), "{}: {}", script.display(), String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout)?;
    text.lines().map(|line| serde_json::from_str(line).with_context(|| line.to_owned())).collect()
}

/// Returns the processor seconds of this thread if the system reports them, else the wall time since `start`.
fn processor_seconds(start: Instant) -> f64 {
    let statistics = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let nanoseconds = statistics.and_then(|text| text.split(' ').next()?.parse::<f64>().ok());
    nanoseconds.map_or(start.elapsed().as_secs_f64(), |n| 1e-9 * n)
}

/// Runs `call` on one thread; returns its result and its processor seconds.
pub(super) fn on_one_thread<T: Send>(call: impl FnOnce() -> T + Send) -> Result<(T, f64)> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    Ok(pool.install(|| {
        let start = Instant::now();
        let before = processor_seconds(start);
        let value = call();
        (value, processor_seconds(start) - before)
    }))
}

/// Detects a chessboard of a given size in an image.
pub(super) fn detect_board(view: ImageView<'_, f32, 1>, size: BoardSize) -> Option<Chessboard> {
    find_chessboard(view, Some(size), &ChessboardOptions::default(), &Silent).ok()
}

pub(super) fn read_gray(path: &Path) -> Result<GrayF32> {
    Ok(cv_imgproc::gray_to_f32(cv_io::read_gray_u8(path)?.view()))
}

/// Lists the files of a folder with the prefix and the extension `.jpg`, sorted.
fn list_photographs(folder: &Path, prefix: &str) -> Result<Vec<PathBuf>> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<Result<_>>()?;
    let is_match = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        name.starts_with(prefix) && name.ends_with(".jpg")
    };
    files.retain(is_match);
    files.sort();
    Ok(files)
}

/// Detects the board in each photograph; returns success by photograph and the processor seconds.
fn detect_all(photos: &[GrayF32], size: BoardSize) -> Result<(Vec<bool>, f64)> {
    // Warm-up: the first call allocates memory and selects the instruction set.
    photos.first().map(|photo| detect_board(photo.view(), size));
    on_one_thread(|| photos.iter().map(|photo| detect_board(photo.view(), size).is_some()).collect())
}

fn calibrate_views(views: &[Vec<&GrayF32>], board: BoardSize, solve: CalibrateOptions) -> Result<BoardCalibration> {
    let options = BoardCalibrationOptions {
        board: BoardChoice::chessboard(Some(board), 1.0),
        solve,
        ..BoardCalibrationOptions::default()
    };
    let cameras = views.first().map_or(0, Vec::len);
    Ok(calibrate((views.len(), cameras), |v, c| Some(views[v][c].clone()), &options, &Silent)?)
}

pub(crate) fn run(python: &Path, data: &Path) -> Result<Vec<Check>> {
    let mut page = Page::default();
    compare_pairs(python, &data.join("calibration"), &mut page)?;
    compare_wide(python, &data.join("calibration-wide"), &mut page)?;
    boards::compare_solve(python, &mut page)?;
    boards::compare_corners(python, &mut page)?;
    markers::run(python, &mut page)?;
    boards::compare_without_board(python, data, &mut page)?;
    undistort::run(python, &mut page)?;
    let text = format!(
        "Written by `cargo xtask peers calibration`; one run, {}, load {} at its end (1 of it is the run itself), OpenCV {}. Processor seconds: on one thread, without decoding. RMS: of the 2D reprojection \
         error of corners, as OpenCV prints it; mrcal prints the RMS per coordinate, smaller by √2. Hold-out: intrinsics from every other \
         view, only the poses of the other views estimated, for both halves; OpenCV's and mrcal's poses by `solvePnP`.\n\n{}\n| figure | measured | target | |\n|---|---|---|---|\n{}",
        super::machine(),
        super::machine_load(),
        page.version,
        page.text,
        page.checks.iter().fold(String::new(), |mut text, c| {
            let verdict = if c.ok { "met" } else { "**not met**" };
            let _ = writeln!(
                text,
                "| {} | {:.4} | {} | {verdict} |",
                c.name,
                c.figure,
                c.target.replace("<=", "≤").replace(">=", "≥")
            );
            text
        })
    );
    print!("{text}");
    super::write_section("Calibration", &text)?;
    Ok(page.checks)
}

/// The section under construction: text, figures with targets, version of OpenCV.
#[derive(Default)]
pub(super) struct Page {
    pub(super) text: String,
    pub(super) checks: Vec<Check>,
    pub(super) version: String,
}

fn compare_pairs(python: &Path, folder: &Path, page: &mut Page) -> Result<()> {
    println!("pairs");
    let peers: Vec<Pairs> = run_script(python, &[&"pairs", &folder])?;
    let board = BoardSize::new(9, 6);
    let read = |prefix| list_photographs(folder, prefix)?.iter().map(|p| read_gray(p)).collect::<Result<Vec<_>>>();
    let [left, right] = [read("left")?, read("right")?];
    let ((in_left, s0), (in_right, s1)) = (detect_all(&left, board)?, detect_all(&right, board)?);
    let seconds = s0 + s1;
    let detected = in_left.iter().zip(&in_right).filter(|(l, r)| **l && **r).count();
    let solve = CalibrateOptions { lens: LensChoice::RadialTangential5, ..CalibrateOptions::default() };
    let alone = |photos: &[GrayF32]| calibrate_views(&photos.iter().map(|p| vec![p]).collect::<Vec<_>>(), board, solve);
    let mono = [alone(&left)?.calibration, alone(&right)?.calibration];
    let rig = calibrate_views(&left.iter().zip(&right).map(|(l, r)| vec![l, r]).collect::<Vec<_>>(), board, solve)?;
    let baseline = rig.calibration.stereo().map_or(f64::NAN, |rig| rig.baseline());
    let dy = rig.rectified_dy_px.unwrap_or((f64::NAN, f64::NAN));
    page.text.push_str(
        "Thirteen pairs, 640×480, 9×6 corners, five distortion coefficients; lengths in squares:\n\n| detector | both boards detected | processor s | RMS left, right | hold-out | hold-out, all corners | RMS of \
         the rig | baseline | rectified abs(Δy), mean and maximum |\n|---|---|---|---|---|---|---|---|---|\n",
    );
    let _ = writeln!(
        page.text,
        "| ours | {detected} of {} | {seconds:.3} | {:.3}, {:.3} | {:.3}, {:.3} | {:.3}, {:.3} | {:.3} | {baseline:.4} | {:.3}, {:.3} |",
        left.len(),
        mono[0].rms_px,
        mono[1].rms_px,
        mono[0].holdout_rms_px,
        mono[1].holdout_rms_px,
        mono[0].holdout_all_rms_px,
        mono[1].holdout_all_rms_px,
        rig.calibration.rms_px,
        dy.0,
        dy.1
    );
    for p in &peers {
        let _ = writeln!(
            page.text,
            "| OpenCV, {} | {} of {} | {:.3} | {:.3}, {:.3} | | {:.3}, {:.3} | {:.3} | {:.4} | {:.3}, {:.3} |",
            p.detector,
            p.found,
            p.of,
            p.seconds,
            p.rms[0],
            p.rms[1],
            p.holdout[0],
            p.holdout[1],
            p.stereo,
            p.baseline,
            p.dy[0],
            p.dy[1]
        );
    }
    let classic = peers.iter().find(|p| p.detector == "classic").context("the classic detector")?;
    page.version.clone_from(&classic.version);
    page.checks.extend([
        Check::at_least("pairs: both boards detected", detected as f64, 13.0),
        Check::at_most("pairs: RMS left, px", mono[0].rms_px, 0.195),
        Check::at_most("pairs: RMS right, px", mono[1].rms_px, 0.207),
        Check::at_most("pairs: RMS of the rig, px", rig.calibration.rms_px, 0.215),
        Check::at_most("pairs: rectified abs(Δy), mean, px", dy.0, 0.10),
        Check::at_most(
            "pairs: difference of the baseline to OpenCV's, %",
            100.0 * (baseline / classic.baseline - 1.0).abs(),
            0.5,
        ),
        Check::at_most("pairs: detection time / classic with cornerSubPix", seconds / classic.seconds, 1.0),
    ]);
    Ok(())
}

fn compare_wide(python: &Path, folder: &Path, page: &mut Page) -> Result<()> {
    println!("wide-angle lens");
    let scratch = tempfile::tempdir()?;
    let corners = scratch.path().join("corners.vnl");
    let mut peers: Vec<Wide> = run_script(python, &[&"wide", &folder, &corners])?;
    let mrcal: Vec<Wide> = run_script(python, &[&"mrcal", &folder, &corners])?;
    if mrcal.is_empty() {
        println!("mrcal is not installed (Debian: apt-get install mrcal): left out");
    }
    peers.extend(mrcal);
    let board = BoardSize::new(8, 6);
    let photos = list_photographs(folder, "")?.iter().map(|p| read_gray(p)).collect::<Result<Vec<_>>>()?;
    let (is_detected, seconds) = detect_all(&photos, board)?;
    let detected = is_detected.iter().filter(|d| **d).count();
    let views: Vec<_> = photos.iter().map(|p| vec![p]).collect();
    let rational = CalibrateOptions { lens: LensChoice::Rational8, ..CalibrateOptions::default() };
    let flat = CalibrateOptions { board_shape: false, ..CalibrateOptions::default() };
    page.text.push_str(
        "\nWide-angle lens, 36 photographs of 1280×960, 8×6 corners; in one the board is cut off. Ours and mrcal exclude outliers from the RMS, ours from the first \
         hold-out too; both estimate the board's deformation, except in “flat board”:\n\n| system | boards detected | processor s | RMS | RMS per coordinate | hold-out | hold-out, all corners | outliers \
         |\n|---|---|---|---|---|---|---|---|\n",
    );
    let mut figures = [f64::NAN; 3];
    for (i, (name, options)) in [
        ("8 coefficients", rational),
        ("model selected, flat board", flat),
        ("model selected", CalibrateOptions::default()),
    ]
    .into_iter()
    .enumerate()
    {
        let c = calibrate_views(&views, board, options)?.calibration;
        let outliers: usize =
            c.views.iter().flat_map(|v| &v.images).map(|p| p.corners.iter().filter(|c| !c.used).count()).sum();
        let _ = writeln!(
            page.text,
            "| ours, {name}{} | {detected} of {} | {seconds:.3} | {:.3} | {:.3} | {:.3} | {:.3} | {outliers} |",
            if i == 0 { String::new() } else { format!(": {}", c.cameras[0].camera.distortion.model().info().name) },
            photos.len(),
            c.rms_px,
            c.rms_px / 2f64.sqrt(),
            c.holdout_rms_px,
            c.holdout_all_rms_px
        );
        match i {
            0 => figures[0] = c.rms_px / 2f64.sqrt(),
            1 => (figures[1], figures[2]) = (c.holdout_rms_px, c.holdout_all_rms_px),
            _ => {}
        }
    }
    for p in &peers {
        let (name, rms) = match p.detector.as_str() {
            "mrcal" => (format!("mrcal, classic corners, {} coefficients", p.coefficients), p.rms * 2f64.sqrt()),
            detector => (format!("OpenCV, {detector}, {} coefficients", p.coefficients), p.rms),
        };
        let seconds = if p.seconds > 0.0 { format!("{:.3}", p.seconds) } else { String::new() };
        let _ = writeln!(
            page.text,
            "| {name} | {} of {} | {seconds} | {rms:.3} | {:.3} | | {:.3} | {} |",
            p.found,
            p.of,
            rms / 2f64.sqrt(),
            p.holdout,
            p.outliers
        );
    }
    let classic = peers.iter().find(|p| p.detector == "classic").context("the classic detector")?;
    page.checks.extend([
        Check::at_least("wide: boards detected", detected as f64, 35.0),
        Check::at_most("wide: RMS per coordinate, 8 coefficients, px", figures[0], 0.24),
        Check::at_most("wide: hold-out RMS, model selected, flat board, px", figures[1], 0.55),
        Check::at_most("wide: hold-out RMS over all corners, model selected, flat board, px", figures[2], 0.55),
        Check::at_most("wide: detection time / classic with cornerSubPix", seconds / classic.seconds, 1.0),
    ]);
    Ok(())
}
