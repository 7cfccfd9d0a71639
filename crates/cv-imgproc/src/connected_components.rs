//! Connected-component labeling of binary masks.

use cv_core::{Image, ImageView, Mask, Point2, UnionFind};

/// Pixel connectivity.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Connectivity {
    /// Pixels that share a side.
    Four,
    /// Pixels that share a side or a corner.
    #[default]
    Eight,
}

/// Statistics of one component.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ComponentStats {
    /// Number of pixels.
    pub area: usize,
    /// Leftmost column.
    pub left: usize,
    /// Topmost row.
    pub top: usize,
    /// Width of the bounding box in pixels.
    pub width: usize,
    /// Height of the bounding box in pixels.
    pub height: usize,
    /// Mean position of the pixels' centers.
    pub centroid: Point2<f64>,
}

/// The connected components of a mask.
#[derive(Debug, Clone, PartialEq)]
pub struct Components {
    /// 0 where the mask is false, else the label of the component, from 1 in scan order of their first pixels.
    pub labels: Image<u32, 1>,
    /// Statistics of the component with label `i + 1`.
    pub stats: Vec<ComponentStats>,
}

/// A horizontal run of true pixels: row, first column, one past the last.
struct Run {
    y: usize,
    start: usize,
    end: usize,
}

/// Labels the connected components of a mask.
///
/// Run-based labeling in one pass over the pixels: runs of adjacent rows that touch are merged by union-find (the first run of a
/// component is its root).
pub fn connected_components(view: ImageView<'_, bool, 1>, connectivity: Connectivity) -> Components {
    let (runs, roots) = label_runs(view, connectivity);
    let mut labels = Image::<u32, 1>::new(view.width(), view.height(), [0]);
    let mut stats: Vec<ComponentStats> = Vec::new();
    // Roots precede their runs, so the label of a component is known at each of its runs.
    let mut number = vec![0u32; runs.len()];
    for (i, run) in runs.iter().enumerate() {
        if roots[i] as usize == i {
            let empty = ComponentStats {
                area: 0,
                left: run.start,
                top: run.y,
                width: 0,
                height: 0,
                centroid: Point2::origin(),
            };
            stats.push(empty);
            number[i] = stats.len() as u32;
        } else {
            number[i] = number[roots[i] as usize];
        }
        labels.row_mut(run.y)[run.start..run.end].fill(number[i]);
        let s = &mut stats[number[i] as usize - 1];
        let length = run.end - run.start;
        s.area += length;
        // During accumulation, width and height are the right and lower limits, the centroid is a sum.
        s.left = s.left.min(run.start);
        s.width = s.width.max(run.end);
        s.height = run.y + 1;
        s.centroid.x += (run.start + run.end - 1) as f64 / 2.0 * length as f64;
        s.centroid.y += run.y as f64 * length as f64;
    }
    for s in &mut stats {
        s.width -= s.left;
        s.height -= s.top;
        s.centroid /= s.area as f64;
    }
    Components { labels, stats }
}

/// Extracts the runs of a mask in scan order, and for each the index of the first run of its component.
fn label_runs(view: ImageView<'_, bool, 1>, connectivity: Connectivity) -> (Vec<Run>, Vec<u32>) {
    let mut runs: Vec<Run> = Vec::new();
    let mut sets = UnionFind::default();
    // Runs a and b of adjacent rows touch where a.start < b.end + overlap and b.start < a.end + overlap.
    let overlap = usize::from(connectivity == Connectivity::Eight);
    let mut above = 0..0;
    for y in 0..view.height() {
        let first = runs.len();
        let row = view.row(y);
        let mut x = 0;
        let mut candidate = above.start;
        while let Some(skip) = row[x..].iter().position(|&p| p) {
            let start = x + skip;
            let end = row[start..].iter().position(|&p| !p).map_or(row.len(), |n| start + n);
            runs.push(Run { y, start, end });
            let current = sets.push();
            while candidate < above.end && runs[candidate].end + overlap <= start {
                candidate += 1;
            }
            let mut touching = candidate;
            while touching < above.end && runs[touching].start < end + overlap {
                sets.union(touching as u32, current);
                touching += 1;
            }
            // The last touching run above may also touch the next run of this row.
            candidate = touching.saturating_sub(1).max(candidate);
            x = end;
        }
        above = first..runs.len();
    }
    (runs, sets.into_roots())
}

