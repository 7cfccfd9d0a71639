//! Parallel loops that are compiled once per result type.

use rayon::prelude::*;

/// Computes `[of(0), of(1), …, of(n - 1)]` in parallel.
///
/// As `(0..n).into_par_iter().map(of).collect()`, but monomorphized per result type rather than per closure, which saves
/// much compile time in generic code. Each call should take microseconds, so that the dynamic dispatch does not matter.
pub fn parallel_map<T: Send>(n: usize, of: &(dyn Fn(usize) -> T + Sync)) -> Vec<T> {
    (0..n).into_par_iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_come_in_order() {
        assert_eq!(parallel_map(1000, &|i| 3 * i), (0..1000).map(|i| 3 * i).collect::<Vec<_>>());
        assert!(parallel_map(0, &|i| i).is_empty());
    }
}
