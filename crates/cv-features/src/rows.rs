//! Rows and their borders.

/// Index `i` of a row of `n` mirrored about its end samples (`dcb|abcd|cba`, OpenCV's BORDER_REFLECT_101).
#[inline]
pub(crate) fn mirror(i: isize, n: usize) -> usize {
    if (0..n as isize).contains(&i) {
        return i as usize;
    }
    if n == 1 {
        return 0;
    }
    let n = n as isize;
    let period = 2 * (n - 1);
    let i = i.rem_euclid(period);
    (if i < n { i } else { period - i }) as usize
}

/// Fills the first `left` and the last `right` samples with the mirror image of what lies between.
pub(crate) fn mirror_ends(padded: &mut [f32], left: usize, right: usize) {
    let w = padded.len() - left - right;
    for k in 1..=left {
        padded[left - k] = padded[left + mirror(-(k as isize), w)];
    }
    for k in 1..=right {
        padded[left + w - 1 + k] = padded[left + mirror((w - 1 + k) as isize, w)];
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mirrors_as_often_as_it_takes() {
        let seen: Vec<usize> = (-5..7).map(|i| mirror(i, 3)).collect();
        assert_eq!(seen, [1, 0, 1, 2, 1, 0, 1, 2, 1, 0, 1, 2]);
        assert_eq!((mirror(-3, 1), mirror(4, 1)), (0, 0));
        let mut row = [0.0, 0.0, 0.0, 1.0, 2.0, 3.0, 0.0, 0.0];
        mirror_ends(&mut row, 3, 2);
        assert_eq!(row, [2.0, 3.0, 2.0, 1.0, 2.0, 3.0, 2.0, 1.0]);
    }
}