/// Returns the mask of the largest component (the first of equally large ones); all false where there is none.
pub fn largest_component(view: ImageView<'_, bool, 1>, connectivity: Connectivity) -> Mask {
    let largest = |areas: &[usize]| areas.iter().copied().max().unwrap_or(0);
    let mut found = false;
    keep_components(view, connectivity, |area, areas| {
        let is_first_largest = !found && area == largest(areas);
        found |= is_first_largest;
        is_first_largest
    })
}

/// Removes the components of fewer than `min_area` pixels.
pub fn remove_small_components(view: ImageView<'_, bool, 1>, connectivity: Connectivity, min_area: usize) -> Mask {
    keep_components(view, connectivity, |area, _| area >= min_area)
}

/// Fills holes: background components that do not touch the border and have at most `max_area` pixels. The background has the complementary
/// connectivity, four for an eight-connected mask and vice versa.
pub fn fill_holes(view: ImageView<'_, bool, 1>, connectivity: Connectivity, max_area: usize) -> Mask {
    let (w, h) = view.size();
    let mut inverted = view.to_image();
    inverted.as_mut_slice().iter_mut().for_each(|p| *p = !*p);
    let complementary = match connectivity {
        Connectivity::Four => Connectivity::Eight,
        Connectivity::Eight => Connectivity::Four,
    };
    let background = connected_components(inverted.view(), complementary);
    let is_hole: Vec<bool> = background
        .stats
        .iter()
        .map(|s| s.area <= max_area && s.left > 0 && s.top > 0 && s.left + s.width < w && s.top + s.height < h)
        .collect();
    background.labels.map(|[label]| [label == 0 || is_hole[label as usize - 1]])
}

