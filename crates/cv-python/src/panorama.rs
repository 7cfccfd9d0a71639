//! Panoramas.

use crate::arrays;
use crate::camera::PyCamera;
use crate::errors::{internal, reason, refused};
use crate::job::Run;
use crate::matching::feature_method;
use crate::options::Options;
use crate::photographs::{Ended, Photograph, Source};
use crate::results::{self, object};
use cv_core::Camera;
use cv_pipeline::panorama_types::{Framing, Registration};
use cv_pipeline::{FeatureOptions, PanoramaOptions, PanoramaPhoto, panorama as join, panorama_with as join_with};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use rayon::prelude::*;

/// The options of `panorama`.
pub(crate) struct Arguments {
    options: PanoramaOptions,
    camera: Option<Camera>,
    focal: Option<f64>,
    registration: Option<Registration>,
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
        let registration = options.take::<String>("registration")?.map(|text| {
            let wrong = |error| PyValueError::new_err(format!("panorama(): registration: {error}"));
            serde_json::from_str(&text).map_err(wrong)
        });
        options.set_named("mode", &mut o.align.motion)?;
        options.set_named("projection", &mut o.render.projection)?;
        o.render.framing = framing(options)?;
        options.set_named("blend", &mut o.render.blend)?;
        options.set_named("seams", &mut o.render.seams)?;
        options.set_named("exposure", &mut o.render.exposure)?;
        options.set("crop", &mut o.render.crop)?;
        options.set("scale", &mut o.render.resolution)?;
        o.matching.features = FeatureOptions::from(feature_method(options)?).at_most(2000);
        options.set("seed", &mut o.verify.seed)?;
        let camera = camera.map(|camera| camera.get().camera);
        Ok(Self { options: o, camera, focal, registration: registration.transpose()?, run: Run::read(options)? })
    }
}

/// Which part of the scene is drawn: options in degrees.
fn framing(options: &mut Options<'_>) -> PyResult<Framing> {
    let radians = |name: &str, degrees: f64, low: f64, high: f64| {
        if (low..=high).contains(&degrees) {
            return Ok(degrees.to_radians());
        }
        let text = format!("panorama(): {name} must be from {low} to {high} degrees, not {degrees}");
        Err(PyValueError::new_err(text))
    };
    let mut framing = Framing::default();
    // One angle, or across and up.
    let (across, up) = match options.take_any("fov")? {
        Some(fov) if fov.is_instance_of::<PyTuple>() => {
            let (across, up) = options.extract::<(f64, f64)>("fov", &fov)?;
            (Some(across), Some(up))
        }
        Some(fov) => (Some(options.extract::<f64>("fov", &fov)?), None),
        None => (None, None),
    };
    framing.across = across.map(|across| radians("fov", across, 1.0, 360.0)).transpose()?;
    framing.up = up.map(|up| radians("fov", up, 1.0, 360.0)).transpose()?;
    if let Some((yaw, pitch)) = options.take::<(f64, f64)>("center")? {
        framing.center = Some([radians("yaw", yaw, -360.0, 360.0)?, radians("pitch", pitch, -90.0, 90.0)?]);
    }
    let mut roll = 0.0;
    options.set("roll", &mut roll)?;
    framing.roll = radians("roll", roll, -180.0, 180.0)?;
    Ok(framing)
}

/// Joins overlapping photographs, in any order, to one picture.
///
/// photographs: arrays of uint8 or paths. camera: the calibrated Camera that took all of them; focal: about the focal length in px, else EXIF tells, or the photographs do.
/// fov: degrees across, or (across, up); center: degrees to the right of the photographs' middle and above the horizon, (yaw, pitch); roll: degrees clockwise.
/// registration: that of a `Panorama` of the same views (or the text of a file of `cv panorama --save-registration`), with which nothing is matched; `camera`, `focal`, `mode` and `features` then mean nothing.
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
    let Arguments { options, camera, focal, registration, run } = &arguments;
    let found = run.run(py, |progress| {
        let read: Vec<_> =
            sources.par_iter().map(|source| Source::read(*source)).collect::<Result<_, _>>().map_err(Ended::File)?;
        let photos: Vec<PanoramaPhoto<'_>> = read
            .iter()
            .map(|(pixels, exif)| PanoramaPhoto { image: pixels.view(), focal: focal.or(*exif), camera: *camera })
            .collect();
        let joined = match registration {
            Some(registration) => {
                let photos: Vec<_> = photos.iter().map(|photo| photo.image).collect();
                join_with(registration, &photos, &options.render, progress)
            }
            None => join(&photos, options, progress),
        };
        joined.map_err(Ended::Job)
    })?;
    let registration = found.registration(&[]).map_err(|error| refused(py, &error))?;
    let registration = serde_json::to_string(&registration).map_err(|error| internal(&error.to_string()))?;
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
            ("registration", object(py, registration)?),
            ("rms", object(py, found.reprojection_rms_px)?),
            ("shows_parallax", object(py, shows_parallax)?),
            ("seconds", results::stages(py, &found.stages)?),
        ],
    )
}
