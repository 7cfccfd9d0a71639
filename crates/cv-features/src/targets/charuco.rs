//! ChArUco boards: chessboards with a marker in every white square, so that a part of one is enough.
//!
//! The chessboard's corners are found and joined first, as those of a plain board are. Then the markers are read, which needs no search: each white square with its
//! four corners says where its marker's bits lie. Every marker that is read votes for where the grid lies on the board.

use super::BoardError;
use super::board::{BoardPoint, CharucoBoard};
use super::chessboard::ChessboardOptions;
use super::grid::{Grid, grids};
use super::marker::{MarkerShape, read_bits, square_to_picture, what_else};
use super::saddle::saddle;
use super::x_corner::x_corners;
use crate::error::check_image;
use cv_core::{ImageView, Matrix3, Point2, Progress, Stage};
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
/// [`BoardError`]; where no marker of the board can be read, it says what was seen in their place.
pub fn find_charuco(
    view: ImageView<'_, f32, 1>,
    board: &CharucoBoard,
    options: &ChessboardOptions,
    progress: &dyn Progress,
) -> Result<Vec<BoardPoint>, BoardError> {
    options.check()?;
    board.check()?;
    check_image(view, 16)?;
    let (corners, smooth) = x_corners(view, options.least_contrast, progress)?;
    let stage = Stage::new(progress, "grid", 0)?;
    // White around a marker, in squares.
    let clear = 0.45 * (1.0 - board.marker / board.square);
    let mut boards: Vec<Vec<BoardPoint>> = Vec::new();
    // White squares of the largest grid that could not be placed.
    let mut unread: Option<Vec<[Point2<f64>; 4]>> = None;
    for mut grid in grids(&corners, smooth.view(), 4, clear, &stage)? {
        // A part of a board that is smaller than half of what is found already tells nothing new.
        if boards.first().is_some_and(|best| 2 * grid.nodes.len() < best.len()) {
            break;
        }
        grid.settle(smooth.view());
        let [x0, x1, y0, y1] = grid.bounds();
        grid.fill(smooth.view(), [x0 - 2, x1 + 2, y0 - 2, y1 + 2], &stage)?;
        let whites = white_squares(&grid);
        let Some(placement) = placed(&whites, view, board) else {
            unread.get_or_insert_with(|| whites.into_iter().map(|white| white.1).collect());
            continue;
        };
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
        points.sort_by_key(|p| p.id);
        if points.len() >= 4 {
            boards.push(points);
        }
    }
    boards.sort_by_key(|points| std::cmp::Reverse(points.len()));
    let Some(best) = boards.first() else {
        let none = BoardError::NoBoard { corners: corners.len() };
        let Some(whites) = unread else { return Err(none) };
        let read = |i: usize, side: usize| read_in_square(view, whites[i], board.marker / board.square, side);
        let seen = BoardError::NoMarkers { dictionary: board.dictionary, seen: whites.len() };
        return Err(what_else(whites.len().min(60), board.dictionary, read).unwrap_or(seen));
    };
    // Parts of one board, which something lies across, have different corners, or the same ones in the same places.
    let elsewhere = |p: &BoardPoint| {
        let known = best.binary_search_by_key(&p.id, |q| q.id).ok().map(|i| best[i].position);
        known.is_some_and(|q| (q - p.position).norm() > 3.0)
    };
    let again = |points: &&Vec<BoardPoint>| points.iter().filter(|p| elsewhere(p)).count() >= 4;
    let several = boards.iter().filter(again).count();
    if several > 0 {
        return Err(BoardError::SeveralBoards { boards: 1 + several });
    }
    Ok(boards.swap_remove(0))
}

/// A white square of a grid: the place of its first corner, and all four, clockwise from it.
type White = ((i32, i32), [Point2<f64>; 4]);

fn white_squares(grid: &Grid) -> Vec<White> {
    let square = |(&(x, y), node): (&(i32, i32), &super::grid::Node)| {
        // Even: the square to the right and below is white.
        let corner = |dx: i32, dy: i32| grid.position((x + dx, y + dy)).filter(|_| node.turns & 1 == 0);
        Some(((x, y), [corner(0, 0)?, corner(1, 0)?, corner(1, 1)?, corner(0, 1)?]))
    };
    let mut all: Vec<_> = grid.nodes.iter().filter_map(square).collect();
    all.sort_by_key(|white| white.0);
    all
}

/// Where a grid lies on the board by its markers: where at least two of them, and more than half of those that can be read, agree.
fn placed(whites: &[White], view: ImageView<'_, f32, 1>, board: &CharucoBoard) -> Option<Placement> {
    let mut votes: BTreeMap<Placement, usize> = BTreeMap::new();
    let mut read = 0;
    for &((x, y), corners) in whites {
        let bits = read_in_square(view, corners, board.marker / board.square, board.dictionary.side());
        let Some((id, turns)) = bits.and_then(|bits| board.dictionary.read(bits, board.markers())) else { continue };
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

/// The bits of a marker in the middle of a white square with these corners; it is `share` of the square wide.
fn read_in_square(view: ImageView<'_, f32, 1>, corners: [Point2<f64>; 4], share: f64, side: usize) -> Option<u64> {
    let first = 0.5 * (1.0 - share);
    let within = Matrix3::new(share, 0.0, first, 0.0, share, first, 0.0, 0.0, 1.0);
    let map = square_to_picture(corners)? * within;
    read_bits(view, &map, MarkerShape { side, frame: 1, rim: 0.5 * first / share })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::targets::Dictionary;
    use cv_core::{GrayF32, Silent, Vector3};

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
            let two = GrayF32::from_fn(720, 300, |x, y| image.at(x % 360, y));
            assert_eq!(
                find_charuco(two.view(), &board, &ChessboardOptions::default(), &Silent),
                Err(BoardError::SeveralBoards { boards: 2 })
            );
            // No marker of another dictionary is there.
            let other = CharucoBoard { dictionary: Dictionary::Aruco5x5x50, ..board };
            let find =
                |image: &GrayF32, board| find_charuco(image.view(), board, &ChessboardOptions::default(), &Silent);
            assert!(matches!(
                find(&image, &other),
                Err(BoardError::OtherDictionary { markers: 5.., asked: Dictionary::Aruco5x5x50, .. })
            ));
            let mirrored = GrayF32::from_fn(360, 300, |x, y| image.at(359 - x, y));
            assert!(matches!(find(&mirrored, &board), Err(BoardError::Mirrored { markers: 5.., .. })));
        }
    }
}
