//! Progress reports and cancellation of jobs.

use std::sync::atomic::{AtomicUsize, Ordering};

/// Receives a job's progress and decides whether it continues.
///
/// Jobs report about ten times a second or more, from any thread: `report` must be cheap. Once it has returned [`Cancelled`] it must
/// keep doing so, since the threads of a job report independently.
pub trait Progress: Sync {
    /// Receives that `done` of `total` units of `stage` are finished; `total` is 0 where it is unknown.
    ///
    /// # Errors
    /// [`Cancelled`] stops the job, which then returns the same error (within 200 ms on an idle machine) and no partial result.
    fn report(&self, stage: &'static str, done: usize, total: usize) -> Result<(), Cancelled>;
}

/// A job was stopped by its [`Progress`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[error("stopped")]
pub struct Cancelled;

impl Cancelled {
    /// Whether `error` or one in its chain of sources is [`Cancelled`].
    pub fn is_cause_of(error: &(dyn std::error::Error + 'static)) -> bool {
        std::iter::successors(Some(error), |error| error.source()).any(|error| error.is::<Self>())
    }
}

/// A [`Progress`] that ignores reports and never cancels.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Progress for Silent {
    fn report(&self, _: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
        Ok(())
    }
}

/// A stage of `total` units of work, counted from any thread.
///
/// It is itself a [`Progress`] for nested work: nested reports are forwarded as this stage's own count.
pub struct Stage<'a> {
    progress: &'a dyn Progress,
    name: &'static str,
    done: AtomicUsize,
    total: usize,
}

impl<'a> Stage<'a> {
    /// Begins a stage and reports it with no unit done.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn new(progress: &'a dyn Progress, name: &'static str, total: usize) -> Result<Self, Cancelled> {
        progress.report(name, 0, total)?;
        Ok(Self { progress, name, done: AtomicUsize::new(0), total })
    }

    /// Adds `units` finished units and reports the sum.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn add(&self, units: usize) -> Result<(), Cancelled> {
        let done = self.done.fetch_add(units, Ordering::Relaxed) + units;
        self.progress.report(self.name, done, self.total)
    }

    /// Reports without new units, to check for cancellation.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn check(&self) -> Result<(), Cancelled> {
        self.add(0)
    }
}

impl Progress for Stage<'_> {
    fn report(&self, _: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
        self.check()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Mutex;

    /// Records its reports and cancels at a given number of them.
    struct Until(usize, Mutex<Vec<(&'static str, usize, usize)>>);

    impl Progress for Until {
        fn report(&self, stage: &'static str, done: usize, total: usize) -> Result<(), Cancelled> {
            let mut reports = self.1.lock().unwrap();
            reports.push((stage, done, total));
            if reports.len() >= self.0 { Err(Cancelled) } else { Ok(()) }
        }
    }

    #[test]
    fn a_stage_counts_its_units_and_forwards_nested_reports() {
        let progress = Until(5, Mutex::default());
        let stage = Stage::new(&progress, "rows", 10).unwrap();
        stage.add(1).unwrap();
        stage.report("inner", 7, 8).unwrap();
        stage.add(3).unwrap();
        assert_eq!(stage.check(), Err(Cancelled));
        let expected = [("rows", 0, 10), ("rows", 1, 10), ("rows", 1, 10), ("rows", 4, 10), ("rows", 4, 10)];
        assert_eq!(*progress.1.lock().unwrap(), expected);
        assert!(Stage::new(&progress, "more", 1).is_err());
    }

    #[test]
    fn cancellation_is_found_in_a_chain_of_sources() {
        #[derive(Debug, thiserror::Error)]
        #[error("inner")]
        struct Inner(#[from] Cancelled);
        #[derive(Debug, thiserror::Error)]
        enum Outer {
            #[error(transparent)]
            Through(#[from] Inner),
            #[error("other")]
            Other(#[source] std::io::Error),
        }
        assert!(Cancelled::is_cause_of(&Cancelled) && Cancelled::is_cause_of(&Outer::from(Inner(Cancelled))));
        assert!(!Cancelled::is_cause_of(&Outer::Other(std::io::Error::other("full"))));
    }
}
