//! The common interface of all board kinds: points, printed rectangles, and detection.

use super::board::{BoardPoint, BoardSize, CharucoBoard};
use super::board_error::BoardError;
use super::chessboard::{ChessboardOptions, find_chessboard};
use super::dictionary::Dictionary;
use super::marker_grid::{GridStyle, MarkerGrid};
use super::{find_charuco, find_marker_grid};
use cv_core::{ImageView, Point2, Progress};

/// The kind of a calibration board.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum BoardKind {
    /// A plain chessboard.
    Chessboard,
    /// A chessboard with a marker in every white square.
    Charuco,
    /// A grid of ArUco markers.
    ArucoGrid,
    /// Kalibr's grid of AprilTags.
    Aprilgrid,
}

cv_core::named!(BoardKind {
    Chessboard = "chessboard": "black and white squares, the most exact corners; the whole board must be seen",
    Charuco = "charuco": "a chessboard with a marker in every white square, of which a part is enough",
    ArucoGrid = "aruco-grid": "ArUco markers side by side (OpenCV's GridBoard), of which a part is enough",
    Aprilgrid = "aprilgrid": "AprilTags with black squares between them (Kalibr's), of which a part is enough",
});

/// A calibration board.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Board {
    /// A chessboard; its points are the inner corners, with the first as origin.
    Chessboard {
        /// Inner corners.
        size: BoardSize,
        /// Side of a square.
        square: f64,
    },
    /// A ChArUco board; its points are the inner corners, with the outer corner of the first square as origin.
    Charuco(CharucoBoard),
    /// A grid of markers; its points are the corners of the markers.
    MarkerGrid(MarkerGrid),
}

/// A black rectangle of a printed board, in the board's frame and unit: x right, y down.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct BlackRectangle {
    /// Left edge.
    pub x: f64,
    /// Top edge.
    pub y: f64,
    /// Width.
    pub width: f64,
    /// Height.
    pub height: f64,
}

impl Board {
    /// Returns the kind.
    pub fn kind(&self) -> BoardKind {
        match self {
            Self::Chessboard { .. } => BoardKind::Chessboard,
            Self::Charuco(_) => BoardKind::Charuco,
            Self::MarkerGrid(MarkerGrid { style: GridStyle::Aruco, .. }) => BoardKind::ArucoGrid,
            Self::MarkerGrid(MarkerGrid { style: GridStyle::AprilGrid, .. }) => BoardKind::Aprilgrid,
        }
    }

    /// Returns the conventional numbers of columns and rows: inner corners of a chessboard, squares of a ChArUco board,
    /// markers of a grid.
    pub fn counts(&self) -> (usize, usize) {
        match self {
            Self::Chessboard { size, .. } => (size.columns, size.rows),
            Self::Charuco(board) => board.squares,
            Self::MarkerGrid(grid) => grid.markers,
        }
    }

    /// Validates the parameters.
    ///
    /// # Errors
    /// [`BoardError::Size`], [`BoardError::Layout`], [`BoardError::TooManyMarkers`].
    pub fn check(&self) -> Result<(), BoardError> {
        match self {
            Self::Chessboard { size, square } => {
                let valid = size.is_valid() && *square > 0.0 && square.is_finite();
                if valid { Ok(()) } else { Err(BoardError::Size { asked: *size }) }
            }
            Self::Charuco(board) => board.check(),
            Self::MarkerGrid(grid) => grid.check(),
        }
    }

    /// Returns the positions of the points, indexed by [`BoardPoint::id`].
    pub fn points(&self) -> Vec<Point2<f64>> {
        match self {
            Self::Chessboard { size, square } => (0..size.corners()).map(|i| size.point(i, *square)).collect(),
            Self::Charuco(board) => (0..board.corners().corners()).map(|i| board.point(i)).collect(),
            Self::MarkerGrid(grid) => (0..4 * grid.count()).map(|i| grid.point(i)).collect(),
        }
    }

