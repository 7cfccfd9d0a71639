//! The progress bar: one line on stderr, redrawn in place.

use std::{
    io::{self, IsTerminal, Write},
    sync::{Mutex, PoisonError},
    time::{Duration, Instant},
};

/// Width of the bar in characters.
const WIDTH: usize = 30;
/// Minimum time between redraws.
const REDRAW_PERIOD: Duration = Duration::from_millis(100);

/// A named step of a command, and the library stages that it consists of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Step {
    pub(crate) name: &'static str,
    pub(crate) stages: &'static [&'static str],
}

/// A bar on stderr, hidden if stderr is not a terminal or under `--quiet`.
pub(super) struct Bar(Option<Mutex<State>>);

struct State {
    start: Instant,
    position: Position,
    /// When the line was last drawn; `None` while it is empty.
    drawn: Option<Instant>,
}

impl Bar {
    pub(super) fn new(quiet: bool) -> Self {
        let shown = !quiet && io::stderr().is_terminal();
        Self(
            shown
                .then(|| Mutex::new(State { start: Instant::now(), position: Position::new(Vec::new()), drawn: None })),
        )
    }

    /// Announces the steps of the command.
    pub(super) fn expect(&self, steps: Vec<Step>) {
        if let Some(state) = &self.0 {
            state.lock().unwrap_or_else(PoisonError::into_inner).position = Position::new(steps);
        }
    }

    /// Draws the progress of a stage.
    pub(super) fn show(&self, stage: &'static str, done: usize, total: usize) {
        let Some(state) = &self.0 else { return };
        let mut state = state.lock().unwrap_or_else(PoisonError::into_inner);
        let begins = state.position.report(stage, (done, total));
        // The first report after the period is drawn; the beginning of a step is drawn at once, since its next report may take long.
        if !begins && state.drawn.is_some_and(|drawn| drawn.elapsed() < REDRAW_PERIOD) {
            return;
        }
        state.drawn = Some(Instant::now());
        let text =
            line(&state.position.label(), state.position.counts, state.position.since.elapsed(), state.start.elapsed());
        write(&format!("\r\x1b[2K{text}"));
    }

    /// Prints a line of text in place of the bar; the next [`Bar::show`] draws the bar below.
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
    // A closed stderr is ignored.
    let _ = io::stderr().write_all(text.as_bytes());
}

/// Duration of a stage from which on its rate and remaining time are shown.
const MIN_TIMED_STAGE: Duration = Duration::from_secs(2);

/// The position of a command among its steps.
struct Position {
    steps: Vec<Step>,
    /// Index of the current step.
    step: Option<usize>,
    /// The displayed stage, its units done and total, and its start.
    stage: &'static str,
    counts: (usize, usize),
    since: Instant,
}

impl Position {
    fn new(steps: Vec<Step>) -> Self {
        Self { steps, step: None, stage: "", counts: (0, 0), since: Instant::now() }
    }

    /// Records a report of a stage. Returns true if a new stage is displayed from now on.
    ///
    /// Steps do not go back: a stage of an earlier step, or of none, counts as part of the current step, and is displayed if no stage of the step is in progress.
    fn report(&mut self, stage: &'static str, counts: (usize, usize)) -> bool {
        let step = self.steps.iter().position(|step| step.stages.contains(&stage));
        let own = step.is_some() && step >= self.step;
        let in_progress =
            self.step.is_some() && stage != self.stage && self.counts.0 < self.counts.1 && self.counts.1 >= 2;
        if !own && in_progress {
            return false;
        }
        let begins = stage != self.stage;
        if begins {
            (self.stage, self.since) = (stage, Instant::now());
        }
        if own {
            self.step = step;
        }
        self.counts = counts;
        begins
    }

    fn label(&self) -> String {
        let Some(at) = self.step else { return self.stage.to_owned() };
        let name = self.steps[at].name;
        let number = if self.steps.len() > 1 { format!("{} of {} ", at + 1, self.steps.len()) } else { String::new() };
        if self.stage == name { format!("{number}{name}") } else { format!("{number}{name}: {}", self.stage) }
    }
}

