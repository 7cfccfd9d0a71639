//! Removal of small patches that agree only with themselves.

use rayon::prelude::*;

/// Rows per strip: strips are labelled side by side, then joined. Small enough to occupy every core.
const STRIP: usize = 64;

/// Memory of [`remove_speckles`], kept between frames.
#[derive(Debug, Default)]
pub(crate) struct Speckles {
    strips: Vec<Strip>,
    /// Parent of each run; a root is its own.
    parents: Vec<u32>,
    /// Pixels of each run, later of each patch.
    sizes: Vec<u32>,
}

/// The runs of some rows.
#[derive(Debug, Default)]
struct Strip {
    /// Run that each pixel of the first row belongs to, of the last row, and of a row in between.
    first: Vec<u32>,
    last: Vec<u32>,
    next: Vec<u32>,
    /// Parent of each run, counted from the first of the strip.
    parents: Vec<u32>,
    sizes: Vec<u32>,
    /// Where each run starts in the strip.
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
    Speckles { strips, parents, sizes }: &mut Speckles,
) {
    if width == 0 || max_size == 0 || disparity.is_empty() {
        return;
    }
    let strip = width * STRIP;
    strips.resize_with(disparity.len().div_ceil(strip), Strip::default);
    strips.par_iter_mut().zip(disparity.par_chunks(strip)).for_each(|(runs, rows)| runs.label(rows, width, range));
    parents.clear();
    sizes.clear();
    for (number, Strip { first, parents: own, sizes: own_sizes, .. }) in strips.iter().enumerate() {
        let offset = parents.len() as u32;
        parents.extend(own.iter().map(|&parent| parent + offset));
        sizes.extend_from_slice(own_sizes);
        if number > 0 {
            let above = &strips[number - 1];
            let offset_above = offset - above.parents.len() as u32;
            let from = number * strip;
            let (up, here) = (&disparity[from - width..from], &disparity[from..from + width]);
            for (((&d, &up), &a), &b) in here.iter().zip(up).zip(&above.last).zip(first) {
                if (d - up).abs() <= range {
                    join(parents, a + offset_above, b + offset);
                }
            }
        }
    }
    // Roots have the smallest index of their patch: counting from the end, every run is complete when it is added.
    for run in (0..parents.len()).rev() {
        let up = parents[run] as usize;
        if up != run {
            sizes[up] += sizes[run];
        }
    }
    // Parents come before children, so theirs is the size of the patch by now.
    for run in 0..parents.len() {
        sizes[run] = sizes[parents[run] as usize];
    }
    let mut offset = 0;
    for (runs, rows) in strips.iter().zip(disparity.chunks_mut(strip)) {
        let sizes = &sizes[offset..offset + runs.starts.len()];
        for (run, (&start, &size)) in runs.starts.iter().zip(sizes).enumerate() {
            if size as usize <= max_size {
                let end = runs.starts.get(run + 1).map_or(rows.len(), |&s| s as usize);
                rows[start as usize..end].fill(f32::NAN);
            }
        }
        offset += runs.starts.len();
    }
}

impl Strip {
    fn label(&mut self, disparity: &[f32], width: usize, range: f32) {
        let Self { first, last, next, parents, sizes, starts } = self;
        parents.clear();
        sizes.clear();
        starts.clear();
        last.resize(width, 0);
        next.resize(width, 0);
        let mut row_above: &[f32] = &[];
        for (y, row) in disparity.chunks_exact(width).enumerate() {
            // NaN compares false: invalid pixels are runs of their own.
            let mut before = f32::NAN;
            let mut from = 0;
            for (x, (&d, run)) in row.iter().zip(next.iter_mut()).enumerate() {
                if (d - before).abs() <= range {
                    *run = parents.len() as u32 - 1;
                } else {
                    if x > 0 {
                        sizes.push((x - from) as u32);
                    }
                    from = x;
                    *run = parents.len() as u32;
                    starts.push((y * width + x) as u32);
                    parents.push(*run);
                }
                before = d;
            }
            sizes.push((width - from) as u32);
            let mut joined = (u32::MAX, u32::MAX);
            for (((&d, &up), &a), &b) in row.iter().zip(row_above).zip(last.iter()).zip(next.iter()) {
                if (a, b) != joined && (d - up).abs() <= range {
                    join(parents, a, b);
                    joined = (a, b);
                }
            }
            if y == 0 {
                first.clone_from(next);
            }
            std::mem::swap(last, next);
            row_above = row;
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

    #[test]
    fn patches_reach_across_strips() {
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
        remove_speckles(&mut d, width, 5, 1.0, &mut Speckles::default());
        assert_eq!(keep.iter().filter(|k| !**k).count(), 5);
        assert!(d.iter().zip(keep).all(|(v, k)| v.is_nan() != k));
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
