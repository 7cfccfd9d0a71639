//! The longest time of a job between two progress reports. Alone in its file: it measures the processor time of the
//! whole process.

#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod stopping;

use cv_core::{Cancelled, Progress};
use std::sync::Mutex;
use std::time::{Duration, Instant};
use stopping::{End, jobs};

const PIXELS: usize = 4_000_000;
const THREADS: usize = 2;
/// Processor time in seconds of all threads between two reports: 200 ms on each of two threads, for images of 12
/// megapixels, of which these have a third; half as much again for overflow checks in tests. (Wall-clock time depends
/// on the load of the machine.)
const LONGEST: f64 = 1.5 * 0.2 * THREADS as f64 / 3.0;
/// Interval between readings of the clock, which take some microseconds.
const FINE: Duration = Duration::from_millis(5);

/// Returns the processor time of all threads of this process, in seconds.
fn processor_seconds() -> f64 {
    let tasks = std::fs::read_dir("/proc/self/task").unwrap();
    let nanoseconds = |task: std::io::Result<std::fs::DirEntry>| -> f64 {
        // A thread may have ended meanwhile.
        let text = std::fs::read_to_string(task.unwrap().path().join("schedstat")).unwrap_or_default();
        text.split_whitespace().next().and_then(|n| n.parse().ok()).unwrap_or(0.0)
    };
    tasks.map(nanoseconds).sum::<f64>() * 1e-9
}

/// Number of attempts for each job.
const ATTEMPTS: usize = 4;

struct Gaps(Mutex<State>);

struct State {
    read: Instant,
    computed: f64,
    stage: &'static str,
    longest: (f64, &'static str, &'static str),
}

impl Gaps {
    fn new() -> Self {
        let now = State { read: Instant::now(), computed: processor_seconds(), stage: "start", longest: (0.0, "", "") };
        Self(Mutex::new(now))
    }

    /// Records the gap that ends now. Its measured length is too long by [`FINE`] for each thread at most, never too
    /// short.
    fn note(&self, stage: &'static str) {
        let mut state = self.0.lock().unwrap();
        if state.read.elapsed() >= FINE {
            let now = processor_seconds();
            let gap = now - state.computed;
            if gap > state.longest.0 {
                state.longest = (gap, state.stage, stage);
            }
            (state.read, state.computed) = (Instant::now(), now);
        }
        state.stage = stage;
    }
}

impl Progress for Gaps {
    fn report(&self, stage: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
        self.note(stage);
        Ok(())
    }
}

#[test]
fn no_job_runs_for_long_without_a_report() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(THREADS).build().unwrap();
    for (name, job) in jobs(PIXELS) {
        let run = || {
            let gaps = Gaps::new();
            assert_eq!(pool.install(|| job(&gaps)), End::Done, "{name}");
            gaps.note("end");
            gaps.0.into_inner().unwrap().longest
        };
        // A shared or throttled processor makes a gap longer, never shorter.
        let mut longest = run();
        for _ in 1..ATTEMPTS {
            if longest.0 > LONGEST {
                let again = run();
                longest = if again.0 < longest.0 { again } else { longest };
            }
        }
        let (seconds, from, to) = longest;
        println!("{name}: {:.0} ms from {from} to {to}", 1e3 * seconds);
        assert!(seconds <= LONGEST, "{name}: {seconds:.3} s of computing from {from} to {to}");
    }
}