/// Returns the mask of the components for which `keep(area, all areas)` is true, called in the order of their labels.
fn keep_components(
    view: ImageView<'_, bool, 1>,
    connectivity: Connectivity,
    mut keep: impl FnMut(usize, &[usize]) -> bool,
) -> Mask {
    let (runs, roots) = label_runs(view, connectivity);
    let mut area = vec![0usize; runs.len()];
    for (run, &root) in runs.iter().zip(&roots) {
        area[root as usize] += run.end - run.start;
    }
    let mut kept = vec![false; runs.len()];
    let mut out = Mask::new(view.width(), view.height(), [false]);
    for (i, run) in runs.iter().enumerate() {
        if roots[i] as usize == i {
            kept[i] = keep(area[i], &area);
        }
        if kept[roots[i] as usize] {
            out.row_mut(run.y)[run.start..run.end].fill(true);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn noise(w: usize, h: usize, seed: u32, density: u32) -> Mask {
        let mut state = seed | 1;
        Mask::from_fn(w, h, |_, _| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            [(state >> 8) % 100 < density]
        })
    }

    /// Reference implementation: flood fill from the first pixel of each component in scan order.
    fn reference(mask: &Mask, connectivity: Connectivity) -> (Image<u32, 1>, u32) {
        let (w, h) = (mask.width() as isize, mask.height() as isize);
        let mut labels = Image::<u32, 1>::new(mask.width(), mask.height(), [0]);
        let mut count = 0;
        for y in 0..h {
            for x in 0..w {
                let free = |labels: &Image<u32, 1>, x: isize, y: isize| {
                    x >= 0
                        && y >= 0
                        && x < w
                        && y < h
                        && mask.at(x as usize, y as usize)[0]
                        && labels.at(x as usize, y as usize)[0] == 0
                };
                if !free(&labels, x, y) {
                    continue;
                }
                count += 1;
                let mut stack = vec![(x, y)];
                while let Some((x, y)) = stack.pop() {
                    if !free(&labels, x, y) {
                        continue;
                    }
                    labels.set(x as usize, y as usize, [count]);
                    for (i, j) in [(-1, 0), (1, 0), (0, -1), (0, 1)] {
                        stack.push((x + i, y + j));
                    }
                    if connectivity == Connectivity::Eight {
                        for (i, j) in [(-1, -1), (1, 1), (1, -1), (-1, 1)] {
                            stack.push((x + i, y + j));
                        }
                    }
                }
            }
        }
        (labels, count)
    }

    proptest! {
        #[test]
        fn labels_equal_those_of_flood_fill(w in 1usize..40, h in 1usize..30, seed in any::<u32>(), density in 1u32..99, eight in any::<bool>()) {
            let connectivity = if eight { Connectivity::Eight } else { Connectivity::Four };
            let mask = noise(w, h, seed, density);
            let found = connected_components(mask.view(), connectivity);
            let (labels, count) = reference(&mask, connectivity);
            prop_assert_eq!(&found.labels, &labels);
            prop_assert_eq!(found.stats.len(), count as usize);
            for (i, s) in found.stats.iter().enumerate() {
                let pixels: Vec<(usize, usize)> = (0..h).flat_map(|y| (0..w).map(move |x| (x, y)))
                    .filter(|&(x, y)| labels.at(x, y)[0] == i as u32 + 1).collect();
                let n = pixels.len() as f64;
                let (xs, ys): (Vec<usize>, Vec<usize>) = pixels.iter().copied().unzip();
                prop_assert_eq!(s.area, pixels.len());
                prop_assert_eq!((s.left, s.top), (*xs.iter().min().unwrap(), *ys.iter().min().unwrap()));
                prop_assert_eq!((s.left + s.width - 1, s.top + s.height - 1), (*xs.iter().max().unwrap(), *ys.iter().max().unwrap()));
                // Sums of at most 1200 integers and halves are exact; one division.
                prop_assert!((s.centroid.x - xs.iter().sum::<usize>() as f64 / n).abs() < 1e-12);
                prop_assert!((s.centroid.y - ys.iter().sum::<usize>() as f64 / n).abs() < 1e-12);
            }
            let largest = found.stats.iter().map(|s| s.area).max().unwrap_or(0);
            let first = found.stats.iter().position(|s| s.area == largest).map_or(0, |i| i as u32 + 1);
            let kept = largest_component(mask.view(), connectivity);
            let expected = labels.map(|[l]| [l != 0 && l == first]);
            prop_assert_eq!(kept, expected);
            let expected = labels.map(|[l]| [l != 0 && found.stats[l as usize - 1].area >= 5]);
            prop_assert_eq!(remove_small_components(mask.view(), connectivity, 5), expected);
        }
    }

    #[test]
    fn enclosed_holes_are_filled_and_open_bays_are_not() {
        let rows = ["#####.", "#..#..", "#.##..", "#####.", "....#.", "##..##"];
        let mask = Mask::from_fn(6, 6, |x, y| [rows[y].as_bytes()[x] == b'#']);
        let filled = fill_holes(mask.view(), Connectivity::Eight, usize::MAX);
        for y in 0..6 {
            for x in 0..6 {
                let hole = (1..3).contains(&x) && y == 1 || (x, y) == (1, 2);
                assert_eq!(filled.at(x, y)[0], mask.at(x, y)[0] || hole, "{x} {y}");
            }
        }
        assert_eq!(fill_holes(mask.view(), Connectivity::Eight, 2), mask);
    }

    #[test]
    fn empty_masks_have_no_components() {
        for mask in
            [Mask::new(0, 0, [true]), Mask::new(0, 3, [true]), Mask::new(3, 0, [true]), Mask::new(4, 4, [false])]
        {
            assert!(connected_components(mask.view(), Connectivity::Eight).stats.is_empty());
            assert_eq!(largest_component(mask.view(), Connectivity::Four), mask);
        }
        let one = connected_components(Mask::new(1, 1, [true]).view(), Connectivity::Four);
        assert_eq!((one.stats.len(), one.stats[0].area, one.stats[0].centroid), (1, 1, Point2::origin()));
    }
}
