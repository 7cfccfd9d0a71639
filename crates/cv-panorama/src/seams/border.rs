//! Seams at the border of a canvas that spans 360°: its last column is a neighbor of its first.

use super::alpha_expansion::LENGTH_COST;
use crate::surface::Preview;
use cv_core::Image;

/// Returns the smoothness term of a label at a pixel of the first or last column and another at its neighbor beyond the border: the differences of the two photographs at both pixels.
/// `difference(a, b, x, y)` is that of two placements at a pixel; on the other side of the border a photograph has another placement.
pub(super) fn cost(
    level: &Preview,
    photo_of: &[usize],
    difference: &impl Fn(usize, usize, usize, usize) -> i32,
    own: usize,
    other: usize,
    (x, y): (usize, usize),
) -> i32 {
    if photo_of[own] == photo_of[other] {
        return 0;
    }
    let beyond = level.width - 1 - x;
    let placed = |label: usize, x: usize| {
        let mut same = (0..photo_of.len()).filter(|&k| photo_of[k] == photo_of[label]);
        same.find(|&k| level.pieces[k].warped.reaches(x, y)).unwrap_or(label)
    };
    LENGTH_COST + difference(own, placed(other, x), x, y) + difference(placed(own, beyond), other, beyond, y)
}

/// Adds the pixels closer than `reach` to a seam along the border.
pub(super) fn add_band(near: &mut [bool], labels: &Image<u16, 1>, photo_of: &[usize], reach: usize) {
    let (w, h) = labels.size();
    let photo = |label: u16| photo_of.get(usize::from(label));
    for y in 0..h {
        let row = labels.row(y);
        if w > 0 && photo(row[0]) != photo(row[w - 1]) {
            for y in y.saturating_sub(reach)..(y + reach + 1).min(h) {
                let near = &mut near[y * w..(y + 1) * w];
                near[..(reach + 1).min(w)].fill(true);
                near[w.saturating_sub(reach + 1)..].fill(true);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

    use super::super::{Seams, on_preview};
    use super::*;
    use crate::surface::{Bounds, Piece};
    use crate::testing::drawn;
    use cv_core::Silent;

    const SIZE: (usize, usize) = (160, 80);

    #[test]
    fn no_seam_follows_the_border_where_the_photographs_differ() {
        // Two photographs across the border, each placed on both sides of it, and one between them. The second is brighter, except in some columns; each is preferred on one side.
        let piece = |left: usize, right: usize, eccentricity: f32, offset: &dyn Fn(usize) -> u8| {
            let bounds = Bounds { left, top: 0, right, bottom: SIZE.1 };
            let wave = |x: usize, y: usize| 90.0 + 40.0 * (0.21 * x as f64).sin() + 30.0 * (0.17 * y as f64).cos();
            let color = |x: usize, y: usize| [wave(x, y) as u8 + offset(x); 3];
            let eccentricity = vec![eccentricity; bounds.width() * bounds.height()];
            Piece::new(drawn(bounds, color), eccentricity.clone(), eccentricity, 0.0)
        };
        let (dark, bright) = (|_| 0, |x: usize| if (135..145).contains(&x) { 0 } else { 30 });
        let middle = |x: usize| (x.saturating_sub(60).min(40) * 3 / 4) as u8;
        let pieces = vec![
            piece(30, 130, 0.5, &middle),
            piece(0, 50, 0.0, &dark),
            piece(110, 160, 1.0, &dark),
            piece(0, 50, 1.0, &bright),
            piece(110, 160, 0.0, &bright),
        ];
        let mut preview = Preview { step: 1, width: SIZE.0, height: SIZE.1, full_circle: true, pieces };
        let photo_of = [0, 1, 1, 2, 2];
        let ends = |preview: &Preview| -> Vec<[usize; 2]> {
            let labels = on_preview(preview, &photo_of, Seams::GraphCut, false, false, &Silent).unwrap();
            (0..SIZE.1).map(|y| [0, SIZE.0 - 1].map(|x| photo_of[usize::from(labels.at(x, y)[0])])).collect()
        };
        assert_eq!(ends(&preview), [[1, 1]; SIZE.1]);
        preview.full_circle = false;
        assert_eq!(ends(&preview), [[1, 2]; SIZE.1]);
    }
}