/// Formats the bar: label, progress and elapsed time; for long stages also the rate and the remaining time.
fn line(label: &str, (done, total): (usize, usize), in_stage: Duration, elapsed: Duration) -> String {
    let name = format!("{label:30}");
    // A stage of one unit has no fraction: a moving mark shows activity.
    if total < 2 {
        let at = (elapsed.as_millis() / REDRAW_PERIOD.as_millis()) as usize % WIDTH;
        return format!("{name} {}#{}       {} s", "-".repeat(at), "-".repeat(WIDTH - 1 - at), elapsed.as_secs());
    }
    let done = done.min(total);
    let filled = done * WIDTH / total;
    let (bar, rest) = ("#".repeat(filled), "-".repeat(WIDTH - filled));
    let mut text = format!("{name} {bar}{rest} {:3} %  {} s", done * 100 / total, elapsed.as_secs());
    if in_stage >= MIN_TIMED_STAGE && done > 0 && done < total {
        let rate = done as f64 / in_stage.as_secs_f64();
        text += &format!(", {rate:.1} of {total} a second, {:.0} s left", ((total - done) as f64 / rate).ceil());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seconds(seconds: f64) -> Duration {
        Duration::from_secs_f64(seconds)
    }

    #[test]
    fn the_bar_shows_the_completed_fraction() {
        let filled = |done, total| {
            let text = line("x", (done, total), Duration::ZERO, Duration::ZERO);
            (text.matches('#').count(), text.contains(&format!("{:3} %", done.min(total) * 100 / total)))
        };
        assert_eq!(
            [filled(0, 3), filled(1, 2), filled(3, 3), filled(9, 3)],
            [(0, true), (15, true), (30, true), (30, true)]
        );
        assert!(line("4 of 6 warp", (2, 7), seconds(0.5), seconds(61.5)).starts_with("4 of 6 warp "));
    }

    #[test]
    fn long_stages_show_rate_and_remaining_time() {
        let text = line("frames", (20, 100), seconds(10.0), seconds(12.0));
        assert!(text.ends_with("20 %  12 s, 2.0 of 100 a second, 40 s left"), "{text}");
        for (done, in_stage) in [(0, 10.0), (100, 10.0), (20, 1.0)] {
            assert!(!line("frames", (done, 100), seconds(in_stage), seconds(12.0)).contains("left"));
        }
    }

    #[test]
    fn a_stage_without_units_shows_a_moving_mark() {
        for total in [0, 1] {
            let [a, b] = [1.0, 1.1].map(|at| line("adjust", (0, total), seconds(at), seconds(at)));
            assert!(a != b && a.matches('#').count() == 1 && !a.contains('%'), "{a}\n{b}");
        }
    }

    #[test]
    fn steps_are_numbered_and_never_go_back() {
        const STEPS: [Step; 3] = [
            Step { name: "features", stages: &["scale space", "describe"] },
            Step { name: "match", stages: &["match"] },
            Step { name: "adjust", stages: &["adjust"] },
        ];
        let mut position = Position::new(STEPS.to_vec());
        for (stage, counts, label, shown) in [
            ("scale space", (0, 4), "1 of 3 features: scale space", 0),
            ("scale space", (4, 4), "1 of 3 features: scale space", 4),
            ("describe", (1, 9), "1 of 3 features: describe", 1),
            // While a stage of the step is in progress, foreign stages are not displayed.
            ("match", (1, 9), "2 of 3 match", 1),
            ("samples", (5, 6), "2 of 3 match", 1),
            ("match", (9, 9), "2 of 3 match", 9),
            ("samples", (5, 6), "2 of 3 match: samples", 5),
            ("adjust", (0, 1), "3 of 3 adjust", 0),
            ("samples", (2, 6), "3 of 3 adjust: samples", 2),
            ("samples", (6, 6), "3 of 3 adjust: samples", 6),
            ("match", (3, 9), "3 of 3 adjust: match", 3),
        ] {
            position.report(stage, counts);
            assert_eq!((position.label().as_str(), position.counts.0), (label, shown), "{stage} {counts:?}");
        }
        let mut only = Position::new(STEPS[1..2].to_vec());
        only.report("match", (0, 3));
        assert_eq!(only.label(), "match");
    }
}
