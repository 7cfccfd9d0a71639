//! Calibration on generated data, peers and ours: corner errors, false detections in images without a board, and the time of a calibration.

use super::calibration::{Page, detect_board, on_one_thread, run_script};
use super::features::Random;
use crate::checks::Check;
use anyhow::{Context, Result, ensure};
use cv_core::{Camera, Distortion, GrayF32, GrayU8, Point2, Pose, Rotation3, Vector3, median};
use cv_imgproc::{gray_to_f32, resize_area, rgb_to_gray};
use cv_parallel::prelude::*;
use cv_pipeline::Silent;
use cv_pipeline::calibration::{
    BoardSize, CalibrateOptions, LensChoice, TargetCorner, TargetObservations, TargetPoints, calibrate,
};
use cv_synth::{ChessboardPhoto, ChessboardTrial, chessboard_photo, photo_without_board};
use serde::Deserialize;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

const BOARD: BoardSize = BoardSize { columns: 9, rows: 6 };
/// Photographs of each kind.
const PHOTOGRAPHS: u64 = 40;
/// Images without a board, of each of the four kinds.
const BOARDLESS_IMAGES: usize = 500;
/// Number of them, of each kind, that the times and the classic detector are measured on.
const TIMED_IMAGES: usize = 15;

#[derive(Debug, Deserialize)]
struct Solve {
    seconds: f64,
    rms: f64,
    fx: f64,
}

#[derive(Debug, Deserialize)]
struct Detection {
    image: String,
    detector: String,
    seconds: f64,
    corners: Option<Vec<[f64; 2]>>,
}

/// Generates 200 views of 11 × 8 corners with noise of σ = 0.1 px per coordinate.
fn generate_observations() -> Result<TargetObservations> {
    let target = TargetPoints::grid(11, 8, 30.0)?;
    let distortion = Distortion::radial_tangential5([-0.35, 0.14, 1e-3, -5e-4, -0.02]);
    let camera = Camera { distortion, ..Camera::pinhole(1280, 960, 900.0, 902.0, 650.0, 470.0) };
    let mut random = Random(1);
    let mut u = move || f64::from(random.next());
    let mut views = Vec::new();
    while views.len() < 200 {
        let rotation = Rotation3::new(Vector3::new(1.2 * u() - 0.6, 1.2 * u() - 0.6, 0.6 * u() - 0.3));
        let z = 350.0 + 350.0 * u();
        let center = Vector3::new((0.7 * u() - 0.35) * z, (0.5 * u() - 0.25) * z, z);
        let pose = Pose::new(rotation, center - rotation * Vector3::new(150.0, 105.0, 0.0));
        let corner = |point| {
            let p = camera.project(&pose.transform(&target.bent(point, [0.0; 2])))?;
            let inside = (5.0..1275.0).contains(&p.x) && (5.0..955.0).contains(&p.y);
            inside.then_some(TargetCorner { point, pixel: p })
        };
        let Some(mut corners) = (0..88).map(corner).collect::<Option<Vec<_>>>() else { continue };
        for c in &mut corners {
            // The sum of twelve uniform numbers is approximately normal. Both systems get coordinates rounded to f32.
            let mut noise = || 0.1 * ((0..12).map(|_| u()).sum::<f64>() - 6.0);
            (c.pixel.x, c.pixel.y) = (f64::from((c.pixel.x + noise()) as f32), f64::from((c.pixel.y + noise()) as f32));
        }
        views.push(vec![corners]);
    }
    Ok(TargetObservations { target, sizes: vec![(1280, 960)], views })
}

pub(super) fn compare_solve(python: &Path, page: &mut Page) -> Result<()> {
    println!("200 views");
    let data = generate_observations()?;
    let scratch = tempfile::tempdir()?;
    let file = scratch.path().join("corners.txt");
    let corners = data.views.iter().flatten().flatten();
    let lines = corners.fold(String::new(), |mut text, c| {
        let _ = writeln!(text, "{:?} {:?}", c.pixel.x as f32, c.pixel.y as f32);
        text
    });
    std::fs::write(&file, lines)?;
    let solves: Vec<Solve> = run_script(python, &[&"solve", &file, &"11", &"8", &"1280", &"960"])?;
    let theirs = solves.first().context("no solve")?;
    // The board is flat for both. Only ours also rejects outliers and computes the covariance of all parameters.
    let options = CalibrateOptions {
        lens: LensChoice::RadialTangential5,
        board_shape: false,
        holdout: false,
        ..CalibrateOptions::default()
    };
    let mut seconds = f64::INFINITY;
    let mut found = None;
    // The fastest of five runs, as for the peer.
    for _ in 0..5 {
        let (result, took) = on_one_thread(|| calibrate(&data, &options, &Silent))?;
        seconds = seconds.min(took);
        found = Some(result?);
    }
    let ours = found.context("no calibration")?;
    let _ = writeln!(
        page.text,
        "\n200 views of 11×8 generated corners, noise of σ = 0.1 px per coordinate, five distortion coefficients, the same corners for both: ours {seconds:.3} s, RMS {:.4} px, fx {:.3}; \
         OpenCV {:.3} s, RMS {:.4} px, fx {:.3} (truth 900).",
        ours.rms_px, ours.cameras[0].camera.fx, theirs.seconds, theirs.rms, theirs.fx
    );
    page.checks.extend([
        Check::at_most("200 views × 88 corners, s", seconds, 0.5),
        Check::at_most("200 views × 88 corners / calibrateCamera", seconds / theirs.seconds, 0.25),
    ]);
    Ok(())
}

