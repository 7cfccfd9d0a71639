//! From photographs of a board to depth by the program's commands: `cv calibrate stereo`, then `cv depth --rig` on the same photographs; measures the flatness of the board.

use super::Check;
use super::calibration::is_within;
use anyhow::{Context, Result, bail, ensure};
use cv_core::{GrayF32, Matrix3, Point2, Vector3, median};
use cv_pipeline::BoardCalibration;
use cv_pipeline::calibration::{Board, BoardSize};
use cv_stereo::{Rectification, RectifyOptions};
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Inlier threshold of the plane, in pixels of disparity: a false match on the board is a square away.
const INLIER_THRESHOLD_PX: f64 = 1.0;
/// Number of plane hypotheses from three pixels.
const HYPOTHESES: usize = 500;

/// Runs the program.
///
/// # Errors
///
/// With the text of stderr if the program fails.
fn run_cv(arguments: &[&dyn AsRef<OsStr>]) -> Result<()> {
    let mut command = Command::new(crate::trust::program()?);
    command.args(arguments.iter().map(|a| a.as_ref()));
    let output = command.output().context("cannot start the program")?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr).trim());
    Ok(())
}

/// Flatness of a board in a depth map.
struct Flatness {
    /// Fraction of the board's pixels with a depth, and the inlier ratio of the plane among them.
    matched: f64,
    inlier_ratio: f64,
    /// RMS distance from the plane in percent of the board's distance, of all inliers and of the half with the higher confidence.
    rms: f64,
    rms_confident: f64,
    distance: f64,
}

/// Runs the commands; `found` gives the corners, from which the boundary of each board follows.
pub(super) fn run(folder: &Path, views: &[Vec<PathBuf>], found: &BoardCalibration) -> Result<Vec<Check>> {
    let scratch = tempfile::tempdir()?;
    let path = |name: &str| scratch.path().join(name);
    let [left, right] = ["left", "right"].map(|side| folder.join(format!("{side}*.jpg")));
    let rig_file = path("rig.yaml");
    run_cv(&[
        &"calibrate",
        &"stereo",
        &"--board",
        &"9x6",
        &"--square",
        &"1",
        &"--left",
        &left,
        &"--right",
        &right,
        &"-o",
        &rig_file,
    ])?;
    let rig = cv_io::read_rig(&rig_file, None)?.rig;
    let rectification = Rectification::new(&rig, &RectifyOptions::default())?;
    let Board::Chessboard { size: BoardSize { columns, rows }, .. } = found.board else {
        bail!("a board of another kind than requested")
    };
    let mut all = Vec::new();
    for (v, pair) in views.iter().enumerate() {
        let (disparity, depth, confidence) = (path("d.pfm"), path("z.npy"), path("c.npy"));
        let name = pair[0].file_name().unwrap_or_default().to_string_lossy().into_owned();
        if let Err(error) = run_cv(&[
            &"depth",
            &pair[0],
            &pair[1],
            &"--rig",
            &rig_file,
            &"--disparities",
            &"auto",
            &"--no-fill",
            &"-o",
            &disparity,
            &"--depth",
            &depth,
            &"--confidence",
            &confidence,
        ]) {
            println!("  {name}: {error}");
            continue;
        }
        let corner = |point: usize| {
            let corner = found.observations.views[v][0].iter().find(|c| c.point == point)?;
            rectification.left.rectified_pixel(corner.pixel)
        };
        let boundary = [0, columns - 1, columns * rows - 1, columns * (rows - 1)];
        let boundary: Vec<Point2<f64>> = boundary.into_iter().map(corner).collect::<Option<_>>().context("a corner")?;
        let maps = [&depth, &confidence].map(|path| Ok(cv_io::npy::read(path)?.into_gray()?));
        let [depth, confidence]: [Result<GrayF32>; 2] = maps;
        let flat =
            measure_flatness(&boundary, &depth?, &confidence?, &rectification).context("no plane on the board")?;
        println!(
            "  {name}: {:.1} squares away; {:.0} % of the board matched, inlier ratio of its plane {:.0} %, RMS distance {:.3} %, of the more confident half {:.3} %",
            flat.distance,
            100.0 * flat.matched,
            100.0 * flat.inlier_ratio,
            flat.rms,
            flat.rms_confident
        );
        all.push(flat);
    }
    let median_of =
        |figure: fn(&Flatness) -> f64| median(&mut all.iter().map(figure).collect::<Vec<_>>()).unwrap_or(f64::NAN);
    Ok(vec![
        Check::at_least("commands: pairs of boards with a depth", all.len() as f64, 13.0),
        Check::at_most(
            "commands: distance of the depth from the board's plane, RMS, median of the pairs, %",
            median_of(|f| f.rms),
            0.3,
        ),
        Check::at_most(
            "commands: the same of the more confident half, RMS, median of the pairs, %",
            median_of(|f| f.rms_confident),
            0.3,
        ),
        Check::at_least(
            "commands: inlier ratio of the board's plane, median of the pairs, %",
            100.0 * median_of(|f| f.inlier_ratio),
            66.0,
        ),
    ])
}

