//! Data term against transient objects: where three or more photographs cover a pixel, the deviation of each from their median.

use crate::surface::{Piece, Preview};
use cv_parallel::prelude::*;

/// Photographs of a pixel from which on their median is that of the scene.
const MIN_PHOTOS: usize = 3;
/// Sum of absolute deviations over channels, in gray levels, that noise and misalignment of the preview cause.
const TOLERANCE: f32 = 30.0;
/// Cost per gray level beyond the tolerance, in the quarters of a level of the smoothness term: a deviation of 60 levels in every channel reaches the maximum.
const COST_PER_LEVEL: f32 = 2.0;
/// Maximum cost of a pixel: about a seam along the border of a photograph, so that a small object is worth the seam around it.
const MAX_COST: f32 = 300.0;

/// Returns the cost of every pixel of every piece, in the order of its pixels. O(preview pixels × pieces).
pub(super) fn transient_costs(preview: &Preview) -> Vec<Vec<f32>> {
    let medians: Vec<Option<[f32; 3]>> = (0..preview.width * preview.height)
        .into_par_iter()
        .map_init(
            || [Vec::new(), Vec::new(), Vec::new()],
            |values, i| {
                values.iter_mut().for_each(Vec::clear);
                let (x, y) = (i % preview.width, i / preview.width);
                for color in preview.pieces.iter().filter_map(|piece| piece.warped.color(x, y)) {
                    values.iter_mut().zip(color).for_each(|(values, v)| values.push(v));
                }
                (values[0].len() >= MIN_PHOTOS).then(|| [0, 1, 2].map(|c| median(&mut values[c])))
            },
        )
        .collect();
    let costs = |piece: &Piece| {
        let b = piece.warped.bounds;
        let places = (b.top..b.bottom).flat_map(|y| (b.left..b.right).map(move |x| (x, y)));
        let cost = |(x, y): (usize, usize)| {
            let median = medians.get(y * preview.width + x).copied().flatten();
            let (Some(median), Some(color)) = (median, piece.warped.color(x, y)) else { return 0.0 };
            let deviation: f32 = color.iter().zip(median).map(|(v, m)| (f32::from(*v) - m).abs()).sum();
            (COST_PER_LEVEL * (deviation - TOLERANCE)).clamp(0.0, MAX_COST)
        };
        places.map(cost).collect()
    };
    preview.pieces.par_iter().map(costs).collect()
}

/// Returns the median; of an even number the mean of the two in the middle.
fn median(values: &mut [u8]) -> f32 {
    values.sort_unstable();
    let (low, high) = (values[(values.len() - 1) / 2], values[values.len() / 2]);
    0.5 * (f32::from(low) + f32::from(high))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::seams::{Seams, on_preview};
    use crate::surface::Bounds;
    use crate::testing::drawn;
    use cv_core::Silent;

    const SIZE: (usize, usize) = (120, 80);

    /// Photographs of one view with a person each, of whom the first is where its photograph is the nearest.
    fn people(photographs: usize) -> Preview {
        let bounds = Bounds { left: 0, top: 0, right: SIZE.0, bottom: SIZE.1 };
        let piece = |k: usize| {
            let n = SIZE.0 * SIZE.1;
            let eccentricity = vec![0.2 * k as f32; n];
            let is_person = move |x: usize, y: usize| (20 + 25 * k..30 + 25 * k).contains(&x) && (30..60).contains(&y);
            let color = move |x: usize, y: usize| {
                if is_person(x, y) { [200, 40, 60] } else { [(90 + x % 7) as u8, (100 + y % 5) as u8, 110] }
            };
            let warped = drawn(bounds, color);
            Piece::new(warped, eccentricity.clone(), eccentricity, 100.0)
        };
        Preview {
            step: 1,
            width: SIZE.0,
            height: SIZE.1,
            full_circle: false,
            pieces: (0..photographs).map(piece).collect(),
        }
    }

    /// Pixels of the composite that show a person.
    fn persons(preview: &Preview, removes_transients: bool) -> usize {
        let photo_of: Vec<usize> = (0..preview.pieces.len()).collect();
        let labels = on_preview(preview, &photo_of, Seams::GraphCut, false, removes_transients, &Silent).unwrap();
        let places = (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| (x, y)));
        let red = |(x, y): &(usize, usize)| {
            preview.pieces[usize::from(labels.at(*x, *y)[0])].warped.color(*x, *y).is_some_and(|c| c[0] == 200)
        };
        places.filter(red).count()
    }

    #[test]
    fn people_who_walk_through_vanish_where_three_photographs_see_the_place() {
        for photographs in [3, 4] {
            let preview = people(photographs);
            assert_eq!((persons(&preview, false), persons(&preview, true)), (300, 0), "{photographs}");
        }
        // Of two it is unknown which is right.
        let preview = people(2);
        assert_eq!(persons(&preview, true), persons(&preview, false));
    }

    #[test]
    fn costs_are_those_of_the_deviation_from_the_median() {
        let preview = people(3);
        let costs = transient_costs(&preview);
        let at = |k: usize, x: usize, y: usize| costs[k][y * SIZE.0 + x];
        // The first person against the background of the others: 110, 60 and 50 levels off, or a few less.
        assert_eq!((at(0, 25, 40), at(1, 25, 40), at(0, 50, 40), at(0, 5, 5)), (MAX_COST, 0.0, 0.0, 0.0));
    }
}
