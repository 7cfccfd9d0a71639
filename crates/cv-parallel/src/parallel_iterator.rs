//! Parallel iterators over the items of an ordinary iterator.

use crate::ParallelMap;
use crate::batches::{for_each_batch, lock};
use std::iter::{Enumerate, Skip, Take, Zip};
use std::slice::{Chunks, ChunksMut, Iter, IterMut};
use std::sync::Mutex;

/// Items to be processed in parallel.
#[derive(Clone, Debug)]
#[must_use = "nothing is done until a loop over the items is called"]
pub struct ParallelIterator<I> {
    items: I,
    min_len: usize,
    max_len: usize,
}

/// Types whose items can be processed in parallel: ranges and vectors.
pub trait IntoParallelIterator: IntoIterator<IntoIter: ExactSizeIterator> + Sized {
    /// Returns a parallel iterator over the items.
    fn into_par_iter(self) -> ParallelIterator<Self::IntoIter> {
        ParallelIterator::new(self.into_iter())
    }
}

impl<C: IntoIterator<IntoIter: ExactSizeIterator>> IntoParallelIterator for C {}

/// Parallel iterators over the elements and chunks of a slice.
pub trait ParallelSlice<T> {
    /// Returns a parallel iterator over references to the elements.
    fn par_iter(&self) -> ParallelIterator<Iter<'_, T>>;

    /// Returns a parallel iterator over chunks of `size` elements, the last one of the rest.
    ///
    /// # Panics
    /// If `size` is 0.
    fn par_chunks(&self, size: usize) -> ParallelIterator<Chunks<'_, T>>;
}

/// Parallel iterators over the elements and chunks of a mutable slice.
pub trait ParallelSliceMut<T> {
    /// Returns a parallel iterator over mutable references to the elements.
    fn par_iter_mut(&mut self) -> ParallelIterator<IterMut<'_, T>>;

    /// Returns a parallel iterator over mutable chunks of `size` elements, the last one of the rest.
    ///
    /// # Panics
    /// If `size` is 0.
    fn par_chunks_mut(&mut self, size: usize) -> ParallelIterator<ChunksMut<'_, T>>;
}

impl<T> ParallelSlice<T> for [T] {
    fn par_iter(&self) -> ParallelIterator<Iter<'_, T>> {
        ParallelIterator::new(self.iter())
    }

    fn par_chunks(&self, size: usize) -> ParallelIterator<Chunks<'_, T>> {
        ParallelIterator::new(self.chunks(size))
    }
}

impl<T> ParallelSliceMut<T> for [T] {
    fn par_iter_mut(&mut self) -> ParallelIterator<IterMut<'_, T>> {
        ParallelIterator::new(self.iter_mut())
    }

    fn par_chunks_mut(&mut self, size: usize) -> ParallelIterator<ChunksMut<'_, T>> {
        ParallelIterator::new(self.chunks_mut(size))
    }
}

/// So that one can be zipped to another.
impl<I: Iterator> IntoIterator for ParallelIterator<I> {
    type Item = I::Item;
    type IntoIter = I;

    fn into_iter(self) -> I {
        self.items
    }
}

impl<I> ParallelIterator<I> {
    fn new(items: I) -> Self {
        Self { items, min_len: 1, max_len: usize::MAX }
    }
}

impl<I: ExactSizeIterator<Item: Send>> ParallelIterator<I> {
    fn with<J>(self, change: impl FnOnce(I) -> J) -> ParallelIterator<J> {
        ParallelIterator { items: change(self.items), min_len: self.min_len, max_len: self.max_len }
    }

    /// Sets the minimum number of items that a thread takes at a time (default 1), for items of less than a microsecond.
    pub fn with_min_len(self, min_len: usize) -> Self {
        Self { min_len, ..self }
    }

    /// Sets the maximum number of items that a thread takes at a time (default unlimited), for items of very unequal times.
    pub fn with_max_len(self, max_len: usize) -> Self {
        Self { max_len, ..self }
    }

