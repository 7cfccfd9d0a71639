//! Geometry of calibration boards: corner positions and black squares.
//!
//! The frame of a board: x right along a row, y down along a column, z forward (away from the viewer), as in a camera
//! frame. The unit is that of the squares, chosen by the caller.

use super::board_error::BoardError;
use super::dictionary::Dictionary;
use cv_core::Point2;

/// Numbers of inner corners of a chessboard. A board of 10×7 squares has 9×6.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct BoardSize {
    /// Corners per row, 3 to 200.
    pub columns: usize,
    /// Number of rows, 3 to 200.
    pub rows: usize,
}

impl BoardSize {
    /// Minimum number of corners along a side: smaller grids also occur by chance.
    pub const MIN_SIDE: usize = 3;
    /// Maximum number of corners along a side.
    pub const MAX_SIDE: usize = 200;

    /// Creates a size.
    pub fn new(columns: usize, rows: usize) -> Self {
        Self { columns, rows }
    }

    /// Returns the number of corners (saturating).
    pub fn corners(self) -> usize {
        self.columns.saturating_mul(self.rows)
    }

    /// Returns whether both sides are between [`BoardSize::MIN_SIDE`] and [`BoardSize::MAX_SIDE`].
    pub fn is_valid(self) -> bool {
        [self.columns, self.rows].iter().all(|side| (Self::MIN_SIDE..=Self::MAX_SIDE).contains(side))
    }

    /// Returns whether the board is symmetric under a rotation by 180° (`columns + rows` is even). The first corner is
    /// then ambiguous: two cameras with different roll may start at opposite ends.
    pub fn is_symmetric(self) -> bool {
        (self.columns ^ self.rows) & 1 == 0
    }

    /// Exchanges rows and columns.
    pub fn transposed(self) -> Self {
        Self { columns: self.rows, rows: self.columns }
    }

    /// Returns the size with the longer side along the rows.
    pub fn landscape(self) -> Self {
        if self.rows > self.columns { self.transposed() } else { self }
    }

    /// Returns the position of corner `index` (row-major) on the board, in the unit of `square`; the first corner is
    /// the origin.
    pub fn point(self, index: usize, square: f64) -> Point2<f64> {
        let columns = self.columns.max(1);
        Point2::new((index % columns) as f64 * square, (index / columns) as f64 * square)
    }
}

impl std::fmt::Display for BoardSize {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}×{}", self.columns, self.rows)
    }
}

/// A ChArUco board: a chessboard with a black top left square and a marker centered in every white square. The markers
/// are the first of the dictionary, row by row (the layout of OpenCV since 4.6).
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct CharucoBoard {
    /// Columns and rows of squares.
    pub squares: (usize, usize),
    /// Side of a square.
    pub square: f64,
    /// Side of a marker including its black border, in the same unit; 0.3 to 0.9 of a square.
    pub marker: f64,
    /// Dictionary of the markers.
    pub dictionary: Dictionary,
}

impl CharucoBoard {
    /// Validates the parameters: number of squares, size of the dictionary, and size of the markers.
    ///
    /// # Errors
    /// [`BoardError::Layout`], [`BoardError::TooManyMarkers`].
    pub fn check(&self) -> Result<(), BoardError> {
        let ratio = self.marker / self.square;
        let is_valid = self.square > 0.0 && self.square.is_finite() && (0.3..=0.9).contains(&ratio);
        if !(self.corners().is_valid() && is_valid) {
            return Err(BoardError::Layout { columns: self.squares.0, rows: self.squares.1, share: ratio });
        }
        BoardError::check_markers(self.markers(), self.dictionary)
    }

    /// Returns the numbers of inner corners.
    pub fn corners(&self) -> BoardSize {
        BoardSize::new(self.squares.0.saturating_sub(1), self.squares.1.saturating_sub(1))
    }

    /// Returns the number of markers.
    pub fn markers(&self) -> usize {
        self.squares.0.saturating_mul(self.squares.1) / 2
    }

    /// Returns the position of inner corner `id` (row-major), relative to the outer corner of the top left square.
    pub fn point(&self, id: usize) -> Point2<f64> {
        let p = self.corners().point(id, self.square);
        Point2::new(p.x + self.square, p.y + self.square)
    }

