//! How a job tells its caller where it is, and hears whether to go on.

use std::sync::atomic::{AtomicUsize, Ordering};

/// Hears how far a job has come and says whether it goes on.
///
/// Jobs ask some ten times a second or more, from any thread, also in their longest stages: an answer must be cheap. Once it was to
/// stop, it stays so: the threads of a job ask by themselves.
pub trait Progress: Sync {
    /// `done` of `total` units of `stage` are finished. A stage whose length is unknown has `total` 0.
    ///
    /// # Errors
    /// [`Cancelled`] stops the job. It gives the same error back soon after (within 200 ms on a machine that is not busy) and leaves no
    /// partial result.
    fn report(&self, stage: &'static str, done: usize, total: usize) -> Result<(), Cancelled>;
}

/// A job was stopped by its [`Progress`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[error("stopped")]
pub struct Cancelled;

impl Cancelled {
    /// Whether an error, or what it is from, is that a job was stopped.
    pub fn is_cause_of(error: &(dyn std::error::Error + 'static)) -> bool {
        std::iter::successors(Some(error), |error| error.source()).any(|error| error.is::<Self>())
    }
}

/// Nobody is watching, and nothing is stopped.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Progress for Silent {
    fn report(&self, _: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
        Ok(())
    }
}

/// A stage of so many units, counted from any thread.
///
/// It is itself the [`Progress`] of what is done within a unit: reports from there are answered, and show as this stage.
pub struct Stage<'a> {
    progress: &'a dyn Progress,
    name: &'static str,
    done: AtomicUsize,
    total: usize,
}

impl<'a> Stage<'a> {
    /// Begins a stage: reports that none of its units is done.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn new(progress: &'a dyn Progress, name: &'static str, total: usize) -> Result<Self, Cancelled> {
        progress.report(name, 0, total)?;
        Ok(Self { progress, name, done: AtomicUsize::new(0), total })
    }

    /// Reports that so many more units are done.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn add(&self, units: usize) -> Result<(), Cancelled> {
        let done = self.done.fetch_add(units, Ordering::Relaxed) + units;
        self.progress.report(self.name, done, self.total)
    }

    /// Asks whether to go on.
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

    /// Remembers what it was told and stops at a given number of reports.
    struct Until(usize, Mutex<Vec<(&'static str, usize, usize)>>);

    impl Progress for Until {
        fn report(&self, stage: &'static str, done: usize, total: usize) -> Result<(), Cancelled> {
            let mut told = self.1.lock().unwrap();
            told.push((stage, done, total));
            if told.len() >= self.0 { Err(Cancelled) } else { Ok(()) }
        }
    }

    #[test]
    fn a_stage_counts_its_units_and_answers_what_is_within_them() {
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
    fn that_a_job_was_stopped_is_found_under_other_errors() {
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
