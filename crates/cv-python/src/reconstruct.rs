//! Two-view reconstruction.

use crate::job::Run;
use crate::matching::max_features;
use crate::options::Options;
use crate::photographs::{Ended, Known, Photograph, Source};
use crate::results::{self, object};
use crate::{arrays, cloud, model};
use cv_core::Camera;
use cv_pipeline::{DenseError, DenseOptions, Intrinsics, ReconstructOptions, reconstruct as solve, reconstruct_dense};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// The options of `reconstruct`.
pub(crate) struct Arguments {
    options: ReconstructOptions,
    known: Known,
    second: Option<Known>,
    ignore_exif: bool,
    dense: bool,
    dense_options: DenseOptions,
    run: Run,
}

impl Arguments {
    pub(crate) fn read(options: &mut Options<'_>) -> PyResult<Self> {
        let mut o = ReconstructOptions::default();
        let known = Known::read(options)?;
        let second = options.take_any("camera2")?.map(|given| Known::of(&given)).transpose()?;
        let mut ignore_exif = false;
        options.set("ignore_exif", &mut ignore_exif)?;
        options.set("threshold", &mut o.two_view.robust.threshold)?;
        options.set("max_error", &mut o.two_view.max_reprojection)?;
        options.set("min_angle", &mut o.two_view.min_angle)?;
        o.matching.features = max_features(options, o.matching.features)?;
        options.set("seed", &mut o.two_view.robust.seed)?;
        let mut dense = false;
        options.set("dense", &mut dense)?;
        let mut dense_options = DenseOptions::default();
        options.set("dense_size", &mut dense_options.max_size)?;
        Ok(Self { options: o, known, second, ignore_exif, dense, dense_options, run: Run::read(options)? })
    }

    /// Returns the prior knowledge of the intrinsics for photographs of these sizes and EXIF focal lengths.
    fn intrinsics(&self, sizes: [(usize, usize); 2], exif: [Option<f64>; 2]) -> PyResult<Intrinsics> {
        let both =
            |second: &Known| -> Option<[Camera; 2]> { Some([self.known.camera(sizes[0])?, second.camera(sizes[1])?]) };
        let second = self.second.as_ref().unwrap_or(&self.known);
        match (&self.known, second) {
            (Known::Camera(_), Known::Camera(_)) => Ok(both(second).map_or(Intrinsics::Unknown, Intrinsics::Known)),
            (Known::Camera(_) | Known::Matrix(_), Known::Camera(_) | Known::Matrix(_)) => {
                Ok(both(second).map_or(Intrinsics::Unknown, Intrinsics::Matrix))
            }
            (Known::Focal(focal), Known::Focal(_)) => Ok(Intrinsics::Focal([*focal; 2])),
            (Known::Nothing, Known::Nothing) => {
                Ok(Intrinsics::from_focal_lengths(exif.map(|focal| focal.filter(|_| !self.ignore_exif))))
            }
            _ => Err(PyTypeError::new_err("reconstruct(): camera2 needs camera")),
        }
    }
}

/// Reconstructs points and the relative pose from two photographs, in the first camera's frame; the unit is the baseline.
///
/// a, b: arrays of uint8 or paths. camera: a Camera, or a 3×3 matrix if the distortion is unknown; camera2: that of the second photograph, if different; focal: approximate
/// focal length in px, by default from EXIF or self-calibrated. dense: also compute a dense cloud of the pixels that pass the left-right check. `defaults("reconstruct")` lists the options.
#[pyfunction]
#[pyo3(signature = (a, b, **options))]
pub(crate) fn reconstruct<'py>(
    py: Python<'py>,
    a: &Bound<'py, PyAny>,
    b: &Bound<'py, PyAny>,
    options: Option<&Bound<'py, PyDict>>,
) -> PyResult<Bound<'py, PyAny>> {
    let mut options = Options::new("reconstruct", options);
    let arguments = Arguments::read(&mut options)?;
    options.finish()?;
    let given = [Photograph::new(a, "a")?, Photograph::new(b, "b")?];
    let sources: [Source<'_>; 2] = [given[0].source()?, given[1].source()?];
    let names = [0, 1].map(|i: usize| sources[i].name(i).into_owned());
    let run = &arguments.run;
    let photos = run.run(py, |_| {
        let [a, b] = sources;
        Ok::<_, Ended<DenseError>>([a.read().map_err(Ended::File)?, b.read().map_err(Ended::File)?])
    })?;
    let views = photos.each_ref().map(|(pixels, _)| pixels.view());
    let exif = photos.each_ref().map(|(_, focal)| *focal);
    let two_view = cv_pipeline::TwoViewOptions {
        intrinsics: arguments.intrinsics(views.map(|view| view.size()), exif)?,
        ..arguments.options.two_view
    };
    let options = ReconstructOptions { two_view, ..arguments.options.clone() };
    let found = run.run(py, |progress| solve(views[0], views[1], &options, progress))?;
    let dense = arguments
        .dense
        .then(|| {
            run.run(py, |progress| reconstruct_dense(views[0], views[1], &found, &arguments.dense_options, progress))
        })
        .transpose()?;
    let scene = &found.scene;
    let (focal_is_doubtful, sparse) = (found.focal_is_doubtful(), found.model(names));
    let mut stages = found.stages.clone();
    let mut dense_cloud = object(py, py.None())?;
    if let Some(dense) = dense {
        stages.extend(dense.stages.iter().copied());
        dense_cloud = cloud::made(py, dense.cloud)?;
    }
    results::made(
        py,
        "TwoViewReconstruction",
        [
            ("reconstruction", model::made(py, &sparse)?),
            ("rotation", arrays::matrix(py, scene.pose.rotation.matrix())?),
            ("translation", arrays::vector(py, &scene.pose.translation)?),
            ("rms", object(py, scene.reprojection_rms)?),
            ("median_angle", object(py, scene.median_angle)?),
            ("pose_deviation", object(py, (scene.pose_deviation[0], scene.pose_deviation[1]))?),
            ("focal_deviation", object(py, scene.focal_deviation)?),
            ("focal_is_doubtful", object(py, focal_is_doubtful)?),
            ("matches", object(py, found.matching.matches.len())?),
            ("inliers", object(py, scene.inliers.len())?),
            ("dense", dense_cloud),
            ("seconds", results::stages(py, &stages)?),
        ],
    )
}
