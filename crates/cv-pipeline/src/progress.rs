//! How a job tells its caller where it is.

/// Hears how far a job has come. Jobs call it from any thread, a few hundred times at most.
pub trait Progress: Sync {
    /// `done` of `total` units of `stage` are finished. A stage whose length is unknown has `total` 0.
    fn report(&self, stage: &'static str, done: usize, total: usize);
}

/// Nobody is watching.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Progress for Silent {
    fn report(&self, _: &'static str, _: usize, _: usize) {}
}
