//! The pipelines on real photographs; each figure is compared with its target.
//!
//! One file per job. A job is a function from the data folder to its [`Check`]s; register it with one line in `JOBS`.
//! A figure that does not meet its target fails the run; so does an error. Jobs print further details.

mod calibration;
mod calibration_commands;
pub(crate) mod depth;
pub(crate) mod estimate;
mod focal;
mod matching;
mod panorama;
mod reconstruct;
mod segment;
mod sfm;

use crate::checks;
pub(crate) use crate::checks::Check;
use anyhow::Result;
use std::path::Path;

/// A job: from the data folder to its figures.
type Job = fn(&Path) -> Result<Vec<Check>>;

const JOBS: &[checks::Named<Job>] = &[
    ("calibration", calibration::run),
    ("depth", depth::run),
    ("estimate", estimate::run),
    ("focal", focal::run),
    ("matching", matching::run),
    ("panorama", panorama::run),
    ("reconstruct", reconstruct::run),
    ("segment", segment::run),
    ("sfm", sfm::run),
];

/// Jobs that take minutes: they run only by their name or with `all`.
const LONG: [&str; 1] = ["focal"];

/// Runs all jobs but the long ones, or the one named, or `all`; true if every figure meets its target.
pub(crate) fn run(only: Option<&str>) -> Result<bool> {
    let mut jobs = checks::select(JOBS, only)?;
    jobs.retain(|(name, _)| only.is_some() || !LONG.contains(name));
    let Some(data) = crate::data_dir() else {
        println!(
            "real: skipped, there is no data: set CV_DATA_DIR to the folder that holds it (see docs/real-data.md)"
        );
        return Ok(true);
    };
    Ok(checks::run(&jobs, |job| job(&data)))
}