    /// Returns the black parts of the print as disjoint rectangles.
    pub fn black_rectangles(&self) -> Vec<BlackRectangle> {
        match self {
            Self::Chessboard { size, square } => squares((size.columns + 1, size.rows + 1), *square, -*square),
            Self::Charuco(board) => {
                let mut all = squares(board.squares, board.square, 0.0);
                for id in 0..board.markers() {
                    let Some((column, row)) = board.square_of(id) else { continue };
                    let at = |i: usize| i as f64 * board.square + 0.5 * (board.square - board.marker);
                    all.extend(marker(board.dictionary, id, (1, 0), Point2::new(at(column), at(row)), board.marker));
                }
                all
            }
            Self::MarkerGrid(grid) => {
                let shape = (grid.border(), grid.quarter_turns());
                let mut all: Vec<BlackRectangle> = (0..grid.count())
                    .flat_map(|id| marker(grid.dictionary, id, shape, grid.origin(id), grid.marker))
                    .collect();
                if grid.style == GridStyle::AprilGrid {
                    let gap = grid.gap();
                    for (i, j) in (0..=grid.markers.1).flat_map(|j| (0..=grid.markers.0).map(move |i| (i, j))) {
                        let at = |k: usize| k as f64 * (grid.marker + gap) - gap;
                        all.push(BlackRectangle { x: at(i), y: at(j), width: gap, height: gap });
                    }
                }
                all
            }
        }
    }

    /// Returns the bounding rectangle of the print, including white squares.
    pub fn outline(&self) -> BlackRectangle {
        match self {
            Self::Chessboard { size, square } => BlackRectangle {
                x: -square,
                y: -square,
                width: (size.columns + 1) as f64 * square,
                height: (size.rows + 1) as f64 * square,
            },
            Self::Charuco(CharucoBoard { squares, square, .. }) => {
                BlackRectangle { x: 0.0, y: 0.0, width: squares.0 as f64 * square, height: squares.1 as f64 * square }
            }
            Self::MarkerGrid(grid) => {
                let margin = if grid.style == GridStyle::AprilGrid { grid.gap() } else { 0.0 };
                let along = |n: usize| n as f64 * grid.marker + n.saturating_sub(1) as f64 * grid.gap() + 2.0 * margin;
                BlackRectangle { x: -margin, y: -margin, width: along(grid.markers.0), height: along(grid.markers.1) }
            }
        }
    }

    /// Scales the board.
    pub fn scaled(self, by: f64) -> Self {
        match self {
            Self::Chessboard { size, square } => Self::Chessboard { size, square: by * square },
            Self::Charuco(b) => Self::Charuco(CharucoBoard { square: by * b.square, marker: by * b.marker, ..b }),
            Self::MarkerGrid(g) => Self::MarkerGrid(MarkerGrid { marker: by * g.marker, ..g }),
        }
    }
}

/// Returns the black squares of a chessboard whose top left square, at (`first`, `first`), is black.
fn squares((columns, rows): (usize, usize), side: f64, first: f64) -> Vec<BlackRectangle> {
    let all = (0..rows).flat_map(|j| (0..columns).map(move |i| (i, j)));
    let at = |k: usize| first + k as f64 * side;
    all.filter(|(i, j)| (i + j) % 2 == 0)
        .map(|(i, j)| BlackRectangle { x: at(i), y: at(j), width: side, height: side })
        .collect()
}

/// Returns the black parts of a marker: runs of cells of a row, merged with equal runs of the following rows.
fn marker(
    dictionary: Dictionary,
    id: usize,
    (border, turns): (usize, usize),
    origin: Point2<f64>,
    size: f64,
) -> Vec<BlackRectangle> {
    let side = dictionary.side();
    let n = side + 2 * border;
    let bits = dictionary.bits(id).unwrap_or(0);
    let black = |column: usize, row: usize| {
        let inner = |k: usize| k.checked_sub(border).filter(|k| *k < side);
        let (Some(x), Some(y)) = (inner(column), inner(row)) else { return true };
        // The cells of an upside-down marker are in reverse order.
        let index = if turns == 2 { side * side - 1 - (y * side + x) } else { y * side + x };
        (bits >> (side * side - 1 - index)) & 1 == 0
    };
    // First column, one past the last, first row.
    let mut open: Vec<[usize; 3]> = Vec::new();
    let mut out = Vec::new();
    let cell = size / n as f64;
    let mut close = |[from, to, first]: [usize; 3], last: usize| {
        out.push(BlackRectangle {
            x: origin.x + from as f64 * cell,
            y: origin.y + first as f64 * cell,
            width: (to - from) as f64 * cell,
            height: (last - first) as f64 * cell,
        });
    };
    for row in 0..=n {
        let mut runs: Vec<[usize; 2]> = Vec::new();
        for column in (0..n).filter(|column| row < n && black(*column, row)) {
            match runs.last_mut().filter(|run| run[1] == column) {
                Some(run) => run[1] += 1,
                None => runs.push([column, column + 1]),
            }
        }
        open.retain(|&rectangle| {
            let goes_on = runs.contains(&[rectangle[0], rectangle[1]]);
            if !goes_on {
                close(rectangle, row);
            }
            goes_on
        });
        for run in runs {
            if !open.iter().any(|r| [r[0], r[1]] == run) {
                open.push([run[0], run[1], row]);
            }
        }
    }
    out
}

