//! Corners of boards of markers: ours and OpenCV's on the same generated photographs.

use super::calibration::{Page, on_one_thread, peer};
use super::features::Random;
use crate::checks::Check;
use anyhow::{Context, Result, bail};
use cv_core::{Camera, Distortion, GrayU8, Point2, Pose, Rotation3, Vector3, median};
use cv_features::{Board, CharucoBoard, ChessboardOptions, Dictionary, GridStyle, MarkerGrid, find_board};
use cv_imgproc::{gray_to_f32, rgb_to_gray};
use cv_pipeline::Silent;
use cv_synth::{Print, RenderOptions, Sheet, Texture};
use rayon::prelude::*;
use serde::Deserialize;
use std::fmt::Write as _;
use std::path::Path;
use std::sync::Arc;

/// Photographs of each board.
const PHOTOGRAPHS: u32 = 40;
/// Paper around the board, in meters.
const MARGIN: f64 = 0.012;
/// A corner that is farther from every true one is none of the board's.
const WRONG_PX: f64 = 3.0;

#[derive(Debug, Deserialize)]
struct Found {
    image: String,
    seconds: f64,
    corners: Vec<[f64; 2]>,
}

/// The boards, with what OpenCV needs to know of each beside its columns and rows: the dictionary, and the share of a marker or the cells of its frame.
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

/// A photograph, 640×480, and where the board's points are in it: tilted to 45°, blurred by up to a pixel, half a stop of exposure, noise; a part may be outside.
fn photograph(board: &Board, seed: u32) -> Result<(GrayU8, Vec<Point2<f64>>)> {
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
    let turn = Rotation3::new(Vector3::new(u(-0.55, 0.55), u(-0.55, 0.55), u(-3.1, 3.1)));
    let middle = Vector3::new(u(-0.06, 0.06), u(-0.04, 0.04), focal * u(4e-4, 7e-4));
    let pose = Pose::new(turn, middle - turn * Vector3::new(size.0 / 2.0, size.1 / 2.0, 0.0));
    let options = RenderOptions {
        samples: 3,
        blur: u(0.4, 1.0) as f32,
        exposure: u(-0.5, 0.2) as f32,
        ..RenderOptions::default()
    };
    let image = sheet.photo(&camera, &pose, &options.with_seed(seed.into()))?;
    let place = |p: &Point2<f64>| {
        camera.project(&pose.transform(&sheet.point(p.x - o.x + MARGIN, p.y - o.y + MARGIN))).context("behind")
    };
    Ok((rgb_to_gray(image.view()), board.points().iter().map(place).collect::<Result<_>>()?))
}

/// For each true point the distance of the nearest corner that was found, where one is near; and how many corners are none.
fn distances(truth: &[Point2<f64>], found: &[[f64; 2]]) -> (Vec<Option<f64>>, usize) {
    let mut near = vec![None; truth.len()];
    let mut wrong = 0;
    for c in found {
        let to = |t: &Point2<f64>| (c[0] - t.x).hypot(c[1] - t.y);
        let best = (0..truth.len()).min_by(|a, b| to(&truth[*a]).total_cmp(&to(&truth[*b])));
        match best.map(|i| (i, to(&truth[i]))).filter(|(_, d)| *d < WRONG_PX) {
            Some((i, d)) => near[i] = Some(d),
            None => wrong += 1,
        }
    }
    (near, wrong)
}

pub(super) fn run(python: &Path, page: &mut Page) -> Result<()> {
    println!("boards of markers");
    let _ = writeln!(
        page.text,
        "\nBoards of markers, {PHOTOGRAPHS} generated photographs of each, 640×480, tilted to 45°, blurred by up to a pixel; a part of the board is outside in some. OpenCV: \
         `CharucoDetector`, and `ArucoDetector` with `CORNER_REFINE_SUBPIX`. Median and 95 % of the distances to the truth, in px, of corners that both have:\n\n| board | \
         corners, ours | OpenCV | error, ours | OpenCV | wrong, ours | OpenCV | processor s, ours | OpenCV |\n|---|---|---|---|---|---|---|---|---|"
    );
    for (board, known) in boards() {
        let scratch = tempfile::tempdir()?;
        let photos = (0..PHOTOGRAPHS).into_par_iter().map(|seed| {
            let (gray, truth) = photograph(&board, seed)?;
            cv_io::write_png(scratch.path().join(format!("{seed:03}.png")), gray.view())?;
            Ok((gray, truth))
        });
        let photos = photos.collect::<Result<Vec<_>>>()?;
        let kind = board.kind().to_string();
        let [columns, rows, dictionary, last] = known;
        let theirs: Vec<Found> =
            peer(python, &[&"markers", &scratch.path(), &kind, &columns, &rows, &dictionary, &last])?;
        let (mut off, mut count, mut wrong, mut seconds) = ([const { Vec::new() }; 2], [0; 2], [0; 2], [0.0; 2]);
        for (seed, (gray, truth)) in photos.iter().enumerate() {
            let float = gray_to_f32(gray.view());
            let (ours, took) =
                on_one_thread(|| find_board(float.view(), &board, &ChessboardOptions::default(), &Silent))?;
            let ours: Vec<[f64; 2]> = ours.unwrap_or_default().iter().map(|p| [p.position.x, p.position.y]).collect();
            let name = format!("{seed:03}.png");
            let Some(their) = theirs.iter().find(|f| f.image == name) else { bail!("no {name} of the peer's") };
            seconds = [seconds[0] + took, seconds[1] + their.seconds];
            let each = [distances(truth, &ours), distances(truth, &their.corners)];
            for (i, (near, none)) in each.iter().enumerate() {
                count[i] += near.iter().flatten().count();
                wrong[i] += none;
            }
            for (a, b) in each[0].0.iter().zip(&each[1].0) {
                if let (Some(a), Some(b)) = (a, b) {
                    off[0].push(*a);
                    off[1].push(*b);
                }
            }
        }
        let middle = off.each_mut().map(|off| median(off).unwrap_or(f64::NAN));
        let most = off.each_mut().map(|off| cv_core::quantile(off, 0.95).unwrap_or(f64::NAN));
        let _ = writeln!(
            page.text,
            "| {kind} | {} | {} | {:.3}, {:.3} | {:.3}, {:.3} | {} | {} | {:.2} | {:.2} |",
            count[0], count[1], middle[0], most[0], middle[1], most[1], wrong[0], wrong[1], seconds[0], seconds[1]
        );
        page.checks.extend([
            Check::at_most(format!("{kind}: median error / OpenCV's"), middle[0] / middle[1], 1.0),
            // Either has some at the border of the picture, or in a glancing view, that the other has not: a fiftieth is no difference.
            Check::at_least(format!("{kind}: corners found / OpenCV's"), count[0] as f64 / count[1] as f64, 0.98),
            Check::at_most(format!("{kind}: corners that are none"), wrong[0] as f64, 0.0),
        ]);
    }
    Ok(())
}
