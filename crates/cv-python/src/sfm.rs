//! Cameras and points from many photographs.

use crate::arrays;
use crate::errors::reason;
use crate::job::Run;
use crate::matching::max_features;
use crate::model;
use crate::options::Options;
use crate::photographs::{Ended, Known, Photograph, Source};
use crate::results::{self, object};
use crate::sfm_photograph::PySfmPhotograph;
use cv_core::{Point3, Progress, StageClock};
use cv_pipeline::features::FeatureError;
use cv_pipeline::many_views::{KnownPlaces, ModelAlignError, SfmModel, ViewOutcome, align_model};
use cv_pipeline::{
    Cancelled, SfmCamera, SfmJobError, SfmJobOptions, SfmPhoto, SfmPhotoError, SfmResult, sfm as solve, sfm_photo,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyTuple};
use std::collections::BTreeMap;

/// A photograph, or what was found of it.
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

/// The same for threads without the interpreter.
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
        options.set_named("solver", &mut o.solve.solver)?;
        options.set_named("order", &mut o.order)?;
        options.set("max_error", &mut o.solve.max_error)?;
        o.features = max_features(options, o.features)?;
        let mut seed = o.solve.seed;
        options.set("seed", &mut seed)?;
        (o.solve.seed, o.pairs.seed) = (seed, seed);
        Ok(Self { options: o, known, ignore_exif, names, centers, run: Run::read(options)? })
    }
}

/// The cameras of the photographs so far: one for each size and focal length.
#[derive(Default)]
struct Cameras {
    list: Vec<SfmCamera>,
    /// By size and focal length in thousandths of a pixel.
    known: BTreeMap<(usize, usize, u64), usize>,
}

impl Cameras {
    fn of(&mut self, size: (usize, usize), exif: Option<f64>, known: &Known) -> usize {
        let focal = match known {
            Known::Focal(focal) => Some(*focal),
            Known::Nothing => exif,
            Known::Camera(_) | Known::Matrix(_) => None,
        };
        let key = (size.0, size.1, focal.map_or(0, |f| (f * 1000.0).round() as u64));
        *self.known.entry(key).or_insert_with(|| {
            self.list.push(match (known, known.camera(size)) {
                (Known::Camera(camera), _) => SfmCamera::known(*camera),
                (Known::Matrix(_), Some(camera)) => SfmCamera::of_matrix(camera),
                _ => focal.map_or_else(|| SfmCamera::unknown(size), |focal| SfmCamera::of_focal(size, focal)),
            });
            self.list.len() - 1
        })
    }
}

/// Why a photograph is not looked at.
enum LeftOut {
    Unreadable(String),
    Features(FeatureError),
}

/// What was found, and what became of each photograph.
struct Found {
    result: SfmResult,
    /// What each model was brought to.
    frames: Vec<&'static str>,
    photos: Vec<SfmPhoto>,
    /// Of each photograph that was given: its place among those that were looked at.
    looked_at: Vec<Result<usize, LeftOut>>,
    stages: Vec<(&'static str, f64)>,
}

/// What threads without the interpreter need of the options.
struct Job<'a> {
    options: &'a SfmJobOptions,
    known: &'a Known,
    ignore_exif: bool,
}

