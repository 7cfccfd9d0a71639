//! Structure from motion.

use crate::arrays;
use crate::errors::reason;
use crate::job::Run;
use crate::matching::max_features;
use crate::model;
use crate::options::Options;
use crate::photographs::{Ended, Known, Photograph, Source};
use crate::results::{self, object};
use crate::sfm_photograph::PySfmPhotograph;
use cv_core::{ImageView, Point3, Progress, StageClock};
use cv_pipeline::features::FeatureError;
use cv_pipeline::many_views::{KnownPlaces, ModelAlignError, SfmModel, ViewOutcome};
use cv_pipeline::{
    Cancelled, GpsFix, OtherSize, PhotoProgress, SfmCamera, SfmCameras, SfmJobError, SfmJobOptions, SfmPhoto,
    SfmPhotoError, SfmResult, gps_centers, place_model, sfm as solve, sfm_photo,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use std::collections::BTreeSet;
use std::convert::Infallible;

/// An input photograph, or its precomputed features.
enum Given<'py> {
    Photograph(Photograph<'py>),
    Features(Bound<'py, PySfmPhotograph>),
}

impl<'py> Given<'py> {
    fn all(given: &Bound<'py, PyAny>) -> PyResult<Vec<Self>> {
        Photograph::each(given, |one, what| match one.cast::<PySfmPhotograph>() {
            Ok(features) => Ok(Self::Features(features.clone())),
            Err(_) => Photograph::new(one, what).map(Self::Photograph),
        })
    }

    fn source(&self) -> PyResult<View<'_>> {
        Ok(match self {
            Self::Photograph(photograph) => View::Photograph(photograph.source()?),
            Self::Features(features) => View::Features(features.get()),
        })
    }
}

/// An input that can be used with the GIL released.
#[derive(Clone, Copy)]
enum View<'a> {
    Photograph(Source<'a>),
    Features(&'a PySfmPhotograph),
}

impl View<'_> {
    fn name(self, index: usize) -> String {
        match self {
            Self::Photograph(source) => source.name(index).into_owned(),
            Self::Features(features) if features.photo.name.is_empty() => index.to_string(),
            Self::Features(features) => features.photo.name.clone(),
        }
    }
}

/// The options of `sfm`.
pub(crate) struct Arguments<'py> {
    options: SfmJobOptions,
    known: Known,
    ignore_exif: bool,
    names: Option<Vec<String>>,
    centers: Option<Bound<'py, PyAny>>,
    distances: Vec<(usize, usize, f64)>,
    ignore_gps: bool,
    run: Run,
}

impl<'py> Arguments<'py> {
    pub(crate) fn read(options: &mut Options<'py>) -> PyResult<Self> {
        let mut o = SfmJobOptions::default();
        let known = Known::read(options)?;
        let mut ignore_exif = false;
        options.set("ignore_exif", &mut ignore_exif)?;
        let names = options.take("names")?;
        let centers = options.take_any("centers")?;
        let distances = options.take("distances")?.unwrap_or_default();
        let mut ignore_gps = false;
        options.set("ignore_gps", &mut ignore_gps)?;
        options.set_named("solver", &mut o.solve.solver)?;
        options.set_named("order", &mut o.order)?;
        options.set("max_error", &mut o.solve.max_error)?;
        o.features = max_features(options, o.features)?;
        let mut seed = o.solve.seed;
        options.set("seed", &mut seed)?;
        (o.solve.seed, o.pairs.seed) = (seed, seed);
        Ok(Self { options: o, known, ignore_exif, names, centers, distances, ignore_gps, run: Run::read(options)? })
    }
}

/// Why a photograph is not used.
enum LeftOut {
    Unreadable(String),
    Features(FeatureError),
    Camera(OtherSize),
}