/// Detections and corner errors in pixels on one kind of photograph, of ours, of the classic and of the sector-based detector.
struct Kind {
    trial: ChessboardTrial,
    detected: [usize; 3],
    errors: [Vec<f64>; 3],
}

/// Returns the distance of each true corner to the nearest detected one in pixels; `None` for a false detection: another number of corners or a distance of two pixels or more.
fn corner_errors(photo: &ChessboardPhoto, detected: &[[f64; 2]]) -> Option<Vec<f64>> {
    let nearest_distance = |truth: &Point2<f64>| {
        let to = |c: &[f64; 2]| (c[0] - truth.x).hypot(c[1] - truth.y);
        detected.iter().map(to).fold(f64::INFINITY, f64::min)
    };
    let all: Vec<f64> = photo.corners.iter().flatten().map(nearest_distance).collect();
    (all.len() == detected.len() && all.iter().all(|d| *d < 2.0)).then_some(all)
}

pub(super) fn compare_corners(python: &Path, page: &mut Page) -> Result<()> {
    println!("generated boards");
    let scratch = tempfile::tempdir()?;
    let all: Vec<(ChessboardTrial, u64)> =
        ChessboardTrial::ALL.into_iter().flat_map(|trial| (0..PHOTOGRAPHS).map(move |seed| (trial, seed))).collect();
    let name = |trial: ChessboardTrial, seed: u64| format!("{trial:?}-{seed:03}.png");
    let photos = all.par_iter().map(|&(trial, seed)| {
        let photo = chessboard_photo((9, 6), trial, 5000 + seed)?;
        let gray = rgb_to_gray(photo.image.view());
        cv_io::write_png(scratch.path().join(name(trial, seed)), gray.view())?;
        Ok((photo, gray))
    });
    let photos = photos.try_collect::<_, anyhow::Error>()?;
    let theirs: Vec<Detection> = run_script(python, &[&"corners", &scratch.path()])?;
    let mut kinds: Vec<Kind> =
        ChessboardTrial::ALL.map(|trial| Kind { trial, detected: [0; 3], errors: Default::default() }).into();
    let (mut false_detections, mut seconds) = ([0usize; 3], [0.0; 3]);
    for (&(trial, seed), (photo, gray)) in all.iter().zip(&photos) {
        let kind = kinds.iter_mut().find(|k| k.trial == trial).context("a kind")?;
        let float = gray_to_f32(gray.view());
        let (ours, took) = on_one_thread(|| detect_board(float.view(), BOARD))?;
        seconds[0] += took;
        let mut results = [ours.map(|b| b.corners.iter().map(|c| [c.x, c.y]).collect::<Vec<_>>()), None, None];
        for (i, detector) in ["classic", "sector-based"].into_iter().enumerate() {
            let name = name(trial, seed);
            let result =
                theirs.iter().find(|f| f.image == name && f.detector == detector).context("an image of the peer's")?;
            seconds[i + 1] += result.seconds;
            results[i + 1].clone_from(&result.corners);
        }
        let errors = results.each_ref().map(|corners| corners.as_ref().map(|corners| corner_errors(photo, corners)));
        // Errors are compared where ours and the sector-based detector both detect the board.
        let is_compared = matches!((&errors[0], &errors[2]), (Some(Some(_)), Some(Some(_))));
        for (i, errors) in errors.into_iter().enumerate() {
            match errors {
                Some(Some(errors)) => {
                    kind.detected[i] += 1;
                    if is_compared {
                        kind.errors[i].extend(errors);
                    }
                }
                Some(None) => false_detections[i] += 1,
                None => {}
            }
        }
    }
    let _ = writeln!(
        page.text,
        "\nGenerated photographs, 640×480, {PHOTOGRAPHS} of each kind, a board of 9×6 corners: boards detected, and the median error of corners in px over the photographs in \
         which ours and the sector-based detector both detect the board. Total processor seconds: ours {:.2}, classic {:.2}, sector-based {:.2}. False detections: {}, {}, \
         {}.\n\n| kind | ours | classic | sector-based |\n|---|---|---|---|",
        seconds[0], seconds[1], seconds[2], false_detections[0], false_detections[1], false_detections[2]
    );
    let (mut detected, mut total) = (0, 0);
    for kind in &mut kinds {
        let medians = kind.errors.each_mut().map(|errors| median(errors).unwrap_or(f64::NAN));
        let cell = |i: usize| {
            let error = if medians[i].is_nan() { String::new() } else { format!(", {:.4}", medians[i]) };
            format!("{} of {PHOTOGRAPHS}{error}", kind.detected[i])
        };
        let _ = writeln!(page.text, "| {:?} | {} | {} | {} |", kind.trial, cell(0), cell(1), cell(2));
        let name = format!("{:?}", kind.trial).to_lowercase();
        match kind.trial {
            // A part of the board is out of view: nothing is to be detected.
            ChessboardTrial::Cut => continue,
            ChessboardTrial::Clean => {
                page.checks.push(Check::at_most("corners, clean: median error, px", medians[0], 0.03))
            }
            _ => page.checks.push(Check::at_most(
                format!("corners, {name}: median error / sector-based"),
                medians[0] / medians[2],
                1.0,
            )),
        }
        (detected, total) = (detected + kind.detected[0], total + PHOTOGRAPHS as usize);
    }
    page.checks.push(Check::at_least("complete boards detected, %", 100.0 * detected as f64 / total as f64, 99.0));
    page.checks.push(Check::at_most("generated boards: false detections", false_detections[0] as f64, 0.0));
    page.checks.push(Check::at_most(
        "generated boards: detection time / classic with cornerSubPix",
        seconds[0] / seconds[1],
        1.0,
    ));
    Ok(())
}

