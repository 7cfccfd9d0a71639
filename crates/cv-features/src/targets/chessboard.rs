//! Detection of chessboards.

use super::board::{BoardPoint, BoardSize};
use super::board_error::BoardError;
use super::grid::{Grid, Node, SAME_CORNER, assemble_grids};
use super::saddle::refine_saddle;
use super::x_corner::detect_x_corners;
use crate::error::check_image;
use cv_core::{ImageView, OptionError, Point2, Progress, Stage};
use cv_parallel::prelude::*;

/// Window radius of the corner refinement relative to the distance to the nearest neighbor: small enough to exclude the
/// neighbor's edges.
const WINDOW_RATIO: f64 = 0.3;

/// Minimum extent in the image of another board, relative to that of the largest. A smaller one is its picture on the screen
/// of the computer that records the photographs.
const MIN_RELATIVE_EXTENT: f64 = 1.0 / 3.0;

/// Options of the board detectors.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct ChessboardOptions {
    /// Minimum contrast between black and white at a corner, relative to full scale, 0 to 1. Default 0.03, about eight
    /// of 255 gray levels, below which noise and compression artifacts cause false corners.
    #[cfg_attr(feature = "serde", serde(rename = "least_contrast"))]
    pub min_contrast: f32,
    /// Maximum window radius of the corner refinement in pixels; the window never extends beyond the squares at the
    /// corner. 2 to 50; default 10: calibration residuals on photographs decrease up to there.
    #[cfg_attr(feature = "serde", serde(rename = "largest_window"))]
    pub max_window_radius: f32,
}

impl Default for ChessboardOptions {
    fn default() -> Self {
        Self { min_contrast: 0.03, max_window_radius: 10.0 }
    }
}

impl ChessboardOptions {
    pub(super) fn check(&self) -> Result<(), OptionError> {
        OptionError::check("least_contrast", self.min_contrast.into(), "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
        OptionError::check("largest_window", self.max_window_radius.into(), "from 2 to 50 px", |v| {
            (2.0..=50.0).contains(&v)
        })
    }
}

/// A detected chessboard with all its inner corners.
///
/// The order is that of the board, not of the image. Corners are row-major; rows follow each other clockwise in the
/// image from the row direction, so the order is never mirrored. The first corner is adjacent to a **black corner
/// square** of the board:
///
/// * If `columns + rows` is odd (9×6), this corner is unique, and the same in every image.
/// * If it is even ([`BoardSize::is_symmetric`]), two corners qualify, or none. Then the row direction is the one that
///   points right in the image (down, if it is vertical). Square boards have four such orders; the first row is the one
///   closest to horizontal.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Chessboard {
    /// Numbers of inner corners.
    pub size: BoardSize,
    /// Positions in pixels, row-major, `size.corners()` of them.
    pub corners: Vec<Point2<f64>>,
    /// Standard deviation of the position of each corner along either axis, in pixels; see [`BoardPoint::deviation`].
    pub deviations: Vec<f64>,
}

impl Chessboard {
    /// Returns the corners as board points; the id of a corner is its index.
    pub fn points(&self) -> Vec<BoardPoint> {
        let each = self.corners.iter().zip(&self.deviations).enumerate();
        each.map(|(id, (&position, &deviation))| BoardPoint { id, position, deviation }).collect()
    }
}