/// Fits the plane of most inliers within the board's boundary, refined by least squares in inverse depth, which is linear in the pixel.
fn measure_flatness(
    boundary: &[Point2<f64>],
    depth: &GrayF32,
    confidence: &GrayF32,
    rectification: &Rectification,
) -> Option<Flatness> {
    let camera = &rectification.left.camera;
    let (low, high) = boundary.iter().fold((boundary[0], boundary[0]), |(a, b), p| (a.inf(p), b.sup(p)));
    let (mut rays, mut inverse_depths, mut confidences, mut area) = (Vec::new(), Vec::new(), Vec::new(), 0usize);
    for y in low.y.max(0.0) as usize..(high.y.max(0.0) as usize + 1).min(depth.height()) {
        for x in low.x.max(0.0) as usize..(high.x.max(0.0) as usize + 1).min(depth.width()) {
            if is_within(boundary, x as f64, y as f64) {
                area += 1;
                let z = f64::from(depth.at(x, y)[0]);
                if z.is_finite() {
                    rays.push(camera.normalize(Point2::new(x as f64, y as f64)).to_homogeneous());
                    inverse_depths.push(1.0 / z);
                    confidences.push(confidence.at(x, y)[0]);
                }
            }
        }
    }
    let n = rays.len();
    if n < 100 {
        return None;
    }
    let limit = INLIER_THRESHOLD_PX / (rectification.geometry.focal * rectification.geometry.baseline);
    let find_inliers = |plane: &Vector3<f64>| -> Vec<usize> {
        (0..n).filter(|i| (plane.dot(&rays[*i]) - inverse_depths[*i]).abs() <= limit).collect()
    };
    // Deterministic sampling: a Kronecker sequence with three irrational steps.
    let pick = |k: usize, step: f64| (((k as f64 + 0.5) * step).fract() * n as f64) as usize % n;
    let plane_through_sample = |k: usize| {
        let [a, b, c] = [0.618_034, 0.414_214, 0.732_051].map(|step| pick(k, step));
        let m = Matrix3::from_columns(&[rays[a], rays[b], rays[c]]).transpose();
        Some(m.try_inverse()? * Vector3::new(inverse_depths[a], inverse_depths[b], inverse_depths[c]))
    };
    let mut plane = (0..HYPOTHESES).filter_map(plane_through_sample).max_by_key(|plane| find_inliers(plane).len())?;
    for _ in 0..4 {
        let (mut a, mut b) = (Matrix3::zeros(), Vector3::zeros());
        for i in find_inliers(&plane) {
            a += rays[i] * rays[i].transpose();
            b += rays[i] * inverse_depths[i];
        }
        plane = a.try_inverse()? * b;
    }
    let inliers = find_inliers(&plane);
    let distance = median(&mut inliers.iter().map(|i| rays[*i].norm() / inverse_depths[*i]).collect::<Vec<_>>())?;
    // Distance of a point from the plane n·p = 1: (n·p − 1) / |n|.
    let distance_to_plane = |i: usize| (plane.dot(&rays[i]) / inverse_depths[i] - 1.0) / plane.norm();
    let rms = |indices: &[usize]| {
        100.0 / distance
            * (indices.iter().map(|i| distance_to_plane(*i).powi(2)).sum::<f64>() / indices.len().max(1) as f64).sqrt()
    };
    let mut by_confidence = inliers.clone();
    by_confidence.sort_by(|a, b| confidences[*b].total_cmp(&confidences[*a]));
    Some(Flatness {
        matched: n as f64 / area as f64,
        inlier_ratio: inliers.len() as f64 / n as f64,
        rms: rms(&inliers),
        rms_confident: rms(&by_confidence[..inliers.len() / 2]),
        distance,
    })
}
