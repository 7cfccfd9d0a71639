//! Smoothness term of the seams: the difference of two photographs on both sides.

use crate::surface::WarpedPhoto;

/// Cost of a seam through a pixel that only one of the two photographs covers, in the unit of [`difference`]: 15 gray levels in every channel.
/// Such seams follow the border of a photograph.
pub(super) const BORDER_COST: i32 = 4 * 45;

/// Computes the difference of two photographs at a pixel in quarters of a gray level: the sum of absolute differences over channels plus that of the
/// gradients of brightness.
#[inline]
pub(super) fn difference(a: Option<&WarpedPhoto>, b: Option<&WarpedPhoto>, x: usize, y: usize) -> i32 {
    let (Some(a), Some(b)) = (a, b) else { return BORDER_COST };
    if !a.bounds.contains(x, y) || !b.bounds.contains(x, y) {
        return BORDER_COST;
    }
    let (first, second) = (a.pixels.as_slice().as_chunks::<4>().0, b.pixels.as_slice().as_chunks::<4>().0);
    let (across, down) = (a.bounds.width(), b.bounds.width());
    let (i, j) = ((y - a.bounds.top) * across + x - a.bounds.left, (y - b.bounds.top) * down + x - b.bounds.left);
    let Some(d) = color_difference(first[i], second[j]) else { return BORDER_COST };
    let brightness = d[0] + d[1] + d[2];
    // The difference of gradients is the gradient of the difference.
    let gradient = |i: usize, j: usize| match color_difference(first[i], second[j]) {
        Some(d) => (brightness - d[0] - d[1] - d[2]).abs(),
        None => 0,
    };
    let mut sum = d[0].abs() + d[1].abs() + d[2].abs();
    if x > a.bounds.left.max(b.bounds.left) {
        sum += gradient(i - 1, j - 1);
    }
    if y > a.bounds.top.max(b.bounds.top) {
        sum += gradient(i - across, j - down);
    }
    4 * sum
}

/// Returns the color difference where both photographs cover the pixel.
#[inline(always)]
fn color_difference(p: [u8; 4], q: [u8; 4]) -> Option<[i32; 3]> {
    let of = |c: usize| i32::from(p[c]) - i32::from(q[c]);
    (p[3] > 0 && q[3] > 0).then(|| [of(0), of(1), of(2)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::Bounds;
    use crate::testing::drawn;

    #[test]
    fn photographs_that_show_the_same_differ_by_nothing() {
        let bounds = Bounds { left: 2, top: 3, right: 12, bottom: 9 };
        let photo = drawn(bounds, |x, y| [(x * 8) as u8, (y * 12) as u8, 100]);
        let (a, b) = (Some(&photo), Some(&photo));
        assert_eq!(difference(a, b, 5, 5), 0);
        assert_eq!(difference(a, b, 2, 3), 0);
        // Where one of the two does not reach.
        assert_eq!(difference(a, b, 1, 5), BORDER_COST);
        assert_eq!(difference(a, None, 5, 5), BORDER_COST);
    }

    #[test]
    fn a_difference_is_that_of_colors_and_of_gradients_in_quarters_of_a_level() {
        let bounds = Bounds { left: 0, top: 0, right: 4, bottom: 4 };
        let first = drawn(bounds, |_, _| [100, 100, 100]);
        let second = drawn(bounds, |x, _| [if x >= 2 { 107 } else { 100 }, 100, if x >= 2 { 95 } else { 100 }]);
        let (a, b) = (Some(&first), Some(&second));
        assert_eq!(difference(a, b, 1, 1), 0);
        // 7 + 5 levels of color; in brightness (the sum of channels) a step of 7 − 5 from the left, none from above.
        assert_eq!(difference(a, b, 2, 1), 4 * (7 + 5 + 2));
        assert_eq!(difference(a, b, 3, 1), 4 * (7 + 5));
        assert_eq!(difference(a, b, 2, 1), difference(b, a, 2, 1));
    }
}