/// Detects the chessboard of `size` inner corners, or with `None` the largest one of any size.
///
/// `view` is gray, 0 to 1. Without a size, the visible part of a truncated board counts as a board: use the most
/// frequent size of several images. A second board of less than a third of the first one's extent is ignored. A board of
/// 9×6 is also detected as 6×9, with rows and columns exchanged.
///
/// # Errors
/// [`BoardError`].
pub fn find_chessboard(
    view: ImageView<'_, f32, 1>,
    size: Option<BoardSize>,
    options: &ChessboardOptions,
    progress: &dyn Progress,
) -> Result<Chessboard, BoardError> {
    options.check()?;
    if let Some(asked) = size.filter(|size| !size.is_valid()) {
        return Err(BoardError::Size { asked });
    }
    check_image(view, 16)?;
    let (corners, smooth) = detect_x_corners(view, options.min_contrast, progress)?;
    let stage = Stage::new(progress, "grid", 0)?;
    let mut boards = Vec::new();
    // The reason of the rejection of the largest grid.
    let mut rejection: Option<(usize, BoardError)> = None;
    for mut grid in assemble_grids(&corners, smooth.view(), BoardSize::MIN_SIDE * 2, WINDOW_RATIO, &stage)? {
        // Grids with less than half of the corners are not completed, only reported.
        if size.is_none_or(|asked| 2 * grid.nodes.len() >= asked.corners()) {
            complete_grid(&mut grid, smooth.view(), size, &stage)?;
        } else if rejection.is_some() {
            continue;
        }
        // Parts of one board grow to the same one.
        let is_near = |node: &Node| {
            let position = node.corner.position;
            boards.iter().flat_map(|board: &Chessboard| &board.corners).any(|c| (c - position).norm() < SAME_CORNER)
        };
        if grid.nodes.values().any(is_near) {
            continue;
        }
        let Some(mut part) = largest_full_rectangle(&grid) else { continue };
        let is_complete = part.size().corners() == grid.nodes.len();
        let board_size = match size {
            Some(asked) => Some(asked).filter(|a| [*a, a.transposed()].contains(&part.size())),
            None => Some(part.size().landscape()).filter(|size| size.is_valid() && boards.is_empty()),
        };
        let ordered = board_size.filter(|_| is_complete).and_then(|size| order_corners(&grid, part, size));
        if let Some((size, places)) = ordered {
            stage.check()?;
            match localize_corners(smooth.view(), size, &places, options.max_window_radius) {
                Ok(board) => {
                    boards.push(board);
                    continue;
                }
                Err(lost) => {
                    grid.nodes.retain(|_, node| !lost.contains(&node.corner.position));
                    let Some(left) = largest_full_rectangle(&grid) else { continue };
                    part = left;
                }
            }
        }
        let detected = grid.nodes.len();
        if part.size().is_valid() && rejection.is_none_or(|r| r.0 < detected) {
            rejection = Some((detected, rejection_reason(&grid, part, size, view.size())));
        }
    }
    let largest = boards.iter().map(extent).fold(0.0, f64::max);
    boards.retain(|board| extent(board) > MIN_RELATIVE_EXTENT * largest);
    if boards.len() > 1 {
        return Err(BoardError::SeveralBoards { boards: boards.len() });
    }
    boards.pop().ok_or_else(|| rejection.map_or(BoardError::NoBoard { corners: corners.len() }, |r| r.1))
}

/// Returns the diagonal of a board's bounding box in the image, in pixels.
fn extent(board: &Chessboard) -> f64 {
    let first = board.corners[0];
    let (low, high) = board.corners.iter().fold((first, first), |(low, high), c| (low.inf(c), high.sup(c)));
    (high - low).norm()
}

/// The position of a corner before the final refinement, and the distance to its nearest neighbor.
type Place = (Point2<f64>, f64);

/// Grid coordinates of a node, or a step between nodes.
type Cell = (i32, i32);

/// A rectangle of a grid: first and last column, first and last row.
#[derive(Debug, Clone, Copy)]
struct Part([i32; 4]);

impl Part {
    fn size(self) -> BoardSize {
        let Part([x0, x1, y0, y1]) = self;
        BoardSize::new((x1 - x0 + 1).max(0) as usize, (y1 - y0 + 1).max(0) as usize)
    }
}

