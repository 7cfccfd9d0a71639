//! Generated boards for the peers of calibration: what their corners are off, what is found where no board is, and the time of a solve.

use super::calibration::{Page, find, on_one_thread, peer};
use super::features::Random;
use crate::checks::Check;
use anyhow::{Context, Result, ensure};
use cv_core::{Camera, Distortion, GrayF32, GrayU8, Point2, Pose, Rotation3, Vector3, median};
use cv_imgproc::{gray_to_f32, resize_area, rgb_to_gray};
use cv_pipeline::Silent;
use cv_pipeline::calibration::{
    BoardSize, CalibrateOptions, LensChoice, TargetCorner, TargetObservations, TargetPoints, calibrate,
};
use cv_synth::{ChessboardPhoto, ChessboardTrial, chessboard_photo, photo_without_board};
use rayon::prelude::*;
use serde::Deserialize;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

const BOARD: BoardSize = BoardSize { columns: 9, rows: 6 };
/// Photographs of each kind.
const PHOTOGRAPHS: u64 = 40;
/// Pictures without a board, of each of the four kinds.
const EMPTY: usize = 500;
/// Of those so many of each kind are shown to the classic finder.
const SHOWN: usize = 15;

#[derive(Debug, Deserialize)]
struct Solve {
    seconds: f64,
    rms: f64,
    fx: f64,
}

#[derive(Debug, Deserialize)]
struct Found {
    image: String,
    finder: String,
    seconds: f64,
    corners: Option<Vec<[f64; 2]>>,
}

/// 200 views of 11 × 8 corners with noise of 0.1 px a coordinate.
fn sightings() -> Result<TargetObservations> {
    let target = TargetPoints::grid(11, 8, 30.0)?;
    let distortion = Distortion::radial_tangential5([-0.35, 0.14, 1e-3, -5e-4, -0.02]);
    let camera = Camera { distortion, ..Camera::pinhole(1280, 960, 900.0, 902.0, 650.0, 470.0) };
    let mut random = Random(1);
    let mut u = move || f64::from(random.next());
    let mut views = Vec::new();
    while views.len() < 200 {
        let turn = Rotation3::new(Vector3::new(1.2 * u() - 0.6, 1.2 * u() - 0.6, 0.6 * u() - 0.3));
        let z = 350.0 + 350.0 * u();
        let middle = Vector3::new((0.7 * u() - 0.35) * z, (0.5 * u() - 0.25) * z, z);
        let pose = Pose::new(turn, middle - turn * Vector3::new(150.0, 105.0, 0.0));
        let corner = |point| {
            let p = camera.project(&pose.transform(&target.bent(point, [0.0; 2])))?;
            let inside = (5.0..1275.0).contains(&p.x) && (5.0..955.0).contains(&p.y);
            inside.then_some(TargetCorner { point, pixel: p })
        };
        let Some(mut corners) = (0..88).map(corner).collect::<Option<Vec<_>>>() else { continue };
        for c in &mut corners {
            // Twelve uniform numbers make a nearly normal one. Both systems get what an f32 holds.
            let mut noise = || 0.1 * ((0..12).map(|_| u()).sum::<f64>() - 6.0);
            (c.pixel.x, c.pixel.y) = (f64::from((c.pixel.x + noise()) as f32), f64::from((c.pixel.y + noise()) as f32));
        }
        views.push(vec![corners]);
    }
    Ok(TargetObservations { target, sizes: vec![(1280, 960)], views })
}

