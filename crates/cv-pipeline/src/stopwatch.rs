//! The time each stage of a job takes.

use std::time::Instant;

/// Collects the seconds of each stage, in the order in which stages first end.
#[derive(Debug, Clone)]
pub struct Stopwatch {
    last: Instant,
    stages: Vec<(&'static str, f64)>,
}

impl Stopwatch {
    /// Starts now.
    pub fn new() -> Self {
        Self { last: Instant::now(), stages: Vec::new() }
    }

    /// Ends `stage`: it lasted from the last lap (or the start) until now. A name that comes again adds up.
    pub fn lap(&mut self, stage: &'static str) {
        let now = Instant::now();
        self.add(stage, now.duration_since(self.last).as_secs_f64());
        self.last = now;
    }

    /// Runs `work` as `stage`. What passed since the last lap belongs to no stage.
    pub fn time<T>(&mut self, stage: &'static str, work: impl FnOnce() -> T) -> T {
        self.last = Instant::now();
        let result = work();
        self.lap(stage);
        result
    }

    /// Adds seconds that were measured elsewhere, such as the stages of a job inside this one.
    pub fn add(&mut self, stage: &'static str, seconds: f64) {
        match self.stages.iter_mut().find(|(name, _)| *name == stage) {
            Some((_, sum)) => *sum += seconds,
            None => self.stages.push((stage, seconds)),
        }
    }

    /// The stages so far and their seconds.
    pub fn stages(&self) -> &[(&'static str, f64)] {
        &self.stages
    }

    /// The stages and their seconds.
    pub fn into_stages(self) -> Vec<(&'static str, f64)> {
        self.stages
    }

    /// The seconds of all stages together.
    pub fn total(&self) -> f64 {
        self.stages.iter().map(|(_, seconds)| seconds).sum()
    }
}

impl Default for Stopwatch {
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
        let mut watch = Stopwatch::new();
        assert_eq!(watch.time("b", || 7), 7);
        watch.add("a", 0.5);
        watch.add("b", 1.0);
        assert_eq!(watch.stages().iter().map(|s| s.0).collect::<Vec<_>>(), ["b", "a"]);
        assert!(watch.stages()[0].1 >= 1.0 && watch.total() >= 1.5);
    }

    #[test]
    fn a_lap_counts_from_the_last_one() {
        let mut watch = Stopwatch::new();
        sleep(Duration::from_millis(20));
        watch.lap("slept");
        watch.lap("did nothing");
        let seconds: Vec<f64> = watch.into_stages().into_iter().map(|s| s.1).collect();
        // `sleep` never returns early; the second lap only has to be shorter than the first.
        assert!(seconds[0] >= 0.02 && seconds[1] < seconds[0], "{seconds:?}");
    }
}
