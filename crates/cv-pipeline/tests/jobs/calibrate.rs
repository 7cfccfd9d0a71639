//! Calibration with generated photographs of boards.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_calib::{CalibrateOptions, LensChoice};
use cv_core::{Camera, Distortion, GrayF32, Pose, Rotation3, Silent, Vector3, luma_u8};
use cv_features::{Board, BoardError, BoardSize, CharucoBoard, Dictionary, GridStyle, MarkerGrid};
use cv_pipeline::{BoardCalibrationError, BoardCalibrationOptions, BoardChoice, PhotoRefusal, calibrate};
use cv_synth::{RenderOptions, Sheet, Texture};

/// In meters.
const SQUARE: f64 = 0.03;

/// Renders a photograph of a chessboard of 8 × 6 squares on a sheet of 260 × 200 mm.
fn photograph(camera: &Camera, pose: &Pose) -> GrayF32 {
    let sheet = Sheet {
        texture: Texture::Board { squares: (8, 6), square: SQUARE as f32 },
        size: (0.26, 0.2),
        bend: 0.0,
        behind: Texture::Paint { color: [0.4; 3], seed: 1 },
        light: [0.1, -0.1],
        glare: None,
    };
    let options = RenderOptions { samples: 2, ..RenderOptions::default() };
    sheet.photo(camera, pose, &options).unwrap().map(|c| [f32::from(luma_u8(c)) / 255.0])
}

fn pose(i: usize) -> Pose {
    let i = i as f64;
    let turn = Rotation3::new(Vector3::new(0.45 * (2.4 * i).sin(), 0.45 * (2.4 * i).cos(), 0.1 * i.sin()));
    let middle = Vector3::new(0.02 + 0.03 * (1.7 * i).sin(), 0.03 * (2.3 * i).cos(), 0.34 + 0.01 * i);
    Pose::new(turn, middle - turn * Vector3::new(0.13, 0.1, 0.0))
}

#[test]
fn photographs_of_a_chessboard_calibrate_a_rig() {
    let lens = |k| Camera { distortion: Distortion::radial(k, 0.0), ..Camera::from_focal(400, 300, 350.0) };
    let cameras = [lens(-0.15), Camera { cx: 205.0, ..lens(-0.1) }];
    let rig_pose = Pose::new(Rotation3::new(Vector3::new(0.0, 0.05, 0.01)), Vector3::new(-0.05, 0.001, 0.002));
    let photo = |view: usize, camera: usize| {
        // The right camera has no photograph of view 3, and no board in view 4.
        match (view, camera) {
            (3, 1) => None,
            (4, 1) => Some(GrayF32::new(400, 300, [0.5])),
            _ => {
                let pose = if camera == 0 { pose(view) } else { rig_pose.compose(&pose(view)) };
                Some(photograph(&cameras[camera], &pose))
            }
        }
    };
    let solve = CalibrateOptions { lens: LensChoice::RadialTangential4, ..CalibrateOptions::default() };
    let board = BoardChoice::AnyChessboard { square: SQUARE };
    let options = BoardCalibrationOptions { board, solve, ..BoardCalibrationOptions::default() };
    let result = calibrate((7, 2), photo, &options, &Silent).unwrap();
    assert_eq!(result.board, Board::Chessboard { size: BoardSize::new(7, 5), square: SQUARE });
    // Corners on such images are accurate to some hundredths of a pixel.
    assert!(result.calibration.rms_px < 0.1, "{}", result.calibration.rms_px);
    for (camera, truth) in result.calibration.cameras.iter().zip(&cameras) {
        assert!((camera.camera.fx / truth.fx - 1.0).abs() < 3e-3, "{:?}", camera.camera);
    }
    let rig = result.calibration.stereo().unwrap();
    assert!((rig.right_from_left.translation - rig_pose.translation).norm() < 5e-4, "{:?}", rig.right_from_left);
    assert!(result.rectified_dy_px.unwrap().0 < 0.1);
    assert_eq!(result.refusals[3][1], Some(PhotoRefusal::NoPhoto));
    assert!(matches!(result.refusals[4][1], Some(PhotoRefusal::Board(BoardError::NoBoard { .. }))));
    assert_eq!(result.refusals[0], [None, None]);
}

/// Creates a sheet with a board and a margin of 12 mm, in meters.
fn board_sheet(board: &Board) -> Sheet {
    let (o, margin) = (board.outline(), 0.012);
    let size = (o.width + 2.0 * margin, o.height + 2.0 * margin);
    let at = |v: f64, first: f64| (v - first + margin) as f32;
    let black = board.black_rectangles();
    let black = black.iter().map(|r| [at(r.x, o.x), at(r.y, o.y), r.width as f32, r.height as f32]).collect();
    let print = cv_synth::Print::new(black, (size.0 as f32, size.1 as f32));
    Sheet {
        texture: Texture::Print(std::sync::Arc::new(print)),
        size,
        bend: 0.0,
        behind: Texture::Paint { color: [0.4; 3], seed: 1 },
        light: [0.1, -0.1],
        glare: None,
    }
}