/// Collects the photographs below a folder, except those of boards.
fn collect_photographs(folder: &Path, out: &mut Vec<PathBuf>) -> Result<()> {
    let mut entries: Vec<PathBuf> = std::fs::read_dir(folder)?.map(|e| Ok(e?.path())).collect::<Result<_>>()?;
    entries.sort();
    for path in entries {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if path.is_dir() {
            if !name.starts_with("calibration") {
                collect_photographs(&path, out)?;
            }
        } else if (name.ends_with(".jpg") || name.ends_with(".png")) && !name.contains("disp") && !name.contains("mask")
        {
            out.push(path);
        }
    }
    Ok(())
}

/// Renders a facade: dark windows in rows and columns on a bright wall, under a projective transformation.
fn render_facade(seed: usize) -> GrayU8 {
    let mut random = Random(seed as u32 * 2 + 1);
    let mut u = |low: f32, high: f32| low + (high - low) * random.next();
    let (width, height) = (u(12.0, 60.0), u(12.0, 60.0));
    let (across, down) = (u(0.35, 0.65), u(0.35, 0.65));
    let (lean, squeeze, rotation) = (u(-0.3, 0.3), u(-4e-4, 4e-4), u(-0.2, 0.2));
    let (wall, pane) = (u(120.0, 250.0), u(5.0, 100.0));
    // In some, every other row is shifted by half a window, as in brickwork.
    let shift = if u(0.0, 1.0) < 0.3 { 0.5 } else { 0.0 };
    let value = |x: f32, y: f32| {
        let w = 1.0 + squeeze * x;
        let (s, t) = ((x + lean * y) / w / width, (y + rotation * x) / w / height);
        let s = s + shift * (t.floor().rem_euclid(2.0));
        if s.rem_euclid(1.0) < across && t.rem_euclid(1.0) < down { pane } else { wall }
    };
    GrayU8::from_fn(640, 480, |x, y| {
        let part = |i: usize| (i as f32 + 0.5) / 3.0 - 0.5;
        let sum: f32 = (0..9).map(|i| value(x as f32 + part(i % 3), y as f32 + part(i / 3))).sum();
        [(sum / 9.0) as u8]
    })
}

/// Renders cells of random gray levels, of a random size: corners without a grid.
fn render_noise(seed: usize) -> GrayU8 {
    let mut random = Random(seed as u32 * 2 + 1);
    let cell = 3 + (random.next() * 40.0) as usize;
    let grays = random.next() < 0.5;
    let cells = GrayF32::from_fn(640 / cell + 2, 480 / cell + 2, |_, _| {
        let v = random.next();
        [if grays { v } else { v.round() }]
    });
    let view = cells.view();
    GrayU8::from_fn(640, 480, |x, y| {
        let (s, t) = (x as f64 / cell as f64, y as f64 / cell as f64);
        let v = if seed & 1 == 0 {
            view.at(s as usize, t as usize)[0]
        } else {
            cv_imgproc::sample_bilinear(view, s, t).map_or(0.0, |[v]| v)
        };
        [(255.0 * v) as u8]
    })
}

