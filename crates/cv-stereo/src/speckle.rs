//! Speckle filter: removal of small connected components of similar disparity.

use crate::PixelState;
use cv_core::UnionFind;
use cv_parallel::prelude::*;

/// Rows per strip: strips are labeled in parallel, then merged. Small enough to occupy every core.
const STRIP: usize = 64;

/// Buffers of [`remove_speckles`], reused between frames.
#[derive(Debug, Default)]
pub(crate) struct Speckles {
    strips: Vec<Strip>,
    /// Components of runs.
    components: UnionFind,
    /// Pixels of each run, later of its component.
    sizes: Vec<u32>,
}

/// The runs of some rows.
#[derive(Debug, Default)]
struct Strip {
    runs: Vec<Run>,
    /// Start of the runs of the last row, and end of those of the first one.
    last: usize,
    first_end: usize,
    /// Components of the runs of the strip.
    components: UnionFind,
}

/// A run of pixels of similar disparity: columns `start` to `end` of a row.
#[derive(Debug, Clone, Copy)]
struct Run {
    y: u32,
    start: u32,
    end: u32,
}

/// Sets every 4-connected component of at most `max_size` pixels, whose neighbors differ by no more than `range`, to NaN, and its matched
/// pixels to mismatched.
///
/// The runs of each row are merged by union-find, counted, and small components cleared: linear in the number of pixels.
pub(crate) fn remove_speckles(
    disparity: &mut [f32],
    states: &mut [PixelState],
    width: usize,
    max_size: usize,
    range: f32,
    Speckles { strips, components, sizes }: &mut Speckles,
) {
    if width == 0 || max_size == 0 || disparity.is_empty() {
        return;
    }
    let strip = width * STRIP;
    strips.resize_with(disparity.len().div_ceil(strip), Strip::default);
    strips.par_iter_mut().zip(disparity.par_chunks(strip)).for_each(|(runs, rows)| runs.label(rows, width, range));
    components.clear();
    sizes.clear();
    for (number, here) in strips.iter().enumerate() {
        let offset = components.len() as u32;
        components.append(&here.components);
        sizes.extend(here.runs.iter().map(|run| run.end - run.start));
        if number > 0 {
            let above = &strips[number - 1];
            let from = number * strip;
            let (up, row) = (&disparity[from - width..from], &disparity[from..from + width]);
            let last = Row {
                row: up,
                runs: &above.runs[above.last..],
                first: offset - (above.runs.len() - above.last) as u32,
            };
            merge_rows(last, Row { row, runs: &here.runs[..here.first_end], first: offset }, range, components);
        }
    }
    let roots = components.flatten();
    for (run, &root) in roots.iter().enumerate() {
        if root as usize != run {
            sizes[root as usize] += sizes[run];
        }
    }
    for (run, &root) in roots.iter().enumerate() {
        sizes[run] = sizes[root as usize];
    }
    let runs =
        strips.iter().enumerate().flat_map(|(number, strip)| strip.runs.iter().map(move |run| (number * STRIP, run)));
    for ((top, run), _) in runs.zip(&*sizes).filter(|(_, size)| **size as usize <= max_size) {
        let row = (top + run.y as usize) * width;
        let pixels = row + run.start as usize..row + run.end as usize;
        disparity[pixels.clone()].fill(f32::NAN);
        for state in &mut states[pixels] {
            if *state == PixelState::Matched {
                *state = PixelState::Mismatched;
            }
        }
    }
}

impl Strip {
    fn label(&mut self, disparity: &[f32], width: usize, range: f32) {
        let Self { runs, last, first_end, components } = self;
        runs.clear();
        components.clear();
        let mut above = 0..0;
        for (y, row) in disparity.chunks_exact(width).enumerate() {
            let first = runs.len();
            let mut x = 0;
            while x < width {
                let start = x;
                let mut before = row[x];
                x += 1;
                // NaN compares false.
                while x < width && (row[x] - before).abs() <= range {
                    before = row[x];
                    x += 1;
                }
                if !before.is_nan() {
                    components.push();
                    runs.push(Run { y: y as u32, start: start as u32, end: x as u32 });
                }
            }
            if y == 0 {
                *first_end = runs.len();
            } else {
                let up = &disparity[(y - 1) * width..y * width];
                let up = Row { row: up, runs: &runs[above.clone()], first: above.start as u32 };
                merge_rows(up, Row { row, runs: &runs[first..], first: first as u32 }, range, components);
            }
            *last = first;
            above = first..runs.len();
        }
    }
}

