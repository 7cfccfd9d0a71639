//! Timing of the stages of a job.

use std::time::Instant;

/// Collects the seconds of each stage, in the order in which stages first end.
///
/// The only clock of the library crates. `wasm32-unknown-unknown` has none (`Instant::now` panics there): every stage counts 0 s.
#[derive(Debug, Clone)]
pub struct StageClock {
    last: Option<Instant>,
    stages: Vec<(&'static str, f64)>,
}

impl StageClock {
    /// Starts the clock.
    pub fn new() -> Self {
        Self { last: now(), stages: Vec::new() }
    }

    /// Ends `stage`, which lasted from the last lap (or the start) until now. Times of repeated names add up.
    pub fn lap(&mut self, stage: &'static str) {
        let now = now();
        let seconds = now.zip(self.last).map_or(0.0, |(now, last)| now.duration_since(last).as_secs_f64());
        self.add(stage, seconds);
        self.last = now;
    }

    /// Runs `work` and times it as `stage`. The time since the last lap is not counted.
    pub fn time<T>(&mut self, stage: &'static str, work: impl FnOnce() -> T) -> T {
        self.last = now();
        let result = work();
        self.lap(stage);
        result
    }

    /// Adds seconds measured elsewhere, such as the stages of a nested job.
    pub fn add(&mut self, stage: &'static str, seconds: f64) {
        match self.stages.iter_mut().find(|(name, _)| *name == stage) {
            Some((_, sum)) => *sum += seconds,
            None => self.stages.push((stage, seconds)),
        }
    }

    /// Returns the stages so far and their seconds.
    pub fn stages(&self) -> &[(&'static str, f64)] {
        &self.stages
    }

    /// Returns the stages and their seconds.
    pub fn into_stages(self) -> Vec<(&'static str, f64)> {
        self.stages
    }

    /// Returns the sum of all stages in seconds.
    pub fn total(&self) -> f64 {
        self.stages.iter().map(|(_, seconds)| seconds).sum()
    }
}

/// `None` where there is no clock.
fn now() -> Option<Instant> {
    (!cfg!(all(target_arch = "wasm32", target_os = "unknown"))).then(Instant::now)
}

impl Default for StageClock {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::{thread::sleep, time::Duration};

    #[test]
    fn stages_keep_their_order_and_a_repeated_one_adds_up() {
        let mut clock = StageClock::new();
        assert_eq!(clock.time("b", || 7), 7);
        clock.add("a", 0.5);
        clock.add("b", 1.0);
        assert_eq!(clock.stages().iter().map(|s| s.0).collect::<Vec<_>>(), ["b", "a"]);
        assert!(clock.stages()[0].1 >= 1.0 && clock.total() >= 1.5);
    }

    #[test]
    fn a_lap_counts_from_the_last_one() {
        let mut clock = StageClock::new();
        sleep(Duration::from_millis(20));
        clock.lap("slept");
        clock.lap("did nothing");
        let seconds: Vec<f64> = clock.into_stages().into_iter().map(|s| s.1).collect();
        // `sleep` never returns early; the second lap only has to be shorter than the first.
        assert!(seconds[0] >= 0.02 && seconds[1] < seconds[0], "{seconds:?}");
    }
}
