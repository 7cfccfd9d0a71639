//! Removal of small patches that agree only with themselves.

/// Memory of [`remove_speckles`], kept between frames.
#[derive(Debug, Default)]
pub(crate) struct Speckles {
    /// Run that each pixel of the row before belongs to, and of this row.
    runs: [Vec<u32>; 2],
    /// Parent of each run; a root is its own.
    parents: Vec<u32>,
    /// Pixels of each run, later of each patch.
    sizes: Vec<u32>,
    /// Where each run starts.
    starts: Vec<u32>,
}

/// Sets to NaN every 4-connected patch of at most `max_size` pixels whose neighbours differ by no more than `range`.
///
/// Runs of each row are joined into a forest (union–find with path halving), counted, and the small ones cleared: linear
/// in the number of pixels.
pub(crate) fn remove_speckles(
    disparity: &mut [f32],
    width: usize,
    max_size: usize,
    range: f32,
    Speckles { runs, parents, sizes, starts }: &mut Speckles,
) {
    if width == 0 || max_size == 0 || disparity.is_empty() {
        return;
    }
    parents.clear();
    sizes.clear();
    starts.clear();
    let [above, here] = runs;
    above.resize(width, 0);
    here.resize(width, 0);
    let mut row_above: &[f32] = &[];
    for (y, row) in disparity.chunks_exact(width).enumerate() {
        // NaN compares false: invalid pixels are runs of their own.
        let mut last = f32::NAN;
        let mut first = 0;
        for (x, (&d, run)) in row.iter().zip(here.iter_mut()).enumerate() {
            if (d - last).abs() <= range {
                *run = parents.len() as u32 - 1;
            } else {
                if x > 0 {
                    sizes.push((x - first) as u32);
                }
                first = x;
                *run = parents.len() as u32;
                starts.push((y * width + x) as u32);
                parents.push(*run);
            }
            last = d;
        }
        sizes.push((width - first) as u32);
        let mut joined = (u32::MAX, u32::MAX);
        for (((&d, &up), &a), &b) in row.iter().zip(row_above).zip(above.iter()).zip(here.iter()) {
            if (a, b) != joined && (d - up).abs() <= range {
                join(parents, a, b);
                joined = (a, b);
            }
        }
        std::mem::swap(above, here);
        row_above = row;
    }
    // Roots have the smallest index of their patch: counting from the end, every run is complete when it is added.
    for run in (0..parents.len()).rev() {
        let up = parents[run] as usize;
        if up != run {
            sizes[up] += sizes[run];
        }
    }
    let lengths = |run: usize| starts.get(run + 1).map_or(disparity.len(), |&s| s as usize);
    let ends: Vec<usize> = (0..parents.len()).map(lengths).collect();
    for run in 0..parents.len() {
        // Parents come before children, so theirs is the size of the patch by now.
        let up = parents[run] as usize;
        sizes[run] = sizes[up];
        if sizes[run] as usize <= max_size {
            disparity[starts[run] as usize..ends[run]].fill(f32::NAN);
        }
    }
}

fn find(labels: &mut [u32], mut i: u32) -> u32 {
    while labels[i as usize] != i {
        let up = labels[labels[i as usize] as usize];
        labels[i as usize] = up;
        i = up;
    }
    i
}

fn join(labels: &mut [u32], a: u32, b: u32) {
    let (a, b) = (find(labels, a), find(labels, b));
    // The smaller index becomes the root, whatever the order of the joins.
    labels[a.max(b) as usize] = a.min(b);
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The definition: flood fill from every pixel.
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

    proptest! {
        #[test]
        fn what_stays_is_what_a_flood_fill_keeps(
            width in 1usize..9,
            values in proptest::collection::vec(prop_oneof![4 => (0..4i32).prop_map(|v| v as f32), 1 => Just(f32::NAN)], 0..72),
            max_size in 1usize..8,
        ) {
            let rows = values.len() / width;
            let mut d = values[..rows * width].to_vec();
            let keep = plain(&d, width, max_size, 1.0);
            remove_speckles(&mut d, width, max_size, 1.0, &mut Speckles::default());
            for (v, k) in d.iter().zip(keep) {
                prop_assert_eq!(!v.is_nan(), k);
            }
        }
    }
}
