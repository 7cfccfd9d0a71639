//! Color segmentation.

use crate::arrays::{self, Rgb};
use crate::errors::refused;
use crate::job::Run;
use crate::options::Options;
use crate::results::{self, data, object};
use cv_core::Mask;
use cv_pipeline::segmentation::{ColorModel, ConfusionMatrix, DetectOptions, Labeled, SegmentError, TrainOptions};
use cv_pipeline::{detect, segment, train_segment};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList, PyTuple};

/// Reads the options of `ColorModel`.
pub(crate) fn read(options: &mut Options<'_>) -> PyResult<(TrainOptions, Run)> {
    let mut o = TrainOptions::default();
    options.set_named("space", &mut o.space)?;
    options.set("components", &mut o.components)?;
    options.set("background_components", &mut o.background_components)?;
    options.set_named("rule", &mut o.rule)?;
    options.set("unknown", &mut o.unknown)?;
    options.set("smoothing", &mut o.smoothing)?;
    options.set("regularization", &mut o.regularization)?;
    options.set("open_radius", &mut o.open_radius)?;
    options.set("close_radius", &mut o.close_radius)?;
    options.set_named("regions", &mut o.regions)?;
    options.set("seed", &mut o.seed)?;
    Ok((o, Run::read(options)?))
}

/// Reads the options of `locate`.
pub(crate) fn read_locate(options: &mut Options<'_>) -> PyResult<(DetectOptions, Run)> {
    let mut o = DetectOptions::default();
    options.set("min_score", &mut o.min_score)?;
    Ok((o, Run::read(options)?))
}

/// A fitted model; `epipole.ColorModel` is its public interface.
#[pyclass(frozen, module = "epipole._native", name = "FittedColorModel")]
pub(crate) struct PyColorModel {
    model: ColorModel,
}

#[pymethods]
impl PyColorModel {
    /// Fits a color model; returns it and its training scores by photograph.
    #[staticmethod]
    #[pyo3(signature = (images, masks, **options))]
    fn fit<'py>(
        py: Python<'py>,
        images: &Bound<'py, PyAny>,
        masks: &Bound<'py, PyAny>,
        options: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<(Self, Bound<'py, PyAny>)> {
        let mut options = Options::new("ColorModel", options);
        let (o, run) = read(&mut options)?;
        options.finish()?;
        let images = images.try_iter()?.enumerate().map(|(i, image)| Rgb::new(&image?, &format!("image {i}")));
        let images = images.collect::<PyResult<Vec<_>>>()?;
        let masks = masks.try_iter()?.enumerate().map(|(i, mask)| arrays::mask(&mask?, &format!("mask {i}")));
        let masks: Vec<Mask> = masks.collect::<PyResult<_>>()?;
        if images.len() != masks.len() {
            return Err(PyValueError::new_err(format!(
                "{} images and {} masks differ in number",
                images.len(),
                masks.len()
            )));
        }
        let views = images.iter().map(Rgb::view).collect::<PyResult<Vec<_>>>()?;
        let labeled: Vec<Labeled<'_>> = views.into_iter().zip(masks.iter().map(Mask::view)).collect();
        let trained = run.run(py, |progress| train_segment(&labeled, &o, progress))?.trained;
        let scores = trained.scores.iter().map(|score| confusion(py, score)).collect::<PyResult<Vec<_>>>()?;
        Ok((Self { model: trained.model }, PyTuple::new(py, scores)?.into_any()))
    }

    /// Predicts the mask of the object after morphological clean-up.
    fn predict<'py>(&self, py: Python<'py>, image: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        let image = Rgb::new(image, "image")?;
        let view = image.view()?;
        let found =
            Run::default().run(py, |progress| segment(view, &self.model, progress).map_err(SegmentError::from))?;
        arrays::array(py, found.mask)
    }

    /// Computes the log posterior odds of object and background at each pixel, smoothed by the model's sigma.
    fn log_odds<'py>(&self, py: Python<'py>, image: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        let image = Rgb::new(image, "image")?;
        let view = image.view()?;
        let score = Run::default().run(py, |progress| self.model.score(view, progress).map_err(SegmentError::from))?;
        arrays::array(py, score)
    }

    /// Detects the regions of the object's color, the best first, and the mask of those accepted as the object.
    #[pyo3(signature = (image, **options))]
    fn locate<'py>(
        &self,
        py: Python<'py>,
        image: &Bound<'py, PyAny>,
        options: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let mut options = Options::new("locate", options);
        let (o, run) = read_locate(&mut options)?;
        options.finish()?;
        let image = Rgb::new(image, "image")?;
        let view = image.view()?;
        let found = run.run(py, |progress| detect(view, &self.model, &o, progress))?;
        let objects = PyList::empty(py);
        for one in &found.objects {
            let region = &one.region;
            objects.append(results::made(
                py,
                "Object",
                [
                    ("found", object(py, one.found)?),
                    ("score", object(py, one.score)?),
                    ("center", object(py, (region.center.x, region.center.y))?),
                    ("area", object(py, region.area)?),
                    ("axes", object(py, (region.axes[0], region.axes[1]))?),
                    ("angle", object(py, region.angle)?),
                    ("box", object(py, (region.left, region.top, region.width, region.height))?),
                    ("truncated", object(py, region.truncated)?),
                ],
            )?)?;
        }
        results::made(
            py,
            "Located",
            [
                ("mask", arrays::array(py, found.mask)?),
                ("objects", objects.to_tuple().into_any()),
                ("seconds", results::stages(py, &found.stages)?),
            ],
        )
    }

    /// The threshold on the log odds.
    #[getter]
    fn threshold(&self) -> f32 {
        self.model.threshold()
    }

    /// Serializes the model as the JSON of `cv segment`.
    fn to_json(&self) -> PyResult<String> {
        serde_json::to_string(&self.model).map_err(|error| PyValueError::new_err(error.to_string()))
    }

    /// Deserializes such JSON.
    #[staticmethod]
    fn from_json(text: &str) -> PyResult<Self> {
        let model = serde_json::from_str(text).map_err(|error| PyValueError::new_err(error.to_string()))?;
        Ok(Self { model })
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyAny>, (String,))> {
        let from_json = slf.py().get_type::<Self>().getattr("from_json")?;
        Ok((from_json, (slf.get().to_json()?,)))
    }
}

/// Converts the counts, with precision, recall, F1 and IoU.
fn confusion<'py>(py: Python<'py>, score: &ConfusionMatrix) -> PyResult<Bound<'py, PyAny>> {
    let all = data(py, score)?;
    for (name, value) in
        [("precision", score.precision()), ("recall", score.recall()), ("f1", score.f1()), ("iou", score.iou())]
    {
        all.set_item(name, value)?;
    }
    Ok(all)
}

/// Scores a mask against ground truth: true and false positives and negatives, precision, recall, F1, intersection over union.
///
///     >>> truth = np.arange(8).reshape(2, 4) < 4
///     >>> scores = epipole.evaluate_mask(np.arange(8).reshape(2, 4) < 3, truth)
///     >>> scores["precision"], scores["recall"]
///     (1.0, 0.75)
#[pyfunction]
pub(crate) fn evaluate_mask<'py>(
    py: Python<'py>,
    mask: &Bound<'py, PyAny>,
    truth: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyAny>> {
    let (mask, truth) = (arrays::mask(mask, "mask")?, arrays::mask(truth, "truth")?);
    let score = ConfusionMatrix::new(mask.view(), truth.view()).map_err(|error| refused(py, &error))?;
    confusion(py, &score)
}
