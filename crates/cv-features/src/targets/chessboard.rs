//! Chessboards in photographs.

use super::board::{BoardPoint, BoardSize};
use super::board_error::BoardError;
use super::grid::{Grid, grids};
use super::saddle::saddle;
use super::x_corner::x_corners;
use crate::error::check_image;
use cv_core::{ImageView, OptionError, Point2, Progress, Stage};
use rayon::prelude::*;

/// Half-width of the window for a corner's position, in distances to its nearest neighbor: away from the neighbor's own edges, which do not go through the corner.
const WINDOW: f64 = 0.3;

/// Settings of [`find_chessboard`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct ChessboardOptions {
    /// Least difference between black and white beside a corner, as a share of full scale. 0 to 1; default 0.03, about eight of 255 levels, below which
    /// noise and compression draw corners of their own.
    pub least_contrast: f32,
    /// Largest half-width of the window that a corner's position is fitted in, in pixels. The window never reaches beyond
    /// the squares that meet at the corner. 2 to 50; default 10: on photographs the residuals of a calibration fall up to there, as noise averages out, and no further.
    pub largest_window: f32,
}

impl Default for ChessboardOptions {
    fn default() -> Self {
        Self { least_contrast: 0.03, largest_window: 10.0 }
    }
}

impl ChessboardOptions {
    pub(super) fn check(&self) -> Result<(), OptionError> {
        OptionError::check("least_contrast", self.least_contrast.into(), "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
        OptionError::check("largest_window", self.largest_window.into(), "from 2 to 50 px", |v| {
            (2.0..=50.0).contains(&v)
        })
    }
}

/// A chessboard found in a picture: all its inner corners.
///
/// The order is that of the board and not of the picture. Corners are row-major; rows follow each other clockwise on screen from the direction of a row,
/// so the order is never that of a mirrored board. The first corner is one that meets a **black corner square** of the board:
///
/// * Where `columns + rows` is odd (9×6) this names one corner of the board, the same in every picture from whatever side.
/// * Where it is even ([`BoardSize::is_symmetric`]) two ends qualify, or none. Then the row direction is the one that points right in the picture (down, where it is
///   vertical). Boards with as many rows as columns have four such orders; of these the first row is the one closest to horizontal.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Chessboard {
    /// Inner corners.
    pub size: BoardSize,
    /// Positions in pixels, row-major, `size.corners()` of them.
    pub corners: Vec<Point2<f64>>,
    /// For each corner the standard deviation of its position along either axis, in pixels; see [`BoardPoint::deviation`].
    pub deviations: Vec<f64>,
}

impl Chessboard {
    /// The corners as points of a board; the id of a corner is its index.
    pub fn points(&self) -> Vec<BoardPoint> {
        let each = self.corners.iter().zip(&self.deviations).enumerate();
        each.map(|(id, (&position, &deviation))| BoardPoint { id, position, deviation }).collect()
    }
}

