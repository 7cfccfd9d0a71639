//! `cv completions`: shell completion scripts.

use crate::frame::{Context, Failure, Global, Outcome, Run};
use clap::CommandFactory;
use clap_complete::Shell;

/// Print a completion script for a shell.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv completions bash > ~/.local/share/bash-completion/completions/cv\n  \
    cv completions fish > ~/.config/fish/completions/cv.fish")]
pub(crate) struct Args {
    /// The shell.
    shell: Shell,
}

impl Run for Args {
    fn has_no_use_for(&self) -> &'static [Global] {
        &[Global::Seed, Global::Report]
    }

    fn run(self, _: &Context) -> Result<Outcome, Failure> {
        let mut script = Vec::new();
        clap_complete::generate(self.shell, &mut crate::Cli::command(), "cv", &mut script);
        Ok(Outcome::default().text("script", script))
    }
}
