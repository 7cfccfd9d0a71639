//! Disparity and depth.

use crate::arrays::{self, ImageArg};
use crate::camera::PyRig;
use crate::errors::refused;
use crate::job::{Run, Shared};
use crate::options::Options;
use crate::rectify::{self, view_options};
use crate::results::{self, data, object};
use crate::{cloud, with_views};
use cv_core::{Cancelled, GrayF32, PointCloud, Progress, RgbU8, StageClock, StereoRig};
use cv_pipeline::stereo::{
    DisparityMap, PixelState, Rectification, RectifyOptions, StereoError, StereoGeometry, StereoMatcher, StereoOptions,
};
use cv_pipeline::{DepthError, DepthOptions, DepthResult, DisparityRange, FrameDepth, RigDepthResult};
use numpy::{PyArray2, PyArrayMethods, PyReadwriteArray2, PyUntypedArrayMethods};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyString};

/// Reads the options of the matcher.
pub(crate) fn matcher_arguments(options: &mut Options<'_>) -> PyResult<(StereoOptions, Run)> {
    let mut o = StereoOptions::default();
    options.set("min_disparity", &mut o.min_disparity)?;
    options.set("disparities", &mut o.disparities)?;
    matching_options(options, &mut o)?;
    options.set("sequence", &mut o.sequence)?;
    Ok((o, Run::read(options)?))
}

/// Reads all options of the matcher except the disparity range.
fn matching_options(options: &mut Options<'_>, o: &mut StereoOptions) -> PyResult<()> {
    options.set_named("census", &mut o.census)?;
    options.set_named("intensity_cost", &mut o.intensity_cost)?;
    options.set("p1", &mut o.p1)?;
    options.set("p2", &mut o.p2)?;
    options.set("p2_min", &mut o.p2_min)?;
    options.set("p2_gradient", &mut o.p2_gradient)?;
    options.set("pyramid_levels", &mut o.pyramid_levels)?;
    options.set_named("search", &mut o.search)?;
    options.set_named("paths", &mut o.paths)?;
    options.set("uniqueness", &mut o.uniqueness)?;
    options.set_optional("left_right", &mut o.left_right)?;
    options.set("speckle_size", &mut o.speckle_size)?;
    options.set("speckle_range", &mut o.speckle_range)?;
    options.set("median", &mut o.median)?;
    options.set_named("smoothing", &mut o.smoothing)?;
    options.set("fill", &mut o.fill)?;
    options.set("ignore_black_borders", &mut o.ignore_black_borders)?;
    options.set("denoise", &mut o.denoise)?;
    options.set("quality", &mut o.quality)?;
    options.set_optional("max_memory", &mut o.max_memory)
}

/// The options of `depth`.
pub(crate) struct DepthArguments {
    options: DepthOptions,
    focal: Option<f64>,
    baseline: Option<f64>,
    offset: f64,
    rig: Option<StereoRig>,
    view: RectifyOptions,
    cloud: bool,
    run: Run,
}

impl DepthArguments {
    pub(crate) fn read(options: &mut Options<'_>) -> PyResult<Self> {
        let mut o = DepthOptions::default();
        let min: Option<i32> = options.take("min_disparity")?;
        o.stereo.min_disparity = min.unwrap_or(o.stereo.min_disparity);
        options.default("disparities", o.stereo.disparities)?;
        if let Some(given) = options.take_any("disparities")? {
            if given.is_instance_of::<PyString>() {
                if given.extract::<String>()? != "auto" {
                    return Err(PyValueError::new_err("depth(): disparities must be a number or “auto”"));
                }
                o.disparities = DisparityRange::Auto { min };
            } else {
                o.stereo.disparities = options.extract("disparities", &given)?;
            }
        }
        matching_options(options, &mut o.stereo)?;
        options.set("confidence", &mut o.stereo.confidence)?;
        let (focal, baseline) = (options.take("focal")?, options.take("baseline")?);
        let mut offset = 0.0;
        options.set("offset", &mut offset)?;
        let rig: Option<Bound<'_, PyRig>> = options.take("rig")?;
        if rig.is_some() && (focal.is_some() || baseline.is_some()) {
            return Err(PyTypeError::new_err(
                "depth() takes a rig, or focal and baseline of a rectified pair, not both",
            ));
        }
        let view = view_options(options)?;
        options.set_named("few_matches", &mut o.few_matches)?;
        options.set("align", &mut o.align)?;
        options.set("near", &mut o.range.0)?;
        options.set("far", &mut o.range.1)?;
        let mut cloud = false;
        options.set("cloud", &mut cloud)?;
        let rig = rig.map(|rig| rig.get().rig);
        Ok(Self { options: o, focal, baseline, offset, rig, view, cloud, run: Run::read(options)? })
    }

