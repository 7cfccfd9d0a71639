//! Files: images and float maps.

use crate::arrays::{self, ImageArg};
use crate::errors::of_file;
use cv_io::{IoError, Metadata, Pixels};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use std::path::PathBuf;

/// Runs I/O with the GIL released.
fn done<R: Send>(py: Python<'_>, work: impl FnOnce() -> Result<R, IoError> + Send) -> PyResult<R> {
    py.detach(work).map_err(|error| of_file(py, &error))
}

/// Reads an image at its bit depth, with the EXIF orientation applied: uint8, uint16, or float32 (linear, as of OpenEXR and Radiance files); of shape (height, width), or (height, width, 3) in RGB.
///
/// Raises FileNotFoundError, or FileError with the reason.
#[pyfunction]
pub(crate) fn read_image(py: Python<'_>, path: PathBuf) -> PyResult<Bound<'_, PyAny>> {
    match done(py, || cv_io::read_image(&path))?.pixels {
        Pixels::Gray8(image) => arrays::array(py, image),
        Pixels::Gray16(image) => arrays::array(py, image),
        Pixels::Rgb8(image) => arrays::array(py, image),
        Pixels::Rgb16(image) => arrays::array(py, image),
        Pixels::GrayF32(image) => arrays::array(py, image),
        Pixels::RgbF32(image) => arrays::array(py, image),
    }
}

/// Writes an image atomically: uint8 as .png, .jpg or .tif, uint16 as .png or .tif.
#[pyfunction]
pub(crate) fn write_image(py: Python<'_>, path: PathBuf, image: &Bound<'_, PyAny>) -> PyResult<()> {
    let none = Metadata::default();
    macro_rules! write {
        ($borrowed:expr) => {
            match ($borrowed.view::<1>(), $borrowed.view::<3>()) {
                (Some(gray), _) => done(py, || cv_io::write_image(&path, gray, &none)),
                (_, Some(color)) => done(py, || cv_io::write_image(&path, color, &none)),
                _ => Err(PyValueError::new_err("the image is neither gray nor color")),
            }
        };
    }
    match ImageArg::new(image, "image")? {
        ImageArg::U8(borrowed) => write!(borrowed),
        ImageArg::U16(borrowed) => write!(borrowed),
        ImageArg::F32(_) => {
            Err(PyTypeError::new_err("image: write float32 with write_map, or scale it to uint8 or uint16"))
        }
    }
}

/// Reads a disparity or depth map: .pfm, .npy, .npz, KITTI's 16-bit PNG, or another gray image of values times `scale`. Invalid is NaN.
#[pyfunction]
#[pyo3(signature = (path, *, scale = None))]
pub(crate) fn read_map(py: Python<'_>, path: PathBuf, scale: Option<f64>) -> PyResult<Bound<'_, PyAny>> {
    arrays::array(py, done(py, || cv_io::read_map(&path, scale))?)
}

/// Writes a float32 map as .pfm (invalid +inf), or a disparity map as KITTI's 16-bit .png.
#[pyfunction]
pub(crate) fn write_map(py: Python<'_>, path: PathBuf, map: &Bound<'_, PyAny>) -> PyResult<()> {
    let map = arrays::map(map, "map")?;
    let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    match ending.as_str() {
        "pfm" => done(py, || cv_io::pfm::write(&path, map.view())),
        "png" => done(py, || cv_io::kitti::write(&path, map.view()).map(drop)),
        _ => Err(PyValueError::new_err(format!(
            "{}: maps are written as .pfm or .png; for .npy use numpy.save",
            path.display()
        ))),
    }
}
