//! Sparse models: cameras, images with poses, and points.

use crate::arrays;
use crate::calibration::pose;
use crate::camera::{PyCamera, pose_from};
use crate::errors::of_file;
use crate::results::{self, object};
use cv_core::{ModelImage, ModelPoint, Named, Point2, Point3, SparseModel};
use cv_io::colmap::{self, ModelFormat};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Converts a model to a `Reconstruction`.
pub(crate) fn made<'py>(py: Python<'py>, model: &SparseModel) -> PyResult<Bound<'py, PyAny>> {
    let (cameras, images) = (PyDict::new(py), PyDict::new(py));
    for (id, camera) in &model.cameras {
        cameras.set_item(id, PyCamera::object(py, *camera)?)?;
    }
    for (id, image) in &model.images {
        let pixels: Vec<[f64; 2]> = image.points.iter().map(|(pixel, _)| pixel.coords.into()).collect();
        let ids: Vec<i64> = image.points.iter().map(|(_, id)| id.map_or(-1, |id| id as i64)).collect();
        let (rotation, translation): (Bound<'py, PyAny>, Bound<'py, PyAny>) = pose(py, &image.pose)?.extract()?;
        let image = results::made(
            py,
            "ModelImage",
            [
                ("name", object(py, &image.name)?),
                ("camera", object(py, image.camera)?),
                ("rotation", rotation),
                ("translation", translation),
                ("keypoints", arrays::row_array(py, &pixels)?),
                ("point_ids", arrays::shaped(py, ids, &[pixels.len()])?),
            ],
        )?;
        images.set_item(id, image)?;
    }
    let points: Vec<[f64; 3]> = model.points.values().map(|p| p.position.coords.into()).collect();
    let colors: Vec<[u8; 3]> = model.points.values().map(|p| p.color).collect();
    let errors: Vec<f64> = model.points.values().map(|p| p.error).collect();
    let ids: Vec<i64> = model.points.keys().map(|id| *id as i64).collect();
    let count = points.len();
    results::made(
        py,
        "Reconstruction",
        [
            ("cameras", cameras.into_any()),
            ("images", images.into_any()),
            ("points", arrays::row_array(py, &points)?),
            ("colors", arrays::row_array(py, &colors)?),
            ("errors", arrays::shaped(py, errors, &[count])?),
            ("point_ids", arrays::shaped(py, ids, &[count])?),
        ],
    )
}

/// Converts a `Reconstruction` to a model; tracks are collected from its images.
fn model_from(given: &Bound<'_, PyAny>) -> PyResult<SparseModel> {
    let cameras: BTreeMap<u32, Bound<'_, PyCamera>> = given.getattr("cameras")?.extract()?;
    let cameras = cameras.into_iter().map(|(id, camera)| (id, camera.get().camera)).collect();
    let mut model = SparseModel { cameras, ..SparseModel::default() };
    let ids = integers(&given.getattr("point_ids")?, "point_ids")?;
    let positions: Vec<[f64; 3]> = arrays::rows(&given.getattr("points")?, "points")?;
    let colors: Vec<[f64; 3]> = arrays::rows(&given.getattr("colors")?, "colors")?;
    let errors: Vec<f64> = given.getattr("errors")?.call_method0("tolist")?.extract()?;
    if [positions.len(), colors.len(), errors.len()].iter().any(|n| *n != ids.len()) {
        return Err(PyValueError::new_err("points, colors, errors and point_ids differ in length"));
    }
    for (((id, position), color), error) in ids.into_iter().zip(positions).zip(colors).zip(errors) {
        let color = color.map(|c| c.round() as u8);
        let point = ModelPoint { position: Point3::from(position), color, error, track: Vec::new() };
        model.points.insert(id as u64, point);
    }
    let images: BTreeMap<u32, Bound<'_, PyAny>> = given.getattr("images")?.extract()?;
    for (number, image) in images {
        let pose = pose_from(&image.getattr("rotation")?, &image.getattr("translation")?)?;
        let pixels: Vec<[f64; 2]> = arrays::rows(&image.getattr("keypoints")?, "keypoints")?;
        let ids = integers(&image.getattr("point_ids")?, "point_ids")?;
        if ids.len() != pixels.len() {
            return Err(PyValueError::new_err(format!("image {number}: keypoints and point_ids differ in length")));
        }
        let mut points = Vec::with_capacity(ids.len());
        for (index, (pixel, id)) in pixels.into_iter().zip(ids).enumerate() {
            let point = u64::try_from(id).ok();
            if let Some(id) = point {
                let Some(point) = model.points.get_mut(&id) else {
                    return Err(PyValueError::new_err(format!(
                        "image {number} observes point {id}, which does not exist"
                    )));
                };
                point.track.push((number, index as u32));
            }
            points.push((Point2::from(pixel), point));
        }
        let (name, camera) = (image.getattr("name")?.extract()?, image.getattr("camera")?.extract()?);
        model.images.insert(number, ModelImage { name, camera, pose, points });
    }
    Ok(model)
}

fn integers(given: &Bound<'_, PyAny>, what: &str) -> PyResult<Vec<i64>> {
    let listed = given.call_method0("tolist")?;
    listed.extract().map_err(|_| PyValueError::new_err(format!("{what} must be an array of integers")))
}

/// Reads a COLMAP model: the folder of cameras, images and points3D, text or binary.
#[pyfunction]
pub(crate) fn read_model(py: Python<'_>, folder: PathBuf) -> PyResult<Bound<'_, PyAny>> {
    let model = py.detach(|| colmap::read(&folder)).map_err(|error| of_file(py, &error))?;
    made(py, &model)
}

/// Writes a `Reconstruction` as a COLMAP model into an existing folder, replacing a model there. format: colmap-text or colmap-binary.
#[pyfunction]
#[pyo3(signature = (folder, model, *, format = "colmap-text"))]
pub(crate) fn write_model(py: Python<'_>, folder: PathBuf, model: &Bound<'_, PyAny>, format: &str) -> PyResult<()> {
    let format = ModelFormat::from_name(format).map_err(|error| PyValueError::new_err(format!("format: {error}")))?;
    let model = model_from(model)?;
    py.detach(|| colmap::replace(&folder, &model, format)).map(drop).map_err(|error| of_file(py, &error))
}
