//! Removal of small patches that agree only with themselves.

/// Sets to NaN every 4-connected patch of at most `max_size` pixels whose neighbours differ by no more than `range`.
///
/// One scan that joins runs into a forest of labels (union–find with path halving), one that counts, one that clears:
/// linear in the number of pixels.
pub(crate) fn remove_speckles(disparity: &mut [f32], width: usize, max_size: usize, range: f32, labels: &mut Vec<u32>) {
    if width == 0 || max_size == 0 || disparity.is_empty() {
        return;
    }
    labels.clear();
    labels.extend(0..disparity.len() as u32);
    for i in 0..disparity.len() {
        let d = disparity[i];
        // NaN compares false: invalid pixels stay alone.
        if i % width > 0 && (d - disparity[i - 1]).abs() <= range {
            join(labels, i as u32 - 1, i as u32);
        }
        if i >= width && (d - disparity[i - width]).abs() <= range {
            join(labels, (i - width) as u32, i as u32);
        }
    }
    // Roots are the smallest index of their patch, so a root is seen before its members: sizes fit in one pass.
    let mut sizes = vec![0u32; disparity.len()];
    for i in 0..labels.len() {
        let root = find(labels, i as u32);
        labels[i] = root;
        sizes[root as usize] += 1;
    }
    for (d, &root) in disparity.iter_mut().zip(labels.iter()) {
        if sizes[root as usize] as usize <= max_size {
            *d = f32::NAN;
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
    let (low, high) = (a.min(b), a.max(b));
    labels[high as usize] = low;
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
            remove_speckles(&mut d, width, max_size, 1.0, &mut Vec::new());
            for (v, k) in d.iter().zip(keep) {
                prop_assert_eq!(!v.is_nan(), k);
            }
        }
    }
}
