//! `calibrate` on photographs of chessboards: thirteen pairs of OpenCV's samples, and a wide lens.

use super::Check;
use anyhow::{Context, Result, bail};
use cv_core::{GrayF32, Matrix3, Point2, Vector3, median};
use cv_pipeline::calibration::{Board, BoardSize, CalibrateOptions, LensChoice};
use cv_pipeline::{BoardCalibration, BoardCalibrationOptions, BoardChoice, Silent, calibrate};
use cv_stereo::{Rectification, RectifyOptions, StereoMatcher, StereoOptions};
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
    let [mut dense, corners] = flatness(&views, &found)?;
    checks.push(Check::at_least("pairs: boards whose depth was measured", dense.len() as f64, 13.0));
    let middle = median(&mut dense).unwrap_or(f64::NAN);
    checks.push(Check::at_most("pairs: depth of squares off the board's plane, median of the pairs, %", middle, 0.3));
    let worst = corners.iter().copied().fold(f64::NAN, f64::max);
    checks.push(Check::at_most("pairs: triangulated corners off their plane, worst pair, RMS, %", worst, 0.3));
    checks.extend(super::calibration_commands::run(folder, &views, &found)?);
    Ok(checks)
}

/// Of each pair, how far the depth that the matcher finds lies off a plane on the board, and how far the corners do that the rig triangulates; both in percent of the
/// board's distance.
///
/// Depth: of the pixels that are matched, nothing filled in, the median of each square between inner corners against the plane of all, and of these squares the median. A pixel by itself
/// shows what the matcher makes of a slanted pattern that is plain within its squares, a square what the rig makes of space. Corners: root mean square.
fn flatness(views: &[Vec<PathBuf>], found: &BoardCalibration) -> Result<[Vec<f64>; 2]> {
    let rig = found.calibration.stereo().context("a rig")?;
    let rectification = Rectification::new(&rig, &RectifyOptions::default())?;
    let Board::Chessboard { size: BoardSize { columns, rows }, .. } = found.board else {
        bail!("another board than was asked for")
    };
    let mut shares = [Vec::new(), Vec::new()];
    for (v, pair) in views.iter().enumerate() {
        let corners = &found.observations.views[v][0];
        let rectified = |point: usize| {
            let corner = corners.iter().find(|c| c.point == point)?;
            rectification.left.rectified_pixel(corner.pixel)
        };
        // Disparities of the corners, and a quarter of their range and 16 px more: less than the two squares after which the pattern repeats.
        let shifts: Vec<(Point2<f64>, f64)> = corners
            .iter()
            .filter_map(|c| {
                let right = found.observations.views[v][1].iter().find(|r| r.point == c.point)?;
                let l = rectification.left.rectified_pixel(c.pixel)?;
                Some((l, l.x - rectification.right.rectified_pixel(right.pixel)?.x))
            })
            .collect();
        let camera = &rectification.left.camera;
        let seen: Vec<Vector3<f64>> = (shifts.iter())
            .map(|(l, d)| camera.normalize(*l).to_homogeneous() * f64::from(rectification.geometry.depth(*d as f32)))
            .collect();
        let (low, high) =
            shifts.iter().fold((f64::INFINITY, 0.0f64), |(low, high), (_, d)| (low.min(*d), high.max(*d)));
        let more = 16.0 + 0.25 * (high - low);
        let (min, max) = ((low - more) as i32, (high + more) as i32);
        let stereo = StereoOptions {
            min_disparity: min,
            disparities: (max - min) as usize + 1,
            fill: false,
            ..StereoOptions::default()
        };
        let photos = [cv_io::read_gray_u8(&pair[0])?, cv_io::read_gray_u8(&pair[1])?];
        let left = rectification.left.apply(photos[0].view(), &Silent)?.0;
        let right = rectification.right.apply(photos[1].view(), &Silent)?.0;
        // The matcher alone: the job would refuse what is behind the board.
        let map = StereoMatcher::new(stereo)?.compute(left.view(), right.view(), &Silent)?;
        let depth = rectification.geometry.depth_map(map.disparity.view(), (0.0, f32::INFINITY));
        // Points in the rectified left frame, and the square that each is of.
        let (mut points, mut of, mut area) = (Vec::new(), Vec::new(), 0);
        for square in (0..columns * (rows - 1)).filter(|s| s % columns + 1 < columns) {
            let around = [square, square + 1, square + columns + 1, square + columns];
            let Some(polygon) = around.iter().map(|p| rectified(*p)).collect::<Option<Vec<_>>>() else { continue };
            let (low, high) = polygon.iter().fold((polygon[0], polygon[0]), |(a, b), p| (a.inf(p), b.sup(p)));
            for y in low.y.max(0.0) as usize..(high.y.max(0.0) as usize + 1).min(depth.height()) {
                for x in low.x.max(0.0) as usize..(high.x.max(0.0) as usize + 1).min(depth.width()) {
                    if is_within(&polygon, x as f64, y as f64) {
                        area += 1;
                        let z = f64::from(depth.at(x, y)[0]);
                        if z.is_finite() {
                            points.push(camera.normalize(Point2::new(x as f64, y as f64)).to_homogeneous() * z);
                            of.push(square);
                        }
                    }
                }
            }
        }
        let dense = off_plane(&points).context("a plane")?;
        let triangulated = off_plane(&seen).context("a plane")?;
        let of_square = |square: usize| {
            let each = dense.off.iter().zip(&of).filter(|(_, s)| **s == square).map(|(off, _)| *off);
            median(&mut each.collect::<Vec<_>>())
        };
        let mut squares: Vec<f64> = (0..columns * rows).filter_map(of_square).map(f64::abs).collect();
        println!(
            "  {}: {:.1} squares away; depth of {:.0} % of the board, off its plane {:.3} % (median of pixels), its {} squares {:.3} % (median); its corners {:.3} % RMS",
            pair[0].file_name().unwrap_or_default().to_string_lossy(),
            dense.distance,
            100.0 * points.len() as f64 / f64::from(area),
            dense.median,
            squares.len(),
            median(&mut squares).unwrap_or(f64::NAN),
            triangulated.rms
        );
        shares[0].push(median(&mut squares).unwrap_or(f64::NAN));
        shares[1].push(triangulated.rms);
    }
    Ok(shares)
}