    /// Reads the options of a call; an option that does not exist is an error.
    fn finish(options: Option<&Bound<'_, PyDict>>) -> PyResult<Self> {
        let mut options = Options::new("depth", options);
        let arguments = Self::read(&mut options)?;
        options.finish()?;
        Ok(arguments)
    }

    fn rectification(&self, py: Python<'_>) -> PyResult<Option<Rectification>> {
        let rectification = self.rig.map(|rig| Rectification::new(&rig, &self.view)).transpose();
        rectification.map_err(|error| refused(py, &error))
    }

    /// Returns the geometry of the rectified pair, if known.
    fn geometry(
        &self,
        py: Python<'_>,
        rectification: Option<&Rectification>,
        left: &ImageArg<'_>,
    ) -> PyResult<Option<StereoGeometry>> {
        match (rectification, self.focal, self.baseline) {
            (Some(rectification), ..) => Ok(Some(rectification.geometry)),
            (None, None, None) => Ok(None),
            (None, Some(focal), Some(baseline)) => {
                let (width, height, _) = left.shape();
                let geometry = StereoGeometry::from_focal(width, height, focal, baseline);
                let geometry = geometry.map_err(|error| refused(py, &error))?;
                Ok(Some(StereoGeometry { offset: self.offset, ..geometry }))
            }
            _ => Err(PyTypeError::new_err("depth() needs focal and baseline together")),
        }
    }

    /// Creates a matcher of pairs.
    fn frames(
        &self,
        rectification: Option<&Rectification>,
        geometry: Option<StereoGeometry>,
    ) -> Result<FrameDepth, DepthError> {
        let options = self.options.clone();
        match rectification {
            Some(rectification) => FrameDepth::of_rig(options, rectification),
            None => FrameDepth::new(options, geometry),
        }
    }
}

/// Computes the disparity of a stereo pair, and depth if its geometry is known.
///
/// left, right: arrays of one shape (height, width) or (height, width, 3) of uint8, uint16 or float32 (0 to 1), rectified, or unrectified with `rig`. With focal (px) and
/// baseline, or a rig, depth is in the unit of the baseline. `defaults("depth")` lists the options.
///
///     >>> scene = np.random.default_rng(0).integers(0, 256, (60, 112), np.uint8)
///     >>> found = epipole.depth(scene[:, :100], scene[:, 12:], disparities=32, focal=500.0, baseline=0.24)
///     >>> round(float(np.median(found.disparity))), round(float(np.median(found.depth)))
///     (12, 10)
///
/// Raises NoPairError if too few pixels are matched, and other exceptions of epipole.errors.
#[pyfunction]
#[pyo3(signature = (left, right, **options))]
pub(crate) fn depth<'py>(
    py: Python<'py>,
    left: &Bound<'py, PyAny>,
    right: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let arguments = DepthArguments::finish(options)?;
    let (left, right) = (ImageArg::new(left, "left")?, ImageArg::new(right, "right")?);
    let rectification = arguments.rectification(py)?;
    let geometry = arguments.geometry(py, rectification.as_ref(), &left)?;
    let result = with_views!(py, [left, right], |a, b| arguments.run.run(py, |progress| {
        if rectification.is_none() && !arguments.cloud {
            let found = cv_pipeline::depth(a, b, geometry.as_ref(), &arguments.options, progress)?;
            return Ok::<_, DepthError>((Found::new(found), None, None));
        }
        let mut frames = arguments.frames(rectification.as_ref(), geometry)?;
        let RigDepthResult { images, maps, cloud } = frames.next_depth(a, b, arguments.cloud, progress)?;
        Ok((Found::new(maps), rectification.map(|_| images), arguments.cloud.then_some(cloud)))
    }))?;
    made(py, result, geometry)
}

/// [`depth()`] over many pairs, which need not be of one film: the memory is reused, and the warp maps of a rig are computed once. Used by the workers of `epipole.ray`.
#[pyclass(frozen, module = "epipole._native", name = "PairDepth")]
pub(crate) struct PyPairDepth {
    arguments: DepthArguments,
    rectification: Option<Rectification>,
    /// The buffers, and the size of the images that they are for.
    worker: Shared<Option<((usize, usize), FrameDepth)>>,
}

