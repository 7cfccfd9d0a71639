//! Chores of the workspace. This file only routes: `cargo xtask --help` lists them.

mod checks;
mod fixtures;
mod golden;
#[cfg(any(feature = "peers", test))]
mod peers;
mod process;
mod python;
mod real;
mod rendered;
mod sfm_score;
mod tidy;
mod trust;

use anyhow::Context;
use clap::{Parser, Subcommand};
use std::{
    path::{Path, PathBuf},
    process::ExitCode,
};

#[derive(Parser)]
#[command(name = "cargo xtask", about = "Chores of the workspace.")]
struct Cli {
    #[command(subcommand)]
    chore: Chore,
}

#[derive(Subcommand)]
enum Chore {
    /// Render the small inputs under fixtures/ anew (only to change them).
    Fixtures,
    /// Check the rules of the workspace that no compiler checks.
    Tidy,
    /// Run the pipelines on fixtures/; compare with the ground truth and the golden figures.
    Golden {
        /// Write nothing; fail if a figure changed.
        #[arg(long)]
        check: bool,
    },
    /// Run the pipelines on real photographs with ground truth; compare each figure with its target.
    Real {
        /// Only this job; `all` or none: every one.
        job: Option<String>,
    },
    /// Run structure from motion on rendered photographs with exact poses; compare each figure with its target.
    Rendered {
        /// Only this job; `all` or none: every one.
        job: Option<String>,
    },
    /// Damage the inputs of every command, kill it, and run it on other processors; see docs/trust.md.
    Trust {
        /// Only this job; `all` or none: every one.
        job: Option<String>,
        /// Number of runs [default: 10000 damaged inputs, 200 kills].
        #[arg(long)]
        count: Option<u64>,
        /// Seed of the random choices.
        #[arg(long, default_value_t = 1)]
        seed: u64,
    },
    /// Build the wheel of the Python package, install it into a virtual environment and run its tests.
    Python {
        /// Build the release wheel: optimized, and on Linux for glibc 2.17 or later by zig from PyPI.
        #[arg(long)]
        release: bool,
    },
    /// Benchmark other systems and ours on the same inputs.
    #[cfg(any(feature = "peers", test))]
    Peers {
        /// Only this job; `all` or none: every one.
        job: Option<String>,
    },
}

fn main() -> ExitCode {
    let result = match Cli::parse().chore {
        Chore::Fixtures => fixtures::run(),
        Chore::Tidy => tidy::run(),
        Chore::Golden { check } => golden::run(check),
        Chore::Real { job } => real::run(job.as_deref()),
        Chore::Rendered { job } => rendered::run(job.as_deref()),
        Chore::Trust { job, count, seed } => trust::run(job.as_deref(), &trust::Options { count, seed }),
        Chore::Python { release } => python::run(release),
        #[cfg(any(feature = "peers", test))]
        Chore::Peers { job } => peers::run(job.as_deref()),
    };
    match result {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::FAILURE,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Returns the root of the workspace.
fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new("."))
}

/// Returns the folder with the real data if it exists: `CV_DATA_DIR`, else `../shared/data` beside the workspace.
fn data_dir() -> Option<PathBuf> {
    let folder = match std::env::var_os("CV_DATA_DIR") {
        Some(folder) => PathBuf::from(folder),
        None => root().join("../shared/data"),
    };
    folder.is_dir().then_some(folder)
}

/// Returns cargo's target folder.
fn target_dir() -> anyhow::Result<PathBuf> {
    let program = std::env::current_exe()?;
    Ok(program.ancestors().nth(2).context("the program is not in a target folder")?.to_owned())
}