    /// Pairs the items with their indices.
    pub fn enumerate(self) -> ParallelIterator<Enumerate<I>> {
        self.with(I::enumerate)
    }

    /// Pairs the items with those of another iterator, parallel or not; the shorter one ends it.
    pub fn zip<Z: IntoIterator<IntoIter: ExactSizeIterator>>(self, other: Z) -> ParallelIterator<Zip<I, Z::IntoIter>> {
        self.with(|items| items.zip(other))
    }

    /// Leaves out the first `n` items.
    pub fn skip(self, n: usize) -> ParallelIterator<Skip<I>> {
        self.with(|items| items.skip(n))
    }

    /// Leaves out all but the first `n` items.
    pub fn take(self, n: usize) -> ParallelIterator<Take<I>> {
        self.with(|items| items.take(n))
    }

    /// Calls `work` for each item, in parallel.
    pub fn for_each(self, work: impl Fn(I::Item) + Sync) {
        self.for_each_init(|| (), |(), item| work(item));
    }

    /// As [`Self::for_each`], with a state (scratch buffers) of each thread, made by `init`.
    pub fn for_each_init<S: Send>(self, init: impl Fn() -> S + Sync, work: impl Fn(&mut S, I::Item) + Sync) {
        self.for_each_batch(init, |state, _, batch| {
            batch.iter_mut().for_each(|item| item.take().into_iter().for_each(|item| work(state, item)));
        });
    }

    /// Calls `work` for each item, in parallel, until one fails.
    ///
    /// # Errors
    /// That of the first item for which `work` fails; items after it may be missing.
    pub fn try_for_each<E: Send>(self, work: impl Fn(I::Item) -> Result<(), E> + Sync) -> Result<(), E> {
        self.try_for_each_init(|| (), |(), item| work(item))
    }

    /// As [`Self::try_for_each`], with a state (scratch buffers) of each thread, made by `init`.
    ///
    /// # Errors
    /// That of the first item for which `work` fails; items after it may be missing.
    pub fn try_for_each_init<S: Send, E: Send>(
        self,
        init: impl Fn() -> S + Sync,
        work: impl Fn(&mut S, I::Item) -> Result<(), E> + Sync,
    ) -> Result<(), E> {
        // Results of no size take no memory.
        self.map_init(init, work).try_collect().map(|_| ())
    }

    /// Applies `of` to each item; the results are made, in parallel, when they are collected.
    pub fn map<R: Send, F: Fn(I::Item) -> R + Sync>(
        self,
        of: F,
    ) -> ParallelMap<I, impl Fn() + Sync, impl Fn(&mut (), I::Item) -> R + Sync> {
        self.map_init(|| (), move |(), item| of(item))
    }

    /// As [`Self::map`], with a state (scratch buffers) of each thread, made by `init`.
    pub fn map_init<S: Send, R: Send, N: Fn() -> S + Sync, F: Fn(&mut S, I::Item) -> R + Sync>(
        self,
        init: N,
        of: F,
    ) -> ParallelMap<I, N, F> {
        ParallelMap { items: self, init, of }
    }

