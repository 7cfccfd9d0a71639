//! Feature extraction and matching.

use crate::arrays::{self, Rgb};
use crate::job::Run;
use crate::options::Options;
use crate::results::{self, object};
use cv_core::Keypoint;
use cv_pipeline::features::{DescriptorKind, Descriptors};
use cv_pipeline::{
    FeatureMethod, FeatureOptions, Features, MatchingOptions, MatchingResult, extract_features as extract,
    match_extracted, match_photos,
};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Reads `features` and `max_features`.
pub(crate) fn feature_options(options: &mut Options<'_>) -> PyResult<FeatureOptions> {
    let method = feature_method(options)?;
    max_features(options, method.into())
}

/// Reads `features`.
pub(crate) fn feature_method(options: &mut Options<'_>) -> PyResult<FeatureMethod> {
    let mut method = FeatureMethod::default();
    options.set_named("features", &mut method)?;
    Ok(method)
}

/// Reads `max_features` and limits the number of features.
pub(crate) fn max_features(options: &mut Options<'_>, features: FeatureOptions) -> PyResult<FeatureOptions> {
    Ok(match options.take("max_features")? {
        Some(most) => features.at_most(most),
        None => features,
    })
}

/// Reads the options of `extract_features`.
pub(crate) fn read_extraction(options: &mut Options<'_>) -> PyResult<(FeatureOptions, Run)> {
    Ok((feature_options(options)?, Run::read(options)?))
}

/// Reads the options of `match`.
pub(crate) fn read_match(options: &mut Options<'_>) -> PyResult<(MatchingOptions, Run)> {
    let mut o = MatchingOptions::default();
    options.set("mutual", &mut o.mutual)?;
    o.guided = options.take_named("guided")?;
    options.set("seed", &mut o.seed)?;
    Ok((o, Run::read(options)?))
}

/// The options of `match_features`.
pub(crate) struct Arguments {
    options: MatchingOptions,
    run: Run,
}

impl Arguments {
    pub(crate) fn read(options: &mut Options<'_>) -> PyResult<Self> {
        let mut o = MatchingOptions { features: feature_options(options)?, ..MatchingOptions::default() };
        options.set("mutual", &mut o.mutual)?;
        options.set_named("affine_simulation", &mut o.affine_simulation)?;
        o.guided = options.take_named("guided")?;
        options.set("seed", &mut o.seed)?;
        Ok(Self { options: o, run: Run::read(options)? })
    }
}

/// Extracts and matches the features of two images. The matches are tentative; `estimate_homography` and `estimate_fundamental` reject outliers.
///
/// a, b: arrays of uint8 of shape (height, width) or (height, width, 3). `defaults("match_features")` lists the options.
///
///     >>> image = np.kron(np.random.default_rng(0).integers(0, 256, (40, 50)), np.ones((6, 6))).astype(np.uint8)
///     >>> found = epipole.match_features(image[:, :280], image[:, 20:])
///     >>> len(found) > 500, float(np.median(found.points[:, 0] - found.points[:, 2]))
///     (True, 20.0)
#[pyfunction]
#[pyo3(signature = (a, b, **options))]
pub(crate) fn match_features<'py>(
    py: Python<'py>,
    a: &Bound<'py, PyAny>,
    b: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let mut options = Options::new("match_features", options);
    let arguments = Arguments::read(&mut options)?;
    options.finish()?;
    let (a, b) = (Rgb::new(a, "a")?, Rgb::new(b, "b")?);
    let views = (a.view()?, b.view()?);
    let found = arguments.run.run(py, |progress| match_photos(views.0, views.1, &arguments.options, progress))?;
    matches(py, &found)
}

/// Converts keypoints to rows x, y, scale, angle, response.
pub(crate) fn keypoints<'py>(py: Python<'py>, keypoints: &[Keypoint]) -> PyResult<Bound<'py, PyAny>> {
    let rows: Vec<[f32; 5]> =
        keypoints.iter().map(|k| [k.position.x, k.position.y, k.scale, k.angle, k.response]).collect();
    arrays::row_array(py, &rows)
}

/// Converts such rows to keypoints.
pub(crate) fn keypoints_from(given: &Bound<'_, PyAny>) -> PyResult<Vec<Keypoint>> {
    let rows: Vec<[f64; 5]> = arrays::rows(given, "keypoints")?;
    let keypoint = |[x, y, scale, angle, response]: [f64; 5]| Keypoint {
        scale: scale as f32,
        angle: angle as f32,
        ..Keypoint::new(x as f32, y as f32, response as f32)
    };
    Ok(rows.into_iter().map(keypoint).collect())
}

