//! Detection of ChArUco boards: chessboards with a marker in every white square, which may be partly visible.
//!
//! The chessboard corners are detected and assembled to grids first, as for plain chessboards. Then the markers are
//! decoded without search: the four corners of each white square define the positions of its marker's bits. Each
//! decoded marker votes for the placement of the grid on the board.

use super::BoardError;
use super::board::{BoardPoint, CharucoBoard};
use super::chessboard::ChessboardOptions;
use super::grid::{Grid, SAME_CORNER, assemble_grids};
use super::marker::{MarkerShape, diagnose, sample_bits, unit_square_to_image};
use super::saddle::refine_saddle;
use super::x_corner::detect_x_corners;
use crate::error::check_image;
use cv_core::{ImageView, Matrix3, Point2, Progress, Stage};
use std::collections::BTreeMap;

/// The placement of a grid on a board: quarter turns, then a shift of columns and rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Placement {
    turns: usize,
    shift: (i32, i32),
}

/// Rotates grid coordinates by clockwise quarter turns.
fn rotate_quarter_turns((x, y): (i32, i32), turns: usize) -> (i32, i32) {
    (0..turns & 3).fold((x, y), |(x, y), _| (-y, x))
}

/// Detects the visible corners of a ChArUco board with their ids.
///
/// `view` is gray, 0 to 1. The points, at least four, are sorted by id, see [`CharucoBoard::point`].
///
/// # Errors
/// [`BoardError`]; if no marker of the board can be decoded, it reports other markers in the image.
pub fn find_charuco(
    view: ImageView<'_, f32, 1>,
    board: &CharucoBoard,
    options: &ChessboardOptions,
    progress: &dyn Progress,
) -> Result<Vec<BoardPoint>, BoardError> {
    options.check()?;
    board.check()?;
    check_image(view, 16)?;
    let (corners, smooth) = detect_x_corners(view, options.min_contrast, progress)?;
    let stage = Stage::new(progress, "grid", 0)?;
    // The white margin around a marker, in squares.
    let clearance = 0.45 * (1.0 - board.marker / board.square);
    let mut boards: Vec<Vec<BoardPoint>> = Vec::new();
    // White squares of the largest grid without placement.
    let mut undecoded: Option<Vec<[Point2<f64>; 4]>> = None;
    for mut grid in assemble_grids(&corners, smooth.view(), 4, clearance, &stage)? {
        // Grids smaller than half of the best one are ignored.
        if boards.first().is_some_and(|best| 2 * grid.nodes.len() < best.len()) {
            break;
        }
        grid.refine(smooth.view());
        let [x0, x1, y0, y1] = grid.bounds();
        grid.grow(smooth.view(), [x0 - 2, x1 + 2, y0 - 2, y1 + 2], &stage)?;
        let whites = white_squares(&grid);
        let Some(placement) = vote_for_placement(&whites, view, board) else {
            undecoded.get_or_insert_with(|| whites.into_iter().map(|white| white.1).collect());
            continue;
        };
        let size = board.corners();
        let mut points: Vec<BoardPoint> = Vec::new();
        for (&place, node) in &grid.nodes {
            let (x, y) = rotate_quarter_turns(place, placement.turns);
            let (x, y) = (x + placement.shift.0, y + placement.shift.1);
            if x < 0 || y < 0 || x >= size.columns as i32 || y >= size.rows as i32 {
                continue;
            }
            let step = grid.spacing(place);
            let window = (clearance * step).min(options.max_window_radius.into()).max(2.0);
            let start = node.corner.position;
            let Some(saddle) = refine_saddle(smooth.view(), start, window, 2e-4) else { continue };
            if (saddle.position - start).norm() < (0.1 * step).max(1.0) {
                let id = y as usize * size.columns + x as usize;
                points.push(BoardPoint { id, position: saddle.position, deviation: saddle.deviation_unsmoothed() });
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
        let Some(whites) = undecoded else { return Err(none) };
        let read = |i: usize, side: usize| sample_bits_in_square(view, whites[i], board.marker / board.square, side);
        let seen = BoardError::NoMarkers { dictionary: board.dictionary, seen: whites.len() };
        return Err(diagnose(whites.len().min(60), board.dictionary, read).unwrap_or(seen));
    };
    // Parts of one board separated by an occluder have different corners, or the same ones at the same positions.
    let is_elsewhere = |p: &BoardPoint| {
        let known = best.binary_search_by_key(&p.id, |q| q.id).ok().map(|i| best[i].position);
        known.is_some_and(|q| (q - p.position).norm() > SAME_CORNER)
    };
    let is_other_board = |points: &&Vec<BoardPoint>| points.iter().filter(|p| is_elsewhere(p)).count() >= 4;
    let several = boards.iter().filter(is_other_board).count();
    if several > 0 {
        return Err(BoardError::SeveralBoards { boards: 1 + several });
    }
    Ok(boards.swap_remove(0))
}

/// A white square of a grid: the grid coordinates of its first corner, and the image positions of all four, clockwise.
type WhiteSquare = ((i32, i32), [Point2<f64>; 4]);

/// Returns the white squares of a grid, sorted by position.
fn white_squares(grid: &Grid) -> Vec<WhiteSquare> {
    let square = |(&(x, y), node): (&(i32, i32), &super::grid::Node)| {
        // Even: the square between +x and +y is white.
        let corner = |dx: i32, dy: i32| grid.position((x + dx, y + dy)).filter(|_| node.turns & 1 == 0);
        Some(((x, y), [corner(0, 0)?, corner(1, 0)?, corner(1, 1)?, corner(0, 1)?]))
    };
    let mut all: Vec<_> = grid.nodes.iter().filter_map(square).collect();
    all.sort_by_key(|white| white.0);
    all
}

/// Determines the placement of a grid on the board by the votes of its decoded markers; `None` unless at least two
/// markers and more than half of all agree.
fn vote_for_placement(whites: &[WhiteSquare], view: ImageView<'_, f32, 1>, board: &CharucoBoard) -> Option<Placement> {
    let mut votes: BTreeMap<Placement, usize> = BTreeMap::new();
    let mut read = 0;
    for &((x, y), corners) in whites {
        let bits = sample_bits_in_square(view, corners, board.marker / board.square, board.dictionary.side());
        let Some((id, turns)) = bits.and_then(|bits| board.dictionary.decode(bits, board.markers())) else { continue };
        let Some((column, row)) = board.square_of(id) else { continue };
        read += 1;
        // The center of the square, in doubled coordinates, is rotated back by the marker's rotation. Square (column,
        // row) has the inner corner (column − 1, row − 1) at its top left.
        let back = (4 - turns) & 3;
        let center = rotate_quarter_turns((2 * x + 1, 2 * y + 1), back);
        let shift = (2 * column as i32 - 1 - center.0, 2 * row as i32 - 1 - center.1);
        *votes.entry(Placement { turns: back, shift: (shift.0 / 2, shift.1 / 2) }).or_default() += 1;
    }
    let (&placement, &agreed) = votes.iter().max_by_key(|v| *v.1)?;
    (agreed >= 2 && 2 * agreed > read).then_some(placement)
}

/// Samples the bits of a marker centered in a white square with the given corners; `ratio` is the side of the marker
/// relative to the square.
fn sample_bits_in_square(
    view: ImageView<'_, f32, 1>,
    corners: [Point2<f64>; 4],
    ratio: f64,
    side: usize,
) -> Option<u64> {
    let margin = 0.5 * (1.0 - ratio);
    let marker_to_square = Matrix3::new(ratio, 0.0, margin, 0.0, ratio, margin, 0.0, 0.0, 1.0);
    let map = unit_square_to_image(corners)? * marker_to_square;
    sample_bits(view, &map, MarkerShape { side, border: 1, margin: 0.5 * margin / ratio })
}
