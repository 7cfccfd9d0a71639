//! The progress bar: one line on stderr that is drawn over.

use std::{
    io::{self, IsTerminal, Write},
    sync::{Mutex, PoisonError},
    time::{Duration, Instant},
};

/// Characters of the bar itself.
const WIDTH: usize = 30;
/// No more often is it drawn.
const PERIOD: Duration = Duration::from_millis(100);

/// A bar on stderr, hidden where stderr is not a terminal or nobody wants to see it.
pub(super) struct Bar(Option<Mutex<State>>);

struct State {
    start: Instant,
    stage: &'static str,
    /// None while nothing stands on the line.
    drawn: Option<Instant>,
}

impl Bar {
    pub(super) fn new(quiet: bool) -> Self {
        let shown = !quiet && io::stderr().is_terminal();
        Self(shown.then(|| Mutex::new(State { start: Instant::now(), stage: "", drawn: None })))
    }

    /// Draws how far a stage is.
    pub(super) fn show(&self, stage: &'static str, done: usize, total: usize) {
        let Some(state) = &self.0 else { return };
        let mut state = state.lock().unwrap_or_else(PoisonError::into_inner);
        if state.stage == stage && state.drawn.is_some_and(|drawn| drawn.elapsed() < PERIOD) {
            return;
        }
        state.stage = stage;
        state.drawn = Some(Instant::now());
        write(&format!("\r\x1b[2K{}", line(stage, done, total, state.start.elapsed())));
    }

    /// Prints a line of text where the bar stood; the next [`Bar::show`] draws it below.
    pub(super) fn print(&self, text: &str) {
        self.clear();
        write(&format!("{text}\n"));
    }

    /// Removes the bar.
    pub(super) fn clear(&self) {
        let Some(state) = &self.0 else { return };
        if state.lock().unwrap_or_else(PoisonError::into_inner).drawn.take().is_some() {
            write("\r\x1b[2K");
        }
    }
}

fn write(text: &str) {
    // Where stderr is closed there is nobody left to tell.
    let _ = io::stderr().write_all(text.as_bytes());
}

fn line(stage: &str, done: usize, total: usize, elapsed: Duration) -> String {
    let full = (done.min(total) * WIDTH).checked_div(total).unwrap_or(0);
    let (bar, rest) = ("#".repeat(full), "-".repeat(WIDTH - full));
    format!("{stage:14} {bar}{rest} {done}/{total} {} s", elapsed.as_secs())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bar_fills() {
        let filled = |done, total| line("x", done, total, Duration::ZERO).matches('#').count();
        assert_eq!([filled(0, 0), filled(0, 3), filled(1, 2), filled(3, 3), filled(9, 3)], [0, 0, 15, 30, 30]);
        assert!(line("warping", 2, 7, Duration::from_millis(61_500)).ends_with(" 2/7 61 s"));
    }
}
