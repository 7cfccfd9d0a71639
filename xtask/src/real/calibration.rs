//! `calibrate` on photographs of chessboards: thirteen pairs of OpenCV's samples, and a wide lens.

use super::Check;
use anyhow::Result;
use cv_core::GrayF32;
use cv_pipeline::calibration::{BoardSize, CalibrateOptions, LensChoice};
use cv_pipeline::{BoardCalibration, BoardCalibrationOptions, BoardChoice, Silent, calibrate};
use std::path::{Path, PathBuf};

/// OpenCV on the pairs, classic corners: RMS of both cameras by themselves, of the rig, and its baseline in squares.
const OPENCV: ([f64; 2], f64, f64) = ([0.195, 0.207], 0.215, 3.327);

pub(super) fn run(data: &Path) -> Result<Vec<Check>> {
    let mut checks = pairs(&data.join("calibration"))?;
    checks.extend(wide(&data.join("calibration-wide"))?);
    Ok(checks)
}

/// Photographs of a folder whose names begin so, by name.
fn photographs(folder: &Path, prefix: &str) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if name.starts_with(prefix) && name.ends_with(".jpg") {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

fn solved(
    views: &[Vec<PathBuf>],
    board: BoardSize,
    solve: CalibrateOptions,
) -> Result<(BoardCalibration, usize), anyhow::Error> {
    let cameras = views.first().map_or(0, Vec::len);
    let photo = |view: usize, camera: usize| -> Option<GrayF32> {
        let gray = cv_io::read_gray_u8(&views[view][camera]).ok()?;
        Some(gray.map(|p| [f32::from(p[0]) / 255.0]))
    };
    let options = BoardCalibrationOptions {
        board: BoardChoice::chessboard(Some(board), 1.0),
        solve,
        ..BoardCalibrationOptions::default()
    };
    let found = calibrate((views.len(), cameras), photo, &options, &Silent)?;
    let used = found.refusals.iter().filter(|v| v.iter().all(Option::is_none)).count();
    Ok((found, used))
}

fn pairs(folder: &Path) -> Result<Vec<Check>> {
    let [left, right] = [photographs(folder, "left")?, photographs(folder, "right")?];
    let solve = CalibrateOptions { lens: LensChoice::RadialTangential5, ..CalibrateOptions::default() };
    let board = BoardSize::new(9, 6);
    let mut checks = Vec::new();
    for (camera, (name, bar)) in [(&left, ("left", OPENCV.0[0])), (&right, ("right", OPENCV.0[1]))] {
        let views: Vec<_> = camera.iter().map(|p| vec![p.clone()]).collect();
        let (found, used) = solved(&views, board, solve)?;
        checks.push(Check::at_most(format!("pairs: RMS {name}, px"), found.calibration.rms_px, bar));
        println!("{name}: {used} of {} used, hold-out {:.3} px", views.len(), found.calibration.holdout_rms_px);
    }
    let views: Vec<_> = left.into_iter().zip(right).map(|(l, r)| vec![l, r]).collect();
    let (found, used) = solved(&views, board, solve)?;
    let baseline = found.calibration.stereo().map_or(f64::NAN, |rig| rig.baseline());
    println!(
        "rig: baseline {baseline:.4} squares, hold-out {:.3} px, board bent by {:?} squares, {}",
        found.calibration.holdout_rms_px, found.calibration.target_shape.deflection, found.calibration.verdict.trust
    );
    checks.push(Check::at_least("pairs: both boards used", used as f64, 13.0));
    checks.push(Check::at_most("pairs: RMS of the rig, px", found.calibration.rms_px, OPENCV.1));
    let rows = found.rectified_dy_px.map_or(f64::NAN, |r| r.0);
    checks.push(Check::at_most("pairs: mean difference of rectified rows, px", rows, 0.10));
    checks.push(Check::at_most("pairs: baseline off OpenCV's, %", 100.0 * (baseline / OPENCV.2 - 1.0).abs(), 0.5));
    Ok(checks)
}

fn wide(folder: &Path) -> Result<Vec<Check>> {
    let views: Vec<_> = photographs(folder, "")?.into_iter().map(|p| vec![p]).collect();
    let board = BoardSize::new(8, 6);
    let rational = CalibrateOptions { lens: LensChoice::Rational8, ..CalibrateOptions::default() };
    let (found, used) = solved(&views, board, rational)?;
    let mut checks = vec![
        Check::at_least("wide: photographs used", used as f64, 35.0),
        // Of one coordinate, as mrcal states it: both together are √2 of it.
        Check::at_most(
            "wide: RMS of a coordinate with the rational lens, px",
            found.calibration.rms_px / 2f64.sqrt(),
            0.24,
        ),
    ];
    println!(
        "wide, rational: RMS {:.3} px, hold-out {:.3} px",
        found.calibration.rms_px, found.calibration.holdout_rms_px
    );
    let flat = CalibrateOptions { board_shape: false, ..CalibrateOptions::default() };
    let (found, _) = solved(&views, board, flat)?;
    for lens in &found.calibration.cameras[0].lenses {
        println!("wide, flat: {lens:?}");
    }
    let holdout = found.calibration.holdout_rms_px;
    checks.push(Check::at_most("wide: hold-out RMS on a flat board, lens chosen, px", holdout, 0.55));
    let (found, _) = solved(&views, board, CalibrateOptions::default())?;
    println!(
        "wide, chosen: RMS {:.3} px, hold-out {:.3} px",
        found.calibration.rms_px, found.calibration.holdout_rms_px
    );
    Ok(checks)
}