#[pymethods]
impl PyPairDepth {
    #[new]
    #[pyo3(signature = (**options))]
    fn new(py: Python<'_>, options: Option<&Bound<'_, PyDict>>) -> PyResult<Self> {
        let arguments = DepthArguments::finish(options)?;
        let rectification = arguments.rectification(py)?;
        Ok(Self { arguments, rectification, worker: Shared::new(None) })
    }

    /// As `depth`.
    fn compute<'py>(
        &self,
        py: Python<'py>,
        left: &Bound<'py, PyAny>,
        right: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let Self { arguments, rectification, worker } = self;
        let (left, right) = (ImageArg::new(left, "left")?, ImageArg::new(right, "right")?);
        let geometry = arguments.geometry(py, rectification.as_ref(), &left)?;
        let result = with_views!(py, [left, right], |a, b| arguments.run.run(py, |progress: &dyn Progress| {
            let mut taken = worker.take(progress)?;
            let Some(kept) = taken.get() else { return Err(Cancelled.into()) };
            let mut frames = match kept.take() {
                Some((size, frames)) if size == a.size() => frames,
                _ => arguments.frames(rectification.as_ref(), geometry)?,
            };
            frames.forget();
            let result = frames.next_depth(a, b, arguments.cloud, progress);
            *kept = Some((a.size(), frames));
            let RigDepthResult { images, maps, cloud } = result?;
            Ok::<_, DepthError>((Found::new(maps), rectification.map(|_| images), arguments.cloud.then_some(cloud)))
        }))?;
        made(py, result, geometry)
    }
}

/// A tuple in Python, where an array would be a list.
type Coefficients = (f64, f64, f64, f64, f64, f64);

/// Makes the Python result.
fn made<'py>(
    py: Python<'py>,
    (found, images, cloud): (Found, Option<[RgbU8; 2]>, Option<PointCloud>),
    geometry: Option<StereoGeometry>,
) -> PyResult<Bound<'py, PyAny>> {
    let Found { depth: found, state, depth_deviation, valid, matched, stages } = found;
    let (width, height) = found.map.disparity.size();
    let none = || object(py, py.None());
    let map = |map: Option<GrayF32>| map.map_or_else(none, |map| arrays::array(py, map));
    results::made(
        py,
        "Depth",
        [
            ("state", arrays::shaped(py, state, &[height, width])?),
            ("disparity", arrays::array(py, found.map.disparity)?),
            ("disparity_deviation", arrays::array(py, found.sigma)?),
            ("depth", map(found.depth)?),
            ("depth_deviation", map(depth_deviation)?),
            ("confidence", map(found.confidence)?),
            ("Q", geometry.map_or_else(none, |geometry| rectify::q(py, &geometry.q()))?),
            (
                "images",
                images
                    .map_or_else(none, |[one, two]| object(py, (arrays::array(py, one)?, arrays::array(py, two)?)))?,
            ),
            ("cloud", cloud.map_or_else(none, |cloud| cloud::made(py, cloud))?),
            ("few_matches", object(py, found.feature_agreement.map(|few| (few.agree, few.seen)))?),
            (
                "vertical_offset",
                object(py, found.vertical_offset.map(|offset| Coefficients::from(offset.coefficients())))?,
            ),
            ("disparities", object(py, found.disparities)?),
            ("valid_fraction", object(py, valid)?),
            ("matched_fraction", object(py, matched)?),
            ("seconds", results::stages(py, &stages)?),
        ],
    )
}

