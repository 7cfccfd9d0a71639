//! Precomputed features of a photograph for structure from motion.

use crate::arrays;
use crate::job::Run;
use crate::matching::{keypoints, keypoints_from, max_features};
use crate::options::Options;
use crate::photographs::{Ended, Exif, Photograph, Source};
use cv_core::GeodeticPoint;
use cv_pipeline::features::{ByteDescriptors, DescriptorKind};
use cv_pipeline::{FeatureOptions, GpsFix, SfmJobOptions, SfmPhoto, SfmPhotoError, sfm_photo};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

/// The features and EXIF data of a photograph: `sfm` takes it in place of the photograph.
#[pyclass(frozen, module = "epipole", name = "SfmPhotograph")]
pub(crate) struct PySfmPhotograph {
    pub(crate) photo: SfmPhoto,
    pub(crate) exif: Exif,
}

/// Latitude and longitude in radians, and the altitude in meters if known.
type Gps = (f64, f64, Option<f64>);

/// Name, size, focal length and position by EXIF, keypoints, descriptors, their kind, and colors.
type Parts<'py> = (
    String,
    (usize, usize),
    (Option<f64>, Option<Gps>),
    Bound<'py, PyAny>,
    Bound<'py, PyBytes>,
    &'static str,
    Bound<'py, PyAny>,
);

#[pymethods]
impl PySfmPhotograph {
    #[getter]
    fn name(&self) -> &str {
        &self.photo.name
    }

    /// Width and height.
    #[getter]
    fn size(&self) -> (usize, usize) {
        self.photo.size
    }

    /// Focal length by EXIF, px.
    #[getter]
    fn focal(&self) -> Option<f64> {
        self.exif.focal
    }

    /// Latitude and longitude by EXIF in radians, and altitude in meters (None if unknown); None without a GPS position.
    #[getter]
    fn gps(&self) -> Option<Gps> {
        self.exif.gps.map(|GpsFix { place, has_altitude }| {
            (place.latitude, place.longitude, has_altitude.then_some(place.altitude))
        })
    }

    /// float32 (n, 5): x, y, scale, angle, response.
    #[getter]
    fn keypoints<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        keypoints(py, &self.photo.keypoints)
    }

    fn __len__(&self) -> usize {
        self.photo.keypoints.len()
    }

    fn __repr__(&self) -> String {
        let (width, height) = self.photo.size;
        format!("SfmPhotograph({}, {width}×{height} px, {} features)", self.photo.name, self.photo.keypoints.len())
    }

    /// Restores a pickled object.
    #[staticmethod]
    fn _of_parts(
        name: String,
        size: (usize, usize),
        exif: (Option<f64>, Option<Gps>),
        keypoints: &Bound<'_, PyAny>,
        descriptors: &[u8],
        kind: &str,
        colors: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let keypoints = keypoints_from(keypoints)?;
        let colors: Vec<[f64; 3]> = arrays::rows(colors, "colors")?;
        let kind = DescriptorKind::BUILT_IN.into_iter().find(|own| own.name == kind);
        let descriptors = kind.and_then(|kind| ByteDescriptors::from_bytes(kind, descriptors.to_vec()));
        let Some(descriptors) = descriptors.filter(|d| d.len() == keypoints.len() && d.len() == colors.len()) else {
            return Err(PyValueError::new_err("these are not parts of an SfmPhotograph"));
        };
        let colors = colors.into_iter().map(|color| color.map(|c| c as u8)).collect();
        Ok(Self {
            photo: SfmPhoto { name, size, camera: 0, keypoints, descriptors, colors },
            exif: Exif { focal: exif.0, gps: exif.1.map(fix) },
        })
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyAny>, Parts<'py>)> {
        let (py, Self { photo, exif }) = (slf.py(), slf.get());
        let parts = (
            photo.name.clone(),
            photo.size,
            (exif.focal, slf.get().gps()),
            keypoints(py, &photo.keypoints)?,
            PyBytes::new(py, photo.descriptors.as_slice()),
            photo.descriptors.kind().name,
            arrays::row_array(py, &photo.colors)?,
        );
        Ok((py.get_type::<Self>().getattr("_of_parts")?, parts))
    }
}

fn fix((latitude, longitude, altitude): Gps) -> GpsFix {
    let place = GeodeticPoint { latitude, longitude, altitude: altitude.unwrap_or(0.0) };
    GpsFix { place, has_altitude: altitude.is_some() }
}

/// Reads the options of `sfm_features`.
pub(crate) fn read_features(options: &mut Options<'_>) -> PyResult<(Option<String>, FeatureOptions, Run)> {
    let name = options.take("name")?;
    Ok((name, max_features(options, SfmJobOptions::default().features)?, Run::read(options)?))
}

/// Extracts the features of a photograph for `sfm`, which takes them in place of it.
///
/// photograph: an array of uint8 or a path. name: name in the model; by default the file name, or none.
#[pyfunction]
#[pyo3(signature = (photograph, **options))]
pub(crate) fn sfm_features(
    py: Python<'_>,
    photograph: &Bound<'_, PyAny>,
    options: Option<&Bound<'_, PyDict>>,
) -> PyResult<PySfmPhotograph> {
    let mut options = Options::new("sfm_features", options);
    let (name, features, run) = read_features(&mut options)?;
    options.finish()?;
    let photograph = Photograph::new(photograph, "photograph")?;
    let source = photograph.source()?;
    let name = name.unwrap_or_else(|| match source {
        Source::File(_) => source.name(0).into_owned(),
        Source::View(_) => String::new(),
    });
    run.run(py, |progress| {
        let (pixels, exif) = source.read_with_exif().map_err(Ended::File)?;
        let photo = sfm_photo(pixels.view(), name, 0, &features, progress).map_err(Ended::Job)?;
        Ok::<_, Ended<SfmPhotoError>>(PySfmPhotograph { photo, exif })
    })
}
