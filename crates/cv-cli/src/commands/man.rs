//! `cv man`: the manual pages.

use crate::frame::{Context, Explain, Failure, Global, Outcome, Output, Run};
use clap::CommandFactory;
use std::path::PathBuf;

/// Write manual pages: cv.1 and one page per command.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  cv man -o ~/.local/share/man/man1")]
pub(crate) struct Args {
    /// The folder to write to; created if missing.
    #[arg(short, long, visible_alias = "out", value_name = "DIR")]
    output: PathBuf,
}

impl Run for Args {
    fn has_no_use_for(&self) -> &'static [Global] {
        &[Global::Seed, Global::Report]
    }

    fn outputs(&self) -> Vec<Output<'_>> {
        vec![Output::Folder(&self.output)]
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        let mut root = crate::Cli::command().disable_help_subcommand(true);
        root.build();
        let mut pages = Vec::new();
        collect(&root, &mut pages)?;
        let count = pages.len();
        context.write(Output::Folder(&self.output), |out| {
            pages.iter().try_for_each(|(name, page)| cv_io::write_bytes(out.join(name), page))
        })?;
        Ok(Outcome::default().with("pages", count).summary(format!("{count} pages in {}", self.output.display())))
    }
}

/// Renders the page of a command and of its subcommands.
fn collect(command: &clap::Command, pages: &mut Vec<(String, Vec<u8>)>) -> Result<(), Failure> {
    let man = clap_mangen::Man::new(command.clone());
    let mut page = Vec::new();
    man.render(&mut page).during("cannot make the page")?;
    pages.push((man.get_filename(), page));
    command.get_subcommands().try_for_each(|inner| collect(inner, pages))
}
