//! ChArUco boards: chessboards with a marker in every white square, so that a part of one is enough.
//!
//! The chessboard's corners are found and joined first, as those of a plain board are. Then the markers are read, which needs no search: each white square with its
//! four corners says where its marker's bits lie. Every marker that is read votes for where the grid lies on the board.

use super::board::{BoardPoint, CharucoBoard};
use super::grid::{Grid, grids};
use super::saddle::saddle;
use super::x_corner::x_corners;
use super::{ChessboardError, ChessboardOptions};
use crate::error::check_image;
use cv_core::{ImageView, Matrix3, Point2, Progress, Stage, Vector3};
use cv_imgproc::sample_bilinear;
use std::collections::BTreeMap;

/// Where a grid lies on a board: quarter turns, then the shift of columns and rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Placement {
    turns: usize,
    shift: (i32, i32),
}

/// A quarter turn clockwise on screen, so many times.
fn turned((x, y): (i32, i32), turns: usize) -> (i32, i32) {
    (0..turns & 3).fold((x, y), |(x, y), _| (-y, x))
}

/// Finds the corners of a ChArUco board: as many as the picture shows, with their numbers on the board.
///
/// `view` is gray, 0 to 1. The points are in the order of their ids, which are those of [`CharucoBoard::point`]; at least four.
///
/// # Errors
/// [`ChessboardError`]; `NoBoard` too where no marker of the board can be read.
pub fn find_charuco(
    view: ImageView<'_, f32, 1>,
    board: &CharucoBoard,
    options: &ChessboardOptions,
    progress: &dyn Progress,
) -> Result<Vec<BoardPoint>, ChessboardError> {
    options.check()?;
    if !board.is_valid() {
        return Err(ChessboardError::Size { asked: board.corners() });
    }
    check_image(view, 16)?;
    let (corners, smooth) = x_corners(view, options.least_contrast, progress)?;
    let stage = Stage::new(progress, "grid", 0)?;
    // White around a marker, in squares.
    let clear = 0.45 * (1.0 - board.marker / board.square);
    let mut best: Vec<BoardPoint> = Vec::new();
    for mut grid in grids(&corners, smooth.view(), 4, clear, &stage)? {
        if grid.nodes.len() <= best.len() {
            break;
        }
        grid.settle(smooth.view());
        let [x0, x1, y0, y1] = grid.bounds();
        grid.fill(smooth.view(), [x0 - 2, x1 + 2, y0 - 2, y1 + 2], &stage)?;
        let Some(placement) = placed(&grid, view, board) else { continue };
        let size = board.corners();
        let mut points: Vec<BoardPoint> = Vec::new();
        for (&place, node) in &grid.nodes {
            let (x, y) = turned(place, placement.turns);
            let (x, y) = (x + placement.shift.0, y + placement.shift.1);
            if x < 0 || y < 0 || x >= size.columns as i32 || y >= size.rows as i32 {
                continue;
            }
            let step = grid.step(place);
            let window = (clear * step).min(options.largest_window.into()).max(2.0);
            let start = node.corner.position;
            let Some(found) = saddle(smooth.view(), start, window, 2e-4) else { continue };
            if (found.position - start).norm() < (0.1 * step).max(1.0) {
                let id = y as usize * size.columns + x as usize;
                points.push(BoardPoint { id, position: found.position, deviation: found.deviation_unsmoothed() });
            }
        }
        if points.len() > best.len() {
            best = points;
        }
    }
    if best.len() < 4 {
        return Err(ChessboardError::NoBoard { corners: corners.len() });
    }
    best.sort_by_key(|p| p.id);
    Ok(best)
}

/// Where a grid lies on the board by its markers: where at least two of them, and more than half of those that can be read, agree.
fn placed(grid: &Grid, view: ImageView<'_, f32, 1>, board: &CharucoBoard) -> Option<Placement> {
    let mut votes: BTreeMap<Placement, usize> = BTreeMap::new();
    let mut read = 0;
    for (&(x, y), node) in &grid.nodes {
        // Even: the square to the right and below is white.
        if node.turns & 1 != 0 {
            continue;
        }
        let corner = |dx: i32, dy: i32| grid.position((x + dx, y + dy));
        let (Some(a), Some(b), Some(c), Some(d)) = (corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)) else {
            continue;
        };
        let Some((id, turns)) = marker(view, [a, b, c, d], board) else { continue };
        let Some((column, row)) = board.square_of(id) else { continue };
        read += 1;
        // The square's middle, in twice its coordinates, turns as the marker must be turned back: to the corner (column, row) of squares belongs the
        // inner corner before it.
        let back = (4 - turns) & 3;
        let middle = turned((2 * x + 1, 2 * y + 1), back);
        let shift = (2 * column as i32 - 1 - middle.0, 2 * row as i32 - 1 - middle.1);
        *votes.entry(Placement { turns: back, shift: (shift.0 / 2, shift.1 / 2) }).or_default() += 1;
    }
    let (&placement, &agreed) = votes.iter().max_by_key(|v| *v.1)?;
    (agreed >= 2 && 2 * agreed > read).then_some(placement)
}

