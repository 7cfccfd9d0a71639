//! OpenCV's calibration, mrcal's where it is installed, and ours on the same photographs and corners. Writes the section “Calibration” of `docs/benchmarks.md`.

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

/// Both finders of a peer on the pairs.
#[derive(Debug, Deserialize)]
struct Pairs {
    finder: String,
    found: usize,
    of: usize,
    seconds: f64,
    rms: [f64; 2],
    stereo: f64,
    holdout: [f64; 2],
    baseline: f64,
    dy: [f64; 2],
    version: String,
}

/// A system on the wide lens.
#[derive(Debug, Deserialize)]
struct Wide {
    finder: String,
    found: usize,
    of: usize,
    seconds: f64,
    numbers: usize,
    rms: f64,
    holdout: f64,
    #[serde(default)]
    outliers: usize,
}

/// Runs the script of the peers; what it prints, a value of a line.
pub(super) fn peer<T: DeserializeOwned>(python: &Path, arguments: &[&dyn AsRef<OsStr>]) -> Result<Vec<T>> {
    let script = crate::root().join("peers/calibration_opencv.py");
    let mut command = Command::new(python);
    command.arg(&script).args(arguments.iter().map(|a| a.as_ref()));
    let output = command.output().context("cannot start Python")?;
    ensure!(output.status.success(), "{}: {}", script.display(), String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout)?;
    text.lines().map(|line| serde_json::from_str(line).with_context(|| line.to_owned())).collect()
}

/// Processor seconds of this thread, where the system tells them; else seconds of the clock.
fn processor(start: Instant) -> f64 {
    let told = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let nanoseconds = told.and_then(|text| text.split(' ').next()?.parse::<f64>().ok());
    nanoseconds.map_or(start.elapsed().as_secs_f64(), |n| 1e-9 * n)
}

/// What `call` returns, and the processor seconds that it takes on one thread.
pub(super) fn on_one_thread<T: Send>(call: impl FnOnce() -> T + Send) -> Result<(T, f64)> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    Ok(pool.install(|| {
        let start = Instant::now();
        let before = processor(start);
        let value = call();
        (value, processor(start) - before)
    }))
}

/// The board of a size in a picture.
pub(super) fn find(view: ImageView<'_, f32, 1>, size: BoardSize) -> Option<Chessboard> {
    find_chessboard(view, Some(size), &ChessboardOptions::default(), &Silent).ok()
}

pub(super) fn gray(path: &Path) -> Result<GrayF32> {
    Ok(cv_imgproc::gray_to_f32(cv_io::read_gray_u8(path)?.view()))
}

/// Files of a folder whose names begin so and end in `.jpg`, sorted.
fn photographs(folder: &Path, prefix: &str) -> Result<Vec<PathBuf>> {
    let mut found: Vec<PathBuf> = std::fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<Result<_>>()?;
    let named = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        name.starts_with(prefix) && name.ends_with(".jpg")
    };
    found.retain(named);
    found.sort();
    Ok(found)
}

/// How many of the photographs show the board, and the processor seconds of finding it.
fn looked(photos: &[GrayF32], size: BoardSize) -> Result<(Vec<bool>, f64)> {
    // The first call of all maps memory and picks instructions.
    photos.first().map(|photo| find(photo.view(), size));
    on_one_thread(|| photos.iter().map(|photo| find(photo.view(), size).is_some()).collect())
}

fn solved(views: &[Vec<&GrayF32>], board: BoardSize, solve: CalibrateOptions) -> Result<BoardCalibration> {
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
    pairs(python, &data.join("calibration"), &mut page)?;
    wide(python, &data.join("calibration-wide"), &mut page)?;
    boards::solve(python, &mut page)?;
    boards::corners(python, &mut page)?;
    markers::run(python, &mut page)?;
    boards::without(python, data, &mut page)?;
    undistort::run(python, &mut page)?;
    let text = format!(
        "Written by `cargo xtask peers calibration`; one run, {}, load {} at its end (one is the run itself), OpenCV {}. Processor seconds are of one thread each, decoding left out. RMS: root mean square \
         distance of corners, both coordinates together, as OpenCV prints it; mrcal prints that of a coordinate, √2 less. Hold-out: solved on every other \
         view, the others by their poses alone, both halves; OpenCV's and mrcal's poses by `solvePnP`.\n\n{}\n| figure | measured | bar | |\n|---|---|---|---|\n{}",
        super::machine(),
        super::machine_load(),
        page.version,
        page.text,
        page.checks.iter().fold(String::new(), |mut text, c| {
            let held = if c.ok { "held" } else { "**not held**" };
            let _ = writeln!(
                text,
                "| {} | {:.4} | {} | {held} |",
                c.name,
                c.figure,
                c.bar.replace("<=", "≤").replace(">=", "≥")
            );
            text
        })
    );
    print!("{text}");
    super::write_section("Calibration", &text)?;
    Ok(page.checks)
}

/// What is written, as far as it is known.
#[derive(Default)]
pub(super) struct Page {
    pub(super) text: String,
    pub(super) checks: Vec<Check>,
    pub(super) version: String,
}

