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
    /// The steps in the order in which they began, and when. Some take turns: each keeps its number and its time.
    steps: Vec<(&'static str, Instant)>,
    /// None while nothing stands on the line.
    drawn: Option<Instant>,
}

impl Bar {
    pub(super) fn new(quiet: bool) -> Self {
        let shown = !quiet && io::stderr().is_terminal();
        Self(shown.then(|| Mutex::new(State { start: Instant::now(), steps: Vec::new(), drawn: None })))
    }

    /// Draws how far a stage is.
    pub(super) fn show(&self, stage: &'static str, done: usize, total: usize) {
        let Some(state) = &self.0 else { return };
        let mut state = state.lock().unwrap_or_else(PoisonError::into_inner);
        let known = state.steps.iter().position(|(name, _)| *name == stage);
        // Of several that take turns, whichever comes first after the period is drawn; one that begins is drawn at once, since it may be silent for long.
        if known.is_some() && state.drawn.is_some_and(|drawn| drawn.elapsed() < PERIOD) {
            return;
        }
        let step = known.unwrap_or_else(|| {
            state.steps.push((stage, Instant::now()));
            state.steps.len() - 1
        });
        state.drawn = Some(Instant::now());
        let (elapsed, in_step) = (state.start.elapsed(), state.steps[step].1.elapsed());
        write(&format!("\r\x1b[2K{}", line(step + 1, stage, (done, total), in_step, elapsed)));
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

/// Shorter steps end before anybody could read when.
const LONG: Duration = Duration::from_secs(2);

/// The number of the step and its name, its share, and the time since the start; of a long step also its rate and the time it will still take.
fn line(step: usize, stage: &str, (done, total): (usize, usize), in_step: Duration, elapsed: Duration) -> String {
    let name = format!("{step:2}. {stage:18}");
    // A step of one unit has no share: a mark that moves says that it goes on.
    if total < 2 {
        let at = (elapsed.as_millis() / PERIOD.as_millis()) as usize % WIDTH;
        return format!("{name} {}#{}       {} s", "-".repeat(at), "-".repeat(WIDTH - 1 - at), elapsed.as_secs());
    }
    let done = done.min(total);
    let full = done * WIDTH / total;
    let (bar, rest) = ("#".repeat(full), "-".repeat(WIDTH - full));
    let mut text = format!("{name} {bar}{rest} {:3} %  {} s", done * 100 / total, elapsed.as_secs());
    if in_step >= LONG && done > 0 && done < total {
        let rate = done as f64 / in_step.as_secs_f64();
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
            let text = line(1, "x", (done, total), Duration::ZERO, Duration::ZERO);
            (text.matches('#').count(), text.contains(&format!("{:3} %", done.min(total) * 100 / total)))
        };
        assert_eq!(
            [filled(0, 3), filled(1, 2), filled(3, 3), filled(9, 3)],
            [(0, true), (15, true), (30, true), (30, true)]
        );
        assert!(line(4, "warping", (2, 7), seconds(0.5), seconds(61.5)).starts_with(" 4. warping "));
    }

    #[test]
    fn long_steps_tell_their_rate_and_the_time_left() {
        let text = line(2, "frames", (20, 100), seconds(10.0), seconds(12.0));
        assert!(text.ends_with("20 %  12 s, 2.0 of 100 a second, 40 s left"), "{text}");
        for (done, in_step) in [(0, 10.0), (100, 10.0), (20, 1.0)] {
            assert!(!line(2, "frames", (done, 100), seconds(in_step), seconds(12.0)).contains("left"));
        }
    }

    #[test]
    fn a_step_without_a_share_moves() {
        for total in [0, 1] {
            let [a, b] = [1.0, 1.1].map(|at| line(3, "adjust", (0, total), seconds(at), seconds(at)));
            assert!(a != b && a.matches('#').count() == 1 && !a.contains('%'), "{a}\n{b}");
        }
    }
}
