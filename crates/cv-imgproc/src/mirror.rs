//! Border mode reflect-101.

/// Maps index `i` into a line of `n` samples under border mode reflect-101 (`dcb|abcd|cba`, OpenCV's `BORDER_REFLECT_101`), repeatedly where
/// needed. 0 for an empty line.
#[inline]
pub fn mirror_index(i: isize, n: usize) -> usize {
    let n = n as isize;
    if (0..n).contains(&i) {
        return i as usize;
    }
    if n <= 1 {
        return 0;
    }
    let period = 2 * (n - 1);
    let i = i.rem_euclid(period);
    (if i < n { i } else { period - i }) as usize
}

/// Fills the first `left` and the last `right` pixels of `C` samples by reflection ([`mirror_index`]) of the pixels between them. Without
/// pixels between, nothing is changed.
#[inline]
pub fn mirror_ends<const C: usize>(padded: &mut [f32], left: usize, right: usize) {
    let w = (padded.len() / C).saturating_sub(left + right);
    if w == 0 {
        return;
    }
    let mut copy = |to: usize, from: isize| {
        let from = left + mirror_index(from, w);
        for c in 0..C {
            padded[to * C + c] = padded[from * C + c];
        }
    };
    for k in 1..=left {
        copy(left - k, -(k as isize));
    }
    for k in 0..right {
        copy(left + w + k, (w + k) as isize);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn far_indices_are_reflected_repeatedly() {
        let reflected: Vec<usize> = (-5..7).map(|i| mirror_index(i, 3)).collect();
        assert_eq!(reflected, [1, 0, 1, 2, 1, 0, 1, 2, 1, 0, 1, 2]);
        assert_eq!([mirror_index(-3, 1), mirror_index(4, 1), mirror_index(2, 0)], [0; 3]);
    }

    #[test]
    fn the_ends_of_a_line_are_filled_by_reflection() {
        let mut row = [0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 0.0, 0.0];
        mirror_ends::<1>(&mut row, 3, 2);
        assert_eq!(row, [2.0, 3.0, 2.0, 1.0, 2.0, 3.0, 2.0, 1.0]);
        let mut pairs = [0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 0.0, 0.0];
        mirror_ends::<2>(&mut pairs, 1, 1);
        assert_eq!(pairs, [3.0, 4.0, 1.0, 2.0, 3.0, 4.0, 1.0, 2.0]);
        let mut only_ends = [5.0, 6.0];
        mirror_ends::<1>(&mut only_ends, 1, 2);
        assert_eq!(only_ends, [5.0, 6.0]);
    }
}
