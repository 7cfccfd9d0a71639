//! The Python package `epipole`: jobs of `cv-pipeline` over NumPy arrays.
//!
//! No algorithms here. A function borrows its arrays (`arrays.rs`), reads its options by name (`options.rs`), runs the job without the interpreter
//! (`job.rs`) and gives a frozen dataclass of `python/epipole/_results.py` back (`results.rs`). What a job refuses becomes an exception with the numbers as
//! attributes (`errors.rs`).
//!
//! | file | what Python sees |
//! |---|---|
//! | `stereo.rs` | `StereoMatcher`, `depth`, `evaluate_disparity` |
//! | `matching.rs` | `match_features` |
//! | `estimate.rs` | `estimate_homography`, `estimate_fundamental`, `estimate_essential` |
//! | `files.rs` | `read_image`, `write_image`, `read_map`, `write_map` |
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
//! Images are positional; options are given by name only, with the library's defaults (`epipole.defaults("depth")` lists them). Arrays are indexed by row, column,
//! channel; color is RGB; points are (x, y) with the center of the first pixel at (0, 0).

mod arrays;
mod errors;
mod estimate;
mod files;
mod job;
mod matching;
mod options;
mod results;
mod stereo;

use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Reads the options of a function.
type Read = fn(&mut options::Options<'_>) -> PyResult<()>;

/// The functions that take options, each with what reads them.
const FUNCTIONS: &[(&str, Read)] = &[
    ("depth", |options| stereo::DepthArguments::read(options).map(drop)),
    ("StereoMatcher", |options| stereo::matcher_arguments(options).map(drop)),
    ("match_features", |options| matching::Arguments::read(options).map(drop)),
    ("estimate_homography", |options| estimate::read_homography(options).map(drop)),
    ("estimate_fundamental", |options| estimate::read_fundamental(options).map(drop)),
    ("estimate_essential", |options| estimate::read_essential(options).map(drop)),
];

/// The options of a function and their defaults; those without one are `None`.
#[pyfunction]
fn defaults<'py>(py: Python<'py>, function: &str) -> PyResult<Bound<'py, PyDict>> {
    let Some((name, read)) = FUNCTIONS.iter().find(|(name, _)| *name == function) else {
        let names = FUNCTIONS.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ");
        return Err(PyValueError::new_err(format!("“{function}” has no options; {names} have")));
    };
    let mut options = options::Options::recording(py, name);
    read(&mut options)?;
    options.recorded()
}

#[pymodule(gil_used = false)]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add_class::<stereo::PyStereoMatcher>()?;
    module.add_function(wrap_pyfunction!(defaults, module)?)?;
    module.add_function(wrap_pyfunction!(arrays::is_borrowed, module)?)?;
    module.add_function(wrap_pyfunction!(stereo::depth, module)?)?;
    module.add_function(wrap_pyfunction!(stereo::evaluate_disparity, module)?)?;
    module.add_function(wrap_pyfunction!(matching::match_features, module)?)?;
    module.add_function(wrap_pyfunction!(estimate::estimate_homography, module)?)?;
    module.add_function(wrap_pyfunction!(estimate::estimate_fundamental, module)?)?;
    module.add_function(wrap_pyfunction!(estimate::estimate_essential, module)?)?;
    module.add_function(wrap_pyfunction!(files::read_image, module)?)?;
    module.add_function(wrap_pyfunction!(files::write_image, module)?)?;
    module.add_function(wrap_pyfunction!(files::read_map, module)?)?;
    module.add_function(wrap_pyfunction!(files::write_map, module)?)?;
    Ok(())
}
