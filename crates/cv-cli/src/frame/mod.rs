//! The frame that runs every command: global arguments, exit codes, stdout and stderr.
//!
//! [`Outcome`] is what a command achieved and [`Failure`] why it did not; [`Context`] is what it knows of how it was called.

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
pub(crate) use outputs::{CLOUD, JSON, MAP, Output, PICTURE, PNG, TEXT, YAML, one_each, same_file, spare_inputs};
pub(crate) use progress::Step;

use clap::{Args, value_parser};
use std::{
    io::{self, Write},
    panic::{AssertUnwindSafe, catch_unwind},
    path::PathBuf,
    process::ExitCode,
    time::Instant,
};

/// Arguments that every command takes.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Everywhere")]
pub(crate) struct Globals {
    /// Print one JSON object on stdout, and nothing else there.
    #[arg(long, global = true)]
    pub(crate) json: bool,
    /// No progress bar, no summary; errors and warnings only.
    #[arg(short, long, global = true)]
    pub(crate) quiet: bool,
    /// Threads to use [default: one per core]. The result is the same for any number.
    #[arg(long, global = true, value_name = "N", value_parser = value_parser!(u16).range(1..=1024))]
    pub(crate) threads: Option<u16>,
    /// Most memory, in MiB, for reading one file (judged by its header) [default: half of the machine's], and for matching pixel by
    /// pixel: where that does not fit, rows are matched in strips that overlap [default: as much as it takes; 1024 for a dense cloud].
    #[arg(long, global = true, value_name = "MIB", value_parser = value_parser!(u32).range(1..))]
    pub(crate) max_memory: Option<u32>,
    /// Seed of random choices [default: that of the pipeline]. The same seed gives the same result; commands that choose nothing at random
    /// refuse it.
    #[arg(long, global = true, value_name = "S")]
    pub(crate) seed: Option<u64>,
    /// Write DIR/report.html, one file with the pictures and figures of this run inside.
    #[arg(long, global = true, value_name = "DIR")]
    pub(crate) report: Option<PathBuf>,
    /// Take options from this file [default: cv.toml, where the current folder has one]: a table for each command, such as [segment.train], with the long
    /// names of its options as keys. The command line wins.
    #[arg(long, global = true, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// Print the options that hold, as a file for --config, and do nothing.
    #[arg(long, global = true)]
    pub(crate) print_config: bool,
}

/// A global option that not every command has a use for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Global {
    /// `--seed`
    Seed,
    /// `--report`
    Report,
}

/// A subcommand.
pub(crate) trait Run: Args {
    /// What this run will write. The frame checks before the work starts whether it can be written.
    fn outputs(&self) -> Vec<Output<'_>> {
        Vec::new()
    }

    /// The steps of the work, in order, of which the progress bar tells the number.
    fn steps(&self) -> Vec<Step> {
        Vec::new()
    }

    /// Those of the global options that mean nothing to it: given all the same, they are wrong usage.
    fn has_no_use_for(&self) -> &'static [Global] {
        &[]
    }

    /// Does the job.
    fn run(self, context: &Context) -> Result<Outcome, Failure>;
}

/// Runs a command under the global arguments and turns what comes of it into output and exit code.
pub(crate) fn run(
    globals: &Globals,
    called: Called,
    command: impl FnOnce(&Context) -> Result<Outcome, Failure>,
) -> ExitCode {
    let start = Instant::now();
    let limit = globals.max_memory.map_or_else(memory::default_limit, |mib| u64::from(mib) << 20);
    // Nothing has set it before: this is the only place.
    let _ = cv_io::set_default_max_memory(limit);
    let context = Context::new(globals, called);
    let result = start_threads(globals.threads).and_then(|()| {
        // A bug in the program is reported like any failure: the person sees what to do, scripts see exit code 1.
        catch_unwind(AssertUnwindSafe(|| command(&context))).unwrap_or_else(|_| {
            Err(Failure::new("the program stopped at a bug of its own (see above)")
                .advice("report it with the command line and, where you can, the input files"))
        })
    });
    context.clear_bar();
    let failure = match result {
        // Ctrl-C came between the last file and here.
        Ok(_) if !context.stop.finish() => return context.stop.end(),
        Ok(mut outcome) => {
            let but = outcome.take_but();
            match finish(outcome, context.take_stdout(), globals, start).err().or(but) {
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

/// Prints what the person asked to see.
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
