//! The Python package `epipole`: jobs of `cv-pipeline` over NumPy arrays.
//!
//! There are no algorithms here. A function borrows its arrays (`arrays.rs`), reads its keyword options (`options.rs`), runs the job with the GIL released
//! (`job.rs`) and returns a frozen dataclass of `python/epipole/_results.py` (`results.rs`). Errors become exceptions with the numbers as
//! attributes (`errors.rs`).
//!
//! | file | Python names |
//! |---|---|
//! | `camera.rs` | `Camera`, `Rig` |
//! | `calibration.rs` | `find_board`, `calibrate` |
//! | `rectify.rs` | `rectify`, `undistort`, `Undistorter` |
//! | `stereo.rs` | `StereoMatcher`, `depth`, `PairDepth` (for `epipole.ray`), `evaluate_disparity` |
//! | `matching.rs` | `extract_features`, `match`, `match_features` |
//! | `estimate.rs` | `estimate_homography`, `estimate_fundamental`, `estimate_essential`, `estimate_pose` |
//! | `reconstruct.rs`, `sfm_photograph.rs`, `sfm.rs` | `reconstruct`, `sfm_features`, `sfm` |
//! | `model.rs` | reading and writing of `Reconstruction` |
//! | `panorama.rs` | `panorama` |
//! | `segment.rs` | the implementation of `ColorModel`; `evaluate_mask` |
//! | `files.rs`, `cloud.rs` | `read_image`, `write_image`, `read_map`, `write_map`, `write_cloud` |
//!
//! ```python
//! import epipole
//!
//! left, right = epipole.read_image("left.png"), epipole.read_image("right.png")
//! found = epipole.depth(left, right, disparities=64, focal=350.0, baseline=0.25)
//! print(found, found.depth[150, 200])
//! ```
//!
//! # Conventions
//!
//! Images are positional arguments; options are keyword-only, with the library's defaults (`epipole.defaults("depth")` lists them). Arrays are indexed by row, column,
//! channel; color is RGB; points are (x, y) with the center of the first pixel at (0, 0).

mod arrays;
mod calibration;
mod camera;
mod cloud;
mod errors;
mod estimate;
mod files;
mod job;
mod matching;
mod model;
mod options;
mod panorama;
mod photographs;
mod reconstruct;
mod rectify;
mod results;
mod segment;
mod sfm;
mod sfm_photograph;
mod stereo;

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Reads the options of a function.
type Read = fn(&mut options::Options<'_>) -> PyResult<()>;

/// The functions with options, each with the function that reads them.
const FUNCTIONS: &[(&str, Read)] = &[
    ("depth", |options| stereo::DepthArguments::read(options).map(drop)),
    ("StereoMatcher", |options| stereo::matcher_arguments(options).map(drop)),
    ("rectify", |options| rectify::read(options).map(drop)),
    ("undistort", |options| rectify::read(options).map(drop)),
    ("Undistorter", |options| rectify::read(options).map(drop)),
    ("find_board", |options| calibration::read_find(options).map(drop)),
    ("calibrate", |options| calibration::read(options).map(drop)),
    ("extract_features", |options| matching::read_extraction(options).map(drop)),
    ("match", |options| matching::read_match(options).map(drop)),
    ("match_features", |options| matching::Arguments::read(options).map(drop)),
    ("estimate_homography", |options| estimate::read_homography(options).map(drop)),
    ("estimate_fundamental", |options| estimate::read_fundamental(options).map(drop)),
    ("estimate_essential", |options| estimate::read_essential(options).map(drop)),
    ("estimate_pose", |options| estimate::read_pose(options).map(drop)),
    ("reconstruct", |options| reconstruct::Arguments::read(options).map(drop)),
    ("sfm_features", |options| sfm_photograph::read_features(options).map(drop)),
    ("sfm", |options| sfm::Arguments::read(options).map(drop)),
    ("panorama", |options| panorama::Arguments::read(options).map(drop)),
    ("ColorModel", |options| segment::read(options).map(drop)),
];

/// Returns the options of a function and their defaults; `None` for options without a default.
///
///     >>> epipole.defaults("undistort")
///     {'alpha': 0.0, 'size': None, 'threads': None, 'progress': None}
#[pyfunction]
fn defaults<'py>(py: Python<'py>, function: &str) -> PyResult<Bound<'py, PyDict>> {
    let Some((name, read)) = FUNCTIONS.iter().find(|(name, _)| *name == function) else {
        let names = FUNCTIONS.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ");
        return Err(PyValueError::new_err(format!("“{function}” has no options; functions with options: {names}")));
    };
    let mut options = options::Options::recording(py, name);
    read(&mut options)?;
    options.recorded()
}

#[pymodule(gil_used = false)]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_class::<camera::PyCamera>()?;
    module.add_class::<camera::PyRig>()?;
    module.add_class::<rectify::PyUndistorter>()?;
    module.add_class::<stereo::PyPairDepth>()?;
    module.add_class::<stereo::PyStereoMatcher>()?;
    module.add_class::<segment::PyColorModel>()?;
    module.add_class::<sfm_photograph::PySfmPhotograph>()?;
    macro_rules! functions {
        ($($of:ident::$function:ident),* $(,)?) => { $(module.add_function(wrap_pyfunction!($of::$function, module)?)?;)* };
    }
    module.add_function(wrap_pyfunction!(defaults, module)?)?;
    functions!(
        arrays::is_borrowed,
        calibration::calibrate,
        calibration::find_board,
        cloud::write_cloud,
        estimate::estimate_essential,
        estimate::estimate_fundamental,
        estimate::estimate_homography,
        estimate::estimate_pose,
        files::read_image,
        files::read_map,
        files::write_image,
        files::write_map,
        matching::extract_features,
        matching::match_,
        matching::match_features,
        model::read_model,
        model::write_model,
        panorama::panorama,
        reconstruct::reconstruct,
        rectify::rectify,
        rectify::undistort,
        segment::evaluate_mask,
        sfm::sfm,
        sfm_photograph::sfm_features,
        stereo::depth,
        stereo::evaluate_disparity,
    );
    Ok(())
}
