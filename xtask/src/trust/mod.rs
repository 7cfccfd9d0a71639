//! Robustness of the program: damaged inputs, kills at random times, other processors and thread counts. See docs/trust.md.
//!
//! One file per job, over the commands of `cases`.

mod bytes;
mod cases;
mod corrupt;
mod killed;

use crate::checks;
use anyhow::{Result, ensure};
use std::path::PathBuf;

/// Options of the jobs.
pub(crate) struct Options {
    /// Number of runs of `corrupt` and `killed`.
    pub(crate) count: Option<u64>,
    /// Seed of the random choices.
    pub(crate) seed: u64,
}

type Job = fn(&Options) -> Result<bool>;

const JOBS: &[checks::Named<Job>] = &[("bytes", bytes::run), ("corrupt", corrupt::run), ("killed", killed::run)];

/// Runs all jobs, or the one named; returns whether there were no failures.
pub(crate) fn run(only: Option<&str>, options: &Options) -> Result<bool> {
    let mut good = true;
    for (name, job) in checks::select(JOBS, only)? {
        println!("\n{name}");
        good &= job(options)?;
    }
    Ok(good)
}

/// Returns the path of the program built with the same profile as this one.
pub(crate) fn program() -> Result<PathBuf> {
    let path = std::env::current_exe()?.with_file_name("cv");
    ensure!(
        path.is_file(),
        "{} does not exist; run: cargo build --locked --bin cv, in the profile of xtask",
        path.display()
    );
    Ok(path)
}
