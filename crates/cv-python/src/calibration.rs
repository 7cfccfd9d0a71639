//! Calibration from photographs of a board.

use crate::arrays::{self, Rgb};
use crate::camera::{PyCamera, PyRig};
use crate::errors::reason;
use crate::job::Run;
use crate::options::Options;
use crate::photographs::{Ended, Photograph, Source};
use crate::results::{self, data, object};
use cv_core::{GrayF32, ImageView, Named, Pose, luma_u8};
use cv_io::IoError;
use cv_pipeline::calibration::{
    Board, BoardError, BoardPoint, BoardSize, CalibrateOptions, CharucoBoard, ChessboardOptions, Dictionary, GridStyle,
    MarkerGrid, find_board as find, find_chessboard,
};
use cv_pipeline::{BoardCalibration, BoardCalibrationOptions, BoardChoice, calibrate as calibrate_cameras};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList, PyTuple};
use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

/// Converts a board of `epipole.boards`; `None` is a chessboard of any size.
fn board(given: Option<&Bound<'_, PyAny>>) -> PyResult<BoardChoice> {
    let Some(given) = given.filter(|given| !given.is_none()) else {
        return Ok(BoardChoice::AnyChessboard { square: 1.0 });
    };
    let number = |name: &str| -> PyResult<f64> { given.getattr(name)?.extract() };
    let counts = || -> PyResult<(usize, usize)> { given.getattr("size")?.extract() };
    let dictionary = || -> PyResult<Dictionary> {
        let name: String = given.getattr("dictionary")?.extract()?;
        Dictionary::from_name(&name).map_err(|error| PyValueError::new_err(error.to_string()))
    };
    let grid = |style, dictionary| -> PyResult<Board> {
        let (marker, spacing) = (number("marker")?, number("spacing")?);
        Ok(Board::MarkerGrid(MarkerGrid { markers: counts()?, marker, spacing, dictionary, style }))
    };
    let kind = given.get_type().name()?.to_string();
    Ok(BoardChoice::Known(match kind.as_str() {
        "Chessboard" if given.getattr("size")?.is_none() => {
            return Ok(BoardChoice::AnyChessboard { square: number("square")? });
        }
        "Chessboard" => {
            let (columns, rows) = counts()?;
            Board::Chessboard { size: BoardSize::new(columns, rows), square: number("square")? }
        }
        "CharucoBoard" => Board::Charuco(CharucoBoard {
            squares: counts()?,
            square: number("square")?,
            marker: number("marker")?,
            dictionary: dictionary()?,
        }),
        "ArucoGrid" => grid(GridStyle::Aruco, dictionary()?)?,
        "AprilGrid" => grid(GridStyle::AprilGrid, Dictionary::AprilTag36h11)?,
        _ => {
            let text = format!("board must be a Chessboard, CharucoBoard, ArucoGrid or AprilGrid, not {kind}");
            return Err(PyTypeError::new_err(text));
        }
    }))
}

/// Reads the options of `find_board`.
pub(crate) fn read_find(options: &mut Options<'_>) -> PyResult<(BoardChoice, Run)> {
    let given = options.take_any("board")?;
    Ok((board(given.as_ref())?, Run::read(options)?))
}

/// Reads the options of `calibrate`.
pub(crate) fn read(options: &mut Options<'_>) -> PyResult<(BoardCalibrationOptions, Run)> {
    let given = options.take_any("board")?;
    let mut solve = CalibrateOptions::default();
    options.set_named("lens", &mut solve.lens)?;
    options.set("board_shape", &mut solve.board_shape)?;
    options.set("outlier_deviations", &mut solve.outlier_deviations)?;
    let o = BoardCalibrationOptions { board: board(given.as_ref())?, solve, ..BoardCalibrationOptions::default() };
    Ok((o, Run::read(options)?))
}

/// Converts to gray from 0 to 1 by 8-bit luma, as in the program.
fn gray(view: ImageView<'_, u8, 3>) -> GrayF32 {
    GrayF32::from_fn(view.width(), view.height(), |x, y| [f32::from(luma_u8(view.at(x, y))) / 255.0])
}