pub(super) fn compare_without_board(python: &Path, data: &Path, page: &mut Page) -> Result<()> {
    println!("images without a board");
    let mut photos = Vec::new();
    collect_photographs(data, &mut photos)?;
    ensure!(!photos.is_empty(), "no photographs in {}", data.display());
    let crops_per_photo = BOARDLESS_IMAGES.div_ceil(photos.len());
    // Crops of photographs at several scales.
    let crops = photos.par_iter().enumerate().map(|(i, path)| {
        let photo = cv_io::read_gray_u8(path)?;
        let mut random = Random(i as u32 * 2 + 1);
        let (w, h) = photo.size();
        let mut out = Vec::new();
        for _ in 0..crops_per_photo {
            let fraction = 0.3 + 0.7 * random.next();
            let (cw, ch) =
                (((w as f32 * fraction) as usize).max(16).min(w), ((h as f32 * fraction) as usize).max(16).min(h));
            let (x, y) = ((random.next() * (w - cw) as f32) as usize, (random.next() * (h - ch) as f32) as usize);
            let part = photo.view().crop(x, y, cw, ch).context("a part")?;
            out.push(resize_area(part, 640, (640 * ch / cw).clamp(160, 960))?);
        }
        Ok(out)
    });
    let crops = crops.try_collect::<_, anyhow::Error>()?.concat();
    let scratch = tempfile::tempdir()?;
    let kinds = ["scenes, generated", "photograph crops", "facades, generated", "noise and random cells"];
    let image = |kind: usize, i: usize| -> Result<GrayU8> {
        Ok(match kind {
            0 => rgb_to_gray(photo_without_board(9000 + i as u64)?.view()),
            1 => crops[i * crops.len() / BOARDLESS_IMAGES].clone(),
            2 => render_facade(i),
            _ => render_noise(i),
        })
    };
    let mut false_detections = [0usize; 4];
    let (mut ours, mut theirs) = ([0.0; 4], [0.0; 4]);
    for kind in 0..kinds.len() {
        let is_detected = (0..BOARDLESS_IMAGES).into_par_iter().map(|i| {
            let gray = image(kind, i)?;
            Ok(detect_board(gray_to_f32(gray.view()).view(), BOARD).is_some())
        });
        false_detections[kind] = is_detected.try_collect::<_, anyhow::Error>()?.into_iter().filter(|d| *d).count();
        for i in (0..TIMED_IMAGES).map(|i| i * BOARDLESS_IMAGES / TIMED_IMAGES) {
            let gray = image(kind, i)?;
            cv_io::write_png(scratch.path().join(format!("none-{kind}-{i:03}.png")), gray.view())?;
            let float = gray_to_f32(gray.view());
            ours[kind] += on_one_thread(|| detect_board(float.view(), BOARD))?.1;
        }
    }
    let results: Vec<Detection> = run_script(python, &[&"corners", &scratch.path()])?;
    let mut classic_detections = 0;
    for f in &results {
        let kind: usize = f.image.split('-').nth(1).and_then(|k| k.parse().ok()).context("a kind")?;
        theirs[kind] += f.seconds;
        classic_detections += usize::from(f.corners.is_some());
    }
    let _ = writeln!(
        page.text,
        "\nImages without a board, {BOARDLESS_IMAGES} of each kind, about 640×480; times are of {TIMED_IMAGES} of each, in which the classic detector has {classic_detections} detections:\n\n| kind | false 9×6 detections of ours \
         | ours, ms per image | classic, ms per image |\n|---|---|---|---|"
    );
    for kind in 0..kinds.len() {
        let ms = |s: f64| 1e3 * s / TIMED_IMAGES as f64;
        let _ = writeln!(
            page.text,
            "| {} | {} | {:.2} | {:.2} |",
            kinds[kind],
            false_detections[kind],
            ms(ours[kind]),
            ms(theirs[kind])
        );
    }
    page.checks.push(Check::at_most(
        "without a board: false detections in 2,000 images",
        false_detections.iter().sum::<usize>() as f64,
        0.0,
    ));
    page.checks.push(Check::at_most(
        "without a board: detection time / classic",
        ours.iter().sum::<f64>() / theirs.iter().sum::<f64>(),
        1.0,
    ));
    page.checks.push(Check::at_most(
        "without a board, photograph crops: detection time / classic",
        ours[1] / theirs[1],
        1.0,
    ));
    Ok(())
}