/// A row, its runs, and the index of the first one.
struct Row<'a> {
    row: &'a [f32],
    runs: &'a [Run],
    first: u32,
}

/// Merges the runs of two rows that touch at pixels of similar disparity.
fn merge_rows(up: Row<'_>, here: Row<'_>, range: f32, components: &mut UnionFind) {
    let mut next = 0;
    for (i, run) in here.runs.iter().enumerate() {
        while let Some(above) = up.runs.get(next).filter(|above| above.start < run.end) {
            let overlap = run.start.max(above.start) as usize..run.end.min(above.end) as usize;
            // Empty if the one above ends before this one starts.
            let mut pixels = overlap.map(|x| (up.row[x] - here.row[x]).abs());
            if pixels.any(|difference| difference <= range) {
                components.union(up.first + next as u32, here.first + i as u32);
            }
            if above.end > run.end {
                break;
            }
            next += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Matched where there is a disparity.
    fn states(disparity: &[f32]) -> Vec<PixelState> {
        disparity.iter().map(|d| if d.is_nan() { PixelState::OutOfView } else { PixelState::Matched }).collect()
    }

    /// Reference: flood fill from every pixel.
    fn plain(disparity: &[f32], width: usize, max_size: usize, range: f32) -> Vec<bool> {
        (0..disparity.len())
            .map(|start| {
                if disparity[start].is_nan() {
                    return false;
                }
                let mut seen = vec![false; disparity.len()];
                let mut stack = vec![start];
                seen[start] = true;
                let mut size = 0;
                while let Some(i) = stack.pop() {
                    size += 1;
                    let mut visit = |j: usize| {
                        if !seen[j] && (disparity[i] - disparity[j]).abs() <= range {
                            seen[j] = true;
                            stack.push(j);
                        }
                    };
                    if i % width > 0 {
                        visit(i - 1);
                    }
                    if i % width + 1 < width {
                        visit(i + 1);
                    }
                    if i >= width {
                        visit(i - width);
                    }
                    if i + width < disparity.len() {
                        visit(i + width);
                    }
                }
                size > max_size
            })
            .collect()
    }

    #[test]
    fn components_extend_across_strips() {
        // A column of nines through four strips, one pixel wide, and a short one across a joint.
        let (width, height) = (5, 3 * STRIP + 7);
        let mut d: Vec<f32> = vec![0.0; width * height];
        for y in 0..height {
            d[y * width + 1] = 9.0;
            if y.abs_diff(2 * STRIP) < 3 {
                d[y * width + 3] = 9.0;
            }
        }
        let keep = plain(&d, width, 5, 1.0);
        let mut states = states(&d);
        remove_speckles(&mut d, &mut states, width, 5, 1.0, &mut Speckles::default());
        assert_eq!(keep.iter().filter(|k| !**k).count(), 5);
        assert!(d.iter().zip(keep).all(|(v, k)| v.is_nan() != k));
    }

    proptest! {
        #[test]
        fn the_filter_equals_a_flood_fill(
            width in 1usize..9,
            values in proptest::collection::vec(prop_oneof![4 => (0..4i32).prop_map(|v| v as f32), 1 => Just(f32::NAN)], 0..72),
            max_size in 1usize..8,
        ) {
            let rows = values.len() / width;
            let mut d = values[..rows * width].to_vec();
            let keep = plain(&d, width, max_size, 1.0);
            let before = d.clone();
            let mut states = states(&d);
            remove_speckles(&mut d, &mut states, width, max_size, 1.0, &mut Speckles::default());
            for ((state, v), before) in states.iter().zip(&d).zip(before) {
                let expected = match (before.is_nan(), v.is_nan()) {
                    (true, _) => PixelState::OutOfView,
                    (false, true) => PixelState::Mismatched,
                    (false, false) => PixelState::Matched,
                };
                prop_assert_eq!(*state, expected);
            }
            for (v, k) in d.iter().zip(keep) {
                prop_assert_eq!(!v.is_nan(), k);
            }
        }
    }
}