    /// Calls `work` for batches of items, with a state that no other batch uses at the time, and the index of the first item.
    pub(crate) fn for_each_batch<S: Send>(
        mut self,
        init: impl Fn() -> S + Sync,
        work: impl Fn(&mut S, usize, &mut [Option<I::Item>]) + Sync,
    ) {
        let (len, states) = (self.items.len(), Mutex::new(Vec::new()));
        for_each_batch(&mut self.items, len, (self.min_len, self.max_len), &|start, batch| {
            let state = lock(&states).pop();
            let mut state = state.unwrap_or_else(&init);
            work(&mut state, start, batch);
            lock(&states).push(state);
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

    /// Runs a test with one thread and with four.
    fn with_threads(test: impl Fn() + Sync) {
        for threads in [1, 4] {
            rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(&test);
        }
    }

    #[test]
    fn every_item_is_processed_once_and_results_come_in_order() {
        with_threads(|| {
            for n in [0, 1, 2, 63, 64, 1000, 100_003] {
                for min_len in [0, 1, 7, 1 << 20] {
                    let squares = (0..n).into_par_iter().with_min_len(min_len).map(|i| i * i).collect();
                    assert_eq!(squares, (0..n).map(|i| i * i).collect::<Vec<_>>());
                    let mut counts = vec![0; n];
                    counts.par_iter_mut().with_min_len(min_len).enumerate().for_each(|(i, count)| *count += i + 1);
                    assert_eq!(counts, (1..=n).collect::<Vec<_>>());
                }
            }
        });
    }

    #[test]
    fn adaptors_are_those_of_ordinary_iterators() {
        let (mut a, b): (Vec<usize>, Vec<usize>) = ((0..103).collect(), (0..50).rev().collect());
        let rows = a.clone();
        let expected: Vec<(usize, usize)> =
            rows.chunks(4).zip(b.chunks(2)).skip(3).take(17).map(|(x, y)| (x[0], y[0])).collect();
        with_threads(|| {
            let pairs = rows.par_chunks(4).zip(b.par_chunks(2)).skip(3).take(17);
            assert_eq!(pairs.map(|(x, y)| (x[0], y[0])).collect(), expected);
        });
        a.par_chunks_mut(10).zip(&b).enumerate().for_each(|(i, (chunk, b))| chunk.fill(100 * i + b));
        assert_eq!((a[0], a[19], a[102]), (49, 148, 1039));
    }

    #[test]
    fn the_first_error_is_returned_at_any_number_of_threads() {
        with_threads(|| {
            for _ in 0..50 {
                let of = |i: usize| if i % 100 == 57 { Err(i) } else { Ok(i) };
                assert_eq!((0..1000).into_par_iter().map(of).try_collect(), Err(57));
                assert_eq!((0..57).into_par_iter().map(of).try_collect(), Ok((0..57).collect()));
                assert_eq!((0..1000).into_par_iter().try_for_each(|i| of(i).map(drop)), Err(57));
                assert_eq!((0..57).into_par_iter().try_for_each(|i| of(i).map(drop)), Ok(()));
            }
        });
    }

    #[test]
    fn an_error_ends_the_loop() {
        let count = AtomicUsize::new(0);
        let work = |_| {
            count.fetch_add(1, Ordering::Relaxed);
            Err(())
        };
        assert_eq!((0..100_000).into_par_iter().try_for_each(work), Err(()));
        // Each batch may have begun, while the first one had not failed yet.
        assert!(count.into_inner() <= 64 * rayon::current_num_threads() + 64);
    }

    #[test]
    fn a_state_belongs_to_one_thread_at_a_time_and_there_are_few() {
        with_threads(|| {
            let made = AtomicUsize::new(0);
            let init = || {
                made.fetch_add(1, Ordering::Relaxed);
                AtomicBool::new(false)
            };
            (0..10_000).into_par_iter().for_each_init(init, |in_use, _| {
                assert!(!in_use.swap(true, Ordering::SeqCst));
                in_use.store(false, Ordering::SeqCst);
            });
            assert!((1..=rayon::current_num_threads()).contains(&made.into_inner()));
        });
    }

    #[test]
    fn loops_within_loops_end() {
        with_threads(|| {
            let sums = (0..100).into_par_iter().map(|i| (0..i).into_par_iter().map(|j| j).collect().len()).collect();
            assert_eq!(sums, (0..100).collect::<Vec<_>>());
        });
    }

    #[test]
    #[should_panic(expected = "of an item")]
    fn a_panic_reaches_the_caller() {
        (0..1000).into_par_iter().for_each(|i| assert_ne!(i, 500, "of an item"));
    }
}