    /// Returns column and row of the square of marker `id`.
    pub fn square_of(&self, id: usize) -> Option<(usize, usize)> {
        let (columns, rows) = self.squares;
        // White squares are at odd columns in even rows, and at even columns in odd rows.
        let (pair, remainder) = (id.checked_div(columns)?, id % columns.max(1));
        let first_row_count = columns / 2;
        let (column, row) = if remainder < first_row_count {
            (2 * remainder + 1, 2 * pair)
        } else {
            (2 * (remainder - first_row_count), 2 * pair + 1)
        };
        (row < rows).then_some((column, row))
    }

    /// Returns the id of the marker in a white square; `None` for black squares.
    pub fn marker_of(&self, column: usize, row: usize) -> Option<usize> {
        let is_white = (column + row) % 2 == 1 && column < self.squares.0 && row < self.squares.1;
        let before = row / 2 * self.squares.0 + (row % 2) * (self.squares.0 / 2);
        is_white.then_some(before + column / 2)
    }

    /// Returns whether a point of the board, relative to the outer corner of its top left square, is black.
    pub fn is_black(&self, x: f64, y: f64) -> bool {
        let (u, v) = (x / self.square, y / self.square);
        let (column, row) = (u.floor(), v.floor());
        if !(u >= 0.0 && v >= 0.0 && column < self.squares.0 as f64 && row < self.squares.1 as f64) {
            return false;
        }
        let Some(id) = self.marker_of(column as usize, row as usize) else { return true };
        let side = self.dictionary.side();
        let ratio = self.marker / self.square;
        let cell = |t: f64| ((t - 0.5 * (1.0 - ratio)) / ratio * (side + 2) as f64).floor();
        let (i, j) = (cell(u - column), cell(v - row));
        let inside = |t: f64, n: usize| t >= 0.0 && t < n as f64;
        if !inside(i, side + 2) || !inside(j, side + 2) {
            return false;
        }
        let (i, j) = (i - 1.0, j - 1.0);
        if !inside(i, side) || !inside(j, side) {
            return true;
        }
        let bit = side * side - 1 - (j as usize * side + i as usize);
        self.dictionary.bits(id).is_none_or(|bits| (bits >> bit) & 1 == 0)
    }
}

/// A detected board point: the output of all board detectors and the input of calibration.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct BoardPoint {
    /// Index of the point on the board.
    pub id: usize,
    /// Position in the image, in pixels.
    pub position: Point2<f64>,
    /// Estimated standard deviation of the position along either axis, in pixels, for weighting.
    pub deviation: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn markers_and_squares_correspond() {
        for squares in [(5, 4), (8, 6), (7, 5)] {
            let board = CharucoBoard { squares, square: 2.0, marker: 1.5, dictionary: Dictionary::Aruco4x4x50 };
            let mut next = 0;
            for row in 0..squares.1 {
                for column in 0..squares.0 {
                    assert_eq!(
                        board.is_black(2.0 * column as f64 + 0.1, 2.0 * row as f64 + 0.1),
                        (column + row) % 2 == 0
                    );
                    if (column + row) % 2 == 1 {
                        assert_eq!(board.marker_of(column, row), Some(next));
                        assert_eq!(board.square_of(next), Some((column, row)));
                        next += 1;
                    }
                }
            }
            assert_eq!((next, board.square_of(next + 7 * squares.0)), (board.markers(), None));
        }
        // Marker 0 of OpenCV's 4×4 dictionary: 1011 0101 0011 0010.
        let board = CharucoBoard { squares: (5, 4), square: 8.0, marker: 6.0, dictionary: Dictionary::Aruco4x4x50 };
        let row = |y: usize| -> Vec<u8> {
            (0..6).map(|x| u8::from(!board.is_black(9.5 + x as f64, 1.5 + y as f64))).collect()
        };
        assert_eq!(row(0), [0; 6]);
        assert_eq!([row(1), row(4)], [[0, 1, 0, 1, 1, 0], [0, 0, 0, 1, 0, 0]]);
        assert!(BoardSize::new(8, 6).is_symmetric() && !BoardSize::new(9, 6).is_symmetric());
        assert_eq!(BoardSize::new(9, 6).point(11, 0.5), Point2::new(1.0, 0.5));
    }
}
