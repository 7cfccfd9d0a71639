//! The frame that runs every command: global arguments, exit codes, stdout and stderr.
//!
//! [`Outcome`] is the result of a command and [`Failure`] its error; [`Context`] has the global options and the channels for messages.

mod called;
mod config;
mod context;
mod failure;
mod inputs;
mod memory;
mod named;
mod outcome;
mod outputs;
mod progress;
pub(crate) mod steps;
mod stop;

pub(crate) use called::Called;
pub(crate) use config::complete;
pub(crate) use context::Context;
pub(crate) use failure::{Explain, Failure};
pub(crate) use inputs::{expand_images, sort_by_name, stands_for_many, two_images};
pub(crate) use named::named;
pub(crate) use outcome::Outcome;
pub(crate) use outputs::{CLOUD, IMAGE, JSON, MAP, Output, PNG, TEXT, YAML, one_each, same_file, spare_inputs};
pub(crate) use progress::Step;

use clap::{Args, value_parser};
use std::{
    io::{self, Write},
    panic::{AssertUnwindSafe, catch_unwind},
    path::PathBuf,
    process::ExitCode,
    time::Instant,
};

/// The global options.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Global options")]
pub(crate) struct Globals {
    /// Print one JSON object on stdout and nothing else.
    #[arg(long, global = true)]
    pub(crate) json: bool,
    /// No progress bar, no summary; errors and warnings only.
    #[arg(short, long, global = true)]
    pub(crate) quiet: bool,
    /// Threads to use [default: one per core]. The result is the same for any number.
    #[arg(long, global = true, value_name = "N", value_parser = value_parser!(u16).range(1..=1024))]
    pub(crate) threads: Option<u16>,
    /// Memory limit in MiB, or with a unit (512M, 2G): for reading one file, by its header [default: half of the machine's], for stereo matching, which is split
    /// into overlapping strips of rows beyond it [default: unlimited; 1024 for a dense cloud], and for panoramas, which are then made from photographs
    /// read when needed and written in strips of rows, with the same pixels.
    #[arg(long, global = true, value_name = "SIZE", value_parser = memory::mebibytes)]
    pub(crate) max_memory: Option<u32>,
    /// Seed of the random number generator [default: fixed per job]. The same seed gives the same result; commands without random sampling
    /// refuse it.
    #[arg(long, global = true, value_name = "S")]
    pub(crate) seed: Option<u64>,
    /// Write DIR/report.html, a self-contained page with the figures and measures of this run.
    #[arg(long, global = true, value_name = "DIR")]
    pub(crate) report: Option<PathBuf>,
    /// Read options from this file [default: cv.toml in the current folder, if present]: a table for each command, such as [segment.train], with the long
    /// names of its options as keys. The command line takes precedence.
    #[arg(long, global = true, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// Print the effective options as a file for --config, and exit.
    #[arg(long, global = true)]
    pub(crate) print_config: bool,
}

/// A global option that has no effect on some commands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Global {
    /// `--seed`
    Seed,
    /// `--report`
    Report,
}

/// A subcommand.
pub(crate) trait Run: Args {
    /// Returns the outputs of this run; the frame checks before the computation whether they can be written.
    fn outputs(&self) -> Vec<Output<'_>> {
        Vec::new()
    }

    /// Returns the steps of the command in order, for the progress bar.
    fn steps(&self) -> Vec<Step> {
        Vec::new()
    }

    /// Returns the global options without effect on the command; giving them is wrong usage.
    fn has_no_use_for(&self) -> &'static [Global] {
        &[]
    }

    /// Does the job.
    fn run(self, context: &Context) -> Result<Outcome, Failure>;
}

/// Runs a command with the global options and converts its result to output and exit code.
pub(crate) fn run(
    globals: &Globals,
    called: Called,
    command: impl FnOnce(&Context) -> Result<Outcome, Failure>,
) -> ExitCode {
    let start = Instant::now();
    let limit = globals.max_memory.map_or_else(memory::default_limit, |mib| u64::from(mib) << 20);
    // This is the only place that sets it.
    let _ = cv_io::set_default_max_memory(limit);
    let context = Context::new(globals, called);
    let result = start_threads(globals.threads).and_then(|()| {
        // A panic is reported like any failure, with a hint and exit code 1.
        catch_unwind(AssertUnwindSafe(|| command(&context))).unwrap_or_else(|_| {
            Err(Failure::new("internal error: the program panicked (see above)")
                .advice("report this bug with the command line and, if possible, the input files"))
        })
    });
    context.clear_bar();
    let failure = match result {
        // A signal arrived after the last file was written.
        Ok(_) if !context.stop.finish() => return context.stop.end(),
        Ok(mut outcome) => {
            let marked = outcome.take_failure();
            match finish(outcome, context.take_stdout(), globals, start).err().or(marked) {
                None => return ExitCode::SUCCESS,
                Some(failure) => failure,
            }
        }
        Err(_) if context.stop.check().is_err() => return context.stop.end(),
        Err(failure) => failure,
    };
    context.say(&failure.text());
    failure.exit_code()
}

fn start_threads(threads: Option<u16>) -> Result<(), Failure> {
    let mut pool = rayon::ThreadPoolBuilder::new();
    if let Some(threads) = threads {
        pool = pool.num_threads(threads.into());
    }
    pool.build_global().during("cannot start the threads")
}

/// Prints the JSON object, or the output for stdout and the summary.
fn finish(outcome: Outcome, output: Vec<u8>, globals: &Globals, start: Instant) -> Result<(), Failure> {
    if globals.json {
        let object = outcome.into_json(start.elapsed().as_secs_f64())?;
        writeln!(io::stdout(), "{object}").during("cannot write to stdout")?;
        return Ok(());
    }
    let mut stdout = io::stdout();
    let written = stdout.write_all(outcome.stdout()).and_then(|()| stdout.write_all(&output));
    written.and_then(|()| stdout.flush()).during("cannot write to stdout")?;
    let summary = outcome.summary_text();
    if !globals.quiet && !summary.is_empty() {
        let _ = writeln!(io::stderr(), "{summary}");
    }
    Ok(())
}
