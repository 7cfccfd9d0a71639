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
