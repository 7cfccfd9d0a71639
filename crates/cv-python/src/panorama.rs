//! Panoramas.

use crate::arrays::{self, ImageArg, Rgb};
use crate::camera::PyCamera;
use crate::errors::{internal, reason, refused};
use crate::job::Run;
use crate::matching::feature_method;
use crate::options::Options;
use crate::photographs::{self, Ended};
use crate::results::{self, object};
use cv_core::{Camera, Image, ImageView, Mask, Progress, Sample};
use cv_io::{DynImage, ExifInfo, IoError, Metadata};
use cv_parallel::prelude::*;
use cv_pipeline::panorama_types::{Framing, PhotoMask, PhotoSample, PhotoUse, Registration};
use cv_pipeline::{
    FeatureOptions, PanoramaError, PanoramaOptions, PanoramaPhoto, PanoramaResult, panorama as join,
    panorama_with_masks as join_with,
};
use numpy::Element;
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use std::path::{Path, PathBuf};

/// The options of `panorama`.
pub(crate) struct Arguments {
    options: PanoramaOptions,
    camera: Option<Camera>,
    focal: Option<f64>,
    registration: Option<Registration>,
    run: Run,
    masks: Vec<Option<PhotoMask>>,
}

impl Arguments {
    pub(crate) fn read(options: &mut Options<'_>) -> PyResult<Self> {
        let mut o = PanoramaOptions::default();
        let camera: Option<Bound<'_, PyCamera>> = options.take("camera")?;
        let focal: Option<f64> = options.take("focal")?;
        if let Some(focal) = focal.filter(|f| !(*f > 0.0 && f.is_finite())) {
            return Err(PyValueError::new_err(format!("panorama(): focal must be positive, not {focal}")));
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
        options.set("clean", &mut o.render.removes_transients)?;
        let masks = masks(options)?;
        options.set_named("exposure", &mut o.render.exposure)?;
        options.set("crop", &mut o.render.crop)?;
        options.set("scale", &mut o.render.resolution)?;
        o.matching.features = PanoramaOptions::features(FeatureOptions::from(feature_method(options)?));
        options.set("seed", &mut o.verify.seed)?;
        let camera = camera.map(|camera| camera.get().camera);
        let (registration, run) = (registration.transpose()?, Run::read(options)?);
        Ok(Self { options: o, camera, focal, registration, run, masks })
    }
}

/// Reads `keep` and `remove`: for each photograph a mask or `None`.
fn masks(options: &mut Options<'_>) -> PyResult<Vec<Option<PhotoMask>>> {
    let mut read = |name: &'static str| -> PyResult<Vec<Option<Mask>>> {
        let Some(given) = options.take_any(name)? else { return Ok(Vec::new()) };
        let one = |(i, mask): (usize, PyResult<Bound<'_, PyAny>>)| {
            let mask = mask?;
            (!mask.is_none()).then(|| arrays::mask(&mask, &format!("{name}[{i}]"))).transpose()
        };
        given.try_iter()?.enumerate().map(one).collect()
    };
    let (mut keep, mut remove) = (read("keep")?, read("remove")?);
    let photographs = keep.len().max(remove.len());
    keep.resize_with(photographs, || None);
    remove.resize_with(photographs, || None);
    let joined = |(i, (keep, remove)): (usize, (Option<Mask>, Option<Mask>))| {
        let Some((width, height)) = keep.as_ref().or(remove.as_ref()).map(Image::size) else { return Ok(None) };
        if let Some((w, h)) = remove.as_ref().map(Image::size).filter(|size| *size != (width, height)) {
            return Err(PyValueError::new_err(format!(
                "panorama(): keep[{i}] has {width} x {height} pixels, remove[{i}] has {w} x {h}"
            )));
        }
        let is_in = |mask: &Option<Mask>, x: usize, y: usize| mask.as_ref().is_some_and(|mask| mask.at(x, y)[0]);
        Ok(Some(PhotoMask::from_fn(width, height, |x, y| match (is_in(&remove, x, y), is_in(&keep, x, y)) {
            (true, _) => PhotoUse::Remove,
            (false, true) => PhotoUse::Keep,
            (false, false) => PhotoUse::Free,
        })))
    };
    keep.into_iter().zip(remove).enumerate().map(joined).collect()
}