fn pairs(python: &Path, folder: &Path, page: &mut Page) -> Result<()> {
    println!("pairs");
    let peers: Vec<Pairs> = peer(python, &[&"pairs", &folder])?;
    let board = BoardSize::new(9, 6);
    let read = |prefix| photographs(folder, prefix)?.iter().map(|p| gray(p)).collect::<Result<Vec<_>>>();
    let [left, right] = [read("left")?, read("right")?];
    let ((in_left, s0), (in_right, s1)) = (looked(&left, board)?, looked(&right, board)?);
    let seconds = s0 + s1;
    let found = in_left.iter().zip(&in_right).filter(|(l, r)| **l && **r).count();
    let solve = CalibrateOptions { lens: LensChoice::RadialTangential5, ..CalibrateOptions::default() };
    let alone = |photos: &[GrayF32]| solved(&photos.iter().map(|p| vec![p]).collect::<Vec<_>>(), board, solve);
    let mono = [alone(&left)?.calibration, alone(&right)?.calibration];
    let rig = solved(&left.iter().zip(&right).map(|(l, r)| vec![l, r]).collect::<Vec<_>>(), board, solve)?;
    let baseline = rig.calibration.stereo().map_or(f64::NAN, |rig| rig.baseline());
    let dy = rig.rectified_dy_px.unwrap_or((f64::NAN, f64::NAN));
    page.text.push_str(
        "Thirteen pairs, 640×480, 9×6 corners, five numbers of a lens; distances in squares:\n\n| finder | both boards | processor s | RMS left, right | hold-out | hold-out, all corners | RMS of \
         the rig | baseline | rectified abs(Δy), mean and largest |\n|---|---|---|---|---|---|---|---|---|\n",
    );
    let _ = writeln!(
        page.text,
        "| ours | {found} of {} | {seconds:.3} | {:.3}, {:.3} | {:.3}, {:.3} | {:.3}, {:.3} | {:.3} | {baseline:.4} | {:.3}, {:.3} |",
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
            p.finder,
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
    let classic = peers.iter().find(|p| p.finder == "classic").context("the classic finder")?;
    page.version.clone_from(&classic.version);
    page.checks.extend([
        Check::at_least("pairs: both boards found", found as f64, 13.0),
        Check::at_most("pairs: RMS left, px", mono[0].rms_px, 0.195),
        Check::at_most("pairs: RMS right, px", mono[1].rms_px, 0.207),
        Check::at_most("pairs: RMS of the rig, px", rig.calibration.rms_px, 0.215),
        Check::at_most("pairs: rectified abs(Δy), mean, px", dy.0, 0.10),
        Check::at_most("pairs: baseline off OpenCV's, %", 100.0 * (baseline / classic.baseline - 1.0).abs(), 0.5),
        Check::at_most("pairs: finding / classic with cornerSubPix", seconds / classic.seconds, 1.0),
    ]);
    Ok(())
}

fn wide(python: &Path, folder: &Path, page: &mut Page) -> Result<()> {
    println!("wide lens");
    let scratch = tempfile::tempdir()?;
    let corners = scratch.path().join("corners.vnl");
    let mut peers: Vec<Wide> = peer(python, &[&"wide", &folder, &corners])?;
    let mrcal: Vec<Wide> = peer(python, &[&"mrcal", &folder, &corners])?;
    if mrcal.is_empty() {
        println!("mrcal is not installed (Debian: apt-get install mrcal): left out");
    }
    peers.extend(mrcal);
    let board = BoardSize::new(8, 6);
    let photos = photographs(folder, "")?.iter().map(|p| gray(p)).collect::<Result<Vec<_>>>()?;
    let (found, seconds) = looked(&photos, board)?;
    let found = found.iter().filter(|f| **f).count();
    let views: Vec<_> = photos.iter().map(|p| vec![p]).collect();
    let rational = CalibrateOptions { lens: LensChoice::Rational8, ..CalibrateOptions::default() };
    let flat = CalibrateOptions { board_shape: false, ..CalibrateOptions::default() };
    page.text.push_str(
        "\nA wide lens, 36 photographs of 1280×960, 8×6 corners, on one of which the board is cut off. Ours and mrcal leave outliers out of the RMS, ours out of the first \
         hold-out too; they adjust the board's shape where it is not said to be flat:\n\n| system | found | processor s | RMS | of a coordinate | hold-out | hold-out, all corners | outliers \
         |\n|---|---|---|---|---|---|---|---|\n",
    );
    let mut figures = [f64::NAN; 3];
    for (i, (name, options)) in
        [("8 numbers", rational), ("lens chosen, flat board", flat), ("lens chosen", CalibrateOptions::default())]
            .into_iter()
            .enumerate()
    {
        let c = solved(&views, board, options)?.calibration;
        let outliers: usize =
            c.views.iter().flat_map(|v| &v.images).map(|p| p.corners.iter().filter(|c| !c.used).count()).sum();
        let _ = writeln!(
            page.text,
            "| ours, {name}{} | {found} of {} | {seconds:.3} | {:.3} | {:.3} | {:.3} | {:.3} | {outliers} |",
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
        let (name, rms) = match p.finder.as_str() {
            "mrcal" => (format!("mrcal, classic corners, {} numbers", p.numbers), p.rms * 2f64.sqrt()),
            finder => (format!("OpenCV, {finder}, {} numbers", p.numbers), p.rms),
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
    let classic = peers.iter().find(|p| p.finder == "classic").context("the classic finder")?;
    page.checks.extend([
        Check::at_least("wide: boards found", found as f64, 35.0),
        Check::at_most("wide: RMS of a coordinate, 8 numbers, px", figures[0], 0.24),
        Check::at_most("wide: hold-out RMS, lens chosen, flat board, px", figures[1], 0.55),
        Check::at_most("wide: the same over all corners, px", figures[2], 0.55),
        Check::at_most("wide: finding / classic with cornerSubPix", seconds / classic.seconds, 1.0),
    ]);
    Ok(())
}