/// The result of a job, and the outcome of each photograph.
struct Found {
    result: SfmResult,
    /// The frame of each model.
    frames: Vec<&'static str>,
    photos: Vec<SfmPhoto>,
    /// For each input photograph: its index among the used ones, or why it is not used.
    used: Vec<Result<usize, LeftOut>>,
    stages: Vec<(&'static str, f64)>,
}

/// The options that are used with the GIL released.
struct Job<'a> {
    options: &'a SfmJobOptions,
    known: &'a Known,
    ignore_exif: bool,
}

impl Job<'_> {
    /// Extracts features, matches pairs and reconstructs models.
    fn reconstruct(
        &self,
        sources: &[(View<'_>, String)],
        places: &Places,
        progress: &dyn Progress,
    ) -> Result<Found, Ended<SfmJobError>> {
        let stop = |stop: Cancelled| Ended::Job(SfmJobError::Cancelled(stop));
        let (mut clock, mut cameras) = (StageClock::new(), SfmCameras::default());
        let (mut photos, mut used, mut fixes) = (Vec::new(), Vec::new(), vec![None; sources.len()]);
        for (i, (source, name)) in sources.iter().enumerate() {
            let place = PhotoProgress { progress, done: i, total: sources.len() };
            place.report("", 0, 0).map_err(stop)?;
            let extracted = match *source {
                View::Features(PySfmPhotograph { photo, exif }) => {
                    fixes[i] = exif.gps;
                    self.camera(&mut cameras, photo.size, exif.focal).map(|camera| SfmPhoto {
                        name: name.clone(),
                        camera,
                        ..photo.clone()
                    })
                }
                View::Photograph(source) => match source.read_with_exif() {
                    Err(error) => Err(LeftOut::Unreadable(error.to_string())),
                    Ok((pixels, exif)) => {
                        fixes[i] = exif.gps;
                        // Checked before the expensive extraction.
                        match self.camera(&mut cameras, pixels.view().size(), exif.focal) {
                            Ok(camera) => self.extract(pixels.view(), name, camera, &place)?,
                            Err(reason) => Err(reason),
                        }
                    }
                },
            };
            used.push(extracted.map(|photo| {
                photos.push(photo);
                photos.len() - 1
            }));
        }
        clock.lap("features");
        let mut result = solve(&photos, cameras.list(), self.options, progress).map_err(Ended::Job)?;
        let mut frames = Vec::new();
        for model in &mut result.models {
            frames.push(places.place(model, (&fixes, &used), self.options.solve.seed, progress).map_err(stop)?);
        }
        clock.lap("align");
        let mut stages = clock.into_stages();
        stages.append(&mut result.stages);
        Ok(Found { result, frames, photos, used, stages })
    }

    /// Returns the index of the camera of a photograph with that size and EXIF focal length.
    fn camera(&self, cameras: &mut SfmCameras, size: (usize, usize), exif: Option<f64>) -> Result<usize, LeftOut> {
        let focal = match self.known {
            Known::Focal(focal) => Some(*focal),
            Known::Nothing => exif.filter(|_| !self.ignore_exif),
            Known::Camera(_) | Known::Matrix(_) => None,
        };
        let given = match (self.known, self.known.camera(size)) {
            (Known::Camera(camera), _) => Some(SfmCamera::known(*camera)),
            (Known::Matrix(_), Some(camera)) => Some(SfmCamera::from_matrix(camera)),
            _ => None,
        };
        let Ok(found) = cameras.get_or_add(size, focal, || Ok::<_, Infallible>(given));
        found.map_err(LeftOut::Camera)
    }

    /// Extracts the features of a photograph, or returns why it is left out.
    fn extract(
        &self,
        pixels: ImageView<'_, u8, 3>,
        name: &str,
        camera: usize,
        progress: &dyn Progress,
    ) -> Result<Result<SfmPhoto, LeftOut>, Ended<SfmJobError>> {
        let ends = |error: SfmJobError| Err(Ended::Job(error));
        match sfm_photo(pixels, name.to_owned(), camera, &self.options.features, progress) {
            Ok(photo) => Ok(Ok(photo)),
            Err(SfmPhotoError::Features(FeatureError::Cancelled(stop))) => ends(stop.into()),
            Err(SfmPhotoError::Features(FeatureError::Option(error))) => ends(error.into()),
            Err(SfmPhotoError::Features(error)) => Ok(Err(LeftOut::Features(error))),
            Err(error) => Ok(Err(LeftOut::Unreadable(error.to_string()))),
        }
    }
}

/// Known camera positions and distances.
struct Places {
    /// Given camera centers, by input photograph; empty if none are given.
    centers: Vec<Option<Point3<f64>>>,
    /// Pairs of input photographs and the distance of their centers.
    distances: Vec<(usize, usize, f64)>,
    ignore_gps: bool,
}

impl Places {
    /// Aligns a model to them, or upright, and returns the name of its frame. `fixes` and `used`: GPS position and view of each input photograph.
    fn place(
        &self,
        model: &mut SfmModel,
        (fixes, used): (&[Option<GpsFix>], &[Result<usize, LeftOut>]),
        seed: u64,
        progress: &dyn Progress,
    ) -> Result<&'static str, Cancelled> {
        let gps = if self.centers.is_empty() && !self.ignore_gps { gps_centers(fixes) } else { None };
        let (all, by) = gps.map_or((self.centers.clone(), "centers"), |gps| (gps.centers, "gps"));
        let centers: Vec<Option<Point3<f64>>> =
            used.iter().zip(all).filter(|(view, _)| view.is_ok()).map(|(_, center)| center).collect();
        let view = |at: usize| {
            used[at].as_ref().ok().copied().filter(|view| model.poses.get(*view).is_some_and(Option::is_some))
        };
        let distances: Vec<(usize, usize, f64)> =
            self.distances.iter().filter_map(|&(a, b, length)| Some((view(a)?, view(b)?, length))).collect();
        let known = KnownPlaces { centers: &centers, distances: &distances };
        match place_model(model, &known, seed, progress) {
            Ok(placed) if placed.alignment.centers.is_some() => Ok(by),
            Ok(placed) if placed.alignment.metric => Ok("distances"),
            Ok(_) => Ok("upright"),
            Err(ModelAlignError::Cancelled(stop)) => Err(stop),
            // The model stays in its initial frame.
            Err(_) => Ok("any"),
        }
    }
}

