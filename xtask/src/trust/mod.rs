//! What the program does under bad circumstances: damaged inputs, sudden death, other processors. See docs/trust.md.
//!
//! One file per job, over the commands of `cases`.

mod bytes;
mod cases;
mod corrupt;
mod killed;

use crate::checks;
use anyhow::{Result, ensure};
use std::path::PathBuf;

/// What a job is given.
pub(crate) struct Options {
    /// Runs of `corrupt` and `killed`.
    pub(crate) count: Option<u64>,
    /// Of the random choices.
    pub(crate) seed: u64,
}

type Job = fn(&Options) -> Result<bool>;

const JOBS: &[checks::Named<Job>] = &[("bytes", bytes::run), ("corrupt", corrupt::run), ("killed", killed::run)];

/// Runs all jobs, or the one named; true where nothing was found.
pub(crate) fn run(only: Option<&str>, options: &Options) -> Result<bool> {
    let mut good = true;
    for (name, job) in checks::select(JOBS, only)? {
        println!("\n{name}");
        good &= job(options)?;
    }
    Ok(good)
}

/// The program that was built with this one.
pub(crate) fn program() -> Result<PathBuf> {
    let path = std::env::current_exe()?.with_file_name("cv");
    ensure!(
        path.is_file(),
        "{} is not there; try: cargo build --locked --bin cv, in the profile of xtask",
        path.display()
    );
    Ok(path)
}