/// Whether a point lies in a convex polygon.
pub(super) fn is_within(polygon: &[Point2<f64>], x: f64, y: f64) -> bool {
    let side = |i: usize| {
        let (a, b) = (polygon[i], polygon[(i + 1) % polygon.len()]);
        (b.x - a.x) * (y - a.y) - (b.y - a.y) * (x - a.x)
    };
    (0..polygon.len()).all(|i| side(i) >= 0.0) || (0..polygon.len()).all(|i| side(i) <= 0.0)
}

/// How far points are off their plane, in percent of their distance.
struct OffPlane {
    /// The median distance of the points.
    distance: f64,
    rms: f64,
    median: f64,
    /// Of each point, behind the plane above zero.
    off: Vec<f64>,
}

/// The plane n·p = 1 by least squares in inverse depth, which on a plane is linear in the pixel: n·(x/z, y/z, 1) = 1/z. Again without what is off by more than
/// three times the median; the figures are of all points.
fn off_plane(points: &[Vector3<f64>]) -> Option<OffPlane> {
    let mut limit = f64::INFINITY;
    let mut plane = Vector3::zeros();
    for _ in 0..4 {
        let off = |n: &Vector3<f64>, p: &Vector3<f64>| (n.dot(p) - 1.0).abs() / p.z;
        let (mut a, mut b) = (Matrix3::zeros(), Vector3::zeros());
        for p in points.iter().filter(|p| off(&plane, p) <= limit) {
            let ray = *p / p.z;
            a += ray * ray.transpose();
            b += ray / p.z;
        }
        plane = a.try_inverse()? * b;
        limit = 3.0 * median(&mut points.iter().map(|p| off(&plane, p)).collect::<Vec<_>>())?;
    }
    let distance = median(&mut points.iter().map(|p| p.norm()).collect::<Vec<_>>())?;
    let share = 100.0 / (plane.norm() * distance);
    let off: Vec<f64> = points.iter().map(|p| (plane.dot(p) - 1.0) * share).collect();
    let rms = (off.iter().map(|d| d * d).sum::<f64>() / off.len() as f64).sqrt();
    let middle = median(&mut off.iter().map(|d| d.abs()).collect::<Vec<_>>())?;
    Some(OffPlane { distance, rms, median: middle, off })
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
    let (holdout, all) = (found.calibration.holdout_rms_px, found.calibration.holdout_all_rms_px);
    checks.push(Check::at_most("wide: hold-out RMS on a flat board, lens chosen, px", holdout, 0.55));
    checks.push(Check::at_most("wide: the same over all corners, px", all, 0.55));
    let (found, _) = solved(&views, board, CalibrateOptions::default())?;
    println!(
        "wide, chosen: RMS {:.3} px, hold-out {:.3} px",
        found.calibration.rms_px, found.calibration.holdout_rms_px
    );
    Ok(checks)
}
