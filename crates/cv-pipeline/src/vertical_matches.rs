//! How far apart the rows of a pair are at pixels that were matched: block matching up and down, along the column to which the disparity leads.

use cv_core::{Correspondence, ImageView, Point2};
use cv_stereo::{DisparityMap, Intensity, PixelState};

/// Cells across and down, of each of which one pixel is asked.
const CELLS: (usize, usize) = (48, 32);
/// Half of a block's width and height, and how far up and down it is looked for, in px.
const BLOCK: (usize, usize) = (4, 3);
const REACH: usize = 3;
const WIDTH: usize = 2 * BLOCK.0 + 1;
const HEIGHT: usize = 2 * BLOCK.1 + 1;
type Block = [[f32; WIDTH]; HEIGHT];
/// How far aside it may be, in px, and what is cut out of the right photograph: a pixel more each way, to interpolate.
const ASIDE: usize = 2;
const STRIP: (usize, usize) = (WIDTH + 2 * ASIDE + 1, HEIGHT + 2 * REACH + 1);
/// Of the steps downward in a block, the share (of squares) that does not come with steps across, as along an edge that runs aslant.
const CLEAR: f32 = 0.3;
/// Share of the squares downward that holds a block against steps across.
const STAY: f32 = 0.01;
/// Gauss-Newton steps: each leaves a small part of the error.
const STEPS: usize = 4;
/// Vertical step of brightness that a pixel needs to be asked, as a share of the range.
const STEP: f32 = 0.03;

/// The matched pixels of the map that show an edge along the row, the clearest one of each cell, with the places in the right photograph that look like
/// them. The images and the map have one size. Linear in the number of pixels; one in four is looked at.
pub(crate) fn vertical_matches<T: Intensity, const C: usize>(
    left: ImageView<'_, T, C>,
    right: ImageView<'_, T, C>,
    map: &DisparityMap,
) -> Vec<Correspondence> {
    let (width, height) = left.size();
    // Room for a block, its gradient and its reach.
    let margin = (BLOCK.0 + 1, BLOCK.1 + REACH + 1);
    let (mut found, inside) = (Vec::new(), (width.saturating_sub(2 * margin.0), height.saturating_sub(2 * margin.1)));
    let cells = (CELLS.0.min(inside.0 / 4), CELLS.1.min(inside.1 / 4));
    for row in 0..cells.1 {
        for column in 0..cells.0 {
            let range = |i: usize, n: usize, inside: usize, margin: usize| {
                (margin + i * inside / n..margin + (i + 1) * inside / n).step_by(2)
            };
            let rows = range(row, cells.1, inside.1, margin.1);
            let pixels = rows.flat_map(|y| range(column, cells.0, inside.0, margin.0).map(move |x| (x, y)));
            let matched = pixels.filter(|&(x, y)| map.state.at(x, y)[0] == PixelState::Matched);
            let step = |(x, y): (usize, usize)| (gray(left, x, y + 1) - gray(left, x, y - 1)).abs();
            let clearest = matched.map(|pixel| (step(pixel), pixel)).reduce(|a, b| if b.0 > a.0 { b } else { a });
            let Some((_, (x, y))) = clearest.filter(|(step, _)| *step >= STEP) else { continue };
            let disparity = map.disparity.at(x, y)[0];
            if let Some(down) = offset(left, right, (x, y), disparity) {
                let b = Point2::new(x as f64 - f64::from(disparity), y as f64 + down);
                found.push(Correspondence { a: Point2::new(x as f64, y as f64), b });
            }
        }
    }
    found
}

/// Brightness of a pixel, 0 to 1.
fn gray<T: Intensity, const C: usize>(view: ImageView<'_, T, C>, x: usize, y: usize) -> f32 {
    let pixel = view.at(x, y);
    f32::from(pixel[if C >= 3 { 1 } else { 0 }].to_u16()) / 65535.0
}

