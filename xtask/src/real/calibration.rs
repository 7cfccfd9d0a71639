//! `calibrate` on photographs of chessboards: thirteen stereo pairs of OpenCV's samples, and a wide-angle lens.

use super::Check;
use anyhow::{Context, Result, bail};
use cv_core::{GrayF32, Matrix3, Point2, Vector3, median};
use cv_pipeline::calibration::{Board, BoardSize, CalibrateOptions, LensChoice};
use cv_pipeline::{BoardCalibration, BoardCalibrationOptions, BoardChoice, Silent, calibrate};
use cv_stereo::{Rectification, RectifyOptions, StereoMatcher, StereoOptions};
use std::path::{Path, PathBuf};

/// OpenCV on the pairs with the classic detector: RMS of the left and the right camera alone in pixels, RMS of the rig, its baseline in squares.
const OPENCV: ([f64; 2], f64, f64) = ([0.195, 0.207], 0.215, 3.327);

pub(super) fn run(data: &Path) -> Result<Vec<Check>> {
    let mut checks = check_pairs(&data.join("calibration"))?;
    checks.extend(check_wide(&data.join("calibration-wide"))?);
    Ok(checks)
}

/// Lists the photographs of a folder with a prefix, sorted by name.
fn list_photographs(folder: &Path, prefix: &str) -> Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if name.starts_with(prefix) && name.ends_with(".jpg") {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

/// Calibrates from files; also returns the number of views in which all cameras were used.
fn calibrate_views(
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

fn check_pairs(folder: &Path) -> Result<Vec<Check>> {
    let [left, right] = [list_photographs(folder, "left")?, list_photographs(folder, "right")?];
    let solve = CalibrateOptions { lens: LensChoice::RadialTangential5, ..CalibrateOptions::default() };
    let board = BoardSize::new(9, 6);
    let mut checks = Vec::new();
    for (camera, (name, max_rms)) in [(&left, ("left", OPENCV.0[0])), (&right, ("right", OPENCV.0[1]))] {
        let views: Vec<_> = camera.iter().map(|p| vec![p.clone()]).collect();
        let (found, used) = calibrate_views(&views, board, solve)?;
        checks.push(Check::at_most(format!("pairs: RMS {name}, px"), found.calibration.rms_px, max_rms));
        println!("{name}: {used} of {} used, hold-out {:.3} px", views.len(), found.calibration.holdout_rms_px);
    }
    let views: Vec<_> = left.into_iter().zip(right).map(|(l, r)| vec![l, r]).collect();
    let (found, used) = calibrate_views(&views, board, solve)?;
    let baseline = found.calibration.stereo().map_or(f64::NAN, |rig| rig.baseline());
    println!(
        "rig: baseline {baseline:.4} squares, hold-out {:.3} px, board deflection {:?} squares, {}",
        found.calibration.holdout_rms_px, found.calibration.target_shape.deflection, found.calibration.verdict.trust
    );
    checks.push(Check::at_least("pairs: both boards used", used as f64, 13.0));
    checks.push(Check::at_most("pairs: RMS of the rig, px", found.calibration.rms_px, OPENCV.1));
    let rows = found.rectified_dy_px.map_or(f64::NAN, |r| r.0);
    checks.push(Check::at_most("pairs: mean vertical disparity after rectification, px", rows, 0.10));
    checks.push(Check::at_most(
        "pairs: difference of the baseline to OpenCV's, %",
        100.0 * (baseline / OPENCV.2 - 1.0).abs(),
        0.5,
    ));
    let [mut dense, corners] = measure_flatness(&views, &found)?;
    checks.push(Check::at_least("pairs: boards with a depth", dense.len() as f64, 13.0));
    let dense_median = median(&mut dense).unwrap_or(f64::NAN);
    checks.push(Check::at_most(
        "pairs: distance of squares from the board's plane, median of the pairs, % of depth",
        dense_median,
        0.3,
    ));
    let worst = corners.iter().copied().fold(f64::NAN, f64::max);
    checks.push(Check::at_most(
        "pairs: distance of triangulated corners from their plane, RMS, worst pair, % of depth",
        worst,
        0.3,
    ));
    checks.extend(super::calibration_commands::run(folder, &views, &found)?);
    Ok(checks)
}

/// Measures for each pair the distance from the board's plane of the matcher's depth and of the triangulated corners; both in percent of the board's distance.
///
/// Depth: from matched pixels without hole filling; the median within each square between inner corners, then the median of the squares. Single pixels would measure the matcher on
/// a slanted pattern with low texture within its squares; squares measure the rig. Corners: RMS.
fn measure_flatness(views: &[Vec<PathBuf>], found: &BoardCalibration) -> Result<[Vec<f64>; 2]> {
    let rig = found.calibration.stereo().context("a rig")?;
    let rectification = Rectification::new(&rig, &RectifyOptions::default())?;
    let Board::Chessboard { size: BoardSize { columns, rows }, .. } = found.board else {
        bail!("a board of another kind than requested")
    };
    let mut percentages = [Vec::new(), Vec::new()];
    for (v, pair) in views.iter().enumerate() {
        let corners = &found.observations.views[v][0];
        let rectified = |point: usize| {
            let corner = corners.iter().find(|c| c.point == point)?;
            rectification.left.rectified_pixel(corner.pixel)
        };
        // Search range: disparities of the corners plus a margin of a quarter of their range and 16 px, less than the period of the pattern (two squares).
        let disparities: Vec<(Point2<f64>, f64)> = corners
            .iter()
            .filter_map(|c| {
                let right = found.observations.views[v][1].iter().find(|r| r.point == c.point)?;
                let l = rectification.left.rectified_pixel(c.pixel)?;
                Some((l, l.x - rectification.right.rectified_pixel(right.pixel)?.x))
            })
            .collect();
        let camera = &rectification.left.camera;
        let triangulated: Vec<Vector3<f64>> = (disparities.iter())
            .map(|(l, d)| camera.normalize(*l).to_homogeneous() * f64::from(rectification.geometry.depth(*d as f32)))
            .collect();
        let (low, high) =
            disparities.iter().fold((f64::INFINITY, 0.0f64), |(low, high), (_, d)| (low.min(*d), high.max(*d)));
        let margin = 16.0 + 0.25 * (high - low);
        let (min, max) = ((low - margin) as i32, (high + margin) as i32);
        let stereo = StereoOptions {
            min_disparity: min,
            disparities: (max - min) as usize + 1,
            fill: false,
            ..StereoOptions::default()
        };
        let photos = [cv_io::read_gray_u8(&pair[0])?, cv_io::read_gray_u8(&pair[1])?];
        let left = rectification.left.apply(photos[0].view(), &Silent)?.0;
        let right = rectification.right.apply(photos[1].view(), &Silent)?.0;
        // The matcher alone: the pipeline would reject the background.
        let map = StereoMatcher::new(stereo)?.compute(left.view(), right.view(), &Silent)?;
        let depth = rectification.geometry.depth_map(map.disparity.view(), (0.0, f32::INFINITY));
        // Points in the rectified left frame, and the square of each.
        let (mut points, mut square_of, mut area) = (Vec::new(), Vec::new(), 0);
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
                            square_of.push(square);
                        }
                    }
                }
            }
        }
        let dense = fit_plane(&points).context("a plane")?;
        let corner_fit = fit_plane(&triangulated).context("a plane")?;
        let median_of_square = |square: usize| {
            let distances = dense.distances.iter().zip(&square_of).filter(|(_, s)| **s == square).map(|(d, _)| *d);
            median(&mut distances.collect::<Vec<_>>())
        };
        let mut squares: Vec<f64> = (0..columns * rows).filter_map(median_of_square).map(f64::abs).collect();
        println!(
            "  {}: {:.1} squares away; depth on {:.0} % of the board; distance from its plane: pixels {:.3} % (median), {} squares {:.3} % (median), corners {:.3} % (RMS)",
            pair[0].file_name().unwrap_or_default().to_string_lossy(),
            dense.depth,
            100.0 * points.len() as f64 / f64::from(area),
            dense.median,
            squares.len(),
            median(&mut squares).unwrap_or(f64::NAN),
            corner_fit.rms
        );
        percentages[0].push(median(&mut squares).unwrap_or(f64::NAN));
        percentages[1].push(corner_fit.rms);
    }
    Ok(percentages)
}