fn matches<'py>(py: Python<'py>, found: &MatchingResult) -> PyResult<Bound<'py, PyAny>> {
    let points: Vec<[f64; 4]> = found.pairs().iter().map(|p| [p.a.x, p.a.y, p.b.x, p.b.y]).collect();
    let indices: Vec<[u32; 2]> = found.matches.iter().map(|m| [m.query, m.train]).collect();
    let ratios: Vec<f32> = found.matches.iter().map(|m| m.ratio).collect();
    let [a, b] = &found.features;
    results::made(
        py,
        "Matches",
        [
            ("points", arrays::row_array(py, &points)?),
            ("indices", arrays::row_array(py, &indices)?),
            ("ratios", arrays::shaped(py, ratios, &[points.len()])?),
            ("keypoints", object(py, (keypoints(py, &a.keypoints)?, keypoints(py, &b.keypoints)?))?),
            ("seconds", results::stages(py, &found.stages)?),
        ],
    )
}

/// Extracts the features of an image: keypoints and descriptors, for `match`.
///
/// image: an array of uint8 of shape (height, width) or (height, width, 3). `defaults("extract_features")` lists the options.
///
///     >>> image = np.kron(np.random.default_rng(0).integers(0, 256, (40, 50)), np.ones((6, 6))).astype(np.uint8)
///     >>> found = epipole.extract_features(image, max_features=300)
///     >>> found.kind, found.descriptors.shape[1], len(found) <= 300
///     ('rootsift', 128, True)
#[pyfunction]
#[pyo3(signature = (image, **options))]
pub(crate) fn extract_features<'py>(
    py: Python<'py>,
    image: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let mut options = Options::new("extract_features", options);
    let (o, run) = read_extraction(&mut options)?;
    options.finish()?;
    let image = Rgb::new(image, "image")?;
    let view = image.view()?;
    let found = run.run(py, |progress| extract(view, &o, progress))?;
    let rows = found.descriptors.as_slice().to_vec();
    results::made(
        py,
        "Features",
        [
            ("keypoints", keypoints(py, &found.keypoints)?),
            ("descriptors", arrays::shaped(py, rows, &[found.keypoints.len(), found.descriptors.dimension()])?),
            ("kind", object(py, found.descriptors.kind().name)?),
        ],
    )
}

/// Converts features of `extract_features` or of another program; of foreign descriptors only the dimension is known.
fn features(given: &Bound<'_, PyAny>, what: &str) -> PyResult<Features> {
    let kind: String = given.getattr("kind")?.extract()?;
    let keypoints = keypoints_from(&given.getattr("keypoints")?)?;
    let (numbers, columns) = arrays::table(&given.getattr("descriptors")?, "descriptors")?;
    let own = DescriptorKind::BUILT_IN.into_iter().find(|own| own.name == kind && own.dimension == columns);
    let kind = own.unwrap_or(DescriptorKind::foreign(columns.max(1)));
    let rows = numbers.len() / columns.max(1);
    if rows != keypoints.len() {
        let text = format!("{what} has {} keypoints and {rows} descriptors", keypoints.len());
        return Err(PyValueError::new_err(text));
    }
    let descriptors = Descriptors::from_vec(kind, numbers)
        .ok_or_else(|| PyValueError::new_err(format!("{what}: the descriptors are not rows of {columns} numbers")))?;
    let mut all = Features::new(kind);
    all.keypoints = keypoints;
    all.descriptors = descriptors;
    Ok(all)
}

/// Matches the features of two images; the matches are tentative. a, b: `Features`, from `extract_features` or another program.
///
///     >>> image = np.kron(np.random.default_rng(0).integers(0, 256, (40, 50)), np.ones((6, 6))).astype(np.uint8)
///     >>> a, b = epipole.extract_features(image[:, :280]), epipole.extract_features(image[:, 20:])
///     >>> found = epipole.match(a, b)
///     >>> bool(np.array_equal(found.points[:, :2], a.keypoints[found.indices[:, 0], :2]))
///     True
#[pyfunction]
#[pyo3(name = "match", signature = (a, b, **options))]
pub(crate) fn match_<'py>(
    py: Python<'py>,
    a: &Bound<'py, PyAny>,
    b: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let mut options = Options::new("match", options);
    let (o, run) = read_match(&mut options)?;
    options.finish()?;
    let both = [features(a, "a")?, features(b, "b")?];
    let found = run.run(py, |progress| match_extracted(both, &o, progress))?;
    matches(py, &found)
}
