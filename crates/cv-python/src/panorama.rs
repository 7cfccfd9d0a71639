//! Panoramas.

use crate::arrays;
use crate::camera::PyCamera;
use crate::errors::reason;
use crate::job::Run;
use crate::matching::feature_method;
use crate::options::Options;
use crate::photographs::{Ended, Photograph, Source};
use crate::results::{self, object};
use cv_core::Camera;
use cv_pipeline::{FeatureOptions, PanoramaOptions, PanoramaPhoto, panorama as join};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use rayon::prelude::*;

/// The options of `panorama`.
pub(crate) struct Arguments {
    options: PanoramaOptions,
    camera: Option<Camera>,
    focal: Option<f64>,
    run: Run,
}

impl Arguments {
    pub(crate) fn read(options: &mut Options<'_>) -> PyResult<Self> {
        let mut o = PanoramaOptions::default();
        let camera: Option<Bound<'_, PyCamera>> = options.take("camera")?;
        let focal: Option<f64> = options.take("focal")?;
        if let Some(focal) = focal.filter(|f| !(*f > 0.0 && f.is_finite())) {
            return Err(PyValueError::new_err(format!("panorama(): focal must be above 0, not {focal}")));
        }
        options.set_named("mode", &mut o.align.motion)?;
        options.set_named("projection", &mut o.render.projection)?;
        options.set_named("blend", &mut o.render.blend)?;
        options.set_named("seams", &mut o.render.seams)?;
        options.set_named("exposure", &mut o.render.exposure)?;
        options.set("crop", &mut o.render.crop)?;
        options.set("scale", &mut o.render.resolution)?;
        o.matching.features = FeatureOptions::from(feature_method(options)?).at_most(2000);
        options.set("seed", &mut o.verify.seed)?;
        let camera = camera.map(|camera| camera.get().camera);
        Ok(Self { options: o, camera, focal, run: Run::read(options)? })
    }
}

/// Joins overlapping photographs, in any order, to one picture.
///
/// photographs: arrays of uint8 or paths. camera: the calibrated Camera that took all of them; focal: about the focal length in px, else EXIF tells, or the photographs do.
/// `defaults("panorama")` lists the options.
#[pyfunction]
#[pyo3(signature = (photographs, **options))]
pub(crate) fn panorama<'py>(
    py: Python<'py>,
    photographs: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let mut options = Options::new("panorama", options);
    let arguments = Arguments::read(&mut options)?;
    options.finish()?;
    let photographs = Photograph::all(photographs)?;
    let sources = photographs.iter().map(Photograph::source).collect::<PyResult<Vec<_>>>()?;
    let Arguments { options, camera, focal, run } = &arguments;
    let found = run.run(py, |progress| {
        let read: Vec<_> =
            sources.par_iter().map(|source| Source::read(*source)).collect::<Result<_, _>>().map_err(Ended::File)?;
        let photos: Vec<PanoramaPhoto<'_>> = read
            .iter()
            .map(|(pixels, exif)| PanoramaPhoto { image: pixels.view(), focal: focal.or(*exif), camera: *camera })
            .collect();
        join(&photos, options, progress).map_err(Ended::Job)
    })?;
    let shows_parallax = found.shows_parallax();
    let left_out = PyDict::new(py);
    for (i, image) in found.images.iter().enumerate() {
        if let Some(why) = &image.reason {
            left_out.set_item(i, reason(py, why)?)?;
        }
    }
    let views = PyDict::new(py);
    for (i, view) in found.alignment.used() {
        let camera = PyCamera::object(py, view.camera)?;
        views.set_item(i, PyTuple::new(py, [camera, arrays::matrix(py, &view.from_world)?])?)?;
    }
    let gains: Vec<[f32; 3]> = found.images.iter().map(|image| image.gain).collect();
    results::made(
        py,
        "Panorama",
        [
            ("image", arrays::array(py, found.image)?),
            ("mask", arrays::array(py, found.mask)?),
            ("labels", arrays::array(py, found.labels)?),
            ("views", views.into_any()),
            ("gains", arrays::row_array(py, &gains)?),
            ("left_out", left_out.into_any()),
            ("rms", object(py, found.reprojection_rms_px)?),
            ("shows_parallax", object(py, shows_parallax)?),
            ("seconds", results::stages(py, &found.stages)?),
        ],
    )
}