/// Reads field of view, center and roll, in degrees.
fn framing(options: &mut Options<'_>) -> PyResult<Framing> {
    let radians = |name: &str, degrees: f64, low: f64, high: f64| {
        if (low..=high).contains(&degrees) {
            return Ok(degrees.to_radians());
        }
        let text = format!("panorama(): {name} must be from {low} to {high} degrees, not {degrees}");
        Err(PyValueError::new_err(text))
    };
    let mut framing = Framing::default();
    // One angle, or horizontal and vertical.
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

/// An input photograph at its bit depth.
enum Photograph<'py> {
    Bytes(Rgb<'py, u8>),
    Words(Rgb<'py, u16>),
    File(PathBuf),
}

impl<'py> Photograph<'py> {
    /// Converts an 8-bit or 16-bit array, or a path.
    fn new(given: &Bound<'py, PyAny>, what: &str) -> PyResult<Self> {
        if let Ok(path) = given.extract::<PathBuf>() {
            return Ok(Self::File(path));
        }
        match ImageArg::new(given, what)? {
            ImageArg::U8(borrowed) => Rgb::of(given.py(), borrowed).map(Self::Bytes),
            ImageArg::U16(borrowed) => Rgb::of(given.py(), borrowed).map(Self::Words),
            other @ ImageArg::F32(_) => {
                let text = format!(
                    "{what}: dtype is {}, but uint8 or uint16 is needed; scale it to 0 to 255 and use .astype(np.uint8)",
                    other.kind()
                );
                Err(PyTypeError::new_err(text))
            }
        }
    }

    /// Returns a source that can be used with the GIL released.
    fn source(&self) -> PyResult<Source<'_>> {
        Ok(match self {
            Self::Bytes(array) => Source::Bytes(array.view()?),
            Self::Words(array) => Source::Words(array.view()?),
            Self::File(path) => Source::File(path),
        })
    }
}

/// The pixels of a photograph: a view, or a file to read.
#[derive(Clone, Copy)]
enum Source<'a> {
    Bytes(ImageView<'a, u8, 3>),
    Words(ImageView<'a, u16, 3>),
    File(&'a Path),
}

/// A photograph in memory.
enum Read<'a> {
    Bytes(ImageView<'a, u8, 3>),
    Words(ImageView<'a, u16, 3>),
    File(Box<DynImage>),
}

impl<'a> Source<'a> {
    fn read(self) -> Result<Read<'a>, IoError> {
        Ok(match self {
            Self::Bytes(view) => Read::Bytes(view),
            Self::Words(view) => Read::Words(view),
            Self::File(path) => Read::File(Box::new(cv_io::read_image(path)?)),
        })
    }
}

/// The pixels of a photograph at the common bit depth.
enum Pixels<'a, T> {
    View(ImageView<'a, T, 3>),
    Made(Image<T, 3>),
}

impl<T: Sample> Pixels<'_, T> {
    fn view(&self) -> ImageView<'_, T, 3> {
        match self {
            Self::View(view) => *view,
            Self::Made(image) => image.view(),
        }
    }
}

impl<'a> Read<'a> {
    fn is_deep(&self) -> bool {
        match self {
            Self::Bytes(_) => false,
            Self::Words(_) => true,
            Self::File(image) => matches!(image.pixels, cv_io::Pixels::Gray16(_) | cv_io::Pixels::Rgb16(_)),
        }
    }

    /// Returns the focal length by EXIF, px.
    fn focal(&self) -> Option<f64> {
        match self {
            Self::File(image) => image.exif.focal.as_ref().map(|focal| focal.pixels),
            _ => None,
        }
    }

    fn into_bytes(self) -> Pixels<'a, u8> {
        match self {
            Self::Bytes(view) => Pixels::View(view),
            Self::Words(view) => Pixels::Made(as_file(view.to_image()).into_rgb8()),
            Self::File(image) => Pixels::Made(image.into_rgb8()),
        }
    }

    fn into_words(self) -> Pixels<'a, u16> {
        match self {
            Self::Bytes(view) => Pixels::Made(as_file(view.to_image()).into_rgb16()),
            Self::Words(view) => Pixels::View(view),
            Self::File(image) => Pixels::Made(image.into_rgb16()),
        }
    }
}

