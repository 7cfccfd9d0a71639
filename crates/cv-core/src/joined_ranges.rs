//! Union of ranges.

use std::ops::Range;

/// Joins overlapping and adjacent ranges; returns them ascending and disjoint. None may be empty. O(n log n).
///
/// ```
/// assert_eq!(cv_core::joined_ranges(vec![7..9, 1..4, 4..5, 2..3]), [1..5, 7..9]);
/// ```
pub fn joined_ranges<T: Ord + Copy>(mut ranges: Vec<Range<T>>) -> Vec<Range<T>> {
    ranges.sort_unstable_by_key(|range| range.start);
    let mut joined: Vec<Range<T>> = Vec::with_capacity(ranges.len());
    for range in ranges {
        match joined.last_mut() {
            Some(last) if range.start <= last.end => last.end = last.end.max(range.end),
            _ => joined.push(range),
        }
    }
    joined
}
