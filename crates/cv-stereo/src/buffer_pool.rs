//! Parallel work whose buffers are kept: those that rayon's `for_each_init` creates are freed and mapped again many times in a call.

use cv_core::Cancelled;
use cv_parallel::prelude::*;
use std::sync::{Mutex, PoisonError};

/// Calls `work` with each item, in parallel, and one of `buffers`, of which there is one per thread.
pub(crate) fn try_for_each<B: Default + Send, I: Send>(
    buffers: &mut Vec<B>,
    items: impl Iterator<Item = I> + Send,
    work: impl Fn(&mut B, I) -> Result<(), Cancelled> + Sync,
) -> Result<(), Cancelled> {
    buffers.resize_with(rayon::current_num_threads(), B::default);
    distribute(buffers, items, work)
}

/// Calls `work` with each item, in parallel, and one of `buffers`.
pub(crate) fn distribute<B: Send, I: Send>(
    buffers: &mut [B],
    items: impl Iterator<Item = I> + Send,
    work: impl Fn(&mut B, I) -> Result<(), Cancelled> + Sync,
) -> Result<(), Cancelled> {
    let items = Mutex::new(items);
    let next = || items.lock().unwrap_or_else(PoisonError::into_inner).next();
    buffers.par_iter_mut().try_for_each(|buffer| {
        while let Some(item) = next() {
            work(buffer, item)?;
        }
        Ok(())
    })
}