/// The marker in a white square with these corners (clockwise from the grid's first), and its quarter turns clockwise against the grid.
fn marker(view: ImageView<'_, f32, 1>, corners: [Point2<f64>; 4], board: &CharucoBoard) -> Option<(usize, usize)> {
    let map = square_to_picture(corners)?;
    let side = board.dictionary.side() + 2;
    let cell = board.marker / board.square / side as f64;
    let first = 0.5 * (1.0 - board.marker / board.square);
    let at = |u: f64, v: f64| {
        let p = map * Vector3::new(u, v, 1.0);
        sample_bilinear(view, p.x / p.z, p.y / p.z).map(|[v]| v)
    };
    let mut values = Vec::with_capacity(side * side);
    for row in 0..side {
        for column in 0..side {
            let (mut sum, mut n) = (0.0, 0.0f32);
            for dv in [-0.2, 0.0, 0.2] {
                for du in [-0.2, 0.0, 0.2] {
                    let (u, v) = (column as f64 + 0.5 + du, row as f64 + 0.5 + dv);
                    sum += at(first + u * cell, first + v * cell)?;
                    n += 1.0;
                }
            }
            values.push(sum / n);
        }
    }
    // White is that of the square's rim, black that of the marker's frame.
    let mut white = 0.0;
    for k in 0..8 {
        let (t, e) = (0.15 + 0.1 * k as f64, 0.5 * first);
        white += (at(t, e)? + at(t, 1.0 - e)? + at(e, t)? + at(1.0 - e, t)?) / 32.0;
    }
    let on_frame = |i: usize| {
        let (row, column) = (i / side, i % side);
        row == 0 || column == 0 || row + 1 == side || column + 1 == side
    };
    let frame: Vec<f32> = (0..side * side).filter(|&i| on_frame(i)).map(|i| values[i]).collect();
    let black = frame.iter().sum::<f32>() / frame.len() as f32;
    let level = 0.5 * (white + black);
    let lit = frame.iter().filter(|&&v| v > level).count();
    if white - black < 0.02 || lit > 1 {
        return None;
    }
    let bits =
        (0..side * side).filter(|&i| !on_frame(i)).fold(0u64, |bits, i| (bits << 1) | u64::from(values[i] > level));
    board.dictionary.read(bits, board.markers())
}

/// The homography from the unit square, corners clockwise from the origin, to four points (P. Heckbert, "Fundamentals of texture mapping and image warping", 1989).
fn square_to_picture([a, b, c, d]: [Point2<f64>; 4]) -> Option<Matrix3<f64>> {
    let (s, d1, d2) = ((a - b) + (c - d), b - c, d - c);
    let det = d1.perp(&d2);
    let (g, h) = (s.perp(&d2) / det, d1.perp(&s) / det);
    let (ab, ad) = (b - a + b.coords * g, d - a + d.coords * h);
    let map = Matrix3::new(ab.x, ad.x, a.x, ab.y, ad.y, a.y, g, h, 1.0);
    map.iter().all(|v| v.is_finite()).then_some(map)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::targets::Dictionary;
    use cv_core::{GrayF32, Silent};

    /// A picture of a board through a homography from board to picture, four samples to a pixel each way.
    fn picture(board: &CharucoBoard, map: &Matrix3<f64>, (w, h): (usize, usize)) -> GrayF32 {
        let back = map.try_inverse().unwrap();
        GrayF32::from_fn(w, h, |x, y| {
            let mut sum = 0.0;
            for k in 0..16 {
                let at =
                    Vector3::new(x as f64 + (k % 4) as f64 / 4.0 - 0.375, y as f64 + (k / 4) as f64 / 4.0 - 0.375, 1.0);
                let p = back * at;
                sum += if board.is_black(p.x / p.z, p.y / p.z) { 0.1 } else { 0.8 };
            }
            [sum / 16.0]
        })
    }

    #[test]
    fn parts_of_boards_are_found_with_their_numbers() {
        for (dictionary, k) in
            [(Dictionary::Aruco4x4x50, 0), (Dictionary::Aruco6x6x250, 1), (Dictionary::AprilTag36h11, 2)]
        {
            let board = CharucoBoard { squares: (8, 6), square: 30.0, marker: 22.0, dictionary };
            // Turned, tilted, and partly outside.
            let (sin, cos) = (0.4 + 1.7 * k as f64).sin_cos();
            let map = Matrix3::new(1.9 * cos, -1.8 * sin, 0.0, 1.9 * sin, 1.8 * cos, 0.0, 4e-4, -5e-4, 1.0);
            let middle = map * Vector3::new(110.0, 80.0, 1.0);
            let (dx, dy) = (160.0 - middle.x / middle.z, 130.0 - middle.y / middle.z);
            let map = Matrix3::new(1.0, 0.0, dx, 0.0, 1.0, dy, 0.0, 0.0, 1.0) * map;
            let image = picture(&board, &map, (360, 300));
            let found = find_charuco(image.view(), &board, &ChessboardOptions::default(), &Silent).unwrap();
            let place = |id: usize| {
                let p = board.point(id);
                let q = map * Vector3::new(p.x, p.y, 1.0);
                Point2::new(q.x / q.z, q.y / q.z)
            };
            let inside = |p: Point2<f64>| p.x > 8.0 && p.y > 8.0 && p.x < 352.0 && p.y < 292.0;
            let visible = (0..board.corners().corners()).filter(|&id| inside(place(id))).count();
            assert!(visible < 35 && found.len() + 4 >= visible, "{dictionary}: {} of {visible}", found.len());
            for point in &found {
                // Edges without any blur in a window of five pixels; the mean is at a twentieth.
                let off = (point.position - place(point.id)).norm();
                assert!(off < 0.3, "{dictionary} {}: {off}", point.id);
            }
            // No marker of another dictionary is there.
            let other = CharucoBoard { dictionary: Dictionary::Aruco5x5x50, ..board };
            assert!(find_charuco(image.view(), &other, &ChessboardOptions::default(), &Silent).is_err());
        }
    }
}
