//! Robust estimation of two-view models and absolute pose.

use crate::arrays;
use crate::camera::PyCamera;
use crate::job::Run;
use crate::options::Options;
use crate::results::{self, Field, object};
use cv_core::{Camera, Correspondence, Matrix3, Point2, Point3, StageClock};
use cv_pipeline::{ModelKind, RobustModel, RobustOptions, WorldMatch, estimate, estimate_calibrated};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Reads the options of all estimators.
fn read(options: &mut Options<'_>, mut o: RobustOptions) -> PyResult<(RobustOptions, Run)> {
    options.set("threshold", &mut o.threshold)?;
    options.set("confidence", &mut o.confidence)?;
    options.set("max_iterations", &mut o.max_iterations)?;
    options.set("seed", &mut o.seed)?;
    Ok((o, Run::read(options)?))
}

pub(crate) fn read_homography(options: &mut Options<'_>) -> PyResult<(RobustOptions, Run)> {
    read(options, RobustOptions::homography())
}

pub(crate) fn read_fundamental(options: &mut Options<'_>) -> PyResult<(RobustOptions, Run)> {
    read(options, RobustOptions::fundamental())
}

pub(crate) fn read_essential(options: &mut Options<'_>) -> PyResult<(RobustOptions, Run)> {
    read(options, RobustOptions::essential())
}

/// Converts rows x1, y1, x2, y2 to matches.
fn matches(given: &Bound<'_, PyAny>) -> PyResult<Vec<Correspondence>> {
    let rows: Vec<[f64; 4]> = arrays::rows(given, "matches")?;
    Ok(rows.into_iter().map(|[x1, y1, x2, y2]| Correspondence::new(x1, y1, x2, y2)).collect())
}

/// Returns the fields common to all models.
fn fields<'py>(
    py: Python<'py>,
    robust: &RobustModel<Matrix3<f64>>,
    count: usize,
    stages: &[(&'static str, f64)],
) -> PyResult<Vec<Field<'py>>> {
    let mut inliers = vec![false; count];
    robust.inliers.iter().for_each(|&i| inliers[i] = true);
    Ok(vec![
        ("model", arrays::matrix(py, &robust.model)?),
        ("inliers", arrays::shaped(py, inliers, &[count])?),
        ("rms", object(py, robust.rms)?),
        ("iterations", object(py, robust.iterations)?),
        ("log10_false_alarms", object(py, robust.log_nfa)?),
        ("seconds", results::stages(py, stages)?),
    ])
}

fn uncalibrated<'py>(
    py: Python<'py>,
    given: &Bound<'py, PyAny>,
    kind: ModelKind,
    mut options: Options<'py>,
) -> PyResult<Bound<'py, PyAny>> {
    let (o, run) = read(&mut options, kind.options())?;
    options.finish()?;
    let pairs = matches(given)?;
    let found = run.run(py, |progress| estimate(&pairs, kind, &o, progress))?;
    results::made(py, "Model", fields(py, &found.robust, pairs.len(), &found.stages)?)
}

/// Robustly estimates the homography H, with b ~ H a. matches: (n, 4), rows x1 y1 x2 y2 in pixels.
///
///     >>> a = np.random.default_rng(1).uniform(0, 500, (40, 2))
///     >>> found = epipole.estimate_homography(np.hstack([a, a + [7, -3]]))
///     >>> np.allclose(found.model / found.model[2, 2], [[1, 0, 7], [0, 1, -3], [0, 0, 1]]), int(found.inliers.sum())
///     (True, 40)
#[pyfunction]
#[pyo3(signature = (matches, **options))]
pub(crate) fn estimate_homography<'py>(
    py: Python<'py>,
    matches: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    uncalibrated(py, matches, ModelKind::Homography, Options::new("estimate_homography", options))
}

/// Robustly estimates the fundamental matrix F, with bᵀ F a = 0. matches: (n, 4), rows x1 y1 x2 y2 in pixels.
#[pyfunction]
#[pyo3(signature = (matches, **options))]
pub(crate) fn estimate_fundamental<'py>(
    py: Python<'py>,
    matches: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    uncalibrated(py, matches, ModelKind::Fundamental, Options::new("estimate_fundamental", options))
}

