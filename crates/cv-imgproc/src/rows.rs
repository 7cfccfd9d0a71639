//! Parallel iteration over the rows of an image.

use cv_core::{Image, Sample};
use cv_parallel::prelude::*;

/// Minimum number of samples that a thread takes at a time: tens of microseconds, against about one microsecond of overhead.
const MIN_SAMPLES: usize = 1 << 15;

/// Calls `f(state, y, row)` for each row of `image`, in parallel; `init` makes the state (buffers) of a thread.
pub(crate) fn for_rows_with<T: Sample, const C: usize, S: Send>(
    image: &mut Image<T, C>,
    init: impl Fn() -> S + Sync,
    f: impl Fn(&mut S, usize, &mut [T]) + Sync,
) {
    let stride = image.width() * C;
    if image.is_empty() {
        return;
    }
    let rows = image.as_mut_slice().par_chunks_mut(stride).with_min_len(MIN_SAMPLES / stride);
    rows.enumerate().for_each_init(init, |state, (y, row)| f(state, y, row));
}

/// Calls `f(y, row)` for each row of `image`, in parallel.
pub(crate) fn for_rows<T: Sample, const C: usize>(image: &mut Image<T, C>, f: impl Fn(usize, &mut [T]) + Sync) {
    for_rows_with(image, || (), |(), y, row| f(y, row));
}

/// As [`for_rows`] over two images of the same size at once.
pub(crate) fn for_rows2<T: Sample, const C: usize, U: Sample, const D: usize>(
    first: &mut Image<T, C>,
    second: &mut Image<U, D>,
    f: impl Fn(usize, &mut [T], &mut [U]) + Sync,
) {
    assert_eq!(first.size(), second.size());
    let (a, b) = (first.width() * C, second.width() * D);
    if first.is_empty() {
        return;
    }
    let rows = first.as_mut_slice().par_chunks_mut(a).zip(second.as_mut_slice().par_chunks_mut(b));
    rows.with_min_len(MIN_SAMPLES / a).enumerate().for_each(|(y, (p, q))| f(y, p, q));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_is_visited_once_with_its_index() {
        for (w, h) in [(0, 3), (3, 0), (1, 1), (7, 5), (4000, 33), (1, 100_000), (70_000, 3)] {
            let mut image = Image::<u32, 2>::new(w, h, [0; 2]);
            let mut other = Image::<u32, 1>::new(w, h, [0]);
            for_rows(&mut image, |y, row| row.iter_mut().for_each(|v| *v += 1 + y as u32));
            for_rows2(&mut image, &mut other, |y, a, b| {
                a.iter_mut().for_each(|v| *v += 1);
                b.iter_mut().for_each(|v| *v += y as u32);
            });
            for y in 0..h {
                assert!(image.row(y).iter().all(|&v| v == 2 + y as u32));
                assert!(other.row(y).iter().all(|&v| v == y as u32));
            }
        }
    }
}
