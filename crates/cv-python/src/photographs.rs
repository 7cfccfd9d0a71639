//! Photographs as arrays or files.

use crate::arrays::{self, Rgb};
use crate::camera::PyCamera;
use crate::errors::{JobError, Refused, of_file};
use crate::options::Options;
use cv_core::{Camera, ImageView, Matrix3, RgbU8};
use cv_io::IoError;
use cv_pipeline::GpsFix;
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use std::borrow::Cow;
use std::path::{Path, PathBuf};

/// An input photograph of a job.
pub(crate) enum Photograph<'py> {
    Array(Rgb<'py>),
    File(PathBuf),
}

impl<'py> Photograph<'py> {
    /// Converts an 8-bit array, or a path.
    pub(crate) fn new(given: &Bound<'py, PyAny>, what: &str) -> PyResult<Self> {
        match given.extract::<PathBuf>() {
            Ok(path) => Ok(Self::File(path)),
            Err(_) => Rgb::new(given, what).map(Self::Array),
        }
    }

    /// Reads each item of a list, with its name for errors.
    pub(crate) fn each<T>(
        given: &Bound<'py, PyAny>,
        read: impl Fn(&Bound<'py, PyAny>, &str) -> PyResult<T>,
    ) -> PyResult<Vec<T>> {
        // A string is a sequence of characters, too.
        if given.extract::<PathBuf>().is_ok() {
            return Err(PyTypeError::new_err("a list of photographs is needed, got a single path"));
        }
        given.try_iter()?.enumerate().map(|(i, one)| read(&one?, &format!("photograph {i}"))).collect()
    }

    /// Returns a source that can be used with the GIL released.
    pub(crate) fn source(&self) -> PyResult<Source<'_>> {
        Ok(match self {
            Self::Array(array) => Source::View(array.view()?),
            Self::File(path) => Source::File(path),
        })
    }
}

/// The pixels of a photograph: a view, or a file to read.
#[derive(Clone, Copy)]
pub(crate) enum Source<'a> {
    View(ImageView<'a, u8, 3>),
    File(&'a Path),
}

/// EXIF data of a photograph.
#[derive(Default)]
pub(crate) struct Exif {
    /// Focal length in px.
    pub(crate) focal: Option<f64>,
    pub(crate) gps: Option<GpsFix>,
}

/// The pixels of a photograph.
pub(crate) enum Pixels<'a> {
    View(ImageView<'a, u8, 3>),
    Read(RgbU8),
}

impl Pixels<'_> {
    pub(crate) fn view(&self) -> ImageView<'_, u8, 3> {
        match self {
            Self::View(view) => *view,
            Self::Read(image) => image.view(),
        }
    }
}

impl<'a> Source<'a> {
    /// Reads the pixels, and the focal length by EXIF in px.
    pub(crate) fn read(self) -> Result<(Pixels<'a>, Option<f64>), IoError> {
        self.read_with_exif().map(|(pixels, exif)| (pixels, exif.focal))
    }

    /// Reads the pixels and EXIF data.
    pub(crate) fn read_with_exif(self) -> Result<(Pixels<'a>, Exif), IoError> {
        Ok(match self {
            Self::View(view) => (Pixels::View(view), Exif::default()),
            Self::File(path) => {
                let image = cv_io::read_image(path)?;
                let focal = image.exif.focal.map(|focal| focal.pixels);
                let gps = image.exif.gps;
                let gps = gps.map(|gps| GpsFix { place: gps.position(), has_altitude: gps.altitude.is_some() });
                (Pixels::Read(image.into_rgb8()), Exif { focal, gps })
            }
        })
    }

    /// Returns the file name, or the index of an array.
    pub(crate) fn name(self, index: usize) -> Cow<'a, str> {
        match self {
            Self::View(_) => Cow::Owned(index.to_string()),
            Self::File(path) => path.file_name().unwrap_or(path.as_os_str()).to_string_lossy(),
        }
    }
}

/// The error of a job that reads photographs.
pub(crate) enum Ended<E> {
    File(IoError),
    Job(E),
}

impl<E: JobError> Refused for Ended<E> {
    fn exception(&self, py: Python<'_>) -> PyErr {
        match self {
            Self::File(error) => of_file(py, error),
            Self::Job(error) => error.exception(py),
        }
    }
}

/// Prior knowledge of the intrinsics.
pub(crate) enum Known {
    /// A calibrated `Camera`, with its distortion.
    Camera(Camera),
    /// A 3×3 calibration matrix, with unknown distortion.
    Matrix(Matrix3<f64>),
    /// An approximate focal length in px.
    Focal(f64),
    /// None: the focal length is from EXIF or self-calibrated.
    Nothing,
}

impl Known {
    /// Reads `camera` and `focal`.
    pub(crate) fn read(options: &mut Options<'_>) -> PyResult<Self> {
        let camera = options.take_any("camera")?;
        let focal: Option<f64> = options.take("focal")?;
        match (camera, focal) {
            (Some(_), Some(_)) => Err(PyTypeError::new_err("camera and focal are mutually exclusive")),
            (Some(given), None) => Self::of(&given),
            (None, Some(focal)) if focal > 0.0 && focal.is_finite() => Ok(Self::Focal(focal)),
            (None, Some(focal)) => Err(PyValueError::new_err(format!("focal must be positive, not {focal}"))),
            (None, None) => Ok(Self::Nothing),
        }
    }

    /// Converts a `Camera` or a matrix.
    pub(crate) fn of(given: &Bound<'_, PyAny>) -> PyResult<Self> {
        match given.cast::<PyCamera>() {
            Ok(camera) => Ok(Self::Camera(camera.get().camera)),
            Err(_) => arrays::matrix_from(given, "camera").map(Self::Matrix),
        }
    }

    /// Returns the camera for photographs of a size, if known.
    pub(crate) fn camera(&self, (width, height): (usize, usize)) -> Option<Camera> {
        match self {
            Self::Camera(camera) => Some(*camera),
            Self::Matrix(m) => Some(Camera::pinhole(width, height, m.m11, m.m22, m.m13, m.m23)),
            Self::Focal(focal) => Some(Camera::from_focal(width, height, *focal)),
            Self::Nothing => None,
        }
    }
}
