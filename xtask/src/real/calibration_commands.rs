//! The whole way from photographs of a board to depth by the program's commands: `cv calibrate stereo`, then `cv depth --rig` of the same photographs, and how flat the board is in it.

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

/// A pixel agrees with a plane where its disparity is that of the plane to so many pixels: another match of a board is a square away.
const AGREES_PX: f64 = 1.0;
/// Planes through three pixels that are tried.
const PLANES: usize = 500;

/// Runs the program; what it says on stderr where it fails.
fn cv(arguments: &[&dyn AsRef<OsStr>]) -> Result<()> {
    let mut command = Command::new(crate::trust::program()?);
    command.args(arguments.iter().map(|a| a.as_ref()));
    let output = command.output().context("cannot start the program")?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr).trim());
    Ok(())
}

/// A board in a map of depth.
struct Flatness {
    /// Shares of the board: matched, and of those on the plane.
    matched: f64,
    agree: f64,
    /// Root mean square distance from the plane in percent of the board's distance, of all pixels that agree and of the surer half of them.
    rms: f64,
    surer: f64,
    distance: f64,
}

/// `found`: where the boards are, of which the corners tell the outline.
pub(super) fn run(folder: &Path, views: &[Vec<PathBuf>], found: &BoardCalibration) -> Result<Vec<Check>> {
    let scratch = tempfile::tempdir()?;
    let at = |name: &str| scratch.path().join(name);
    let [left, right] = ["left", "right"].map(|side| folder.join(format!("{side}*.jpg")));
    let rig_file = at("rig.yaml");
    cv(&[
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
        bail!("another board than was asked for")
    };
    let mut all = Vec::new();
    for (v, pair) in views.iter().enumerate() {
        let (disparity, depth, confidence) = (at("d.pfm"), at("z.npy"), at("c.npy"));
        let name = pair[0].file_name().unwrap_or_default().to_string_lossy().into_owned();
        if let Err(error) = cv(&[
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
        let outline = [0, columns - 1, columns * rows - 1, columns * (rows - 1)];
        let outline: Vec<Point2<f64>> = outline.into_iter().map(corner).collect::<Option<_>>().context("a corner")?;
        let maps = [&depth, &confidence].map(|path| Ok(cv_io::npy::read(path)?.into_gray()?));
        let [depth, confidence]: [Result<GrayF32>; 2] = maps;
        let flat = flatness(&outline, &depth?, &confidence?, &rectification).context("no plane on the board")?;
        println!(
            "  {name}: {:.1} squares away; {:.0} % of the board matched, {:.0} % of that on its plane, off it by {:.3} % RMS, the surer half by {:.3} %",
            flat.distance,
            100.0 * flat.matched,
            100.0 * flat.agree,
            flat.rms,
            flat.surer
        );
        all.push(flat);
    }
    let middle = |of: fn(&Flatness) -> f64| median(&mut all.iter().map(of).collect::<Vec<_>>()).unwrap_or(f64::NAN);
    Ok(vec![
        Check::at_least("commands: pairs of boards with a depth", all.len() as f64, 13.0),
        Check::at_most("commands: a board's depth off its plane, RMS, median of the pairs, %", middle(|f| f.rms), 0.3),
        Check::at_most(
            "commands: surer half of a board's depth off its plane, RMS, median of the pairs, %",
            middle(|f| f.surer),
            0.3,
        ),
        Check::at_least(
            "commands: matched pixels on the board's plane, median of the pairs, %",
            100.0 * middle(|f| f.agree),
            66.0,
        ),
    ])
}

/// The plane that most pixels within the outline agree with, then by least squares in inverse depth, which on a plane is linear in the pixel.
fn flatness(
    outline: &[Point2<f64>],
    depth: &GrayF32,
    confidence: &GrayF32,
    rectification: &Rectification,
) -> Option<Flatness> {
    let camera = &rectification.left.camera;
    let (low, high) = outline.iter().fold((outline[0], outline[0]), |(a, b), p| (a.inf(p), b.sup(p)));
    let (mut rays, mut inverse, mut sure, mut area) = (Vec::new(), Vec::new(), Vec::new(), 0usize);
    for y in low.y.max(0.0) as usize..(high.y.max(0.0) as usize + 1).min(depth.height()) {
        for x in low.x.max(0.0) as usize..(high.x.max(0.0) as usize + 1).min(depth.width()) {
            if is_within(outline, x as f64, y as f64) {
                area += 1;
                let z = f64::from(depth.at(x, y)[0]);
                if z.is_finite() {
                    rays.push(camera.normalize(Point2::new(x as f64, y as f64)).to_homogeneous());
                    inverse.push(1.0 / z);
                    sure.push(confidence.at(x, y)[0]);
                }
            }
        }
    }
    let n = rays.len();
    if n < 100 {
        return None;
    }
    let limit = AGREES_PX / (rectification.geometry.focal * rectification.geometry.baseline);
    let agree = |plane: &Vector3<f64>| -> Vec<usize> {
        (0..n).filter(|i| (plane.dot(&rays[*i]) - inverse[*i]).abs() <= limit).collect()
    };
    // Three pixels by multiples of irrational numbers: spread over all, and the same each time.
    let pick = |k: usize, step: f64| (((k as f64 + 0.5) * step).fract() * n as f64) as usize % n;
    let through = |k: usize| {
        let [a, b, c] = [0.618_034, 0.414_214, 0.732_051].map(|step| pick(k, step));
        let m = Matrix3::from_columns(&[rays[a], rays[b], rays[c]]).transpose();
        Some(m.try_inverse()? * Vector3::new(inverse[a], inverse[b], inverse[c]))
    };
    let mut plane = (0..PLANES).filter_map(through).max_by_key(|plane| agree(plane).len())?;
    for _ in 0..4 {
        let (mut a, mut b) = (Matrix3::zeros(), Vector3::zeros());
        for i in agree(&plane) {
            a += rays[i] * rays[i].transpose();
            b += rays[i] * inverse[i];
        }
        plane = a.try_inverse()? * b;
    }
    let inliers = agree(&plane);
    let distance = median(&mut inliers.iter().map(|i| rays[*i].norm() / inverse[*i]).collect::<Vec<_>>())?;
    // n·p = 1 on the plane: a point is as far from it as that is off, over the length of n.
    let off = |i: usize| (plane.dot(&rays[i]) / inverse[i] - 1.0) / plane.norm();
    let rms = |of: &[usize]| {
        100.0 / distance * (of.iter().map(|i| off(*i).powi(2)).sum::<f64>() / of.len().max(1) as f64).sqrt()
    };
    let mut by_confidence = inliers.clone();
    by_confidence.sort_by(|a, b| sure[*b].total_cmp(&sure[*a]));
    Some(Flatness {
        matched: n as f64 / area as f64,
        agree: inliers.len() as f64 / n as f64,
        rms: rms(&inliers),
        surer: rms(&by_confidence[..inliers.len() / 2]),
        distance,
    })
}
