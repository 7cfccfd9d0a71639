//! Calibration from photographs of a board: corner detection and [`cv_calib`].

use crate::Progress;
use cv_calib::{
    CalibrateError, CalibrateOptions, Calibration, ImageOutcome, TargetCorner, TargetObservations, TargetPoints,
};
use cv_core::{Cancelled, GrayF32, ImageView, OptionError, Stage, StageClock};
use cv_features::{
    Board, BoardError, BoardPoint, BoardSize, ChessboardOptions, FeatureError, find_board, find_chessboard,
};
use cv_parallel::prelude::*;
use cv_stereo::{Rectification, RectifyOptions};

/// The calibration board on the photographs.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum BoardChoice {
    /// A chessboard of the size that most photographs show.
    AnyChessboard {
        /// Side of a square, in the unit of the result. Above 0.
        square: f64,
    },
    /// The given board, with lengths in the unit of the result.
    Known(Board),
}

impl BoardChoice {
    /// Creates the choice of a chessboard of a given size, or of any.
    pub fn chessboard(size: Option<BoardSize>, square: f64) -> Self {
        size.map_or(Self::AnyChessboard { square }, |size| Self::Known(Board::Chessboard { size, square }))
    }
}

/// Settings of [`calibrate`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct BoardCalibrationOptions {
    /// The board. Default: a chessboard of any size, with the square as unit.
    pub board: BoardChoice,
    /// Corner detection.
    pub chessboard: ChessboardOptions,
    /// Calibration.
    pub solve: CalibrateOptions,
}

impl Default for BoardCalibrationOptions {
    fn default() -> Self {
        Self {
            board: BoardChoice::AnyChessboard { square: 1.0 },
            chessboard: ChessboardOptions::default(),
            solve: CalibrateOptions::default(),
        }
    }
}

/// Why a photograph is not used in a calibration.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum PhotoRefusal {
    /// This camera has no photograph of this view.
    NoPhoto,
    /// No board was detected.
    Board(BoardError),
    /// Its size differs from that of the camera's first photograph.
    OtherPictureSize {
        /// Its width and height.
        seen: (usize, usize),
        /// Width and height of the first one.
        first: (usize, usize),
    },
    /// Its corners were rejected by the calibration.
    Corners(ImageOutcome),
}

