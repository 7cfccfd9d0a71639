//! The only instance of a rayon loop, over batches of items.

use rayon::prelude::*;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Batches per thread: few enough that they cost little, and enough that the threads end at about the same time if items take unequal time.
const BATCHES_PER_THREAD: usize = 32;

/// Work on a batch: gets the index of its first item, and the items, each of which it takes.
pub(crate) type BatchWork<'a, P> = dyn Fn(usize, &mut [Option<P>]) + Sync + 'a;

/// Calls `work` for batches of the `len` items, in parallel: of at least `limits.0` items, but for the last one, and at most `limits.1`. Generic
/// over the type of the items only.
pub(crate) fn for_each_batch<P: Send>(
    items: &mut dyn Iterator<Item = P>,
    len: usize,
    limits: (usize, usize),
    work: &BatchWork<'_, P>,
) {
    let size = limits.0.max(len / (BATCHES_PER_THREAD * rayon::current_num_threads())).min(limits.1).max(1);
    let mut all: Vec<Option<P>> = Vec::with_capacity(len);
    all.extend(items.map(Some));
    let batches: Vec<Mutex<Option<&mut [Option<P>]>>> = all.chunks_mut(size).map(|b| Mutex::new(Some(b))).collect();
    run(batches.len(), &|i| {
        // Not locked during the work, in which this thread may begin another batch.
        let batch = lock(&batches[i]).take();
        if let Some(batch) = batch {
            work(i * size, batch);
        }
    });
}

/// Calls `task` with each of `0..tasks`, in parallel.
///
/// Each thread takes one task after the other of its own share, then of what the others have left: threads end within the time of one task of each
/// other, and successive loops over the same rows leave them in the same processor's cache. (Rayon divides what it has by two at a time; a thread that
/// finds nothing left sleeps, and waking it takes longer than many of our loops.)
fn run(tasks: usize, task: &(dyn Fn(usize) + Sync)) {
    let threads = rayon::current_num_threads().min(tasks);
    if threads < 2 {
        return (0..tasks).for_each(task);
    }
    let start = |share: usize| share * tasks / threads;
    let next: Vec<AtomicUsize> = (0..threads).map(|share| AtomicUsize::new(start(share))).collect();
    (0..threads).into_par_iter().with_max_len(1).for_each(|i| {
        let own = rayon::current_thread_index().unwrap_or(i);
        for share in (own..own + threads).map(|share| share % threads) {
            loop {
                let i = next[share].fetch_add(1, Ordering::Relaxed);
                if i >= start(share + 1) {
                    break;
                }
                task(i);
            }
        }
    });
}

/// Locks what no panic can leave inconsistent.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
