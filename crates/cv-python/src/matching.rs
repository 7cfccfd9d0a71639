//! The same points in two photographs.

use crate::arrays::{self, Rgb};
use crate::job::Run;
use crate::options::Options;
use crate::results::{self, object};
use cv_pipeline::{FeatureMethod, MatchingOptions, match_photos};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// The options of `match_features`.
pub(crate) struct Arguments {
    options: MatchingOptions,
    run: Run,
}

impl Arguments {
    pub(crate) fn read(options: &mut Options<'_>) -> PyResult<Self> {
        let mut method = FeatureMethod::default();
        options.set_named("features", &mut method)?;
        let mut o = MatchingOptions { features: method.into(), ..MatchingOptions::default() };
        if let Some(most) = options.take("max_features")? {
            o.features = o.features.at_most(most);
        }
        options.set("mutual", &mut o.mutual)?;
        options.set_named("affine_simulation", &mut o.affine_simulation)?;
        o.guided = options.take_named("guided")?;
        options.set("seed", &mut o.seed)?;
        Ok(Self { options: o, run: Run::read(options)? })
    }
}

/// Tentative matches between two photographs: some are wrong; `estimate_homography` and `estimate_fundamental` find what most agree on.
///
/// a, b: arrays of uint8 of shape (height, width) or (height, width, 3). `defaults("match_features")` lists the options.
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
    let points: Vec<[f64; 4]> = found.pairs().iter().map(|p| [p.a.x, p.a.y, p.b.x, p.b.y]).collect();
    let indices: Vec<[u32; 2]> = found.matches.iter().map(|m| [m.query, m.train]).collect();
    let ratios: Vec<f32> = found.matches.iter().map(|m| m.ratio).collect();
    let keypoints = |i: usize| {
        let rows: Vec<[f32; 5]> = (found.features[i].keypoints.iter())
            .map(|k| [k.position.x, k.position.y, k.scale, k.angle, k.response])
            .collect();
        arrays::row_array(py, &rows)
    };
    results::made(
        py,
        "Matches",
        [
            ("points", arrays::row_array(py, &points)?),
            ("indices", arrays::row_array(py, &indices)?),
            ("ratios", arrays::shaped(py, ratios, &[points.len()])?),
            ("keypoints", object(py, (keypoints(0)?, keypoints(1)?))?),
            ("seconds", results::stages(py, &found.stages)?),
        ],
    )
}