pub(super) fn solve(python: &Path, page: &mut Page) -> Result<()> {
    println!("200 views");
    let data = sightings()?;
    let scratch = tempfile::tempdir()?;
    let file = scratch.path().join("corners.txt");
    let corners = data.views.iter().flatten().flatten();
    let lines = corners.fold(String::new(), |mut text, c| {
        let _ = writeln!(text, "{:?} {:?}", c.pixel.x as f32, c.pixel.y as f32);
        text
    });
    std::fs::write(&file, lines)?;
    let theirs: Vec<Solve> = peer(python, &[&"solve", &file, &"11", &"8", &"1280", &"960"])?;
    let theirs = theirs.first().context("no solve")?;
    // The board is flat for both; outliers and the covariance of all parameters are looked at by ours alone.
    let options = CalibrateOptions {
        lens: LensChoice::RadialTangential5,
        board_shape: false,
        holdout: false,
        ..CalibrateOptions::default()
    };
    let mut seconds = f64::INFINITY;
    let mut found = None;
    // The least of as many runs as the peer's.
    for _ in 0..5 {
        let (result, took) = on_one_thread(|| calibrate(&data, &options, &Silent))?;
        seconds = seconds.min(took);
        found = Some(result?);
    }
    let ours = found.context("no calibration")?;
    let _ = writeln!(
        page.text,
        "\n200 views of 11×8 generated corners, noise 0.1 px a coordinate, five numbers, the same corners for both: ours {seconds:.3} s, RMS {:.4} px, fx {:.3}; \
         OpenCV {:.3} s, RMS {:.4} px, fx {:.3} (truth 900).",
        ours.rms_px, ours.cameras[0].camera.fx, theirs.seconds, theirs.rms, theirs.fx
    );
    page.checks.extend([
        Check::at_most("200 views × 88 corners, s", seconds, 0.5),
        Check::at_most("200 views × 88 corners / calibrateCamera", seconds / theirs.seconds, 0.25),
    ]);
    Ok(())
}

/// Medians of the distances of corners to the truth: those of ours, of the classic and of the sector-based finder.
struct Kind {
    trial: ChessboardTrial,
    /// Boards found.
    found: [usize; 3],
    off: [Vec<f64>; 3],
}

/// Distances of the true corners to the nearest ones found; `None` where one has none within two pixels, so that another grid was found.
fn distances(photo: &ChessboardPhoto, found: &[[f64; 2]]) -> Option<Vec<f64>> {
    let near = |truth: &Point2<f64>| {
        let to = |c: &[f64; 2]| (c[0] - truth.x).hypot(c[1] - truth.y);
        found.iter().map(to).fold(f64::INFINITY, f64::min)
    };
    let all: Vec<f64> = photo.corners.iter().flatten().map(near).collect();
    (all.len() == found.len() && all.iter().all(|d| *d < 2.0)).then_some(all)
}