/// Returns whether a point is inside a convex polygon.
pub(super) fn is_within(polygon: &[Point2<f64>], x: f64, y: f64) -> bool {
    let side = |i: usize| {
        let (a, b) = (polygon[i], polygon[(i + 1) % polygon.len()]);
        (b.x - a.x) * (y - a.y) - (b.y - a.y) * (x - a.x)
    };
    (0..polygon.len()).all(|i| side(i) >= 0.0) || (0..polygon.len()).all(|i| side(i) <= 0.0)
}

/// Distances of points from their plane, in percent of the points' distance from the camera.
struct PlaneFit {
    /// Median distance of the points from the camera.
    depth: f64,
    rms: f64,
    median: f64,
    /// Signed distance of each point, positive behind the plane.
    distances: Vec<f64>,
}

/// Fits the plane n·p = 1 by least squares in inverse depth, which is linear in the pixel: n·(x/z, y/z, 1) = 1/z. Repeats without residuals above three
/// times the median; the figures are of all points.
fn fit_plane(points: &[Vector3<f64>]) -> Option<PlaneFit> {
    let mut limit = f64::INFINITY;
    let mut plane = Vector3::zeros();
    for _ in 0..4 {
        let residual = |n: &Vector3<f64>, p: &Vector3<f64>| (n.dot(p) - 1.0).abs() / p.z;
        let (mut a, mut b) = (Matrix3::zeros(), Vector3::zeros());
        for p in points.iter().filter(|p| residual(&plane, p) <= limit) {
            let ray = *p / p.z;
            a += ray * ray.transpose();
            b += ray / p.z;
        }
        plane = a.try_inverse()? * b;
        limit = 3.0 * median(&mut points.iter().map(|p| residual(&plane, p)).collect::<Vec<_>>())?;
    }
    let depth = median(&mut points.iter().map(|p| p.norm()).collect::<Vec<_>>())?;
    let percent = 100.0 / (plane.norm() * depth);
    let distances: Vec<f64> = points.iter().map(|p| (plane.dot(p) - 1.0) * percent).collect();
    let rms = (distances.iter().map(|d| d * d).sum::<f64>() / distances.len() as f64).sqrt();
    let median = median(&mut distances.iter().map(|d| d.abs()).collect::<Vec<_>>())?;
    Some(PlaneFit { depth, rms, median, distances })
}

