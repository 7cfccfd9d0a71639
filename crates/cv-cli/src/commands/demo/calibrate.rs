//! Stereo calibration from images of a chessboard on bent paper.

use super::{Check, Demo, Part};
use crate::frame::Failure;
use crate::words::calibration::no_calibration;
use cv_core::{Camera, Distortion, GrayF32, Pose, RgbU8, Rotation3, Vector3, luma_u8};
use cv_pipeline::calibration::{BoardSize, CalibrateOptions, LensChoice};
use cv_pipeline::{BoardCalibrationOptions, BoardChoice, calibrate};
use cv_synth::{RenderOptions, Sheet, Texture};

/// Inner corners of the board, and the side of a square in meters.
const BOARD: BoardSize = BoardSize { columns: 9, rows: 6 };
const SQUARE: f64 = 0.025;
/// The margin around the squares, in meters.
const MARGIN: f64 = 0.012;
/// Pairs of photographs.
const PAIRS: usize = 8;

/// The sheet with its board, deflected by a millimeter at its center.
fn sheet(seed: u64) -> Sheet {
    let (columns, rows) = (BOARD.columns as u32 + 1, BOARD.rows as u32 + 1);
    Sheet {
        texture: Texture::Board { squares: (columns, rows), square: SQUARE as f32 },
        size: (f64::from(columns) * SQUARE + 2.0 * MARGIN, f64::from(rows) * SQUARE + 2.0 * MARGIN),
        bend: 0.001,
        behind: Texture::Paint { color: [0.35, 0.4, 0.45], seed: seed as u32 },
        light: [0.2, -0.15],
        glare: None,
    }
}

/// A pose of the board: tilted to all sides, spread over the image, near and far.
fn pose(view: usize, sheet: &Sheet) -> Pose {
    let i = view as f64;
    let tilt = Vector3::new(0.55 * (2.4 * i).sin(), 0.55 * (2.4 * i).cos(), 0.12 * (5.0 * i).sin());
    let rotation = Rotation3::new(tilt);
    let distance = 0.32 + 0.03 * (i % 3.0);
    let middle = Vector3::new(0.02 + 0.055 * (1.9 * i).sin(), 0.045 * (2.7 * i).cos(), distance);
    Pose::new(rotation, middle - rotation * Vector3::new(sheet.size.0 / 2.0, sheet.size.1 / 2.0, 0.0))
}

fn gray(photo: &RgbU8) -> GrayF32 {
    photo.map(|c| [f32::from(luma_u8(c)) / 255.0])
}

pub(super) fn run(demo: &Demo<'_>) -> Result<Part, Failure> {
    let lens = |k1| Distortion::radial_tangential4([k1, 0.08, 5e-4, -3e-4]);
    let left = Camera { distortion: lens(-0.25), ..Camera::pinhole(480, 360, 390.0, 390.0, 242.0, 178.0) };
    let right = Camera { distortion: lens(-0.22), ..Camera::pinhole(480, 360, 394.0, 394.0, 236.0, 182.0) };
    let mount = Pose::new(Rotation3::new(Vector3::new(0.004, 0.02, -0.003)), Vector3::new(-0.04, 0.0005, 0.001));
    let sheet = sheet(demo.seed);
    let mut photos: Vec<[RgbU8; 2]> = Vec::with_capacity(PAIRS);
    for view in 0..PAIRS {
        let first = pose(view, &sheet);
        let options = RenderOptions { samples: 2, ..RenderOptions::default() };
        let photo = |camera: &Camera, pose: &Pose, side: u64| {
            sheet.photo(camera, pose, &options.clone().with_seed(demo.seed + 2 * view as u64 + side))
        };
        let pair = [photo(&left, &first, 0)?, photo(&right, &mount.compose(&first), 1)?];
        for (side, photo) in ["left", "right"].iter().zip(&pair) {
            cv_io::write_png(demo.out.join(format!("board-{side}-{:02}.png", view + 1)), photo.view())?;
        }
        photos.push(pair);
    }
    let solve = CalibrateOptions { lens: LensChoice::RadialTangential4, ..CalibrateOptions::default() };
    let board = BoardChoice::chessboard(Some(BOARD), SQUARE);
    let options = BoardCalibrationOptions { board, solve, ..BoardCalibrationOptions::default() };
    let source = |view: usize, camera: usize| Some(gray(&photos[view][camera]));
    let found = match calibrate((PAIRS, 2), source, &options, demo.context) {
        Ok(found) => found,
        Err(error) => {
            let failure = no_calibration(error, &["left", "right"], "");
            return Ok(Part::failed("calibrate", &failure.text()));
        }
    };
    let c = &found.calibration;
    let focal = c.cameras[0].camera.fx;
    let baseline = c.stereo().map_or(f64::NAN, |rig| rig.baseline());
    let truth = mount.translation.norm();
    let checks = vec![
        Check::at_most("calibrate", "error of the focal length", (focal / left.fx - 1.0).abs(), 0.003, "%")
            .of(format!("{:.2} px", left.fx), format!("{focal:.2} px")),
        Check::at_most("calibrate", "error of the baseline", (baseline / truth - 1.0).abs(), 0.01, "%")
            .of(format!("{:.3} mm", 1e3 * truth), format!("{:.3} mm", 1e3 * baseline)),
    ];
    let [first, second] = &photos[0];
    let figures = vec![
        demo.figure("board-left.png", first, "The first photograph of the left camera.")?,
        demo.figure("board-right.png", second, "The same board by the right camera.")?,
    ];
    let (rms, count) = (c.rms_px, c.views.len());
    Ok(Part::new(checks, move |page| {
        page.section("Calibration")
            .paragraph(&format!(
                "A chessboard on bent paper seen by two cameras with lens distortion. The corners of {count} image pairs determine the intrinsics, the relative pose and the deflection of the paper; reprojection RMS {rms:.3} px."
            ))
            .figures(figures);
    }))
}