/// The result, computed with the GIL released.
struct Found {
    depth: DepthResult,
    /// State of each pixel: 0 matched, 1 occluded, 2 mismatched, 3 out of view, 4 without data.
    state: Vec<u8>,
    depth_deviation: Option<GrayF32>,
    valid: f64,
    matched: f64,
    stages: Vec<(&'static str, f64)>,
}

impl Found {
    fn new(mut depth: DepthResult) -> Self {
        let mut clock = StageClock::new();
        let state = depth.map.state.as_slice().iter().map(|state: &PixelState| *state as u8).collect();
        let (valid, matched) = (depth.map.valid_fraction(), depth.map.matched_fraction());
        let depth_deviation = depth.depth_sigma();
        clock.lap("deviation");
        let mut stages = std::mem::take(&mut depth.stages);
        stages.append(&mut clock.into_stages());
        Self { depth, state, depth_deviation, valid, matched, stages }
    }
}

/// A matcher and its output buffer.
struct Worker {
    matcher: StereoMatcher,
    map: DisparityMap,
}

/// Semi-global matching with buffers reused between pairs, for video. With `sequence=True` the pairs are consecutive frames, and noise is averaged over time
/// where an image does not change.
///
/// Threads may share a matcher; they use it one at a time.
///
///     >>> scene = np.random.default_rng(0).integers(0, 256, (60, 112), np.uint8)
///     >>> matcher, disparity = epipole.StereoMatcher(disparities=32), np.empty((60, 100), np.float32)
///     >>> disparity is matcher.compute(scene[:, :100], scene[:, 12:], out=disparity)
///     True
///     >>> round(float(np.median(disparity)))
///     12
#[pyclass(frozen, module = "epipole", name = "StereoMatcher")]
pub(crate) struct PyStereoMatcher {
    worker: Shared<Worker>,
    run: Run,
}

#[pymethods]
impl PyStereoMatcher {
    #[new]
    #[pyo3(signature = (**options))]
    fn new(py: Python<'_>, options: Option<&Bound<'_, PyDict>>) -> PyResult<Self> {
        let mut options = Options::new("StereoMatcher", options);
        let (stereo, run) = matcher_arguments(&mut options)?;
        options.finish()?;
        let matcher = StereoMatcher::new(stereo).map_err(|error| refused(py, &error))?;
        Ok(Self { worker: Shared::new(Worker { matcher, map: DisparityMap::empty() }), run })
    }

    /// Computes the disparities of a rectified pair as an array of float32, invalid NaN; written to `out` if given.
    #[pyo3(signature = (left, right, *, out = None))]
    fn compute<'py>(
        &self,
        py: Python<'py>,
        left: &Bound<'py, PyAny>,
        right: &Bound<'py, PyAny>,
        out: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let (left, right) = (ImageArg::new(left, "left")?, ImageArg::new(right, "right")?);
        let (width, height, _) = left.shape();
        let mut given = out.map(|out| writable(out, (width, height))).transpose()?;
        let target = match &mut given {
            Some(array) => Some(array.as_slice_mut().map_err(|_| PyValueError::new_err("out must be C-contiguous"))?),
            None => None,
        };
        let fresh = with_views!(py, [left, right], |a, b| self.run.run(py, |progress: &dyn Progress| {
            let mut taken = self.worker.take(progress)?;
            let Some(Worker { matcher, map }) = taken.get() else { return Err(Cancelled.into()) };
            matcher.compute_into(a, b, map, progress)?;
            Ok::<_, StereoError>(match target {
                Some(target) => {
                    target.copy_from_slice(map.disparity.as_slice());
                    None
                }
                None => Some(map.disparity.clone()),
            })
        }))?;
        match (fresh, out) {
            (Some(map), _) => arrays::array(py, map),
            (None, Some(out)) => Ok(out.clone()),
            (None, None) => Err(crate::errors::internal("no disparities")),
        }
    }
}

/// Borrows an array to write a map of that size to.
fn writable<'py>(out: &Bound<'py, PyAny>, (width, height): (usize, usize)) -> PyResult<PyReadwriteArray2<'py, f32>> {
    let Ok(array) = out.cast::<PyArray2<f32>>() else {
        return Err(PyTypeError::new_err("out must be an array of float32 and two dimensions"));
    };
    if array.shape() != [height, width] {
        let text = format!("out has shape {:?} where ({height}, {width}) is needed", array.shape());
        return Err(PyValueError::new_err(text));
    }
    if !array.is_c_contiguous() {
        return Err(PyValueError::new_err("out must be C-contiguous"));
    }
    array.try_readwrite().map_err(|_| PyValueError::new_err("out is read-only or in use"))
}

/// Scores a disparity map against ground truth, over the pixels of `mask` with finite ground truth.
///
///     >>> scores = epipole.evaluate_disparity(np.full((2, 2), 8.5, np.float32), np.full((2, 2), 8.0, np.float32))
///     >>> scores["average"], scores["bad"][0]
///     (0.5, 0.0)
#[pyfunction]
#[pyo3(signature = (estimate, truth, *, mask = None))]
pub(crate) fn evaluate_disparity<'py>(
    py: Python<'py>,
    estimate: &Bound<'py, PyAny>,
    truth: &Bound<'py, PyAny>,
    mask: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyAny>> {
    let (estimate, truth) = (arrays::map(estimate, "estimate")?, arrays::map(truth, "truth")?);
    let mask = mask.map(|mask| arrays::mask(mask, "mask")).transpose()?;
    let scores =
        cv_pipeline::stereo::evaluate_disparity(estimate.view(), truth.view(), mask.as_ref().map(|mask| mask.view()))
            .map_err(|error| refused(py, &error))?;
    data(py, &scores)
}
