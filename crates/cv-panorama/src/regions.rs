//! The parts of the canvas on which photographs are warped at full resolution.

use crate::seams::label_bounds;
use crate::surface::{Bounds, Layout, Preview};
use cv_core::Image;
use std::ops::Range;

/// The part of the canvas on which a placement is warped.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Region {
    /// Bounding box of the label and the margin of a pyramid.
    pub(crate) bounds: Bounds,
    /// Canvas pixels per row of `spans`.
    step: usize,
    /// Columns of each preview row that lie within the margin of the label. Beyond them, pixels have no influence, and are not sampled.
    spans: Vec<Range<usize>>,
}

impl Region {
    /// Returns a region of all pixels of a rectangle.
    pub(crate) fn whole(bounds: Bounds) -> Self {
        Self { bounds, step: 1, spans: Vec::new() }
    }

    /// Returns the columns of a canvas row of the bounds that are sampled.
    pub(crate) fn span(&self, y: usize) -> Range<usize> {
        self.spans.get(y / self.step).cloned().unwrap_or(self.bounds.left..self.bounds.right)
    }
}

/// Returns the region of each placement for a pyramid of `levels` levels, by the labels of the preview.
pub(crate) fn regions(
    coarse: &Image<u16, 1>,
    preview: &Preview,
    layout: &Layout,
    levels: usize,
) -> Vec<Option<Region>> {
    let (w, h, step) = (layout.width, layout.height, preview.step);
    // One preview pixel for upsampling, two for the refinement of the seams.
    let slack = 3 * step;
    let unit = 1 << levels;
    // Of the columns; rows are also rounded out.
    let margin = slack + 2 * unit;
    let reach = (margin + unit).div_ceil(step) + 1;
    #[allow(clippy::reversed_empty_ranges, reason = "an empty hull, which any column extends")]
    let none = vec![vec![usize::MAX..0; coarse.height()]; layout.placements.len()];
    let (mut own, mut fills) = (none.clone(), none);
    let add = |spans: &mut [Vec<Range<usize>>], label: usize, columns: Range<usize>, y: usize| {
        let span = &mut spans[label][y];
        *span = span.start.min(columns.start)..span.end.max(columns.end);
    };
    for y in 0..coarse.height() {
        let mut start = 0;
        for run in coarse.row(y).chunk_by(|a, b| a == b) {
            let columns = start..start + run.len();
            start = columns.end;
            let label = usize::from(run[0]);
            let Some(piece) = preview.pieces.get(label) else { continue };
            add(&mut own, label, columns.clone(), y);
            // At the border of a photograph, pixels of the canvas that it does not cover are taken from another.
            let rows = [y.wrapping_sub(1), y, y + 1].map(|y| piece.warped.row(y));
            let left = piece.warped.bounds.left;
            let is_covered = |x: usize| {
                rows.iter().all(|row| row.get(x.wrapping_sub(left)).is_some_and(|[.., opacity]| *opacity != 0))
            };
            let mut before = [columns.start.wrapping_sub(1), columns.start].map(is_covered);
            for x in columns {
                let next = is_covered(x + 1);
                if before != [true; 2] || !next {
                    let others = preview.pieces.iter().enumerate().filter(|(_, piece)| piece.warped.reaches(x, y));
                    others.for_each(|(other, _)| add(&mut fills, other, x..x + 1, y));
                }
                before = [before[1], next];
            }
        }
    }
    let region = |label: usize, b: Bounds| {
        let full = Bounds {
            left: (b.left * step).min(w),
            top: (b.top * step).min(h),
            right: (b.right * step).min(w),
            bottom: (b.bottom * step).min(h),
        };
        let bounds = full.grown(slack, w, h).for_pyramid(levels, w, h);
        let span = |y: usize| {
            // Columns within `margin` of the spans of the rows within `reach`.
            let near = |spans: &[Range<usize>], reach: usize, margin: usize| {
                let rows = &spans[y.saturating_sub(reach)..(y + reach + 1).min(spans.len())];
                let (start, end) = rows.iter().fold((usize::MAX, 0), |s, row| (s.0.min(row.start), s.1.max(row.end)));
                if start < end { ((start * step).saturating_sub(margin), end * step + margin) } else { (usize::MAX, 0) }
            };
            let ((left, right), (first, last)) = (near(&own[label], reach, margin), near(&fills[label], 1, step));
            let (left, right) = (left.min(first), right.max(last));
            if left >= right {
                return bounds.left..bounds.right;
            }
            let left = left.clamp(bounds.left, bounds.right);
            left..right.clamp(left, bounds.right)
        };
        Region { bounds, step, spans: (0..coarse.height()).map(span).collect() }
    };
    let bounds = label_bounds(coarse, layout.placements.len());
    bounds.into_iter().enumerate().map(|(label, b)| b.map(|b| region(label, b))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::View;
    use crate::surface::{Canvas, Piece, Placement, Projection, Surface};
    use crate::testing::drawn;
    use cv_core::{Camera, Matrix3, Point2};
    use proptest::prelude::*;

    const SIZE: (usize, usize) = (30, 20);

    /// A preview of two photographs, of the left and right 20 of 30 columns, that represents 4 canvas pixels by one.
    fn preview() -> (Preview, Layout) {
        let boxes = [(0, 20), (10, 30)].map(|(left, right)| Bounds { left, top: 0, right, bottom: SIZE.1 });
        let piece = |bounds: &Bounds| {
            let n = bounds.width() * bounds.height();
            Piece::new(drawn(*bounds, |_, _| [9; 3]), vec![0.0; n], vec![0.0; n], 9.0)
        };
        let preview = Preview {
            step: 4,
            width: SIZE.0,
            height: SIZE.1,
            full_circle: false,
            pieces: boxes.iter().map(piece).collect(),
        };
        let view = View { camera: Camera::from_focal(80, 80, 80.0), from_world: Matrix3::identity() };
        let origin = Point2::new(0.0, 0.0);
        let placement = |bounds: &Bounds| Placement { photo: 0, view, bounds: *bounds, origin };
        let layout = Layout {
            surface: Surface { projection: Projection::Plane, scale: 80.0 },
            width: 4 * SIZE.0,
            height: 4 * SIZE.1,
            full_circle: false,
            reaches_beyond: false,
            placements: boxes.iter().map(placement).collect(),
            canvas: Canvas { projection: Projection::Plane, scale: 80.0, origin, frame: Matrix3::identity() },
        };
        (preview, layout)
    }

    proptest! {
        #[test]
        fn spans_hold_all_within_the_margin_of_a_label(steps in proptest::collection::vec(10..20_usize, SIZE.1), levels in 0..3_usize) {
            let (preview, layout) = preview();
            let coarse = Image::from_fn(SIZE.0, SIZE.1, |x, y| [u16::from(x >= steps[y])]);
            let found = regions(&coarse, &preview, &layout, levels);
            let margin = 3 * 4 + (2 << levels);
            for (label, region) in found.iter().enumerate() {
                let region = region.as_ref().unwrap();
                for (x, y) in (0..layout.height).flat_map(|y| (0..layout.width).map(move |x| (x, y))) {
                    if usize::from(coarse.at(x / 4, y / 4)[0]) != label {
                        continue;
                    }
                    for y in y.saturating_sub(margin)..(y + margin + 1).min(layout.height) {
                        let span = region.span(y);
                        prop_assert!(region.bounds.contains(x, y) && span.contains(&x));
                        prop_assert!(span.start <= x.saturating_sub(margin).max(region.bounds.left));
                        prop_assert!(span.end > (x + margin).min(region.bounds.right - 1));
                        prop_assert!(span.start >= region.bounds.left && span.end <= region.bounds.right);
                    }
                }
            }
        }
    }
}