/// Converts a photograph to a bit depth; returns its focal length too.
fn in_depth<'a, T>(read: Read<'a>, pixels: impl Fn(Read<'a>) -> Pixels<'a, T>) -> (Pixels<'a, T>, Option<f64>) {
    let focal = read.focal();
    (pixels(read), focal)
}

/// Wraps an array as an image of a file.
fn as_file(pixels: impl Into<cv_io::Pixels>) -> DynImage {
    DynImage { pixels: pixels.into(), exif: ExifInfo::default(), metadata: Metadata::default() }
}

/// A panorama at the largest bit depth of the photographs.
enum Joined {
    Bytes(PanoramaResult),
    Words(PanoramaResult<u16>),
}

impl Arguments {
    fn stitch<T: PhotoSample>(
        &self,
        photographs: &[(Pixels<'_, T>, Option<f64>)],
        progress: &dyn Progress,
    ) -> Result<PanoramaResult<T>, Ended<PanoramaError>> {
        let photos: Vec<PanoramaPhoto<'_, T>> = photographs
            .iter()
            .enumerate()
            .map(|(i, (pixels, exif))| PanoramaPhoto {
                image: pixels.view(),
                focal: self.focal.or(*exif),
                camera: self.camera,
                mask: self.masks.get(i).and_then(Option::as_ref),
            })
            .collect();
        let joined = match &self.registration {
            Some(registration) => {
                let (photos, masks): (Vec<_>, Vec<_>) = photos.iter().map(|photo| (photo.image, photo.mask)).unzip();
                join_with(registration, &photos, &masks, &self.options.render, progress)
            }
            None => join(&photos, &self.options, progress),
        };
        joined.map_err(Ended::Job)
    }
}

/// Stitches overlapping photographs, in any order, to a panorama.
///
/// photographs: arrays of uint8 or uint16 (65535 is white), or paths; if one has 16 bits, so has the panorama. camera: the calibrated Camera of all photographs; focal: approximate focal length in px, by default from EXIF or self-calibrated.
/// fov: horizontal field of view in degrees, or (horizontal, vertical); center: (yaw, pitch) in degrees, to the right of the center of the photographs and above the horizon; roll: degrees clockwise.
/// registration: that of a `Panorama` of the same views (or the contents of a file of `cv panorama --save-registration`), used instead of matching; `camera`, `focal`, `mode` and `features` are then ignored.
/// remove, keep: for each photograph a mask of its size (bool, or uint8 with 0 for false) or None, true where it must not be, or must be, in the panorama; `remove` is stronger.
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
    let photographs = photographs::Photograph::each(photographs, Photograph::new)?;
    if arguments.masks.len() > photographs.len() {
        let (masks, photographs) = (arguments.masks.len(), photographs.len());
        return Err(PyValueError::new_err(format!("panorama(): {masks} masks for {photographs} photographs")));
    }
    let sources = photographs.iter().map(Photograph::source).collect::<PyResult<Vec<_>>>()?;
    let found = arguments.run.run(py, |progress| {
        let read: Vec<_> = sources.par_iter().map(|source| source.read()).try_collect().map_err(Ended::File)?;
        if read.iter().any(Read::is_deep) {
            let read: Vec<_> = read.into_par_iter().map(|r| in_depth(r, Read::into_words)).collect();
            arguments.stitch(&read, progress).map(Joined::Words)
        } else {
            let read: Vec<_> = read.into_par_iter().map(|r| in_depth(r, Read::into_bytes)).collect();
            arguments.stitch(&read, progress).map(Joined::Bytes)
        }
    })?;
    match found {
        Joined::Bytes(found) => made(py, found),
        Joined::Words(found) => made(py, found),
    }
}

fn made<T: PhotoSample + Element>(py: Python<'_>, found: PanoramaResult<T>) -> PyResult<Bound<'_, PyAny>> {
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
            ("stacks", object(py, found.stacks)?),
            ("rms", object(py, found.reprojection_rms_px)?),
            ("shows_parallax", object(py, shows_parallax)?),
            ("seconds", results::stages(py, &found.stages)?),
        ],
    )
}
