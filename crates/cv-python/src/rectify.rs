//! Rectified pairs, and photographs without the distortion of their lens.

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

/// `alpha` and `size`.
pub(crate) fn view_options(options: &mut Options<'_>) -> PyResult<RectifyOptions> {
    let mut o = RectifyOptions::default();
    options.set("alpha", &mut o.alpha)?;
    options.set_optional("size", &mut o.size)?;
    Ok(o)
}

/// The options of `rectify` and `undistort`.
pub(crate) fn read(options: &mut Options<'_>) -> PyResult<(RectifyOptions, Run)> {
    Ok((view_options(options)?, Run::read(options)?))
}

/// Q, which makes (X, Y, Z, W) of (x, y, disparity, 1), as OpenCV's reprojectImageTo3D takes it.
pub(crate) fn q<'py>(py: Python<'py>, q: &Matrix4<f64>) -> PyResult<Bound<'py, PyAny>> {
    arrays::shaped(py, q.transpose().as_slice().to_vec(), &[4, 4])
}

/// Turns both photographs of a rig so that the same points lie in the same rows, without the distortion of the lenses.
///
/// left, right: arrays of one type, each of its camera's size. `defaults("rectify")` lists the options: alpha from 0 (no pixel without content) to 1 (no pixel lost), size (width, height).
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
    let turned = (arrays::matrix(py, view.rotation.matrix())?, arrays::matrix(py, other.rotation.matrix())?);
    results::made(
        py,
        "Rectified",
        [
            ("left", left),
            ("right", right),
            ("masks", object(py, (mask(one)?, mask(two)?))?),
            ("camera", PyCamera::object(py, view.camera)?),
            ("rotations", object(py, turned)?),
            ("Q", q(py, &geometry.q())?),
            ("baseline", object(py, geometry.baseline)?),
            ("vertical", object(py, vertical)?),
            ("vertical_px", object(py, vertical_px)?),
            ("seconds", results::stages(py, &stages)?),
        ],
    )
}

/// Takes the distortion of a lens out of photographs of one camera: the map is made once.
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

    /// The camera that would have taken the results: the same place and direction, square pixels, no distortion.
    #[getter]
    fn camera(&self) -> PyCamera {
        PyCamera { camera: self.camera }
    }

    /// The photograph without distortion, in its own type; black where the lens does not reach.
    fn compute<'py>(&self, py: Python<'py>, image: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        let image = ImageArg::new(image, "image")?;
        with_view!(image, |view| {
            let straight = self.run.run(py, |_| self.map.compute(view))?;
            arrays::array(py, straight)
        })
    }
}

/// A photograph without the distortion of its lens, and the camera that would have taken it: `(image, camera)`. For many photographs of one camera, `Undistorter` makes the map once.
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
