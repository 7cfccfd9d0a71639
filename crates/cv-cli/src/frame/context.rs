//! The context of a running command: global options, messages, reports and cancellation.

use super::progress::{Bar, Step};
use super::stop::Stop;
use super::{Called, Failure, Global, Globals, Output, outputs};
use cv_pipeline::{Cancelled, Progress};
use cv_report::Report;
use std::{
    fmt::Display,
    path::PathBuf,
    sync::{Arc, Mutex, PoisonError},
};

/// The context of a running command. It is also the [`Progress`] that pipelines report to.
pub(crate) struct Context {
    /// `--seed`, if given.
    pub(crate) seed: Option<u64>,
    /// `--max-memory` in bytes, if given.
    pub(crate) max_memory: Option<usize>,
    quiet: bool,
    json: bool,
    /// The output for stdout, written at the end.
    stdout: Mutex<Vec<u8>>,
    report: Option<PathBuf>,
    called: Called,
    /// The warnings so far.
    warnings: Mutex<Vec<String>>,
    bar: Arc<Bar>,
    pub(super) stop: Stop,
}

impl Context {
    pub(super) fn new(globals: &Globals, called: Called) -> Self {
        let Globals { quiet, json, seed, .. } = *globals;
        let bar = Arc::new(Bar::new(quiet));
        let max_memory = globals.max_memory.map(|mib| usize::try_from(u64::from(mib) << 20).unwrap_or(usize::MAX));
        let (report, stop) = (globals.report.clone(), Stop::listen(&bar));
        let (stdout, warnings) = (Mutex::default(), Mutex::default());
        Self { seed, max_memory, quiet, json, stdout, report, called, warnings, bar, stop }
    }

    /// Refuses global options that have no effect on the command.
    pub(crate) fn refuse(&self, without_use: &[Global]) -> Result<(), Failure> {
        let given = |option: &Global| match option {
            Global::Seed => self.seed.is_some(),
            Global::Report => self.report.is_some(),
        };
        match without_use.iter().find(|option| given(option)) {
            Some(Global::Seed) => Err(Failure::usage("--seed has no effect here: this command uses no random numbers")),
            Some(Global::Report) => Err(Failure::usage("--report has no effect here: this command has no report")),
            None => Ok(()),
        }
    }

    /// Checks before the computation whether the results can be written.
    pub(crate) fn check(&self, outputs: &[Output<'_>]) -> Result<(), Failure> {
        outputs::check(outputs, self.report.as_deref(), self.json)
    }

    /// Announces the steps of the command.
    pub(crate) fn expect(&self, steps: Vec<Step>) {
        self.bar.expect(steps);
    }

    /// Keeps an output for stdout until the command is done.
    pub(super) fn keep_for_stdout(&self, bytes: Vec<u8>) {
        *self.stdout.lock().unwrap_or_else(PoisonError::into_inner) = bytes;
    }

    /// Takes the output for stdout.
    pub(super) fn take_stdout(&self) -> Vec<u8> {
        std::mem::take(&mut *self.stdout.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Prints a line on stderr, even under `--quiet`.
    pub(super) fn say(&self, text: &str) {
        self.bar.print(text);
    }

    /// Removes the progress bar.
    pub(super) fn clear_bar(&self) {
        self.bar.clear();
    }

    /// Prints a message on stderr, unless under `--quiet`.
    pub(crate) fn note(&self, text: impl Display) {
        if !self.quiet {
            self.bar.print(&text.to_string());
        }
    }

    /// Prints a warning, even under `--quiet`, and records it for the report.
    pub(crate) fn warn(&self, text: impl Display) {
        let text = text.to_string();
        self.bar.print(&format!("warning: {text}"));
        self.warnings.lock().unwrap_or_else(PoisonError::into_inner).push(text);
    }

    /// Renders a report, with the warnings of this run at the top and the command line at the end.
    pub(crate) fn page(&self, mut report: Report) -> String {
        for text in self.warnings.lock().unwrap_or_else(PoisonError::into_inner).iter() {
            report.warn(text);
        }
        self.called.add_to(&mut report);
        report.to_html()
    }

    /// Under `--report DIR`, writes `DIR/report.html`. Must follow the warnings.
    pub(crate) fn report(&self, build: impl FnOnce() -> Result<Report, Failure>) -> Result<(), Failure> {
        let Some(folder) = &self.report else { return Ok(()) };
        let html = self.page(build()?);
        let path = folder.join("report.html");
        self.write(Output::Folder(folder), |_| cv_io::write_bytes(&path, html.as_bytes()))?;
        self.note(format!("report: {}", path.display()));
        Ok(())
    }

    /// Whether the program was asked to stop.
    pub(crate) fn is_stopped(&self) -> bool {
        self.stop.check().is_err()
    }

    /// Whether `--report` was given, so that figures must be drawn.
    pub(crate) fn wants_report(&self) -> bool {
        self.report.is_some()
    }
}

impl Progress for Context {
    fn report(&self, stage: &'static str, done: usize, total: usize) -> Result<(), Cancelled> {
        self.stop.check()?;
        self.bar.show(stage, done, total);
        Ok(())
    }
}
