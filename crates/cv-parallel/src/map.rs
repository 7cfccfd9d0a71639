//! Results of the items of a parallel iterator, in their order.

use crate::ParallelIterator;
use crate::batches::lock;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};

/// Items and what is computed of each, in parallel, when the results are collected. Made by [`ParallelIterator::map`].
#[must_use = "nothing is done until the results are collected"]
pub struct ParallelMap<I, N, F> {
    pub(crate) items: ParallelIterator<I>,
    pub(crate) init: N,
    pub(crate) of: F,
}

impl<I: ExactSizeIterator<Item: Send>, S: Send, N: Fn() -> S + Sync, F: Sync> ParallelMap<I, N, F> {
    /// Returns the results in the order of the items.
    pub fn collect<R: Send>(self) -> Vec<R>
    where
        F: Fn(&mut S, I::Item) -> R,
    {
        let (of, results) = (self.of, Results::default());
        self.items.for_each_batch(self.init, |state, start, batch| {
            results.push(start, batch.iter_mut().filter_map(Option::take).map(|item| of(state, item)).collect());
        });
        results.in_order()
    }

    /// Returns the results in the order of the items, if none is an error.
    ///
    /// # Errors
    /// That of the first item that failed; items after it may not have been processed.
    pub fn try_collect<T: Send, E: Send>(self) -> Result<Vec<T>, E>
    where
        F: Fn(&mut S, I::Item) -> Result<T, E>,
    {
        let (of, results, first) = (self.of, Results::default(), FirstError::default());
        self.items.for_each_batch(self.init, |state, start, batch| {
            let mut done = Vec::with_capacity(batch.len());
            for (i, item) in (start..).zip(batch) {
                if first.is_before(i) {
                    return;
                }
                match item.take().map(|item| of(state, item)) {
                    Some(Ok(result)) => done.push(result),
                    Some(Err(error)) => return first.set(i, error),
                    None => {}
                }
            }
            results.push(start, done);
        });
        first.into_result().map(|()| results.in_order())
    }
}

/// Results of batches.
struct Results<R>(Mutex<Batches<R>>);

/// Results of batches in the order in which they ended, and the index of each one's first item.
struct Batches<R> {
    starts: Vec<usize>,
    results: Vec<Vec<R>>,
}

impl<R> Default for Results<R> {
    fn default() -> Self {
        Self(Mutex::new(Batches { starts: Vec::new(), results: Vec::new() }))
    }
}

impl<R> Results<R> {
    fn push(&self, start: usize, batch: Vec<R>) {
        let mut batches = lock(&self.0);
        batches.starts.push(start);
        batches.results.push(batch);
    }

    fn in_order(self) -> Vec<R> {
        let Batches { starts, mut results } = self.0.into_inner().unwrap_or_else(PoisonError::into_inner);
        let mut all = Vec::with_capacity(results.iter().map(Vec::len).sum());
        for i in ascending(&starts) {
            all.append(&mut results[i]);
        }
        all
    }
}

/// Returns the indices of `starts` in ascending order of their values. Not generic: sorting is compiled once.
fn ascending(starts: &[usize]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..starts.len()).collect();
    order.sort_unstable_by_key(|&i| starts[i]);
    order
}

/// The error of the first item that failed.
struct FirstError<E> {
    /// Of the item; `usize::MAX` without one.
    index: AtomicUsize,
    error: Mutex<Option<E>>,
}

impl<E> Default for FirstError<E> {
    fn default() -> Self {
        Self { index: AtomicUsize::new(usize::MAX), error: Mutex::new(None) }
    }
}

impl<E> FirstError<E> {
    /// Returns whether an item before this one failed, so that this one does not matter.
    fn is_before(&self, index: usize) -> bool {
        self.index.load(Ordering::Relaxed) < index
    }

    fn set(&self, index: usize, error: E) {
        let mut kept = lock(&self.error);
        if self.index.fetch_min(index, Ordering::Relaxed) > index {
            *kept = Some(error);
        }
    }

    fn into_result(self) -> Result<(), E> {
        let error = self.error.into_inner().unwrap_or_else(PoisonError::into_inner);
        error.map_or(Ok(()), Err)
    }
}
