//! Vertical disparity at matched pixels: block matching up and down, near the column of a coarse disparity.

use crate::coarse_match::CoarseDisparity;
use cv_core::{GrayF32, Point2};
use cv_parallel::prelude::*;

/// Number of cells across and down; one pixel is sampled in each.
const CELLS: (usize, usize) = (48, 32);
/// Block radius (horizontal, vertical) in px.
const BLOCK_RADIUS: (usize, usize) = (4, 3);
/// Vertical search radius in px.
const SEARCH_RADIUS: usize = 3;
/// Size of a block in px.
const WIDTH: usize = 2 * BLOCK_RADIUS.0 + 1;
const HEIGHT: usize = 2 * BLOCK_RADIUS.1 + 1;
type Block = [[f32; WIDTH]; HEIGHT];
/// Horizontal search radius in px.
const HORIZONTAL_RADIUS: usize = 2;
/// Size of the search region in the right image, with a pixel more for interpolation.
const REGION: (usize, usize) = (WIDTH + 2 * HORIZONTAL_RADIUS + 1, HEIGHT + 2 * SEARCH_RADIUS + 1);
/// Minimum fraction of the squared vertical gradient that is not correlated with the horizontal gradient, as it is
/// along an oblique edge.
const MIN_INDEPENDENT_FRACTION: f32 = 0.3;
/// Damping of horizontal steps, as a ratio of the squared vertical gradient.
const HORIZONTAL_DAMPING: f32 = 0.01;
/// Gauss-Newton iterations.
const ITERATIONS: usize = 4;
/// Minimum vertical difference of gray levels of a sampled pixel, on a range of 0 to 1 and after smoothing.
const MIN_VERTICAL_GRADIENT: f32 = 0.01;
/// Variance of gray levels by which that of the residuals is increased: quantization of 8 bits, twice, after smoothing.
const MIN_VARIANCE: f32 = 1e-5;

/// The vertical disparity at a position of the right image.
#[derive(Debug, Clone, Copy)]
pub(crate) struct VerticalMatch {
    pub(crate) position: Point2<f64>,
    /// Right minus left, in px.
    pub(crate) offset: f64,
    /// Inverse variance, up to a factor.
    pub(crate) weight: f64,
}

/// Estimates subpixel vertical disparities: in each cell, at the matched pixel with the largest vertical gradient. Linear in the number of
/// pixels; one in four is tested.
pub(crate) fn vertical_matches([left, right]: [&GrayF32; 2], coarse: &CoarseDisparity) -> Vec<VerticalMatch> {
    let (width, height) = left.size();
    // Space for a block, its gradient and the search.
    let margin = (BLOCK_RADIUS.0 + 1, BLOCK_RADIUS.1 + SEARCH_RADIUS + 1);
    let inside = (width.saturating_sub(2 * margin.0), height.saturating_sub(2 * margin.1));
    let (columns, rows) = (CELLS.0.min(inside.0 / 4), CELLS.1.min(inside.1 / 4));
    let range = |i: usize, n: usize, inside: usize, margin: usize| {
        (margin + i * inside / n..margin + (i + 1) * inside / n).step_by(2)
    };
    let gradient = |(x, y): (usize, usize)| (intensity(left, x, y + 1) - intensity(left, x, y - 1)).abs();
    let in_cell = |cell: usize| {
        let ys = range(cell / columns, rows, inside.1, margin.1);
        let pixels = ys.flat_map(|y| range(cell % columns, columns, inside.0, margin.0).map(move |x| (x, y)));
        let matched = pixels.filter(|&(x, y)| coarse.at(x, y).is_some());
        let strongest = matched.map(|pixel| (gradient(pixel), pixel)).reduce(|a, b| if b.0 > a.0 { b } else { a });
        let (_, (x, y)) = strongest.filter(|(gradient, _)| *gradient >= MIN_VERTICAL_GRADIENT)?;
        let disparity = coarse.at(x, y)?;
        let (offset, weight) = block_offset(left, right, (x, y), disparity)?;
        let position = Point2::new(x as f64 - f64::from(disparity), y as f64 + offset);
        Some(VerticalMatch { position, offset, weight })
    };
    let cells = (0..columns * rows).into_par_iter().with_min_len(columns);
    let matches: Vec<Option<VerticalMatch>> = cells.map(in_cell).collect();
    matches.into_iter().flatten().collect()
}

/// Returns the gray level of a pixel.
fn intensity(gray: &GrayF32, x: usize, y: usize) -> f32 {
    gray.at(x, y)[0]
}

