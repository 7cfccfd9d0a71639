//! Parallel iteration over the rows of an image.

use cv_core::{Image, Sample};
use rayon::prelude::*;

/// Samples per band, the unit of parallel work: tens of microseconds, against about one microsecond of overhead per task.
const SAMPLES_PER_BAND: usize = 1 << 15;

/// Calls `f(state, y, row)` for each row of `image`, bands of rows in parallel; `init` makes the state (buffers) of a band.
pub(crate) fn for_rows_with<T: Sample, const C: usize, S>(
    image: &mut Image<T, C>,
    init: impl Fn() -> S + Sync,
    f: impl Fn(&mut S, usize, &mut [T]) + Sync,
) {
    let stride = image.width() * C;
    if image.is_empty() {
        return;
    }
    let rows = (SAMPLES_PER_BAND / stride).max(1);
    for_each_band(image.as_mut_slice(), stride * rows, &|i, band| {
        let mut state = init();
        for (j, row) in band.chunks_exact_mut(stride).enumerate() {
            f(&mut state, i * rows + j, row);
        }
    });
}

/// Calls `f(i, band)` for each band of `size` samples, in parallel. Dynamic dispatch: the thread-pool code is compiled once per sample type,
/// not once per filter.
fn for_each_band<T: Sample>(samples: &mut [T], size: usize, f: &(dyn Fn(usize, &mut [T]) + Sync)) {
    if samples.len() <= size {
        f(0, samples);
    } else {
        samples.par_chunks_mut(size).enumerate().for_each(|(i, band)| f(i, band));
    }
}

/// Calls `f(y, row)` for each row of `image`, bands of rows in parallel.
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
    let rows = (SAMPLES_PER_BAND / a).max(1);
    let band = |(i, (p, q)): (usize, (&mut [T], &mut [U]))| {
        for (j, (p, q)) in p.chunks_exact_mut(a).zip(q.chunks_exact_mut(b)).enumerate() {
            f(i * rows + j, p, q);
        }
    };
    if first.height() <= rows {
        band((0, (first.as_mut_slice(), second.as_mut_slice())));
    } else {
        let pairs = first.as_mut_slice().par_chunks_mut(a * rows).zip(second.as_mut_slice().par_chunks_mut(b * rows));
        pairs.enumerate().for_each(band);
    }
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