/// Searches missing corners of a grid, and removes incomplete boundary columns and rows: if the grid is still large
/// enough for the requested size, or (without a size) if more than a quarter of their corners is missing. False corners
/// occur at the border of a board, its clips and in the background.
fn complete_grid(
    grid: &mut Grid,
    view: ImageView<'_, f32, 1>,
    size: Option<BoardSize>,
    stage: &Stage<'_>,
) -> Result<(), BoardError> {
    grid.refine(view);
    let [x0, x1, y0, y1] = grid.bounds();
    if x1 < x0 {
        return Ok(());
    }
    let side = size.map_or(0, |s| s.columns.max(s.rows)) as i32;
    // In every direction as far as the requested board may extend.
    let (across, down) = ((side - (x1 - x0 + 1)).max(1), (side - (y1 - y0 + 1)).max(1));
    grid.grow(view, [x0 - across, x1 + across, y0 - down, y1 + down], stage)?;
    while !grid.nodes.is_empty() {
        let [x0, x1, y0, y1] = grid.bounds();
        let seen = Part([x0, x1, y0, y1]).size();
        let on = |p: &(i32, i32), column: bool, at: i32| if column { p.0 == at } else { p.1 == at };
        let boundaries =
            [(true, x0, seen.rows), (true, x1, seen.rows), (false, y0, seen.columns), (false, y1, seen.columns)];
        let completeness = |&(column, at, length): &(bool, i32, usize)| {
            grid.nodes.keys().filter(|p| on(p, column, at)).count() as f64 / length.max(1) as f64
        };
        let Some(&(column, at, length)) = boundaries.iter().min_by(|a, b| completeness(a).total_cmp(&completeness(b)))
        else {
            return Ok(());
        };
        let present = completeness(&(column, at, length));
        let is_removable = size.is_some_and(|asked| {
            let reduced = if column {
                BoardSize::new(seen.columns - 1, seen.rows)
            } else {
                BoardSize::new(seen.columns, seen.rows - 1)
            };
            let is_large_enough = |a: BoardSize| reduced.columns >= a.columns && reduced.rows >= a.rows;
            is_large_enough(asked) || is_large_enough(asked.transposed())
        });
        if present < 0.5 || (present < 1.0 && is_removable) || (present < 0.75 && size.is_none()) {
            grid.nodes.retain(|p, _| !on(p, column, at));
        } else {
            break;
        }
    }
    Ok(())
}

/// Finds the largest rectangle of a grid without missing corners. O(cells × columns).
fn largest_full_rectangle(grid: &Grid) -> Option<Part> {
    let [x0, x1, y0, y1] = grid.bounds();
    if x1 < x0 || (i64::from(x1) - i64::from(x0) + 1) * (i64::from(y1) - i64::from(y0) + 1) > 1_000_000 {
        return None;
    }
    let mut heights = vec![0i32; (x1 - x0 + 1) as usize];
    let mut best: Option<(i32, Part)> = None;
    for y in y0..=y1 {
        for (i, height) in heights.iter_mut().enumerate() {
            *height = if grid.nodes.contains_key(&(x0 + i as i32, y)) { *height + 1 } else { 0 };
        }
        for i in 0..heights.len() {
            let mut low = i32::MAX;
            for (j, &height) in heights.iter().enumerate().skip(i) {
                low = low.min(height);
                if low == 0 {
                    break;
                }
                let area = low * (j - i + 1) as i32;
                if best.is_none_or(|b| b.0 < area) {
                    best = Some((area, Part([x0 + i as i32, x0 + j as i32, y - low + 1, y])));
                }
            }
        }
    }
    best.map(|b| b.1)
}

/// Determines why a grid is not the requested board.
fn rejection_reason(grid: &Grid, part: Part, size: Option<BoardSize>, (w, h): (usize, usize)) -> BoardError {
    let [x0, x1, y0, y1] = grid.bounds();
    let seen = BoardSize::new((x1 - x0 + 1) as usize, (y1 - y0 + 1) as usize).landscape();
    let asked = size.unwrap_or(seen);
    let is_complete = part.size().corners() == grid.nodes.len();
    let cut_off = grid.nodes.keys().any(|&(x, y)| {
        [(x == x0, -1, 0), (x == x1, 1, 0), (y == y0, 0, -1), (y == y1, 0, 1)].iter().any(|&(rim, dx, dy)| {
            let ends = (grid.position((x, y)), grid.position((x - dx, y - dy)));
            let (true, (Some(p), Some(q))) = (rim, ends) else { return false };
            let next = p + (p - q) * 1.2;
            !(next.x > 0.0 && next.y > 0.0 && next.x < w as f64 - 1.0 && next.y < h as f64 - 1.0)
        })
    });
    let is_part_of = |a: BoardSize| seen.columns <= a.columns && seen.rows <= a.rows;
    if (is_part_of(asked) || is_part_of(asked.transposed())) && (!is_complete || cut_off) {
        let found = grid.nodes.len();
        BoardError::Partial { found, seen: part.size().landscape(), asked, cut_off }
    } else {
        BoardError::OtherSize { seen, asked }
    }
}