/// Robustly estimates the essential matrix and the relative pose x2 = R x1 + t, |t| = 1.
///
/// matches: (n, 4), rows x1 y1 x2 y2 in pixels. k1, k2: the cameras of the two views, or 3×3 calibration matrices without distortion; k2 defaults to k1.
#[pyfunction]
#[pyo3(signature = (matches, k1, k2 = None, **options))]
pub(crate) fn estimate_essential<'py>(
    py: Python<'py>,
    matches: &Bound<'py, PyAny>,
    k1: &Bound<'py, PyAny>,
    k2: Option<&Bound<'py, PyAny>>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let mut options = Options::new("estimate_essential", options);
    let (o, run) = read_essential(&mut options)?;
    options.finish()?;
    let pairs = self::matches(matches)?;
    let cameras = [camera(k1, "k1")?, camera(k2.unwrap_or(k1), "k2")?];
    let found = run.run(py, |progress| estimate_calibrated(&pairs, &cameras, &o, progress))?;
    let mut all = fields(py, &found.robust, pairs.len(), &found.stages)?;
    all.push(("rotation", arrays::matrix(py, found.pose.rotation.matrix())?));
    all.push(("translation", arrays::vector(py, &found.pose.translation)?));
    results::made(py, "EssentialModel", all)
}

pub(crate) fn read_pose(options: &mut Options<'_>) -> PyResult<(RobustOptions, Run)> {
    read(options, RobustOptions { threshold: POSE_THRESHOLD_PX, ..RobustOptions::essential() })
}

/// Inlier threshold of the reprojection error in px: COLMAP's for the registration of an image.
const POSE_THRESHOLD_PX: f64 = 4.0;

/// Robustly estimates the absolute pose of a camera from 2D-3D correspondences (PnP): x = R X + t.
///
/// points: (n, 3) in the world frame. pixels: (n, 2), their projections. camera: a Camera. threshold is in px.
///
///     >>> camera = epipole.Camera(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]])
///     >>> points = np.random.default_rng(2).uniform([-1, -1, 4], [1, 1, 8], (30, 3))
///     >>> found = epipole.estimate_pose(points, camera.project(points + [0.1, 0, 0]), camera)
///     >>> np.allclose(found.translation, [0.1, 0, 0]), np.allclose(found.rotation, np.eye(3))
///     (True, True)
#[pyfunction]
#[pyo3(signature = (points, pixels, camera, **options))]
pub(crate) fn estimate_pose<'py>(
    py: Python<'py>,
    points: &Bound<'py, PyAny>,
    pixels: &Bound<'py, PyAny>,
    camera: &Bound<'py, PyCamera>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let mut options = Options::new("estimate_pose", options);
    let (mut o, run) = read_pose(&mut options)?;
    options.finish()?;
    let world: Vec<[f64; 3]> = arrays::rows(points, "points")?;
    let seen: Vec<[f64; 2]> = arrays::rows(pixels, "pixels")?;
    if world.len() != seen.len() {
        return Err(PyValueError::new_err(format!(
            "{} points and {} pixels differ in number",
            world.len(),
            seen.len()
        )));
    }
    let camera = camera.get().camera;
    let focal = 0.5 * (camera.fx + camera.fy);
    o.threshold /= focal;
    let matches: Vec<WorldMatch> = world
        .iter()
        .zip(&seen)
        .map(|(p, pixel)| WorldMatch { world: Point3::from(*p), image: camera.normalize(Point2::from(*pixel)) })
        .collect();
    let mut clock = StageClock::new();
    let found = run.run(py, |progress| cv_pipeline::estimate_pose(&matches, &o, progress))?;
    clock.lap("pose");
    let mut inliers = vec![false; matches.len()];
    found.inliers.iter().for_each(|&i| inliers[i] = true);
    results::made(
        py,
        "PoseModel",
        [
            ("rotation", arrays::matrix(py, found.model.rotation.matrix())?),
            ("translation", arrays::vector(py, &found.model.translation)?),
            ("inliers", arrays::shaped(py, inliers, &[matches.len()])?),
            ("rms", object(py, found.rms * focal)?),
            ("iterations", object(py, found.iterations)?),
            ("log10_false_alarms", object(py, found.log_nfa)?),
            ("seconds", results::stages(py, &clock.into_stages())?),
        ],
    )
}

/// Converts a Camera, or a calibration matrix to a pinhole camera.
fn camera(given: &Bound<'_, PyAny>, what: &str) -> PyResult<Camera> {
    if let Ok(camera) = given.cast::<PyCamera>() {
        return Ok(camera.get().camera);
    }
    let m = arrays::matrix_from(given, what)?;
    // Skew is not supported; a scaled or transposed matrix is an error.
    let expected = Matrix3::new(m.m11, 0.0, m.m13, 0.0, m.m22, m.m23, 0.0, 0.0, 1.0);
    let camera = Camera::pinhole(0, 0, m.m11, m.m22, m.m13, m.m23);
    if m != expected || camera.validate().is_err() {
        let text = format!("{what} must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0");
        return Err(PyValueError::new_err(text));
    }
    Ok(camera)
}
