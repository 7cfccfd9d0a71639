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

/// A part of a command's work that a person would name, and the stages of the libraries that it consists of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Step {
    pub(crate) name: &'static str,
    pub(crate) stages: &'static [&'static str],
}

/// A bar on stderr, hidden where stderr is not a terminal or nobody wants to see it.
pub(super) struct Bar(Option<Mutex<State>>);

struct State {
    start: Instant,
    at: Place,
    /// None while nothing stands on the line.
    drawn: Option<Instant>,
}

impl Bar {
    pub(super) fn new(quiet: bool) -> Self {
        let shown = !quiet && io::stderr().is_terminal();
        Self(shown.then(|| Mutex::new(State { start: Instant::now(), at: Place::new(Vec::new()), drawn: None })))
    }

    /// Says which steps will come.
    pub(super) fn expect(&self, steps: Vec<Step>) {
        if let Some(state) = &self.0 {
            state.lock().unwrap_or_else(PoisonError::into_inner).at = Place::new(steps);
        }
    }

    /// Draws how far a stage is.
    pub(super) fn show(&self, stage: &'static str, done: usize, total: usize) {
        let Some(state) = &self.0 else { return };
        let mut state = state.lock().unwrap_or_else(PoisonError::into_inner);
        let begins = state.at.report(stage, (done, total));
        // Of several that take turns, whichever comes first after the period is drawn; a step that begins is drawn at once, since it may be silent for long.
        if !begins && state.drawn.is_some_and(|drawn| drawn.elapsed() < PERIOD) {
            return;
        }
        state.drawn = Some(Instant::now());
        let text = line(&state.at.label(), state.at.share, state.at.since.elapsed(), state.start.elapsed());
        write(&format!("\r\x1b[2K{text}"));
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

/// Shorter stages end before anybody could read when.
const LONG: Duration = Duration::from_secs(2);

/// Where a command is among its steps.
struct Place {
    steps: Vec<Step>,
    /// The step that goes on, by its number from 0.
    step: Option<usize>,
    /// The stage whose share is shown, that share, and when the stage began.
    stage: &'static str,
    share: (usize, usize),
    since: Instant,
}

impl Place {
    fn new(steps: Vec<Step>) -> Self {
        Self { steps, step: None, stage: "", share: (0, 0), since: Instant::now() }
    }

    /// Takes in what a stage reports. True where a step or a stage begins that is shown from now on.
    ///
    /// Steps do not go back: a stage of an earlier one, or of none, is a part of the step that goes on, and is shown where the step has no share of its own.
    fn report(&mut self, stage: &'static str, share: (usize, usize)) -> bool {
        let step = self.steps.iter().position(|step| step.stages.contains(&stage));
        let own = step.is_some() && step >= self.step;
        let goes_on = self.step.is_some() && stage != self.stage && self.share.0 < self.share.1 && self.share.1 >= 2;
        if !own && goes_on {
            return false;
        }
        let begins = stage != self.stage;
        if begins {
            (self.stage, self.since) = (stage, Instant::now());
        }
        if own {
            self.step = step;
        }
        self.share = share;
        begins
    }

    fn label(&self) -> String {
        let Some(at) = self.step else { return self.stage.to_owned() };
        let name = self.steps[at].name;
        let number = if self.steps.len() > 1 { format!("{} of {} ", at + 1, self.steps.len()) } else { String::new() };
        if self.stage == name { format!("{number}{name}") } else { format!("{number}{name}: {}", self.stage) }
    }
}

/// What goes on, its share, and the time since the start; of what takes long also its rate and the time it will still take.
fn line(label: &str, (done, total): (usize, usize), in_stage: Duration, elapsed: Duration) -> String {
    let name = format!("{label:30}");
    // A stage of one unit has no share: a mark that moves says that it goes on.
    if total < 2 {
        let at = (elapsed.as_millis() / PERIOD.as_millis()) as usize % WIDTH;
        return format!("{name} {}#{}       {} s", "-".repeat(at), "-".repeat(WIDTH - 1 - at), elapsed.as_secs());
    }
    let done = done.min(total);
    let full = done * WIDTH / total;
    let (bar, rest) = ("#".repeat(full), "-".repeat(WIDTH - full));
    let mut text = format!("{name} {bar}{rest} {:3} %  {} s", done * 100 / total, elapsed.as_secs());
    if in_stage >= LONG && done > 0 && done < total {
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
    fn the_bar_fills_and_tells_its_share() {
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
    fn long_stages_tell_their_rate_and_the_time_left() {
        let text = line("frames", (20, 100), seconds(10.0), seconds(12.0));
        assert!(text.ends_with("20 %  12 s, 2.0 of 100 a second, 40 s left"), "{text}");
        for (done, in_stage) in [(0, 10.0), (100, 10.0), (20, 1.0)] {
            assert!(!line("frames", (done, 100), seconds(in_stage), seconds(12.0)).contains("left"));
        }
    }

    #[test]
    fn a_stage_without_a_share_moves() {
        for total in [0, 1] {
            let [a, b] = [1.0, 1.1].map(|at| line("adjust", (0, total), seconds(at), seconds(at)));
            assert!(a != b && a.matches('#').count() == 1 && !a.contains('%'), "{a}\n{b}");
        }
    }

    #[test]
    fn a_command_tells_the_number_of_its_step_and_never_goes_back() {
        const STEPS: [Step; 3] = [
            Step { name: "features", stages: &["scale space", "describe"] },
            Step { name: "match", stages: &["match"] },
            Step { name: "adjust", stages: &["adjust"] },
        ];
        let mut place = Place::new(STEPS.to_vec());
        for (stage, share, label, shown) in [
            ("scale space", (0, 4), "1 of 3 features: scale space", 0),
            ("scale space", (4, 4), "1 of 3 features: scale space", 4),
            ("describe", (1, 9), "1 of 3 features: describe", 1),
            // Within a step that has a share, its own is shown.
            ("match", (1, 9), "2 of 3 match", 1),
            ("samples", (5, 6), "2 of 3 match", 1),
            ("match", (9, 9), "2 of 3 match", 9),
            ("samples", (5, 6), "2 of 3 match: samples", 5),
            ("adjust", (0, 1), "3 of 3 adjust", 0),
            ("samples", (2, 6), "3 of 3 adjust: samples", 2),
            ("samples", (6, 6), "3 of 3 adjust: samples", 6),
            ("match", (3, 9), "3 of 3 adjust: match", 3),
        ] {
            place.report(stage, share);
            assert_eq!((place.label().as_str(), place.share.0), (label, shown), "{stage} {share:?}");
        }
        let mut only = Place::new(STEPS[1..2].to_vec());
        only.report("match", (0, 3));
        assert_eq!(only.label(), "match");
    }
}