/// Detects a board of any kind. The points are sorted by id: all for a chessboard, the visible ones for other kinds.
///
/// `view` is gray, 0 to 1.
///
/// # Errors
/// [`BoardError`].
pub fn find_board(
    view: ImageView<'_, f32, 1>,
    board: &Board,
    options: &ChessboardOptions,
    progress: &dyn Progress,
) -> Result<Vec<BoardPoint>, BoardError> {
    match board {
        Board::Chessboard { size, .. } => {
            find_chessboard(view, Some(*size), options, progress).map(|found| found.points())
        }
        Board::Charuco(board) => find_charuco(view, board, options, progress),
        Board::MarkerGrid(grid) => find_marker_grid(view, grid, options, progress),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn black_rectangles_agree_with_is_black() {
        let charuco =
            CharucoBoard { squares: (8, 5), square: 30.0, marker: 21.0, dictionary: Dictionary::Aruco6x6x100 };
        let rectangles = Board::Charuco(charuco).black_rectangles();
        // Sample points that are not on an edge.
        for k in 0..(240 * 150) {
            let (x, y) = ((k % 240) as f64 + 0.37, (k / 240) as f64 + 0.43);
            let inside =
                rectangles.iter().filter(|r| x > r.x && y > r.y && x < r.x + r.width && y < r.y + r.height).count();
            assert_eq!(inside, usize::from(charuco.is_black(x, y)), "{x} {y}");
        }
    }

    #[test]
    fn aprilgrids_have_the_layout_of_kalibr() {
        let grid = MarkerGrid {
            markers: (6, 5),
            marker: 10.0,
            spacing: 0.3,
            dictionary: Dictionary::AprilTag36h11,
            style: GridStyle::AprilGrid,
        };
        // Kalibr's ids start at the bottom left, row by row.
        assert_eq!((grid.cell(0), grid.cell(5), grid.cell(29)), ((0, 4), (5, 4), (5, 0)));
        // The published code of AprilTag 0, highest bit at the top left, 1 is white.
        let code: u64 = 0xd_5d62_8584;
        let rectangles = Board::MarkerGrid(grid).black_rectangles();
        let black =
            |x: f64, y: f64| rectangles.iter().any(|r| x > r.x && y > r.y && x < r.x + r.width && y < r.y + r.height);
        for k in 0..36 {
            let (x, y) = (2.5 + (k % 6) as f64, 52.0 + 2.5 + (k / 6) as f64);
            assert_eq!(black(x, y), (code >> (35 - k)) & 1 == 0, "{k}");
        }
        // A border of two cells, and a square at every corner, also along the boundary.
        assert!(black(1.5, 53.5) && black(-1.0, -1.0) && black(11.5, 11.5) && !black(5.0, 11.5));
        assert_eq!(Board::MarkerGrid(grid).outline(), BlackRectangle { x: -3.0, y: -3.0, width: 81.0, height: 68.0 });
    }

    #[test]
    fn invalid_boards_are_rejected() {
        let grid = MarkerGrid {
            markers: (10, 6),
            marker: 10.0,
            spacing: 0.2,
            dictionary: Dictionary::Aruco4x4x50,
            style: GridStyle::Aruco,
        };
        let many = BoardError::TooManyMarkers { needed: 60, dictionary: Dictionary::Aruco4x4x50 };
        assert_eq!(Board::MarkerGrid(grid).check(), Err(many));
        assert_eq!(many.to_string(), "the board takes 60 markers, and 4x4_50 has 50");
        for bad in [MarkerGrid { spacing: 0.0, ..grid }, MarkerGrid { markers: (0, 3), ..grid }] {
            assert!(matches!(bad.check(), Err(BoardError::Layout { .. })));
        }
        let board = CharucoBoard { squares: (8, 6), square: 3.0, marker: 3.0, dictionary: Dictionary::Aruco4x4x50 };
        assert!(matches!(Board::Charuco(board).check(), Err(BoardError::Layout { share: 1.0, .. })));
    }
}