/// Detects the points of a calibration board in an image.
///
/// board: Chessboard (the default, of any size), CharucoBoard, ArucoGrid or AprilGrid. Raises a BoardNotFoundError that describes what was detected instead.
///
///     >>> dark = np.pad(np.indices((6, 9)).sum(0) % 2, 1, constant_values=1)
///     >>> found = epipole.find_board(np.kron(255 * dark, np.ones((20, 20))).astype(np.uint8))
///     >>> found
///     BoardView(40 points of a board of 8×5)
#[pyfunction]
#[pyo3(signature = (image, **options))]
pub(crate) fn find_board<'py>(
    py: Python<'py>,
    image: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let mut options = Options::new("find_board", options);
    let (choice, run) = read_find(&mut options)?;
    options.finish()?;
    let image = Rgb::new(image, "image")?;
    let view = image.view()?;
    let (board, seen): (Board, Vec<BoardPoint>) = run.run(py, |progress| {
        let (gray, settings) = (gray(view), ChessboardOptions::default());
        match choice {
            BoardChoice::Known(board) => {
                board.check()?;
                Ok::<_, BoardError>((board, find(gray.view(), &board, &settings, progress)?))
            }
            BoardChoice::AnyChessboard { square } => {
                let found = find_chessboard(gray.view(), None, &settings, progress)?;
                Ok((Board::Chessboard { size: found.size, square }, found.points()))
            }
        }
    })?;
    let places = board.points();
    let pixels: Vec<[f64; 2]> = seen.iter().map(|p| p.position.coords.into()).collect();
    let points: Vec<[f64; 2]> = seen.iter().map(|p| places[p.id].coords.into()).collect();
    let (ids, deviations) = (seen.iter().map(|p| p.id as i64).collect(), seen.iter().map(|p| p.deviation).collect());
    results::made(
        py,
        "BoardView",
        [
            ("pixels", arrays::row_array(py, &pixels)?),
            ("points", arrays::row_array(py, &points)?),
            ("ids", arrays::shaped::<i64>(py, ids, &[seen.len()])?),
            ("deviations", arrays::shaped::<f64>(py, deviations, &[seen.len()])?),
            ("size", object(py, board.counts())?),
        ],
    )
}

/// Photographs by view and camera; `None` if missing.
type Views<T> = Vec<Vec<Option<T>>>;

/// Reads a list of photographs of one camera, or one such list per camera.
fn photographs<'py>(given: &Bound<'py, PyAny>) -> PyResult<Views<Photograph<'py>>> {
    let all: Vec<Bound<'py, PyAny>> = given.try_iter()?.collect::<PyResult<_>>()?;
    let one = |given: &Bound<'py, PyAny>, name: String| -> PyResult<Option<Photograph<'py>>> {
        if given.is_none() { Ok(None) } else { Photograph::new(given, &name).map(Some) }
    };
    let is_list = |one: &Bound<'_, PyAny>| one.is_instance_of::<PyList>() || one.is_instance_of::<PyTuple>();
    if all.is_empty() || !all.iter().all(is_list) {
        return all.iter().enumerate().map(|(v, p)| Ok(vec![one(p, format!("photograph {v}"))?])).collect();
    }
    let cameras: Vec<Vec<Bound<'py, PyAny>>> = all.iter().map(|c| c.extract()).collect::<PyResult<_>>()?;
    let views = cameras.iter().map(Vec::len).max().unwrap_or(0);
    if let Some(short) = cameras.iter().position(|camera| camera.len() != views) {
        let got = cameras[short].len();
        let text = format!("camera {short} has {got} photographs, another has {views}; use None for missing ones");
        return Err(PyValueError::new_err(text));
    }
    let of_view = |v: usize| {
        let named = cameras.iter().enumerate().map(|(c, of)| one(&of[v], format!("photograph {v} of camera {c}")));
        named.collect()
    };
    (0..views).map(of_view).collect()
}