/// Result of [`calibrate`].
#[derive(Debug, Clone, PartialEq)]
pub struct BoardCalibration {
    /// The calibration: cameras, poses, errors, verdict.
    pub calibration: Calibration,
    /// The detected corners.
    pub observations: TargetObservations,
    /// The board.
    pub board: Board,
    /// By view and camera: why the photograph was not used; `None` where it was.
    pub refusals: Vec<Vec<Option<PhotoRefusal>>>,
    /// Mean and largest vertical disparity of the inlier corners in the rectified images of the first two cameras, in px.
    pub rectified_dy_px: Option<(f64, f64)>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Why a calibration failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum BoardCalibrationError {
    /// No photograph shows the board.
    #[error("no board was detected on any of {} photographs", refusals.iter().flatten().flatten().count())]
    NoBoards {
        /// The reasons, by view and camera.
        refusals: Vec<Vec<Option<PhotoRefusal>>>,
    },
    /// The corners do not determine the cameras.
    #[error("{source}")]
    Calibrate {
        /// The reason.
        source: CalibrateError,
        /// By view and camera: why photographs have no board.
        refusals: Vec<Vec<Option<PhotoRefusal>>>,
    },
    /// The board is not valid.
    #[error(transparent)]
    Board(BoardError),
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

/// A detection: the size for a chessboard of any size, and the points of the board.
type Detection = (Option<BoardSize>, Vec<BoardPoint>);

/// A photograph with its detection.
struct Photo {
    size: (usize, usize),
    detection: Result<Detection, BoardError>,
}

/// Detects the board on the photographs of one or several cameras, and calibrates them.
///
/// `photo(view, camera)` returns the gray image with intensities from 0 to 1, or `None` where there is none. It is called once for each photograph
/// (twice for those of another board size than most, for a chessboard of any size), from several threads; at most one photograph for each thread is
/// in memory. The photographs of a view were taken at the same time.
///
/// # Errors
/// [`BoardCalibrationError`].
pub fn calibrate(
    (views, cameras): (usize, usize),
    photo: impl Fn(usize, usize) -> Option<GrayF32> + Sync,
    options: &BoardCalibrationOptions,
    progress: &dyn Progress,
) -> Result<BoardCalibration, BoardCalibrationError> {
    let mut board = match options.board {
        BoardChoice::Known(board) => {
            board.check().map_err(BoardCalibrationError::Board)?;
            Some(board)
        }
        BoardChoice::AnyChessboard { square } => {
            OptionError::check("square", square, "a number above 0", |v| v > 0.0 && v.is_finite())?;
            None
        }
    };
    let mut clock = StageClock::new();
    let all = vec![vec![true; cameras]; views];
    let mut photos = detect_boards(&all, &photo, board.as_ref(), options, progress)?;
    if let BoardChoice::AnyChessboard { square } = options.board {
        let sizes = photos.iter().flatten().flatten().filter_map(|l| l.detection.as_ref().ok()?.0);
        let size = most_frequent(sizes.map(BoardSize::landscape));
        board = size.map(|size| Board::Chessboard { size, square });
        if let (Some(size), Some(board)) = (size, &board) {
            // The known size helps on photographs where another size was detected.
            let differs = |l: &Option<Photo>| {
                l.as_ref().is_some_and(|l| !l.detection.as_ref().is_ok_and(|found| found.0 == Some(size)))
            };
            let again: Vec<Vec<bool>> = photos.iter().map(|v| v.iter().map(differs).collect()).collect();
            let second = detect_boards(&again, &photo, Some(board), options, progress)?;
            for (old, new) in photos.iter_mut().flatten().zip(second.into_iter().flatten()) {
                if new.is_some() {
                    *old = new;
                }
            }
        }
    }
    clock.lap("boards");
    let first_sizes: Vec<Option<(usize, usize)>> =
        (0..cameras).map(|c| photos.iter().find_map(|v| v[c].as_ref().map(|l| l.size))).collect();
    let mut refusals = vec![vec![Some(PhotoRefusal::NoPhoto); cameras]; views];
    let mut corners = vec![vec![Vec::new(); cameras]; views];
    for (v, c) in (0..views).flat_map(|v| (0..cameras).map(move |c| (v, c))) {
        let Some(photo) = &photos[v][c] else { continue };
        refusals[v][c] = match (&photo.detection, first_sizes[c]) {
            (Err(error), _) => Some(PhotoRefusal::Board(*error)),
            (_, Some(first)) if first != photo.size => Some(PhotoRefusal::OtherPictureSize { seen: photo.size, first }),
            (Ok((_, points)), _) => {
                corners[v][c] = points.iter().map(|p| TargetCorner { point: p.id, pixel: p.position }).collect();
                None
            }
        };
    }
    let (Some(board), true) = (board, corners.iter().flatten().any(|c| !c.is_empty())) else {
        return Err(BoardCalibrationError::NoBoards { refusals });
    };
    let sizes = first_sizes.into_iter().map(|f| f.unwrap_or((0, 0))).collect();
    let failed = |source, refusals| match source {
        CalibrateError::Cancelled(stop) => BoardCalibrationError::Cancelled(stop),
        source => BoardCalibrationError::Calibrate { source, refusals },
    };
    let target = match TargetPoints::new(board.points()).map(|target| with_board_symmetry(target, &board)) {
        Ok(target) => target,
        Err(error) => return Err(failed(error, refusals)),
    };
    // A camera without photographs has no size and no views.
    if let Some(camera) = (0..cameras).find(|c| corners.iter().all(|v| v[*c].is_empty())) {
        let none = CalibrateError::TooFewViews { camera, got: 0, needed: 3, small: 0, mirrored: 0 };
        return Err(failed(none, refusals));
    }
    let mut observations = TargetObservations { target, sizes, views: corners };
    let calibration = match cv_calib::calibrate(&observations, &options.solve, progress) {
        Ok(calibration) => calibration,
        Err(error) => return Err(failed(error, refusals)),
    };
    // Corners are renumbered by the symmetry of the board that the calibration found.
    for (corners, view) in observations.views.iter_mut().zip(&calibration.views) {
        for (corners, image) in corners.iter_mut().zip(&view.images) {
            corners.iter_mut().for_each(|c| c.point = observations.target.symmetric_index(c.point, image.symmetry));
        }
    }
    for (refusals, view) in refusals.iter_mut().zip(&calibration.views) {
        for (refusal, image) in refusals.iter_mut().zip(&view.images) {
            if refusal.is_none() && !image.outcome.is_used() {
                *refusal = Some(PhotoRefusal::Corners(image.outcome));
            }
        }
    }
    let rectified_dy_px = rectified_vertical_disparity(&calibration, &observations);
    clock.lap("solve");
    Ok(BoardCalibration { calibration, observations, board, refusals, rectified_dy_px, stages: clock.into_stages() })
}

/// Declares the rotational symmetry of chessboards whose corners two cameras may number from different ends.
fn with_board_symmetry(target: TargetPoints, board: &Board) -> TargetPoints {
    match board {
        Board::Chessboard { size, .. } if size.columns == size.rows => target.with_rotational_symmetry(4),
        Board::Chessboard { size, .. } if size.is_symmetric() => target.with_rotational_symmetry(2),
        _ => target,
    }
}

/// Detects a board, or a chessboard of any size.
fn detect_board(
    view: ImageView<'_, f32, 1>,
    board: Option<&Board>,
    options: &ChessboardOptions,
    progress: &dyn Progress,
) -> Result<Detection, BoardError> {
    match board {
        Some(board) => Ok((None, find_board(view, board, options, progress)?)),
        None => find_chessboard(view, None, options, progress).map(|found| (Some(found.size), found.points())),
    }
}

/// Detects the board on the selected photographs.
fn detect_boards(
    selected: &[Vec<bool>],
    photo: &(impl Fn(usize, usize) -> Option<GrayF32> + Sync),
    board: Option<&Board>,
    options: &BoardCalibrationOptions,
    progress: &dyn Progress,
) -> Result<Vec<Vec<Option<Photo>>>, Cancelled> {
    let (views, cameras) = (selected.len(), selected.first().map_or(0, Vec::len));
    let stage = Stage::new(progress, "boards", selected.iter().flatten().filter(|w| **w).count())?;
    let detect = |i: usize| -> Result<Option<Photo>, Cancelled> {
        let (view, camera) = (i / cameras, i % cameras);
        if !selected[view][camera] {
            return Ok(None);
        }
        stage.check()?;
        let detected = match photo(view, camera) {
            None => None,
            Some(gray) => {
                let detection = detect_board(gray.view(), board, &options.chessboard, &stage);
                if let Err(BoardError::Feature(FeatureError::Cancelled(stop))) = detection {
                    return Err(stop);
                }
                Some(Photo { size: gray.size(), detection })
            }
        };
        stage.add(1)?;
        Ok(detected)
    };
    let all = (0..views * cameras).into_par_iter().map(detect).try_collect::<_, Cancelled>()?;
    let mut all = all.into_iter();
    Ok((0..views).map(|_| all.by_ref().take(cameras).collect()).collect())
}

/// Returns the most frequent size, the first one of equals.
fn most_frequent(sizes: impl Iterator<Item = BoardSize>) -> Option<BoardSize> {
    let mut counts: Vec<(BoardSize, usize)> = Vec::new();
    for size in sizes {
        match counts.iter_mut().find(|(s, _)| *s == size) {
            Some((_, count)) => *count += 1,
            None => counts.push((size, 1)),
        }
    }
    counts.iter().rev().max_by_key(|(_, count)| *count).map(|(size, _)| *size)
}

/// Returns the mean and the largest vertical disparity of corners in the rectified images of the first two cameras.
fn rectified_vertical_disparity(calibration: &Calibration, observations: &TargetObservations) -> Option<(f64, f64)> {
    let rectification = Rectification::new(&calibration.stereo()?, &RectifyOptions::default()).ok()?;
    let (mut sum, mut count, mut largest) = (0.0, 0, 0.0f64);
    for (view, fitted) in observations.views.iter().zip(&calibration.views) {
        let used = |c: usize| view[c].iter().zip(&fitted.images[c].corners).filter(|(_, f)| f.used).map(|(c, _)| c);
        for left in used(0) {
            let Some(right) = used(1).find(|r| r.point == left.point) else { continue };
            let rows =
                rectification.left.rectified_pixel(left.pixel).zip(rectification.right.rectified_pixel(right.pixel));
            let Some((l, r)) = rows else { continue };
            let vertical_disparity = (l.y - r.y).abs();
            (sum, count, largest) = (sum + vertical_disparity, count + 1, largest.max(vertical_disparity));
        }
    }
    (count > 0).then(|| (sum / f64::from(count), largest))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Silent;
    use cv_core::{Camera, Distortion, Pose, Rotation3, Vector3, luma_u8};
    use cv_features::{CharucoBoard, Dictionary, GridStyle, MarkerGrid};
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
        let solve = CalibrateOptions { lens: cv_calib::LensChoice::RadialTangential4, ..CalibrateOptions::default() };
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
        let charuco =
            CharucoBoard { squares: (8, 6), square: 0.03, marker: 0.022, dictionary: Dictionary::Aruco5x5x100 };
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
                    let turn =
                        Rotation3::new(Vector3::new(0.5 * (2.4 * i).sin(), 0.5 * (2.4 * i).cos(), 0.2 * i.sin()));
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
            let solve =
                CalibrateOptions { lens: cv_calib::LensChoice::RadialTangential4, ..CalibrateOptions::default() };
            let options = BoardCalibrationOptions {
                board: BoardChoice::Known(board),
                solve,
                ..BoardCalibrationOptions::default()
            };
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
}