/// Returns the corners of a rectangle of a grid in the order of a [`Chessboard`] of `size`, with the distance to the
/// nearest neighbor of each.
fn order_corners(grid: &Grid, part: Part, size: BoardSize) -> Option<(BoardSize, Vec<Place>)> {
    let Part([x0, x1, y0, y1]) = part;
    // Quarter turns of the board relative to the grid: first corner, and directions of columns and rows.
    let turns: [[Cell; 3]; 4] = [
        [(x0, y0), (1, 0), (0, 1)],
        [(x1, y0), (0, 1), (-1, 0)],
        [(x1, y1), (-1, 0), (0, -1)],
        [(x0, y1), (0, -1), (1, 0)],
    ];
    let mut best: Option<((bool, f64), [Cell; 3])> = None;
    for (k, &[first, column, row]) in turns.iter().enumerate() {
        let rotated_size = if k & 1 == 0 { part.size() } else { part.size().transposed() };
        if rotated_size != size {
            continue;
        }
        let node = grid.nodes.get(&first)?;
        // The sector between the first and the second edge of a corner is white, so the corner square is black after an
        // odd number of turns.
        let is_black = (node.turns + k) & 1 == 1;
        let last = (first.0 + column.0 * (size.columns as i32 - 1), first.1 + column.1 * (size.columns as i32 - 1));
        let along = grid.position(last)? - node.corner.position;
        // With a tie-break for vertical rows.
        let to_right = along.x / along.norm() + 1e-6 * along.y / along.norm();
        if best.is_none_or(|b| (is_black, to_right) > b.0) {
            best = Some(((is_black, to_right), [first, column, row]));
        }
    }
    let [first, column, row] = best?.1;
    let place = |c: i32, r: i32| (first.0 + c * column.0 + r * row.0, first.1 + c * column.1 + r * row.1);
    let mut places = Vec::with_capacity(size.corners());
    for r in 0..size.rows as i32 {
        for c in 0..size.columns as i32 {
            let p = grid.position(place(c, r))?;
            let neighbors = [(c - 1, r), (c + 1, r), (c, r - 1), (c, r + 1)];
            let neighbors = neighbors.iter().filter_map(|&(c, r)| grid.position(place(c, r)));
            places.push((p, neighbors.fold(f64::INFINITY, |nearest, q| nearest.min((q - p).norm()))));
        }
    }
    Some((size, places))
}

/// Refines all corners to sub-pixel accuracy.
///
/// # Errors
/// The positions of the corners at which it fails.
fn localize_corners(
    view: ImageView<'_, f32, 1>,
    size: BoardSize,
    places: &[Place],
    max_window_radius: f32,
) -> Result<Chessboard, Vec<Point2<f64>>> {
    let localized: Vec<Option<(Point2<f64>, f64)>> = places
        .par_iter()
        .with_min_len(16)
        .map(|&(start, spacing)| {
            let window = (WINDOW_RATIO * spacing).min(max_window_radius.into()).max(2.0);
            let saddle = refine_saddle(view, start, window, 2e-4)?;
            // The initial position of a valid corner is accurate to a tenth of a pixel.
            let is_near = (saddle.position - start).norm() < (0.1 * spacing).max(1.0);
            is_near.then_some((saddle.position, saddle.deviation_unsmoothed()))
        })
        .collect();
    let lost: Vec<Point2<f64>> =
        places.iter().zip(&localized).filter(|(_, found)| found.is_none()).map(|((start, _), _)| *start).collect();
    if !lost.is_empty() {
        return Err(lost);
    }
    let (corners, deviations) = localized.into_iter().flatten().unzip();
    Ok(Chessboard { size, corners, deviations })
}
