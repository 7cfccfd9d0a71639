//! The program `cv`: arguments, files and reports. The algorithms are called through `cv-pipeline`.

mod boards;
mod commands;
mod frame;
mod masks;
mod photos;
mod pictures;
mod rig;
mod words;

use clap::{CommandFactory, FromArgMatches, Parser};
use frame::{Called, Globals};

#[global_allocator]
static ALLOCATOR: cv_alloc::ImageAllocator = cv_alloc::ImageAllocator;

/// Classical computer vision: panoramas, structure from motion, stereo depth, calibration, matching and color segmentation.
#[derive(Parser)]
#[command(name = "cv", version, propagate_version = true, arg_required_else_help = true, max_term_width = 100)]
#[command(after_help = "Exit codes: 0 done; 1 the job could not be done (the reason is on stderr); 2 wrong usage;\n\
    130 stopped by Ctrl-C.\n\
    Output folders are created. An output file named - is stdout, in the first of its possible formats.\n\
    `cv COMMAND --help` shows examples of each command.")]
struct Cli {
    #[command(flatten)]
    globals: Globals,
    #[command(subcommand)]
    command: commands::Command,
}

fn main() -> std::process::ExitCode {
    let mut command = Cli::command();
    let completed = match frame::complete(&command, std::env::args_os().collect()) {
        Ok(completed) => completed,
        Err(failure) => {
            eprintln!("{}", failure.text());
            return failure.exit_code();
        }
    };
    if let Some(text) = completed.printed {
        print!("{text}");
        return std::process::ExitCode::SUCCESS;
    }
    let matches = command.try_get_matches_from_mut(completed.args).unwrap_or_else(|error| error.exit());
    let cli = Cli::from_arg_matches(&matches).unwrap_or_else(|error| error.format(&mut command).exit());
    frame::run(&cli.globals, Called::new(&command, &matches), |context| {
        if let Some(note) = completed.note {
            context.note(note);
        }
        cli.command.run(context)
    })
}