/// Calibrates cameras from photographs of a board, with uncertainties.
///
/// photographs: a list of arrays of uint8 or of paths; for a rig, one such list per camera, in which simultaneous photographs have the same index and missing ones are None.
/// board: as in `find_board`. `defaults("calibrate")` lists the options.
#[pyfunction]
#[pyo3(signature = (photographs, **options))]
pub(crate) fn calibrate<'py>(
    py: Python<'py>,
    photographs: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let mut options = Options::new("calibrate", options);
    let (o, run) = read(&mut options)?;
    options.finish()?;
    let given = self::photographs(photographs)?;
    let cameras = given.first().map_or(1, Vec::len);
    let sources: Views<Source<'_>> = given
        .iter()
        .map(|view| view.iter().map(|p| p.as_ref().map(Photograph::source).transpose()).collect())
        .collect::<PyResult<_>>()?;
    let found = run.run(py, |progress| {
        let unreadable: Mutex<BTreeMap<(usize, usize), IoError>> = Mutex::default();
        let photo = |view: usize, camera: usize| -> Option<GrayF32> {
            match sources[view][camera]?.read() {
                Ok((pixels, _)) => Some(gray(pixels.view())),
                Err(error) => {
                    unreadable.lock().unwrap_or_else(PoisonError::into_inner).insert((view, camera), error);
                    None
                }
            }
        };
        let found = calibrate_cameras((sources.len(), cameras), photo, &o, progress);
        let unreadable = unreadable.into_inner().unwrap_or_else(PoisonError::into_inner);
        match unreadable.into_values().next() {
            Some(error) => Err(Ended::File(error)),
            None => found.map_err(Ended::Job),
        }
    })?;
    calibration(py, &found)
}

fn calibration<'py>(py: Python<'py>, found: &BoardCalibration) -> PyResult<Bound<'py, PyAny>> {
    let c = &found.calibration;
    let tuple = |items: Vec<Bound<'py, PyAny>>| PyTuple::new(py, items).map(Bound::into_any);
    let cameras = c.cameras.iter().map(|c| PyCamera::object(py, c.camera)).collect::<PyResult<Vec<_>>>()?;
    let places = c.cameras.iter().map(|c| pose(py, &c.from_first)).collect::<PyResult<Vec<_>>>()?;
    let rig = match c.stereo() {
        Some(rig) => PyRig::object(py, rig, String::new())?,
        None => object(py, py.None())?,
    };
    let numbers = |values: Vec<f64>| {
        let length = values.len();
        arrays::shaped(py, values, &[length])
    };
    let names: Vec<String> = c
        .parameters
        .iter()
        .map(|p| match p.camera {
            Some(camera) => format!("camera{camera}.{}", p.name),
            None => format!("board.{}", p.name),
        })
        .collect();
    let count = c.parameters.len();
    let refused: Vec<Bound<'py, PyAny>> = found
        .refusals
        .iter()
        .map(|view| {
            let each = view.iter().map(|r| r.map_or_else(|| object(py, py.None()), |r| reason(py, &r)));
            tuple(each.collect::<PyResult<_>>()?)
        })
        .collect::<PyResult<_>>()?;
    let poses: Vec<Bound<'py, PyAny>> = c
        .views
        .iter()
        .map(|view| view.pose.map_or_else(|| object(py, py.None()), |p| pose(py, &p)))
        .collect::<PyResult<_>>()?;
    results::made(
        py,
        "Calibration",
        [
            ("cameras", tuple(cameras)?),
            ("places", tuple(places)?),
            ("rig", rig),
            ("rms", object(py, c.rms_px)?),
            ("holdout_rms", object(py, c.holdout_rms_px)?),
            ("holdout_all_rms", object(py, c.holdout_all_rms_px)?),
            ("camera_rms", numbers(c.cameras.iter().map(|c| c.rms_px).collect())?),
            ("camera_holdout_rms", numbers(c.cameras.iter().map(|c| c.holdout_rms_px).collect())?),
            ("noise", object(py, c.noise_px)?),
            ("rectified_dy", object(py, found.rectified_dy_px)?),
            ("parameter_names", object(py, PyTuple::new(py, names)?)?),
            ("parameters", numbers(c.parameters.iter().map(|p| p.value).collect())?),
            ("deviations", numbers(c.parameters.iter().map(|p| p.deviation).collect())?),
            ("covariance", arrays::shaped(py, c.covariance.transpose().as_slice().to_vec(), &[count, count])?),
            ("board_size", object(py, found.board.counts())?),
            ("board_deflection", object(py, c.target_shape.deflection)?),
            ("poses", tuple(poses)?),
            ("refused", tuple(refused)?),
            ("trust", object(py, c.verdict.trust.name())?),
            ("notes", data(py, &c.verdict.notes)?),
            ("seconds", results::stages(py, &found.stages)?),
        ],
    )
}

/// Converts a pose to a tuple of rotation matrix and translation.
pub(crate) fn pose<'py>(py: Python<'py>, pose: &Pose) -> PyResult<Bound<'py, PyAny>> {
    object(py, (arrays::matrix(py, pose.rotation.matrix())?, arrays::vector(py, &pose.translation)?))
}
