//! The progress bar.

use indicatif::{ProgressBar, ProgressStyle};
use std::{
    io::{self, IsTerminal, Write},
    sync::Mutex,
    time::Duration,
};

/// A bar on stderr, hidden where stderr is not a terminal or nobody wants to see it.
pub(super) struct Bar {
    bar: Option<ProgressBar>,
    stage: Mutex<&'static str>,
}

impl Bar {
    pub(super) fn new(quiet: bool) -> Self {
        let bar = (!quiet && io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::new(0);
            // The template is a constant; were it wrong, indicatif's own style would do.
            if let Ok(style) = ProgressStyle::with_template("{msg:14} {bar:30} {pos}/{len} {elapsed}") {
                bar.set_style(style);
            }
            bar.enable_steady_tick(Duration::from_millis(120));
            bar
        });
        Self { bar, stage: Mutex::new("") }
    }

    pub(super) fn show(&self, stage: &'static str, done: usize, total: usize) {
        let Some(bar) = &self.bar else { return };
        if let Ok(mut last) = self.stage.lock()
            && *last != stage
        {
            *last = stage;
            bar.set_message(stage);
        }
        bar.set_length(total as u64);
        bar.set_position(done as u64);
    }

    pub(super) fn print(&self, text: &str) {
        let print = || {
            // Where stderr is closed there is nobody left to tell.
            let _ = writeln!(io::stderr(), "{text}");
        };
        match &self.bar {
            Some(bar) => bar.suspend(print),
            None => print(),
        }
    }

    pub(super) fn clear(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}
