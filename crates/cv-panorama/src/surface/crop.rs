//! The largest axis-aligned rectangle inside a mask.

use crate::rows::is_check_due;
use crate::surface::Bounds;
use cv_core::{Cancelled, ImageView, Stage};

/// Finds the rectangle of maximum area in which every pixel is true; `None` where no pixel is. O(pixels): the stack algorithm for the largest rectangle
/// in a histogram, per row.
pub(crate) fn largest_rectangle(mask: ImageView<'_, bool, 1>, stage: &Stage<'_>) -> Result<Option<Bounds>, Cancelled> {
    largest_rectangle_of(mask.size(), |y, row| row.copy_from_slice(mask.row(y)), stage)
}

/// As [`largest_rectangle`], of a mask of this size whose row `y` is written by `mask_row`.
pub(crate) fn largest_rectangle_of(
    (w, h): (usize, usize),
    mut mask_row: impl FnMut(usize, &mut [bool]),
    stage: &Stage<'_>,
) -> Result<Option<Bounds>, Cancelled> {
    let mut inside_row = vec![false; w];
    let mut heights = vec![0_usize; w];
    let mut best: Option<Bounds> = None;
    let area = |b: &Bounds| b.width() * b.height();
    // Stack of bars: start column and height, ascending.
    let mut stack: Vec<(usize, usize)> = Vec::with_capacity(w);
    for y in 0..h {
        if is_check_due(y, 4 * w) {
            stage.check()?;
        }
        mask_row(y, &mut inside_row);
        for (height, inside) in heights.iter_mut().zip(&inside_row) {
            *height = if *inside { *height + 1 } else { 0 };
        }
        stack.clear();
        for x in 0..=w {
            let height = heights.get(x).copied().unwrap_or(0);
            let mut start = x;
            while let Some(&(left, tall)) = stack.last()
                && tall >= height
            {
                stack.pop();
                let b = Bounds { left, top: y + 1 - tall, right: x, bottom: y + 1 };
                if tall > 0 && best.is_none_or(|best| area(&b) > area(&best)) {
                    best = Some(b);
                }
                start = left;
            }
            stack.push((start, height));
        }
    }
    Ok(best)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Mask;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_crop_is_the_largest_covered_rectangle(w in 1..8_usize, h in 1..7_usize, bits in any::<u64>()) {
            let mask = Mask::from_fn(w, h, |x, y| [bits >> (y * w + x) & 1 == 1]);
            let full = |b: &Bounds| (b.top..b.bottom).all(|y| (b.left..b.right).all(|x| mask.at(x, y)[0]));
            let mut largest = 0;
            for top in 0..h {
                for bottom in top + 1..=h {
                    for left in 0..w {
                        for right in left + 1..=w {
                            let b = Bounds { left, top, right, bottom };
                            if full(&b) {
                                largest = largest.max(b.width() * b.height());
                            }
                        }
                    }
                }
            }
            match largest_rectangle(mask.view(), &crate::testing::stage()).unwrap() {
                None => prop_assert_eq!(largest, 0),
                Some(b) => {
                    prop_assert!(full(&b));
                    prop_assert_eq!(b.width() * b.height(), largest);
                }
            }
        }
    }
}
