//! Parallel, cancellable iteration over image rows.

use cv_core::{Cancelled, Stage};
use cv_parallel::prelude::*;

/// Samples processed between two checks for cancellation: a few milliseconds of the slowest loops.
const SAMPLES_PER_CHECK: usize = 1 << 18;

/// Returns whether to check for cancellation before row `y` of `width` samples.
pub(crate) fn is_check_due(y: usize, width: usize) -> bool {
    y.is_multiple_of((SAMPLES_PER_CHECK / width.max(1)).max(1))
}

/// Calls `work` with the index and the samples of every row of `data`, in parallel.
///
/// # Errors
/// [`Cancelled`]; rows may then be missing.
pub(crate) fn for_each_row<T: Send>(
    data: &mut [T],
    width: usize,
    stage: &Stage<'_>,
    work: impl Fn(usize, &mut [T]) + Sync,
) -> Result<(), Cancelled> {
    for_each_row_with(data, width, stage, || (), |(), y, row| work(y, row))
}

/// As [`for_each_row`], with a scratch buffer of each thread.
///
/// # Errors
/// [`Cancelled`]; rows may then be missing.
pub(crate) fn for_each_row_with<T: Send, B: Send>(
    data: &mut [T],
    width: usize,
    stage: &Stage<'_>,
    buffer: impl Fn() -> B + Sync,
    work: impl Fn(&mut B, usize, &mut [T]) + Sync,
) -> Result<(), Cancelled> {
    let width = width.max(1);
    data.par_chunks_mut(width).enumerate().try_for_each_init(buffer, |buffer, (y, row)| {
        if is_check_due(y, width) {
            stage.check()?;
        }
        work(buffer, y, row);
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::StopAt;

    #[test]
    fn every_row_is_worked_on_once_with_its_index() {
        let progress = StopAt::never();
        let stage = Stage::new(&progress, "rows", 1).unwrap();
        let mut data = vec![0_usize; 7 * 300];
        for_each_row(&mut data, 7, &stage, |y, row| row.iter_mut().for_each(|v| *v += y + 1)).unwrap();
        assert!(data.iter().enumerate().all(|(i, v)| *v == i / 7 + 1));
        for_each_row(&mut [0_u8; 0], 0, &stage, |_, _| unreachable!()).unwrap();
    }

    #[test]
    fn checks_are_at_most_a_quarter_of_a_million_samples_apart() {
        let (width, height) = (1000, 2000);
        let progress = StopAt::never();
        let stage = Stage::new(&progress, "rows", 1).unwrap();
        for_each_row(&mut vec![0_u8; width * height], width, &stage, |_, _| {}).unwrap();
        // One for the beginning of the stage.
        assert_eq!(progress.reports(), 1 + (height as f64 / 262.0).ceil() as usize);
        // A row longer than that is asked about by itself.
        assert!((0..5).all(|y| is_check_due(y, 1 << 20)));
    }

    #[test]
    fn cancellation_ends_the_work() {
        let progress = StopAt::report(3);
        let stage = Stage::new(&progress, "rows", 1).unwrap();
        let result = for_each_row(&mut vec![0_u8; 4_000_000], 1000, &stage, |_, _| {});
        assert_eq!(result, Err(Cancelled));
        // The threads of the pool ask once more each at most.
        assert!(progress.reports() <= 3 + rayon::current_num_threads());
    }
}
