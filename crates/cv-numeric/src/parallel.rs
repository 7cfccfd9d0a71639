//! Parallel loops that are compiled once for each result.

use rayon::prelude::*;

/// `[of(0), of(1), …, of(n - 1)]`, computed by all threads.
///
/// As `(0..n).into_par_iter().map(of).collect()`, which the compiler would make once more for each closure. In generic code,
/// whose closures are many and whose results are few, that is most of what it compiles. Each call should do enough
/// (microseconds) for a call through a pointer not to matter.
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