impl Job<'_> {
    /// Features, pairs, models.
    fn reconstruct(
        &self,
        sources: &[(View<'_>, String)],
        centers: &[Option<Point3<f64>>],
        progress: &dyn Progress,
    ) -> Result<Found, Ended<SfmJobError>> {
        let stop = |stop: Cancelled| Ended::Job(SfmJobError::Cancelled(stop));
        let (mut clock, mut cameras) = (StageClock::new(), Cameras::default());
        let (mut photos, mut looked_at) = (Vec::new(), Vec::new());
        for (i, (source, name)) in sources.iter().enumerate() {
            let place = Place { progress, done: i, total: sources.len() };
            place.report("", 0, 0).map_err(stop)?;
            let known = |focal: Option<f64>| (focal.filter(|_| !self.ignore_exif), self.known);
            let source = match *source {
                View::Photograph(source) => source,
                View::Features(PySfmPhotograph { photo, focal }) => {
                    let (focal, known) = known(*focal);
                    let camera = cameras.of(photo.size, focal, known);
                    photos.push(SfmPhoto { name: name.clone(), camera, ..photo.clone() });
                    looked_at.push(Ok(photos.len() - 1));
                    continue;
                }
            };
            let (pixels, focal) = match source.read() {
                Ok(read) => read,
                Err(error) => {
                    looked_at.push(Err(LeftOut::Unreadable(error.to_string())));
                    continue;
                }
            };
            let (focal, known) = known(focal);
            let camera = cameras.of(pixels.view().size(), focal, known);
            looked_at.push(match sfm_photo(pixels.view(), name.clone(), camera, &self.options.features, &place) {
                Ok(photo) => {
                    photos.push(photo);
                    Ok(photos.len() - 1)
                }
                Err(SfmPhotoError::Features(FeatureError::Cancelled(cancelled))) => return Err(stop(cancelled)),
                Err(SfmPhotoError::Features(FeatureError::Option(error))) => {
                    return Err(Ended::Job(SfmJobError::Option(error)));
                }
                Err(SfmPhotoError::Features(error)) => Err(LeftOut::Features(error)),
                Err(error) => Err(LeftOut::Unreadable(error.to_string())),
            });
        }
        clock.lap("features");
        let mut result = solve(&photos, &cameras.list, self.options, progress).map_err(Ended::Job)?;
        let centers: Vec<Option<Point3<f64>>> = if centers.is_empty() {
            Vec::new()
        } else {
            looked_at.iter().zip(centers).filter(|(looked, _)| looked.is_ok()).map(|(_, c)| *c).collect()
        };
        let mut frames = Vec::new();
        for model in &mut result.models {
            frames.push(align(model, &centers, self.options.solve.seed, progress).map_err(stop)?);
        }
        clock.lap("align");
        let mut stages = clock.into_stages();
        stages.append(&mut result.stages);
        Ok(Found { result, frames, photos, looked_at, stages })
    }
}

/// Brings a model to known centers of its cameras, or stands it upright; tells which.
fn align(
    model: &mut SfmModel,
    centers: &[Option<Point3<f64>>],
    seed: u64,
    progress: &dyn Progress,
) -> Result<&'static str, Cancelled> {
    let known = KnownPlaces { centers, distances: &[] };
    let found = align_model(model, &known, seed, progress).or_else(|error| match error {
        ModelAlignError::Cancelled(_) => Err(error),
        _ => align_model(model, &KnownPlaces::default(), seed, progress),
    });
    match found {
        Ok(found) => {
            model.transform(&found.similarity);
            Ok(if found.centers.is_some() { "centers" } else { "upright" })
        }
        Err(ModelAlignError::Cancelled(stop)) => Err(stop),
        // It stays in the frame it was found in.
        Err(_) => Ok("any"),
    }
}

/// How many of the photographs have been looked at.
struct Place<'a> {
    progress: &'a dyn Progress,
    done: usize,
    total: usize,
}

impl Progress for Place<'_> {
    fn report(&self, _: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
        self.progress.report("photographs", self.done, self.total)
    }
}

/// Cameras and points from many photographs in any order (structure from motion).
///
/// photographs: arrays of uint8, paths, or what `sfm_features` found of them. camera: a Camera, or a 3×3 matrix where the lens is not known; focal: about the focal length in px; else EXIF tells, or the photographs do.
/// centers: (n, 3), where the cameras stood, NaN where that is not known. Without them models stand upright, Z up, and their unit is arbitrary.
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
        Some(names) => names.clone(),
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
    let named: Vec<(View<'_>, String)> = sources.into_iter().zip(names).collect();
    let job = Job { options: &arguments.options, known: &arguments.known, ignore_exif: arguments.ignore_exif };
    let found = arguments.run.run(py, |progress| job.reconstruct(&named, &centers, progress))?;
    let models: Vec<Bound<'py, PyAny>> = (0..found.result.models.len())
        .filter_map(|m| found.result.sparse_model(m, &found.photos))
        .map(|model| model::made(py, &model))
        .collect::<PyResult<_>>()?;
    let left_out = PyDict::new(py);
    for ((_, name), looked) in named.iter().zip(&found.looked_at) {
        let why = match looked {
            Err(LeftOut::Unreadable(message)) => {
                reason(py, &serde_json::json!({ "Unreadable": { "message": message } }))?
            }
            Err(LeftOut::Features(error)) => reason(py, error)?,
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

/// The files' names, or their whole paths where two have one name; numbers of arrays.
fn names_of(sources: &[View<'_>]) -> Vec<String> {
    let names: Vec<String> = sources.iter().enumerate().map(|(i, s)| s.name(i)).collect();
    let mut sorted = names.clone();
    sorted.sort_unstable();
    if sorted.windows(2).all(|pair| pair[0] != pair[1]) {
        return names;
    }
    let whole = |(source, name): (&View<'_>, String)| match source {
        View::Photograph(Source::File(path)) => path.to_string_lossy().into_owned(),
        _ => name,
    };
    sources.iter().zip(names).map(whole).collect()
}