pub(super) fn corners(python: &Path, page: &mut Page) -> Result<()> {
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
    let photos = photos.collect::<Result<Vec<_>>>()?;
    let theirs: Vec<Found> = peer(python, &[&"corners", &scratch.path()])?;
    let mut kinds: Vec<Kind> =
        ChessboardTrial::ALL.map(|trial| Kind { trial, found: [0; 3], off: Default::default() }).into();
    let (mut wrong, mut seconds) = ([0usize; 3], [0.0; 3]);
    for (&(trial, seed), (photo, gray)) in all.iter().zip(&photos) {
        let kind = kinds.iter_mut().find(|k| k.trial == trial).context("a kind")?;
        let float = gray_to_f32(gray.view());
        let (ours, took) = on_one_thread(|| find(float.view(), BOARD))?;
        seconds[0] += took;
        let mut each = [ours.map(|b| b.corners.iter().map(|c| [c.x, c.y]).collect::<Vec<_>>()), None, None];
        for (i, finder) in ["classic", "sector-based"].into_iter().enumerate() {
            let name = name(trial, seed);
            let of =
                theirs.iter().find(|f| f.image == name && f.finder == finder).context("a picture of the peer's")?;
            seconds[i + 1] += of.seconds;
            each[i + 1].clone_from(&of.corners);
        }
        let off = each.each_ref().map(|found| found.as_ref().map(|found| distances(photo, found)));
        // Errors are compared where ours and the sector-based finder both have the board.
        let compared = matches!((&off[0], &off[2]), (Some(Some(_)), Some(Some(_))));
        for (i, off) in off.into_iter().enumerate() {
            match off {
                Some(Some(off)) => {
                    kind.found[i] += 1;
                    if compared {
                        kind.off[i].extend(off);
                    }
                }
                Some(None) => wrong[i] += 1,
                None => {}
            }
        }
    }
    let _ = writeln!(
        page.text,
        "\nGenerated photographs, 640×480, {PHOTOGRAPHS} of each kind, a board of 9×6 corners: found, and the median distance of corners to the truth in px, of those photographs on \
         which ours and the sector-based finder have the board. Processor seconds in all: ours {:.2}, classic {:.2}, sector-based {:.2}. Grids that are not the board's: {}, {}, \
         {}.\n\n| kind | ours | classic | sector-based |\n|---|---|---|---|",
        seconds[0], seconds[1], seconds[2], wrong[0], wrong[1], wrong[2]
    );
    let (mut whole, mut of) = (0, 0);
    for kind in &mut kinds {
        let medians = kind.off.each_mut().map(|off| median(off).unwrap_or(f64::NAN));
        let cell = |i: usize| {
            let distance = if medians[i].is_nan() { String::new() } else { format!(", {:.4}", medians[i]) };
            format!("{} of {PHOTOGRAPHS}{distance}", kind.found[i])
        };
        let _ = writeln!(page.text, "| {:?} | {} | {} | {} |", kind.trial, cell(0), cell(1), cell(2));
        let name = format!("{:?}", kind.trial).to_lowercase();
        match kind.trial {
            // A part of the board is outside: none is to be found.
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
        (whole, of) = (whole + kind.found[0], of + PHOTOGRAPHS as usize);
    }
    page.checks.push(Check::at_least("whole boards found, %", 100.0 * whole as f64 / of as f64, 99.0));
    page.checks.push(Check::at_most("grids that are not the board's", wrong[0] as f64, 0.0));
    page.checks.push(Check::at_most(
        "generated boards: finding / classic with cornerSubPix",
        seconds[0] / seconds[1],
        1.0,
    ));
    Ok(())
}

/// Photographs below a folder, those of boards aside.
fn real(folder: &Path, out: &mut Vec<PathBuf>) -> Result<()> {
    let mut entries: Vec<PathBuf> = std::fs::read_dir(folder)?.map(|e| Ok(e?.path())).collect::<Result<_>>()?;
    entries.sort();
    for path in entries {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if path.is_dir() {
            if !name.starts_with("calibration") {
                real(&path, out)?;
            }
        } else if (name.ends_with(".jpg") || name.ends_with(".png")) && !name.contains("disp") && !name.contains("mask")
        {
            out.push(path);
        }
    }
    Ok(())
}

/// A front of windows: dark rectangles in rows and columns on a bright wall, under some perspective.
fn facade(seed: usize) -> GrayU8 {
    let mut random = Random(seed as u32 * 2 + 1);
    let mut u = |low: f32, high: f32| low + (high - low) * random.next();
    let (width, height) = (u(12.0, 60.0), u(12.0, 60.0));
    let (across, down) = (u(0.35, 0.65), u(0.35, 0.65));
    let (lean, squeeze, turn) = (u(-0.3, 0.3), u(-4e-4, 4e-4), u(-0.2, 0.2));
    let (wall, pane) = (u(120.0, 250.0), u(5.0, 100.0));
    // Every other row moved by half a window, as bricks are, on some.
    let shift = if u(0.0, 1.0) < 0.3 { 0.5 } else { 0.0 };
    let value = |x: f32, y: f32| {
        let w = 1.0 + squeeze * x;
        let (s, t) = ((x + lean * y) / w / width, (y + turn * x) / w / height);
        let s = s + shift * (t.floor().rem_euclid(2.0));
        if s.rem_euclid(1.0) < across && t.rem_euclid(1.0) < down { pane } else { wall }
    };
    GrayU8::from_fn(640, 480, |x, y| {
        let part = |i: usize| (i as f32 + 0.5) / 3.0 - 0.5;
        let sum: f32 = (0..9).map(|i| value(x as f32 + part(i % 3), y as f32 + part(i / 3))).sum();
        [(sum / 9.0) as u8]
    })
}

/// Black and white cells at random, and noise of all sizes: corners without order.
fn noise(seed: usize) -> GrayU8 {
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

pub(super) fn without(python: &Path, data: &Path, page: &mut Page) -> Result<()> {
    println!("pictures without a board");
    let mut photos = Vec::new();
    real(data, &mut photos)?;
    ensure!(!photos.is_empty(), "no photographs in {}", data.display());
    let each = EMPTY.div_ceil(photos.len());
    // Parts of photographs at several scales.
    let crops = photos.par_iter().enumerate().map(|(i, path)| {
        let photo = cv_io::read_gray_u8(path)?;
        let mut random = Random(i as u32 * 2 + 1);
        let (w, h) = photo.size();
        let mut out = Vec::new();
        for _ in 0..each {
            let share = 0.3 + 0.7 * random.next();
            let (cw, ch) = (((w as f32 * share) as usize).max(16).min(w), ((h as f32 * share) as usize).max(16).min(h));
            let (x, y) = ((random.next() * (w - cw) as f32) as usize, (random.next() * (h - ch) as f32) as usize);
            let part = photo.view().crop(x, y, cw, ch).context("a part")?;
            out.push(resize_area(part, 640, (640 * ch / cw).clamp(160, 960))?);
        }
        Ok(out)
    });
    let crops = crops.collect::<Result<Vec<_>>>()?.concat();
    let scratch = tempfile::tempdir()?;
    let kinds = ["scenes, generated", "parts of photographs", "fronts of windows, generated", "noise and cells"];
    let picture = |kind: usize, i: usize| -> Result<GrayU8> {
        Ok(match kind {
            0 => rgb_to_gray(photo_without_board(9000 + i as u64)?.view()),
            1 => crops[i * crops.len() / EMPTY].clone(),
            2 => facade(i),
            _ => noise(i),
        })
    };
    let mut grids = [0usize; 4];
    let (mut ours, mut theirs) = ([0.0; 4], [0.0; 4]);
    for kind in 0..kinds.len() {
        let found = (0..EMPTY).into_par_iter().map(|i| {
            let gray = picture(kind, i)?;
            Ok(find(gray_to_f32(gray.view()).view(), BOARD).is_some())
        });
        grids[kind] = found.collect::<Result<Vec<bool>>>()?.into_iter().filter(|f| *f).count();
        for i in (0..SHOWN).map(|i| i * EMPTY / SHOWN) {
            let gray = picture(kind, i)?;
            cv_io::write_png(scratch.path().join(format!("none-{kind}-{i:03}.png")), gray.view())?;
            let float = gray_to_f32(gray.view());
            ours[kind] += on_one_thread(|| find(float.view(), BOARD))?.1;
        }
    }
    let shown: Vec<Found> = peer(python, &[&"corners", &scratch.path()])?;
    let mut told = 0;
    for f in &shown {
        let kind: usize = f.image.split('-').nth(1).and_then(|k| k.parse().ok()).context("a kind")?;
        theirs[kind] += f.seconds;
        told += usize::from(f.corners.is_some());
    }
    let _ = writeln!(
        page.text,
        "\nPictures without a board, {EMPTY} of each kind, about 640×480; times are of {SHOWN} of each, on which the classic finder finds {told} boards:\n\n| kind | grids of 9×6 that ours finds \
         | ours, ms a picture | classic, ms a picture |\n|---|---|---|---|"
    );
    for kind in 0..kinds.len() {
        let ms = |s: f64| 1e3 * s / SHOWN as f64;
        let _ = writeln!(
            page.text,
            "| {} | {} | {:.2} | {:.2} |",
            kinds[kind],
            grids[kind],
            ms(ours[kind]),
            ms(theirs[kind])
        );
    }
    page.checks.push(Check::at_most(
        "grids in 2,000 pictures without a board",
        grids.iter().sum::<usize>() as f64,
        0.0,
    ));
    page.checks.push(Check::at_most(
        "without a board: looking / classic",
        ours.iter().sum::<f64>() / theirs.iter().sum::<f64>(),
        1.0,
    ));
    page.checks.push(Check::at_most(
        "without a board, parts of photographs: looking / classic",
        ours[1] / theirs[1],
        1.0,
    ));
    Ok(())
}