/// Finds the chessboard of `size` inner corners, or with `None` the largest one of any size.
///
/// `view` is gray, 0 to 1. Where no size is asked for, what the picture shows of a board that is cut off counts as a board: over several pictures the size that most of them show is the right one.
/// A board of 9×6 is found as one of 6×9 too if that is asked for: its rows are then its columns.
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
    let (corners, smooth) = x_corners(view, options.least_contrast, progress)?;
    let stage = Stage::new(progress, "grid", 0)?;
    let none = BoardError::NoBoard { corners: corners.len() };
    let mut boards = Vec::new();
    // What to say where there is none: of the largest grid.
    let mut refusal: Option<(usize, BoardError)> = None;
    for mut grid in grids(&corners, smooth.view(), BoardSize::LEAST * 2, WINDOW, &stage)? {
        // A board that lacks more than half its corners is not completed, only told of.
        if size.is_none_or(|asked| 2 * grid.nodes.len() >= asked.corners()) {
            complete(&mut grid, smooth.view(), size, &stage)?;
        } else if refusal.is_some() {
            continue;
        }
        let seen = whole_part(&grid);
        let Some(part) = seen.filter(|part| part.size().is_valid()) else { continue };
        let whole = part.size().corners() == grid.nodes.len();
        let fits = |asked: BoardSize| [asked, asked.transposed()].contains(&part.size());
        match size {
            Some(asked) if fits(asked) && whole => boards.extend(ordered(&grid, part, asked)),
            None if whole && boards.is_empty() => boards.extend(ordered(&grid, part, part.size().landscape())),
            _ => {
                let found = grid.nodes.len();
                if refusal.is_none_or(|r| r.0 < found) {
                    refusal = Some((found, refused(&grid, part, size, view.size())));
                }
            }
        }
    }
    if boards.len() > 1 {
        return Err(BoardError::SeveralBoards { boards: boards.len() });
    }
    let Some((size, places)) = boards.pop() else { return Err(refusal.map_or(none, |r| r.1)) };
    stage.check()?;
    located(smooth.view(), size, &places, options.largest_window).ok_or(none)
}

/// A corner before its last refinement, and the distance to its nearest neighbor.
type Place = (Point2<f64>, f64);

/// A place of a grid, or a step from one to the next.
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

/// Looks up the corners that a grid lacks, and drops what sticks out of it: columns and rows at its rim that are not all there, where the board is then still as
/// large as asked, or (of any size) of which a quarter is missing. The frame of a board, its clips and what is behind it look like corners here and there.
fn complete(
    grid: &mut Grid,
    view: ImageView<'_, f32, 1>,
    size: Option<BoardSize>,
    stage: &Stage<'_>,
) -> Result<(), BoardError> {
    grid.settle(view);
    let [x0, x1, y0, y1] = grid.bounds();
    if x1 < x0 {
        return Ok(());
    }
    let side = size.map_or(0, |s| s.columns.max(s.rows)) as i32;
    // In any direction as far as the asked board can reach.
    let (across, down) = ((side - (x1 - x0 + 1)).max(1), (side - (y1 - y0 + 1)).max(1));
    grid.fill(view, [x0 - across, x1 + across, y0 - down, y1 + down], stage)?;
    while !grid.nodes.is_empty() {
        let [x0, x1, y0, y1] = grid.bounds();
        let seen = Part([x0, x1, y0, y1]).size();
        let on = |p: &(i32, i32), column: bool, at: i32| if column { p.0 == at } else { p.1 == at };
        let rims = [(true, x0, seen.rows), (true, x1, seen.rows), (false, y0, seen.columns), (false, y1, seen.columns)];
        let share = |&(column, at, length): &(bool, i32, usize)| {
            grid.nodes.keys().filter(|p| on(p, column, at)).count() as f64 / length.max(1) as f64
        };
        let Some(&(column, at, length)) = rims.iter().min_by(|a, b| share(a).total_cmp(&share(b))) else {
            return Ok(());
        };
        let left = share(&(column, at, length));
        let needless = size.is_some_and(|asked| {
            let less = if column {
                BoardSize::new(seen.columns - 1, seen.rows)
            } else {
                BoardSize::new(seen.columns, seen.rows - 1)
            };
            let holds = |a: BoardSize| less.columns >= a.columns && less.rows >= a.rows;
            holds(asked) || holds(asked.transposed())
        });
        if left < 0.5 || (left < 1.0 && needless) || (left < 0.75 && size.is_none()) {
            grid.nodes.retain(|p, _| !on(p, column, at));
        } else {
            break;
        }
    }
    Ok(())
}

