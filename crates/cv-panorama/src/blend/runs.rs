//! Sets of cells of a grid as runs of each row.

use cv_core::joined_ranges;
use std::ops::Range;

/// Runs of cells of each row, ascending and disjoint.
pub(crate) type Runs = Vec<Vec<Range<usize>>>;

/// Returns the cells of half resolution that contain one of these cells.
pub(crate) fn coarse_runs(rows: &Runs) -> Runs {
    let coarse = |pair: &[Vec<Range<usize>>]| {
        joined_ranges(pair.iter().flatten().map(|r| r.start / 2..r.end.div_ceil(2)).collect())
    };
    rows.chunks(2).map(coarse).collect()
}

/// Returns the cells at most `radius` cells away along both axes, in a grid of this width.
pub(crate) fn dilated(rows: &Runs, width: usize, radius: usize) -> Runs {
    let near = |y: usize| {
        let rows = &rows[y.saturating_sub(radius)..(y + radius + 1).min(rows.len())];
        joined_ranges(
            rows.iter().flatten().map(|r| r.start.saturating_sub(radius)..(r.end + radius).min(width)).collect(),
        )
    };
    (0..rows.len()).map(near).collect()
}

/// Returns the cells of twice the resolution inside these cells, in a grid of this size.
pub(crate) fn children(rows: &Runs, (width, height): (usize, usize)) -> Runs {
    let row = |y: usize| rows[y / 2].iter().map(|r| 2 * r.start..(2 * r.end).min(width)).collect();
    (0..height).map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the cells of a set, sorted by rows.
    fn cells(rows: &Runs) -> Vec<(usize, usize)> {
        rows.iter().enumerate().flat_map(|(y, row)| row.iter().cloned().flatten().map(move |x| (x, y))).collect()
    }

    #[test]
    fn sets_are_those_of_the_definitions() {
        let (width, height) = (23, 17);
        let is_in = |x: usize, y: usize| (x * 7 + y * 13).is_multiple_of(37) || (x, y) == (22, 16);
        let row = |y: usize| joined_ranges((0..width).filter(|x| is_in(*x, y)).map(|x| x..x + 1).collect());
        let rows: Runs = (0..height).map(row).collect();
        let all = |w: usize, h: usize| (0..h).flat_map(move |y| (0..w).map(move |x| (x, y)));
        assert_eq!(cells(&rows), all(width, height).filter(|(x, y)| is_in(*x, *y)).collect::<Vec<_>>());
        let near = |(x, y): &(usize, usize)| {
            all(width, height).any(|(u, v)| is_in(u, v) && u.abs_diff(*x) <= 2 && v.abs_diff(*y) <= 2)
        };
        assert_eq!(cells(&dilated(&rows, width, 2)), all(width, height).filter(near).collect::<Vec<_>>());
        let coarse = coarse_runs(&rows);
        let contains =
            |(x, y): &(usize, usize)| all(width, height).any(|(u, v)| is_in(u, v) && (u / 2, v / 2) == (*x, *y));
        assert_eq!(cells(&coarse), all(12, 9).filter(contains).collect::<Vec<_>>());
        let inside = |(x, y): &(usize, usize)| contains(&(x / 2, y / 2));
        assert_eq!(cells(&children(&coarse, (width, height))), all(width, height).filter(inside).collect::<Vec<_>>());
    }
}
