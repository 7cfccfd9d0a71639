//! Point clouds.

use crate::arrays;
use crate::errors::of_file;
use crate::results;
use cv_core::PointCloud;
use cv_io::ply::PlyEncoding;
use numpy::Element;
use pyo3::prelude::*;
use std::path::PathBuf;

/// Converts a cloud to arrays.
pub(crate) fn made(py: Python<'_>, cloud: PointCloud) -> PyResult<Bound<'_, PyAny>> {
    results::made(
        py,
        "PointCloud",
        [
            ("positions", arrays::row_array(py, &cloud.positions)?),
            ("colors", optional_rows(py, &cloud.colors)?),
            ("normals", optional_rows(py, &cloud.normals)?),
        ],
    )
}

/// Converts per-point values, or `None` if there are none.
fn optional_rows<'py, T: Element + Copy>(py: Python<'py>, rows: &[[T; 3]]) -> PyResult<Bound<'py, PyAny>> {
    if rows.is_empty() { Ok(py.None().into_bound(py)) } else { arrays::row_array(py, rows) }
}

/// Writes a point cloud as a binary PLY: positions (n, 3), colors (n, 3) from 0 to 255, normals (n, 3).
#[pyfunction]
#[pyo3(signature = (path, positions, colors = None, normals = None))]
pub(crate) fn write_cloud(
    py: Python<'_>,
    path: PathBuf,
    positions: &Bound<'_, PyAny>,
    colors: Option<&Bound<'_, PyAny>>,
    normals: Option<&Bound<'_, PyAny>>,
) -> PyResult<()> {
    let floats = |given: &Bound<'_, PyAny>, what: &str| -> PyResult<Vec<[f32; 3]>> {
        Ok(arrays::rows(given, what)?.into_iter().map(|row: [f64; 3]| row.map(|v| v as f32)).collect())
    };
    let bytes = |given: &Bound<'_, PyAny>| -> PyResult<Vec<[u8; 3]>> {
        Ok(arrays::rows(given, "colors")?.into_iter().map(|row: [f64; 3]| row.map(|v| v.round() as u8)).collect())
    };
    let cloud = PointCloud {
        positions: floats(positions, "positions")?,
        colors: colors.map_or(Ok(Vec::new()), bytes)?,
        normals: normals.map_or(Ok(Vec::new()), |given| floats(given, "normals"))?,
        edges: Vec::new(),
    };
    let write = || cv_io::ply::write_cloud(&path, &cloud, PlyEncoding::Binary);
    py.detach(write).map_err(|error| of_file(py, &error))
}
