//! Corners of marker boards (ChArUco, AprilGrid, ArUco grid): ours and OpenCV's on the same generated photographs.

use super::calibration::{Page, on_one_thread, run_script};
use super::features::Random;
use crate::checks::Check;
use anyhow::{Context, Result, bail};
use cv_core::{Camera, Distortion, GrayU8, Point2, Pose, Rotation3, Vector3, median};
use cv_features::{Board, CharucoBoard, ChessboardOptions, Dictionary, GridStyle, MarkerGrid, find_board};
use cv_imgproc::{gray_to_f32, rgb_to_gray};
use cv_parallel::prelude::*;
use cv_pipeline::Silent;
use cv_synth::{Print, RenderOptions, Sheet, Texture};
use serde::Deserialize;
use std::fmt::Write as _;
use std::path::Path;
use std::sync::Arc;

/// Photographs of each board.
const PHOTOGRAPHS: u32 = 40;
/// Paper around the board, in meters.
const MARGIN: f64 = 0.012;
/// A detected corner farther than this from every true one is a false corner.
const MAX_CORNER_ERROR_PX: f64 = 3.0;

#[derive(Debug, Deserialize)]
struct Detection {
    image: String,
    seconds: f64,
    corners: Vec<[f64; 2]>,
}

/// Returns the boards with OpenCV's parameters of each: columns, rows, dictionary, and the ratio of marker to square or the cells of the marker's border.
fn boards() -> [(Board, [&'static str; 4]); 3] {
    let dictionary = Dictionary::Aruco5x5x100;
    let charuco = CharucoBoard { squares: (8, 6), square: 0.03, marker: 0.022, dictionary };
    let style = GridStyle::Aruco;
    let aruco = MarkerGrid { markers: (6, 5), marker: 0.03, spacing: 0.3, dictionary: Dictionary::Aruco4x4x50, style };
    let april = MarkerGrid { dictionary: Dictionary::AprilTag36h11, style: GridStyle::AprilGrid, ..aruco };
    [
        (Board::Charuco(charuco), ["8", "6", "DICT_5X5_100", "0.7333333"]),
        (Board::MarkerGrid(april), ["6", "5", "DICT_APRILTAG_36h11", "2"]),
        (Board::MarkerGrid(aruco), ["6", "5", "DICT_4X4_50", "1"]),
    ]
}

/// Renders a photograph of 640×480 px, tilted by up to 45°, blurred by up to 1 px, with up to half a stop of exposure and noise; a part of the board may be out of
/// view. Also returns the true pixels of the board's points.
fn render_photograph(board: &Board, seed: u32) -> Result<(GrayU8, Vec<Point2<f64>>)> {
    let (o, black) = (board.outline(), board.black_rectangles());
    let size = (o.width + 2.0 * MARGIN, o.height + 2.0 * MARGIN);
    let at = |v: f64, first: f64| (v - first + MARGIN) as f32;
    let black = black.iter().map(|r| [at(r.x, o.x), at(r.y, o.y), r.width as f32, r.height as f32]).collect();
    let mut random = Random(2 * seed + 1);
    let mut u = |low: f64, high: f64| low + (high - low) * f64::from(random.next());
    let sheet = Sheet {
        texture: Texture::Print(Arc::new(Print::new(black, (size.0 as f32, size.1 as f32)))),
        size,
        bend: 0.0,
        behind: Texture::Paint { color: [0.4; 3], seed },
        light: [u(-0.2, 0.2) as f32, u(-0.2, 0.2) as f32],
        glare: None,
    };
    let focal = u(500.0, 700.0);
    let camera = Camera { distortion: Distortion::radial(u(-0.15, 0.0), 0.0), ..Camera::from_focal(640, 480, focal) };
    let rotation = Rotation3::new(Vector3::new(u(-0.55, 0.55), u(-0.55, 0.55), u(-3.1, 3.1)));
    let center = Vector3::new(u(-0.06, 0.06), u(-0.04, 0.04), focal * u(4e-4, 7e-4));
    let pose = Pose::new(rotation, center - rotation * Vector3::new(size.0 / 2.0, size.1 / 2.0, 0.0));
    let options = RenderOptions {
        samples: 3,
        blur: u(0.4, 1.0) as f32,
        exposure: u(-0.5, 0.2) as f32,
        ..RenderOptions::default()
    };
    let image = sheet.photo(&camera, &pose, &options.with_seed(seed.into()))?;
    let project = |p: &Point2<f64>| {
        camera.project(&pose.transform(&sheet.point(p.x - o.x + MARGIN, p.y - o.y + MARGIN))).context("behind")
    };
    Ok((rgb_to_gray(image.view()), board.points().iter().map(project).collect::<Result<_>>()?))
}

/// Returns the error of each true point that has a detected corner nearby, in pixels, and the number of false corners.
fn corner_errors(truth: &[Point2<f64>], detected: &[[f64; 2]]) -> (Vec<Option<f64>>, usize) {
    let mut errors = vec![None; truth.len()];
    let mut false_corners = 0;
    for c in detected {
        let to = |t: &Point2<f64>| (c[0] - t.x).hypot(c[1] - t.y);
        let best = (0..truth.len()).min_by(|a, b| to(&truth[*a]).total_cmp(&to(&truth[*b])));
        match best.map(|i| (i, to(&truth[i]))).filter(|(_, d)| *d < MAX_CORNER_ERROR_PX) {
            Some((i, d)) => errors[i] = Some(d),
            None => false_corners += 1,
        }
    }
    (errors, false_corners)
}

pub(super) fn run(python: &Path, page: &mut Page) -> Result<()> {
    println!("marker boards");
    let _ = writeln!(
        page.text,
        "\nMarker boards, {PHOTOGRAPHS} generated photographs of each, 640×480, tilted by up to 45°, blurred by up to 1 px; in some a part of the board is out of view. OpenCV: \
         `CharucoDetector`, and `ArucoDetector` with `CORNER_REFINE_SUBPIX`. Error: median and 95th percentile in px over the corners that both detect:\n\n| board | \
         corners, ours | OpenCV | error, ours | OpenCV | false corners, ours | OpenCV | processor s, ours | OpenCV |\n|---|---|---|---|---|---|---|---|---|"
    );
    for (board, parameters) in boards() {
        let scratch = tempfile::tempdir()?;
        let photos = (0..PHOTOGRAPHS).into_par_iter().map(|seed| {
            let (gray, truth) = render_photograph(&board, seed)?;
            cv_io::write_png(scratch.path().join(format!("{seed:03}.png")), gray.view())?;
            Ok((gray, truth))
        });
        let photos = photos.try_collect::<_, anyhow::Error>()?;
        let kind = board.kind().to_string();
        let [columns, rows, dictionary, last] = parameters;
        let theirs: Vec<Detection> =
            run_script(python, &[&"markers", &scratch.path(), &kind, &columns, &rows, &dictionary, &last])?;
        let (mut errors, mut count, mut false_corners, mut seconds) =
            ([const { Vec::new() }; 2], [0; 2], [0; 2], [0.0; 2]);
        for (seed, (gray, truth)) in photos.iter().enumerate() {
            let float = gray_to_f32(gray.view());
            let (ours, took) =
                on_one_thread(|| find_board(float.view(), &board, &ChessboardOptions::default(), &Silent))?;
            let ours: Vec<[f64; 2]> = ours.unwrap_or_default().iter().map(|p| [p.position.x, p.position.y]).collect();
            let name = format!("{seed:03}.png");
            let Some(their) = theirs.iter().find(|f| f.image == name) else { bail!("no {name} of the peer's") };
            seconds = [seconds[0] + took, seconds[1] + their.seconds];
            let both = [corner_errors(truth, &ours), corner_errors(truth, &their.corners)];
            for (i, (by_point, false_count)) in both.iter().enumerate() {
                count[i] += by_point.iter().flatten().count();
                false_corners[i] += false_count;
            }
            for (a, b) in both[0].0.iter().zip(&both[1].0) {
                if let (Some(a), Some(b)) = (a, b) {
                    errors[0].push(*a);
                    errors[1].push(*b);
                }
            }
        }
        let median_error = errors.each_mut().map(|e| median(e).unwrap_or(f64::NAN));
        let percentile_95 = errors.each_mut().map(|e| cv_core::quantile(e, 0.95).unwrap_or(f64::NAN));
        let _ = writeln!(
            page.text,
            "| {kind} | {} | {} | {:.3}, {:.3} | {:.3}, {:.3} | {} | {} | {:.2} | {:.2} |",
            count[0],
            count[1],
            median_error[0],
            percentile_95[0],
            median_error[1],
            percentile_95[1],
            false_corners[0],
            false_corners[1],
            seconds[0],
            seconds[1]
        );
        page.checks.extend([
            Check::at_most(format!("{kind}: median error / OpenCV's"), median_error[0] / median_error[1], 1.0),
            // Each detects some corners at the image border or at grazing angles that the other misses; a difference of 2 % is tolerated.
            Check::at_least(format!("{kind}: corners detected / OpenCV's"), count[0] as f64 / count[1] as f64, 0.98),
            Check::at_most(format!("{kind}: false corners"), false_corners[0] as f64, 0.0),
        ]);
    }
    Ok(())
}
