//! Rectification and undistortion.

use crate::arrays::{self, ImageArg};
use crate::camera::{PyCamera, PyRig};
use crate::errors::refused;
use crate::job::Run;
use crate::options::Options;
use crate::results::{self, object};
use crate::{with_view, with_views};
use cv_core::Camera;
use cv_core::nalgebra::Matrix4;
use cv_pipeline::rectify as rectify_pair;
use cv_pipeline::stereo::{Rectification, RectifiedView, RectifyOptions, WarpMap};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Reads `alpha` and `size`.
pub(crate) fn view_options(options: &mut Options<'_>) -> PyResult<RectifyOptions> {
    let mut o = RectifyOptions::default();
    options.set("alpha", &mut o.alpha)?;
    options.set_optional("size", &mut o.size)?;
    Ok(o)
}

/// Reads the options of `rectify` and `undistort`.
pub(crate) fn read(options: &mut Options<'_>) -> PyResult<(RectifyOptions, Run)> {
    Ok((view_options(options)?, Run::read(options)?))
}

/// Converts Q, which maps (x, y, disparity, 1) to homogeneous (X, Y, Z, W), as in OpenCV's reprojectImageTo3D.
pub(crate) fn q<'py>(py: Python<'py>, q: &Matrix4<f64>) -> PyResult<Bound<'py, PyAny>> {
    arrays::shaped(py, q.transpose().as_slice().to_vec(), &[4, 4])
}

/// Rectifies and undistorts a pair of a rig, so that corresponding points lie in the same row.
///
/// left, right: arrays of one type, each of its camera's size. `defaults("rectify")` lists the options: alpha from 0 (only valid pixels) to 1 (all source pixels kept), size (width, height).
#[pyfunction]
#[pyo3(signature = (left, right, rig, **options))]
pub(crate) fn rectify<'py>(
    py: Python<'py>,
    left: &Bound<'py, PyAny>,
    right: &Bound<'py, PyAny>,
    rig: &Bound<'py, PyRig>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let mut options = Options::new("rectify", options);
    let (o, run) = read(&mut options)?;
    options.finish()?;
    let (left, right) = (ImageArg::new(left, "left")?, ImageArg::new(right, "right")?);
    let rig = rig.get().rig;
    let (images, masks, rectification, vertical_px, stages) = with_views!(py, [left, right], |a, b| {
        let found = run.run(py, |progress| rectify_pair(a, b, &rig, &o, progress))?;
        let [left, right] = found.images;
        let images = [arrays::array(py, left)?, arrays::array(py, right)?];
        Ok::<_, PyErr>((images, found.masks, found.rectification, found.vertical_px, found.stages))
    })?;
    let ([left, right], [one, two]) = (images, masks);
    let mask = |mask: cv_core::Mask| arrays::array(py, mask);
    let Rectification { left: view, right: other, geometry, vertical } = rectification;
    let rotations = (arrays::matrix(py, view.rotation.matrix())?, arrays::matrix(py, other.rotation.matrix())?);
    results::made(
        py,
        "Rectified",
        [
            ("left", left),
            ("right", right),
            ("masks", object(py, (mask(one)?, mask(two)?))?),
            ("camera", PyCamera::object(py, view.camera)?),
            ("rotations", object(py, rotations)?),
            ("Q", q(py, &geometry.q())?),
            ("baseline", object(py, geometry.baseline)?),
            ("vertical", object(py, vertical)?),
            ("vertical_px", object(py, vertical_px)?),
            ("seconds", results::stages(py, &stages)?),
        ],
    )
}

/// Undistorts images of one camera with a precomputed map.
#[pyclass(frozen, module = "epipole", name = "Undistorter")]
pub(crate) struct PyUndistorter {
    map: WarpMap,
    camera: Camera,
    run: Run,
}

#[pymethods]
impl PyUndistorter {
    #[new]
    #[pyo3(signature = (camera, **options))]
    fn new(py: Python<'_>, camera: &Bound<'_, PyCamera>, options: Option<&Bound<'_, PyDict>>) -> PyResult<Self> {
        let mut options = Options::new("Undistorter", options);
        let (o, run) = read(&mut options)?;
        options.finish()?;
        let view = RectifiedView::undistorted(&camera.get().camera, &o).map_err(|error| refused(py, &error))?;
        let map = run.run(py, |progress| view.map(progress))?;
        Ok(Self { map, camera: view.camera, run })
    }

    /// The pinhole camera of the results: same center and orientation, square pixels, no distortion.
    #[getter]
    fn camera(&self) -> PyCamera {
        PyCamera { camera: self.camera }
    }

    /// Undistorts an image, in its own type; pixels outside the source are black.
    fn compute<'py>(&self, py: Python<'py>, image: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        let image = ImageArg::new(image, "image")?;
        with_view!(image, |view| {
            let straight = self.run.run(py, |_| self.map.compute(view))?;
            arrays::array(py, straight)
        })
    }
}

/// Undistorts an image; returns it and its pinhole camera: `(image, camera)`. For many images of one camera, `Undistorter` computes the map once.
///
///     >>> camera = epipole.Camera(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]], [-0.1, 0.01, 0, 0])
///     >>> straight, pinhole = epipole.undistort(np.zeros((480, 640, 3), np.uint8), camera)
///     >>> straight.shape, pinhole.lens
///     ((480, 640, 3), 'none')
#[pyfunction]
#[pyo3(signature = (image, camera, **options))]
pub(crate) fn undistort<'py>(
    py: Python<'py>,
    image: &Bound<'py, PyAny>,
    camera: &Bound<'py, PyCamera>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<(Bound<'py, PyAny>, PyCamera)> {
    let mut options = Options::new("undistort", options);
    let (o, run) = read(&mut options)?;
    options.finish()?;
    let image = ImageArg::new(image, "image")?;
    let view = RectifiedView::undistorted(&camera.get().camera, &o).map_err(|error| refused(py, &error))?;
    let straight = with_view!(image, |pixels| {
        let (straight, _) = run.run(py, |progress| view.apply(pixels, progress))?;
        arrays::array(py, straight)
    })?;
    Ok((straight, PyCamera { camera: view.camera }))
}
