//! Every job stops when its progress callback returns stop, at any report.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod stopping;

use cv_core::{Cancelled, Progress};
use std::sync::atomic::{AtomicUsize, Ordering};
use stopping::{End, jobs};

/// Stops at a given number of reports.
struct StopAt {
    at: usize,
    reports: AtomicUsize,
}

impl StopAt {
    fn new(at: usize) -> Self {
        Self { at, reports: AtomicUsize::new(0) }
    }

    fn reports(&self) -> usize {
        self.reports.load(Ordering::Relaxed)
    }
}

impl Progress for StopAt {
    fn report(&self, stage: &'static str, done: usize, total: usize) -> Result<(), Cancelled> {
        assert!(done <= total || total == 0, "{stage}: {done} of {total}");
        assert!(!stage.is_empty());
        if self.reports.fetch_add(1, Ordering::Relaxed) + 1 >= self.at { Err(Cancelled) } else { Ok(()) }
    }
}

const THREADS: usize = 2;
/// Each thread has one unit in progress when the job is stopped, and one more of each enclosing loop that waits: two of
/// them at most (RANSAC, chunks of samples).
const MORE: usize = 3 * THREADS;

#[test]
fn every_job_stops_at_any_report() {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(THREADS).build().unwrap();
    for (name, job) in jobs(160_000) {
        let watch = StopAt::new(usize::MAX);
        assert_eq!(pool.install(|| job(&watch)), End::Done, "{name}");
        let all = watch.reports();
        // Ten times in the fifty milliseconds or more that each of these jobs takes on any machine.
        assert!(all >= 10, "{name}: {all} reports");
        let moments = [1, 2, all / 7, all / 3, all / 2, 3 * all / 4, 7 * all / 8, all - 1, all];
        for at in moments {
            let watch = StopAt::new(at);
            assert_eq!(pool.install(|| job(&watch)), End::Stopped, "{name} at report {at} of {all}");
            let more = watch.reports() - at;
            assert!(more <= MORE, "{name} at report {at} of {all}: {more} more");
        }
    }
}