fn check_wide(folder: &Path) -> Result<Vec<Check>> {
    let views: Vec<_> = list_photographs(folder, "")?.into_iter().map(|p| vec![p]).collect();
    let board = BoardSize::new(8, 6);
    let rational = CalibrateOptions { lens: LensChoice::Rational8, ..CalibrateOptions::default() };
    let (found, used) = calibrate_views(&views, board, rational)?;
    let mut checks = vec![
        Check::at_least("wide: photographs used", used as f64, 35.0),
        // Per coordinate, as mrcal prints it: the 2D RMS is larger by √2.
        Check::at_most(
            "wide: RMS per coordinate with the rational model, px",
            found.calibration.rms_px / 2f64.sqrt(),
            0.24,
        ),
    ];
    println!(
        "wide, rational: RMS {:.3} px, hold-out {:.3} px",
        found.calibration.rms_px, found.calibration.holdout_rms_px
    );
    let flat = CalibrateOptions { board_shape: false, ..CalibrateOptions::default() };
    let (found, _) = calibrate_views(&views, board, flat)?;
    for lens in &found.calibration.cameras[0].lenses {
        println!("wide, flat: {lens:?}");
    }
    let (holdout, all) = (found.calibration.holdout_rms_px, found.calibration.holdout_all_rms_px);
    checks.push(Check::at_most("wide: hold-out RMS, model selected, flat board, px", holdout, 0.55));
    checks.push(Check::at_most("wide: hold-out RMS over all corners, model selected, flat board, px", all, 0.55));
    let (found, _) = calibrate_views(&views, board, CalibrateOptions::default())?;
    println!(
        "wide, model selected: RMS {:.3} px, hold-out {:.3} px",
        found.calibration.rms_px, found.calibration.holdout_rms_px
    );
    Ok(checks)
}