#[test]
fn every_kind_of_board_calibrates_a_camera_though_partly_out_of_view() {
    let charuco = CharucoBoard { squares: (8, 6), square: 0.03, marker: 0.022, dictionary: Dictionary::Aruco5x5x100 };
    let aruco = MarkerGrid {
        markers: (6, 5),
        marker: 0.03,
        spacing: 0.3,
        dictionary: Dictionary::Aruco4x4x50,
        style: GridStyle::Aruco,
    };
    let april = MarkerGrid { dictionary: Dictionary::AprilTag36h11, style: GridStyle::AprilGrid, ..aruco };
    // Saddle corners are accurate to a few hundredths of a pixel, on chessboards too. An outer corner of a marker is the intersection of two
    // edges, each averaged over some tens of samples: twice that.
    for (board, median_px) in
        [(Board::Charuco(charuco), 0.05), (Board::MarkerGrid(april), 0.06), (Board::MarkerGrid(aruco), 0.1)]
    {
        let kind = board.kind();
        let sheet = board_sheet(&board);
        let (points, outline) = (board.points(), board.outline());
        let truth = Camera {
            cx: 322.0,
            cy: 236.0,
            distortion: Distortion::radial(-0.12, 0.0),
            ..Camera::from_focal(640, 480, 560.0)
        };
        let poses: Vec<Pose> = (0..8)
            .map(|v| {
                let i = f64::from(v);
                let turn = Rotation3::new(Vector3::new(0.5 * (2.4 * i).sin(), 0.5 * (2.4 * i).cos(), 0.2 * i.sin()));
                // Close and off-center, so that a part of the board is out of view in most images.
                let middle = Vector3::new(0.07 * (1.7 * i).sin(), 0.05 * (2.3 * i).cos(), 0.22 + 0.01 * i);
                Pose::new(turn, middle - turn * Vector3::new(sheet.size.0 / 2.0, sheet.size.1 / 2.0, 0.0))
            })
            .collect();
        let render = RenderOptions { samples: 3, ..RenderOptions::default() };
        let photo = |view: usize, _: usize| {
            let photo = sheet.photo(&truth, &poses[view], &render).unwrap();
            Some(photo.map(|c| [f32::from(luma_u8(c)) / 255.0]))
        };
        let solve = CalibrateOptions { lens: LensChoice::RadialTangential4, ..CalibrateOptions::default() };
        let options =
            BoardCalibrationOptions { board: BoardChoice::Known(board), solve, ..BoardCalibrationOptions::default() };
        let result = calibrate((poses.len(), 1), photo, &options, &Silent).unwrap();
        let mut errors = Vec::new();
        for (view, pose) in result.observations.views.iter().zip(&poses) {
            for corner in &view[0] {
                let p = points[corner.point];
                let on_sheet = sheet.point(p.x - outline.x + 0.012, p.y - outline.y + 0.012);
                let seen = truth.project(&pose.transform(&on_sheet)).unwrap();
                errors.push((corner.pixel - seen).norm());
            }
        }
        errors.sort_by(f64::total_cmp);
        let median = errors[errors.len() / 2];
        let parts = result.observations.views.iter().filter(|v| v[0].len() < points.len()).count();
        let used = result.refusals.iter().filter(|r| r[0].is_none()).count();
        let camera = result.calibration.cameras[0].camera;
        assert!(median < median_px, "{kind}: {median}");
        assert!(used >= 7 && parts >= 3, "{kind}: {used} used, {parts} in part, {:?}", result.refusals);
        // For some hundreds of corners with this error; the foreshortening by a tilt, an eighth, leaves 1e-3 of the focal length and 1.5 px of
        // the principal point.
        assert!((camera.fx / truth.fx - 1.0).abs() < 3e-3, "{kind}: {camera:?}");
        let off = (camera.cx - truth.cx).hypot(camera.cy - truth.cy);
        assert!(off < 2.0, "{kind}: {off}");
    }
}

#[test]
fn photographs_without_boards_are_errors() {
    let empty = |_: usize, _: usize| Some(GrayF32::new(64, 48, [0.5]));
    let error = calibrate((3, 1), empty, &BoardCalibrationOptions::default(), &Silent).unwrap_err();
    assert!(matches!(error, BoardCalibrationError::NoBoards { refusals } if refusals.len() == 3));
    let none = calibrate((0, 1), empty, &BoardCalibrationOptions::default(), &Silent).unwrap_err();
    assert_eq!(none, BoardCalibrationError::NoBoards { refusals: Vec::new() });
    let board = BoardChoice::AnyChessboard { square: -1.0 };
    let options = BoardCalibrationOptions { board, ..BoardCalibrationOptions::default() };
    assert!(matches!(calibrate((1, 1), empty, &options, &Silent), Err(BoardCalibrationError::Option(_))));
}