/// Estimates the vertical offset of a pixel's block in the right image, and its inverse variance: minimum of the zero-mean sum of squared
/// differences, then Gauss-Newton steps in both directions with the gradient of the left block (inverse compositional,
/// Baker & Matthews, "Lucas-Kanade 20 years on", IJCV 2004). Horizontal steps are needed since along an oblique edge
/// the disparity has compensated for the offset. `None` for an oblique edge (aperture problem), outside the search
/// range, or at the image border.
fn block_offset(left: &GrayF32, right: &GrayF32, (x, y): (usize, usize), disparity: f32) -> Option<(f64, f64)> {
    let column = x as f32 - disparity;
    let first = column.floor() as i64 - (BLOCK_RADIUS.0 + HORIZONTAL_RADIUS) as i64;
    if first < 0 || first as usize + REGION.0 > right.width() {
        return None;
    }
    let first = first as usize;
    let (x, y) = (x - BLOCK_RADIUS.0, y - BLOCK_RADIUS.1);
    let block = |value: &dyn Fn(usize, usize) -> f32| -> Block {
        let values: Block = std::array::from_fn(|j| std::array::from_fn(|i| value(i, j)));
        let mean = values.as_flattened().iter().sum::<f32>() / (WIDTH * HEIGHT) as f32;
        values.map(|row| row.map(|value| value - mean))
    };
    let template = block(&|i, j| intensity(left, x + i, y + j));
    let across = block(&|i, j| 0.5 * (intensity(left, x + i + 1, y + j) - intensity(left, x + i - 1, y + j)));
    let downward = block(&|i, j| 0.5 * (intensity(left, x + i, y + j + 1) - intensity(left, x + i, y + j - 1)));
    let sum = |a: &Block, b: &Block| a.as_flattened().iter().zip(b.as_flattened()).map(|(a, b)| a * b).sum::<f32>();
    let [xx, xy, yy] = [sum(&across, &across), sum(&across, &downward), sum(&downward, &downward)];
    // Without a horizontal gradient, horizontal steps are zero.
    let xx = xx + HORIZONTAL_DAMPING * yy;
    let determinant = xx * yy - xy * xy;
    // Also false for a block without gradient.
    let is_determined = determinant > MIN_INDEPENDENT_FRACTION * xx * yy && yy > 0.0;
    if !is_determined {
        return None;
    }
    // The search region of the right image.
    let region: [[f32; REGION.0]; REGION.1] =
        std::array::from_fn(|j| std::array::from_fn(|i| intensity(right, first + i, y + j - SEARCH_RADIUS)));
    // Difference to the block at `(across, down)` from the region's corner.
    let difference = |across: f32, down: f32| {
        let ((i0, j0), (fx, fy)) = ((across as usize, down as usize), (across.fract(), down.fract()));
        let target = block(&|i, j| {
            let in_row = |row: &[f32; REGION.0]| row[i0 + i] + fx * (row[i0 + i + 1] - row[i0 + i]);
            let (above, below) = (in_row(&region[j0 + j]), in_row(&region[j0 + j + 1]));
            above + fy * (below - above)
        });
        std::array::from_fn(|j| std::array::from_fn(|i| template[j][i] - target[j][i]))
    };
    let mut position = (HORIZONTAL_RADIUS as f32 + column.fract(), 0.0);
    let mut min_cost = f32::INFINITY;
    for down in 0..2 * SEARCH_RADIUS {
        let residual = difference(position.0, down as f32);
        let cost = sum(&residual, &residual);
        if cost < min_cost {
            (min_cost, position.1) = (cost, down as f32);
        }
    }
    for _ in 0..ITERATIONS {
        let residual = difference(position.0, position.1);
        let (ex, ey) = (sum(&residual, &across), sum(&residual, &downward));
        position.0 += (yy * ex - xy * ey) / determinant;
        position.1 += (xx * ey - xy * ex) / determinant;
        let (last_x, last_y) = ((2 * HORIZONTAL_RADIUS) as f32, (2 * SEARCH_RADIUS) as f32);
        if !((0.0..last_x).contains(&position.0) && (0.0..last_y).contains(&position.1)) {
            return None;
        }
    }
    let residual = difference(position.0, position.1);
    // The variance of the vertical step is that of the residuals by the squared gradient that is not correlated with the horizontal one.
    let variance = sum(&residual, &residual) / (WIDTH * HEIGHT) as f32 + MIN_VARIANCE;
    Some((f64::from(position.1) - SEARCH_RADIUS as f64, f64::from(determinant / (xx * variance))))
}