/// How far below its row the right photograph shows a pixel's block: the least sum of squared differences about the blocks' means, then Gauss-Newton steps
/// across and down with the gradient of the left block (Baker & Matthews, "Lucas-Kanade 20 years on", IJCV 2004, inverse compositional). Across as well, since
/// along an edge that runs aslant the disparity has made up for the offset. `None` where an edge leaves that open, where the block is not found within its
/// reach, and where it would lie outside.
fn offset<T: Intensity, const C: usize>(
    left: ImageView<'_, T, C>,
    right: ImageView<'_, T, C>,
    (x, y): (usize, usize),
    disparity: f32,
) -> Option<f64> {
    let column = x as f32 - disparity;
    let first = column.floor() as i64 - (BLOCK.0 + ASIDE) as i64;
    if first < 0 || first as usize + STRIP.0 > right.width() {
        return None;
    }
    let first = first as usize;
    let (x, y) = (x - BLOCK.0, y - BLOCK.1);
    let block = |value: &dyn Fn(usize, usize) -> f32| -> Block {
        let values: Block = std::array::from_fn(|j| std::array::from_fn(|i| value(i, j)));
        let mean = values.as_flattened().iter().sum::<f32>() / (WIDTH * HEIGHT) as f32;
        values.map(|row| row.map(|value| value - mean))
    };
    let here = block(&|i, j| gray(left, x + i, y + j));
    let across = block(&|i, j| 0.5 * (gray(left, x + i + 1, y + j) - gray(left, x + i - 1, y + j)));
    let downward = block(&|i, j| 0.5 * (gray(left, x + i, y + j + 1) - gray(left, x + i, y + j - 1)));
    let sum = |a: &Block, b: &Block| a.as_flattened().iter().zip(b.as_flattened()).map(|(a, b)| a * b).sum::<f32>();
    let [xx, xy, yy] = [sum(&across, &across), sum(&across, &downward), sum(&downward, &downward)];
    // An edge along the row says nothing across: stay there.
    let xx = xx + STAY * yy;
    let determinant = xx * yy - xy * xy;
    // Also false for a block without any gradient.
    let is_clear = determinant > CLEAR * xx * yy && yy > 0.0;
    if !is_clear {
        return None;
    }
    // The right photograph as far as the block may reach.
    let strip: [[f32; STRIP.0]; STRIP.1] =
        std::array::from_fn(|j| std::array::from_fn(|i| gray(right, first + i, y + j - REACH)));
    // Of the block `(across, down)` from the strip's corner.
    let difference = |across: f32, down: f32| {
        let ((i0, j0), (fx, fy)) = ((across as usize, down as usize), (across.fract(), down.fract()));
        let there = block(&|i, j| {
            let in_row = |row: &[f32; STRIP.0]| row[i0 + i] + fx * (row[i0 + i + 1] - row[i0 + i]);
            let (above, below) = (in_row(&strip[j0 + j]), in_row(&strip[j0 + j + 1]));
            above + fy * (below - above)
        });
        std::array::from_fn(|j| std::array::from_fn(|i| here[j][i] - there[j][i]))
    };
    let mut place = (ASIDE as f32 + column.fract(), 0.0);
    let mut least = f32::INFINITY;
    for down in 0..2 * REACH {
        let off = difference(place.0, down as f32);
        let cost = sum(&off, &off);
        if cost < least {
            (least, place.1) = (cost, down as f32);
        }
    }
    for _ in 0..STEPS {
        let off = difference(place.0, place.1);
        let (ex, ey) = (sum(&off, &across), sum(&off, &downward));
        place.0 += (yy * ex - xy * ey) / determinant;
        place.1 += (xx * ey - xy * ex) / determinant;
        let (last_x, last_y) = ((2 * ASIDE) as f32, (2 * REACH) as f32);
        if !((0.0..last_x).contains(&place.0) && (0.0..last_y).contains(&place.1)) {
            return None;
        }
    }
    Some(f64::from(place.1) - REACH as f64)
}
