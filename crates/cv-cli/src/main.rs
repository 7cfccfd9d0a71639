//! The program `cv`: arguments, files and reports. The work itself is done by `cv-pipeline`.

mod boards;
mod commands;
mod frame;
mod photos;
mod pictures;
mod rig;
mod words;

use clap::{CommandFactory, FromArgMatches, Parser};
use frame::{Called, Globals};

/// Classical computer vision: color segmentation, panoramas, two-view reconstruction and stereo depth.
#[derive(Parser)]
#[command(name = "cv", version, propagate_version = true, arg_required_else_help = true, max_term_width = 100)]
#[command(after_help = "Exit codes: 0 done; 1 the job could not be done (the reason is on stderr); 2 wrong usage;\n\
    130 stopped by Ctrl-C.\n\
    Folders of outputs are made. An output file named - is stdout, in the first of the formats it may have.\n\
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
        if let Some(said) = completed.said {
            context.note(said);
        }
        cli.command.run(context)
    })
}