/// Reconstructs camera poses and points from many photographs in any order (structure from motion).
///
/// photographs: arrays of uint8, paths, or results of `sfm_features`. camera: a Camera, or a 3×3 matrix if the distortion is unknown; focal: approximate focal length in px, by default from EXIF or self-calibrated.
/// A photograph that cannot be read, or whose size is not that of the camera, is left out.
/// centers: (n, 3), known camera centers, NaN if unknown; distances: (i, j, length) between the centers of photographs i and j. Without centers, a model with three or more GPS positions in EXIF
/// is georeferenced in meters, X east, Y north, Z up. Otherwise it is upright, Z up, in the unit of the distances, or of arbitrary scale.
/// `defaults("sfm")` lists the options.
#[pyfunction]
#[pyo3(signature = (photographs, **options))]
pub(crate) fn sfm<'py>(
    py: Python<'py>,
    photographs: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let mut options = Options::new("sfm", options);
    let arguments = Arguments::read(&mut options)?;
    options.finish()?;
    let photographs = Given::all(photographs)?;
    let count = photographs.len();
    let sources = photographs.iter().map(Given::source).collect::<PyResult<Vec<_>>>()?;
    let names = match &arguments.names {
        Some(names) if names.len() != count => {
            return Err(PyValueError::new_err(format!("{} names for {count} photographs", names.len())));
        }
        Some(names) => {
            if let Some(twice) = find_duplicate(names) {
                return Err(PyValueError::new_err(format!("names: “{twice}” is used twice")));
            }
            names.clone()
        }
        None => names_of(&sources),
    };
    let centers: Vec<Option<Point3<f64>>> = match &arguments.centers {
        None => Vec::new(),
        Some(given) => {
            let rows: Vec<[f64; 3]> = arrays::rows(given, "centers")?;
            if rows.len() != count {
                return Err(PyValueError::new_err(format!("{} centers for {count} photographs", rows.len())));
            }
            rows.into_iter().map(|row| row.iter().all(|v| v.is_finite()).then(|| row.into())).collect()
        }
    };
    if let Some((a, b, length)) = arguments
        .distances
        .iter()
        .find(|(a, b, length)| *a >= count || *b >= count || a == b || !(*length > 0.0 && length.is_finite()))
    {
        let text =
            format!("distances: ({a}, {b}, {length}) is not a pair of the {count} photographs and a positive length");
        return Err(PyValueError::new_err(text));
    }
    let places = Places { centers, distances: arguments.distances.clone(), ignore_gps: arguments.ignore_gps };
    let named: Vec<(View<'_>, String)> = sources.into_iter().zip(names).collect();
    let job = Job { options: &arguments.options, known: &arguments.known, ignore_exif: arguments.ignore_exif };
    let found = arguments.run.run(py, |progress| job.reconstruct(&named, &places, progress))?;
    let models: Vec<Bound<'py, PyAny>> = (0..found.result.models.len())
        .filter_map(|m| found.result.sparse_model(m, &found.photos))
        .map(|model| model::made(py, &model))
        .collect::<PyResult<_>>()?;
    let left_out = PyDict::new(py);
    for ((_, name), view) in named.iter().zip(&found.used) {
        let why = match view {
            Err(LeftOut::Unreadable(message)) => {
                reason(py, &serde_json::json!({ "Unreadable": { "message": message } }))?
            }
            Err(LeftOut::Features(error)) => reason(py, error)?,
            Err(LeftOut::Camera(error)) => reason(py, &serde_json::json!({ "CameraSize": error }))?,
            Ok(at) => match &found.result.outcomes[*at] {
                ViewOutcome::Registered { .. } => continue,
                outcome => reason(py, outcome)?,
            },
        };
        left_out.set_item(name, why)?;
    }
    let solvers = found.result.solvers.iter().map(ToString::to_string).collect::<Vec<_>>();
    results::made(
        py,
        "SfmResult",
        [
            ("models", PyTuple::new(py, models)?.into_any()),
            ("solvers", PyTuple::new(py, solvers)?.into_any()),
            ("frames", PyTuple::new(py, found.frames)?.into_any()),
            ("left_out", left_out.into_any()),
            ("pairs", object(py, found.result.pairs.len())?),
            ("refused_pairs", object(py, found.result.refused.len())?),
            ("seconds", results::stages(py, &found.stages)?),
        ],
    )
}

/// Finds a duplicate name.
fn find_duplicate(names: &[String]) -> Option<&String> {
    let mut sorted: Vec<&String> = names.iter().collect();
    sorted.sort_unstable();
    sorted.windows(2).find(|pair| pair[0] == pair[1]).map(|pair| pair[0])
}

/// Returns file names, or paths if they are not unique; indices of arrays. Remaining duplicates are numbered.
fn names_of(sources: &[View<'_>]) -> Vec<String> {
    let mut names: Vec<String> = sources.iter().enumerate().map(|(i, s)| s.name(i)).collect();
    if find_duplicate(&names).is_some() {
        for (source, name) in sources.iter().zip(&mut names) {
            if let View::Photograph(Source::File(path)) = source {
                *name = path.to_string_lossy().into_owned();
            }
        }
    }
    let mut taken = BTreeSet::new();
    for name in &mut names {
        let numbered = |n: usize| if n == 1 { name.clone() } else { format!("{name}#{n}") };
        if let Some(free) = (1..).map(numbered).find(|name| !taken.contains(name)) {
            *name = free;
        }
        taken.insert(name.clone());
    }
    names
}