/// The largest rectangle of a grid without a gap. Time: cells of its bounds times its columns.
fn whole_part(grid: &Grid) -> Option<Part> {
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

/// Why a grid is not the board that was asked for.
fn refused(grid: &Grid, part: Part, size: Option<BoardSize>, (w, h): (usize, usize)) -> BoardError {
    let [x0, x1, y0, y1] = grid.bounds();
    let seen = BoardSize::new((x1 - x0 + 1) as usize, (y1 - y0 + 1) as usize).landscape();
    let asked = size.unwrap_or(seen);
    let whole = part.size().corners() == grid.nodes.len();
    let cut_off = grid.nodes.keys().any(|&(x, y)| {
        [(x == x0, -1, 0), (x == x1, 1, 0), (y == y0, 0, -1), (y == y1, 0, 1)].iter().any(|&(rim, dx, dy)| {
            let ends = (grid.position((x, y)), grid.position((x - dx, y - dy)));
            let (true, (Some(p), Some(q))) = (rim, ends) else { return false };
            let next = p + (p - q) * 1.2;
            !(next.x > 0.0 && next.y > 0.0 && next.x < w as f64 - 1.0 && next.y < h as f64 - 1.0)
        })
    });
    let fits = |a: BoardSize| seen.columns <= a.columns && seen.rows <= a.rows;
    if (fits(asked) || fits(asked.transposed())) && (!whole || cut_off) {
        let found = grid.nodes.len();
        BoardError::Partial { found, seen: part.size().landscape(), asked, cut_off }
    } else {
        BoardError::OtherSize { seen, asked }
    }
}

/// The corners of a part of a grid in the order of a [`Chessboard`] of `size`, with the distance to the nearest neighbor of each.
fn ordered(grid: &Grid, part: Part, size: BoardSize) -> Option<(BoardSize, Vec<Place>)> {
    let Part([x0, x1, y0, y1]) = part;
    // Quarter turns of the board against the grid: where the first corner lies, and how columns and rows go from there.
    let turns: [[Cell; 3]; 4] = [
        [(x0, y0), (1, 0), (0, 1)],
        [(x1, y0), (0, 1), (-1, 0)],
        [(x1, y1), (-1, 0), (0, -1)],
        [(x0, y1), (0, -1), (1, 0)],
    ];
    let mut best: Option<((bool, f64), [Cell; 3])> = None;
    for (k, &[first, column, row]) in turns.iter().enumerate() {
        let turned = if k & 1 == 0 { part.size() } else { part.size().transposed() };
        if turned != size {
            continue;
        }
        let node = grid.nodes.get(&first)?;
        // White lies between the first and the second edge of a corner; so the square before the first corner is black after an odd number of turns.
        let black = (node.turns + k) & 1 == 1;
        let last = (first.0 + column.0 * (size.columns as i32 - 1), first.1 + column.1 * (size.columns as i32 - 1));
        let along = grid.position(last)? - node.corner.position;
        // Rows that point straight down and straight up are told apart too.
        let to_right = along.x / along.norm() + 1e-6 * along.y / along.norm();
        if best.is_none_or(|b| (black, to_right) > b.0) {
            best = Some(((black, to_right), [first, column, row]));
        }
    }
    let [first, column, row] = best?.1;
    let place = |c: i32, r: i32| (first.0 + c * column.0 + r * row.0, first.1 + c * column.1 + r * row.1);
    let mut places = Vec::with_capacity(size.corners());
    for r in 0..size.rows as i32 {
        for c in 0..size.columns as i32 {
            let p = grid.position(place(c, r))?;
            let near = [(c - 1, r), (c + 1, r), (c, r - 1), (c, r + 1)];
            let near = near.iter().filter_map(|&(c, r)| grid.position(place(c, r)));
            places.push((p, near.fold(f64::INFINITY, |least, q| least.min((q - p).norm()))));
        }
    }
    Some((size, places))
}

/// The board with every corner where the picture has it to a fraction of a pixel.
fn located(view: ImageView<'_, f32, 1>, size: BoardSize, places: &[Place], largest_window: f32) -> Option<Chessboard> {
    let found: Option<Vec<_>> = places
        .par_iter()
        .with_min_len(16)
        .map(|&(start, spacing)| {
            let window = (WINDOW * spacing).min(largest_window.into()).max(2.0);
            let found = saddle(view, start, window, 2e-4)?;
            // The start is exact to a tenth of a pixel where a corner is a corner.
            let stays = (found.position - start).norm() < (0.1 * spacing).max(1.0);
            stays.then_some((found.position, found.deviation_unsmoothed()))
        })
        .collect();
    let (corners, deviations) = found?.into_iter().unzip();
    Some(Chessboard { size, corners, deviations })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::FeatureError;
    use cv_core::{Cancelled, GrayF32, Silent};
    use cv_imgproc::{gray_to_f32, rgb_to_gray};
    use cv_synth::{ChessboardPhoto, ChessboardTrial, chessboard_photo, photo_without_board};

    const SIZE: BoardSize = BoardSize { columns: 9, rows: 6 };

    fn photo(trial: ChessboardTrial, seed: u64) -> (GrayF32, ChessboardPhoto) {
        let photo = chessboard_photo((9, 6), trial, seed).unwrap();
        (gray_to_f32(rgb_to_gray(photo.image.view()).view()), photo)
    }

    fn find(gray: &GrayF32, size: Option<BoardSize>) -> Result<Chessboard, BoardError> {
        find_chessboard(gray.view(), size, &ChessboardOptions::default(), &Silent)
    }

    /// Distances of the corners to the truth, in the order of the board, sorted.
    fn errors(board: &Chessboard, photo: &ChessboardPhoto) -> Vec<f64> {
        let mut errors: Vec<f64> =
            board.corners.iter().zip(&photo.corners).map(|(c, t)| (c - t.unwrap()).norm()).collect();
        errors.sort_by(f64::total_cmp);
        errors
    }

    #[test]
    fn whole_boards_are_found_where_they_are() {
        use ChessboardTrial as T;
        // Medians over fourteen pictures of each kind lie at 0.013, 0.018, 0.056, 0.020, 0.038 and 0.014 px. One picture may be at some three times that: blur,
        // noise and glare are drawn for each, and under a wide lens edges bend within the window.
        for (trial, median) in
            [(T::Clean, 0.045), (T::Blur, 0.045), (T::Noise, 0.14), (T::Tilt, 0.06), (T::Glare, 0.1), (T::Wide, 0.07)]
        {
            let (gray, photo) = photo(trial, 100);
            let board = find(&gray, Some(SIZE)).unwrap_or_else(|e| panic!("{trial:?}: {e}"));
            let errors = errors(&board, &photo);
            // The same corner first, from whatever side: anything else is a square off.
            assert!(errors[27] < median && errors[53] < 1.0, "{trial:?}: {} {}", errors[27], errors[53]);
            assert!(board.deviations.iter().all(|d| (0.018..0.5).contains(d)), "{trial:?}");
        }
    }

    #[test]
    fn a_picture_says_what_it_has() {
        let (gray, photo) = photo(ChessboardTrial::Clean, 7);
        let board = find(&gray, None).unwrap();
        assert_eq!(board, find(&gray, Some(SIZE)).unwrap());
        assert!(errors(&board, &photo)[53] < 0.5);
        assert_eq!(board.points()[10].id, 10);
        // The same board by its columns: a quarter turn on, beginning at a black corner as well.
        let turned = find(&gray, Some(SIZE.transposed())).unwrap();
        let last_column: Vec<_> = (0..6).map(|r| board.corners[9 * r]).rev().collect();
        let first_row = turned.corners[..6].to_vec();
        assert!(first_row == last_column || first_row.iter().eq((0..6).map(|r| &board.corners[9 * r + 8])));
        let asked = BoardSize::new(7, 5);
        assert_eq!(find(&gray, Some(asked)), Err(BoardError::OtherSize { seen: SIZE, asked }));
        assert_eq!(find(&gray, Some(asked)).unwrap_err().to_string(), "saw a board of 9×6, not 7×5 inner corners");
        let asked = BoardSize::new(2, 5);
        assert_eq!(find(&gray, Some(asked)), Err(BoardError::Size { asked }));
        // Half a turn of the picture leaves the order on the board as it is.
        let (w, h) = gray.size();
        let upside_down = GrayF32::from_fn(w, h, |x, y| gray.at(w - 1 - x, h - 1 - y));
        for (a, b) in find(&upside_down, Some(SIZE)).unwrap().corners.iter().zip(&board.corners) {
            let turned = Point2::new(w as f64 - 1.0 - b.x, h as f64 - 1.0 - b.y);
            assert!((a - turned).norm() < 0.01, "{a} {turned}");
        }
    }

    #[test]
    fn a_board_that_is_cut_off_is_told_of() {
        for seed in [3, 5] {
            let (gray, photo) = photo(ChessboardTrial::Cut, seed);
            let visible = photo.corners.iter().flatten().count();
            match find(&gray, Some(SIZE)) {
                Err(BoardError::Partial { found, cut_off, .. }) => {
                    assert!(cut_off && found <= visible && 2 * found > visible, "{seed}: {found} of {visible}");
                }
                other => panic!("{seed}: {other:?}, {visible} corners visible"),
            }
        }
    }

    #[test]
    fn two_boards_in_one_picture_are_told_of() {
        // 10 by 7 squares of 20 px, twice, 40 px of white between them and around.
        let image = GrayF32::from_fn(560, 220, |x, y| {
            let (i, j) = ((x as i64 % 260 - 40).div_euclid(20), (y as i64 - 40).div_euclid(20));
            let black = (0..10).contains(&i) && (0..7).contains(&j) && (i + j) % 2 == 0 && x < 510;
            [if black { 0.1 } else { 0.9 }]
        });
        assert_eq!(find(&image, Some(SIZE)), Err(BoardError::SeveralBoards { boards: 2 }));
        assert_eq!(find(&image, None).map(|board| board.size), Ok(SIZE));
    }

    #[test]
    fn nothing_is_found_where_nothing_is() {
        for seed in 0..4 {
            let gray = gray_to_f32(rgb_to_gray(photo_without_board(seed).unwrap().view()).view());
            for size in [Some(SIZE), None] {
                assert!(find(&gray, size).is_err(), "{seed}");
            }
        }
    }

    #[test]
    fn any_input_gets_an_answer() {
        for (w, h) in [(0, 0), (1, 1), (15, 400), (16, 16), (60, 17)] {
            assert!(find(&GrayF32::new(w, h, [0.5]), Some(SIZE)).is_err());
        }
        let mut image = GrayF32::new(40, 40, [0.5]);
        image.set(3, 4, [f32::NAN]);
        assert_eq!(find(&image, None), Err(FeatureError::NotFinite { x: 3, y: 4 }.into()));
        // Tens of thousands of corners, a board without an end, and values far beyond 0 to 1.
        for (period, scale) in [(4, 1.0), (9, 1.0), (24, 1e30)] {
            let image = GrayF32::from_fn(500, 400, |x, y| [((x / period + y / period) % 2) as f32 * scale]);
            assert!(find(&image, Some(SIZE)).is_err(), "{period}");
        }
        let options = ChessboardOptions { largest_window: 1.0, ..ChessboardOptions::default() };
        let refused = find_chessboard(image.view(), None, &options, &Silent);
        assert!(matches!(refused, Err(BoardError::Feature(FeatureError::Option(_)))));
        struct Stop;
        impl Progress for Stop {
            fn report(&self, _: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
                Err(Cancelled)
            }
        }
        let stopped = find_chessboard(GrayF32::new(64, 64, [0.5]).view(), None, &ChessboardOptions::default(), &Stop);
        assert_eq!(stopped, Err(Cancelled.into()));
    }

    #[test]
    fn threads_change_nothing() {
        let (gray, _) = photo(ChessboardTrial::Noise, 4);
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| find(&gray, Some(SIZE)))
        };
        assert_eq!(with(1), with(3));
    }
}
