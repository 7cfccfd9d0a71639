//! Smoothness term through contradictions: places where two photographs show different objects, such as a person in one of them.

use crate::surface::Piece;

/// Difference of colors, in the unit of [`difference`](super::cost::difference), up to which two photographs show the same: 20 gray levels in every channel.
const TOLERANCE: i32 = 4 * 60;
/// Cost per unit beyond the tolerance. Eight keeps whole a person in front of a clipped wall, around whom every seam crosses clipped pixels and the edges of windows.
const WEIGHT: i32 = 8;

/// Computes the cost of a seam through a contradiction at a preview pixel, in addition to the difference: the minimum over 3 × 3 pixels of the difference of colors beyond a tolerance, weighted.
///
/// `difference` is that of the pixel; up to the tolerance it is no contradiction. The minimum is 0 along edges that are displaced or bloom by a pixel, where a seam is visible but cuts nothing. What a clipped sample bounds is no contradiction.
#[inline]
pub(super) fn contradiction(a: &Piece, b: &Piece, (x, y): (usize, usize), difference: i32) -> i32 {
    if difference > TOLERANCE {
        least_difference(a, b, x, y).map_or(0, |least| WEIGHT * (least - TOLERANCE))
    } else {
        0
    }
}

/// Returns the least difference of colors over 3 × 3 pixels if all exceed the tolerance, without the channels that a clipped sample bounds from below.
fn least_difference(a: &Piece, b: &Piece, x: usize, y: usize) -> Option<i32> {
    let mut least: Option<i32> = None;
    for y in y.saturating_sub(1)..=y + 1 {
        for x in x.saturating_sub(1)..=x + 1 {
            let (Some(c), Some(d)) = (a.warped.color(x, y), b.warped.color(x, y)) else { continue };
            let (above_a, above_b) = (a.bounded_channels(d, x, y), b.bounded_channels(c, x, y));
            let off = |k: usize| if above_a[k] || above_b[k] { 0 } else { i32::from(c[k].abs_diff(d[k])) };
            let difference = 4 * (off(0) + off(1) + off(2));
            if difference <= TOLERANCE {
                return None;
            }
            least = Some(least.map_or(difference, |least| least.min(difference)));
        }
    }
    least
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::seams::cost::difference;
    use crate::surface::Bounds;
    use crate::testing::drawn;

    const BOUNDS: Bounds = Bounds { left: 3, top: 2, right: 33, bottom: 22 };

    fn between(a: &Piece, b: &Piece, x: usize, y: usize) -> i32 {
        contradiction(a, b, (x, y), difference(Some(&a.warped), Some(&b.warped), x, y))
    }

    fn piece(color: impl Fn(usize, usize) -> [u8; 3]) -> Piece {
        let n = BOUNDS.width() * BOUNDS.height();
        Piece::new(drawn(BOUNDS, color), vec![0.0; n], vec![0.0; n], 0.0)
    }

    #[test]
    fn a_person_is_a_contradiction_and_a_displaced_edge_is_none() {
        let wall = piece(|_, _| [120; 3]);
        let person = piece(|x, _| if (10..20).contains(&x) { [60; 3] } else { [120; 3] });
        let edge = piece(|x, _| if (10..12).contains(&x) { [60; 3] } else { [120; 3] });
        // 60 levels in three channels, of which the tolerance is a third.
        assert_eq!(between(&wall, &person, 15, 10), 8 * 4 * (180 - 60));
        assert_eq!(between(&person, &wall, 15, 10), between(&wall, &person, 15, 10));
        // At the outline, and on two columns.
        assert_eq!(between(&wall, &person, 10, 10), 0);
        assert!((8..14).all(|x| between(&wall, &edge, x, 10) == 0));
        // At and beyond the border of the photographs.
        assert_eq!(between(&wall, &person, 15, 2), 8 * 4 * (180 - 60));
        assert_eq!(between(&wall, &person, 15, 0), 0);
    }

    #[test]
    fn a_clipped_sample_contradicts_only_what_is_darker_than_its_bound() {
        let sky = piece(|_, _| [255; 3]);
        // White, and the wood of a table.
        let [brighter, darker] = [[230; 3], [230, 150, 110]].map(|color| piece(move |_, _| color));
        assert_eq!(between(&sky, &brighter, 15, 10), 0);
        assert_eq!(between(&brighter, &sky, 15, 10), 0);
        assert!(between(&sky, &darker, 15, 10) > 0);
        assert!(between(&darker, &sky, 15, 10) > 0);
    }
}
