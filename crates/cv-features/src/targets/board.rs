//! The geometry of calibration boards: where their corners lie and which squares are black. The one place for it.
//!
//! A board lies in its own plane: x along its columns, y along its rows, in the unit of its squares (millimeters, meters: the caller's), z away
//! from whoever looks at it. So x right, y down, z forward, as in a camera's frame.

use super::board_error::BoardError;
use super::dictionary::Dictionary;
use cv_core::Point2;

/// Inner corners of a chessboard: `columns` along a row, `rows` of them. A board of 10×7 squares has 9×6.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct BoardSize {
    /// Corners along a row. 3 to 200.
    pub columns: usize,
    /// Rows of corners. 3 to 200.
    pub rows: usize,
}

impl BoardSize {
    /// Fewest corners along a side: a smaller grid also turns up where no board is.
    pub const LEAST: usize = 3;
    /// Most corners along a side.
    pub const MOST: usize = 200;

    /// So many corners along a row, and rows.
    pub fn new(columns: usize, rows: usize) -> Self {
        Self { columns, rows }
    }

    /// Number of corners. Saturates.
    pub fn corners(self) -> usize {
        self.columns.saturating_mul(self.rows)
    }

    /// Whether both sides are within [`BoardSize::LEAST`] and [`BoardSize::MOST`].
    pub fn is_valid(self) -> bool {
        [self.columns, self.rows].iter().all(|side| (Self::LEAST..=Self::MOST).contains(side))
    }

    /// Whether the board looks the same after half a turn: where `columns + rows` is even. Then nothing in a picture tells which end is the
    /// first, and two cameras that are turned against each other may start at opposite ends.
    pub fn is_symmetric(self) -> bool {
        (self.columns ^ self.rows) & 1 == 0
    }

    /// Rows and columns exchanged.
    pub fn transposed(self) -> Self {
        Self { columns: self.rows, rows: self.columns }
    }

    /// The longer side along the rows.
    pub fn landscape(self) -> Self {
        if self.rows > self.columns { self.transposed() } else { self }
    }

    /// Position of corner `index` (row-major) on the board, in the unit of `square`; the first corner is the origin.
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

/// A ChArUco board: a chessboard whose corner square at the top left is black, with a marker in the middle of every white square. The markers are those
/// of the dictionary from the first on, row by row (the layout of OpenCV since 4.6).
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct CharucoBoard {
    /// Columns and rows of squares.
    pub squares: (usize, usize),
    /// Side of a square.
    pub square: f64,
    /// Side of a marker with its black frame, in the same unit; 0.3 to 0.9 of a square.
    pub marker: f64,
    /// Where the markers are from.
    pub dictionary: Dictionary,
}

impl CharucoBoard {
    /// What is wrong with it, if anything: too few squares, too few markers in the dictionary, or no room for them.
    ///
    /// # Errors
    /// [`BoardError::Layout`], [`BoardError::TooManyMarkers`].
    pub fn check(&self) -> Result<(), BoardError> {
        let share = self.marker / self.square;
        let sized = self.square > 0.0 && self.square.is_finite() && (0.3..=0.9).contains(&share);
        if !(self.corners().is_valid() && sized) {
            return Err(BoardError::Layout { columns: self.squares.0, rows: self.squares.1, share });
        }
        BoardError::check_markers(self.markers(), self.dictionary)
    }

    /// Its inner corners.
    pub fn corners(&self) -> BoardSize {
        BoardSize::new(self.squares.0.saturating_sub(1), self.squares.1.saturating_sub(1))
    }

    /// Number of markers on it.
    pub fn markers(&self) -> usize {
        self.squares.0.saturating_mul(self.squares.1) / 2
    }

    /// The place of inner corner `id` (row-major), from the outer corner of the top left square.
    pub fn point(&self, id: usize) -> Point2<f64> {
        let p = self.corners().point(id, self.square);
        Point2::new(p.x + self.square, p.y + self.square)
    }

    /// Column and row of the square that marker `id` lies in.
    pub fn square_of(&self, id: usize) -> Option<(usize, usize)> {
        let (columns, rows) = self.squares;
        // Of two rows the first has its white squares at odd columns and the second at even ones.
        let (pair, rest) = (id.checked_div(columns)?, id % columns.max(1));
        let of_first = columns / 2;
        let (column, row) =
            if rest < of_first { (2 * rest + 1, 2 * pair) } else { (2 * (rest - of_first), 2 * pair + 1) };
        (row < rows).then_some((column, row))
    }

    /// The number of the marker in a white square.
    pub fn marker_of(&self, column: usize, row: usize) -> Option<usize> {
        let white = (column + row) % 2 == 1 && column < self.squares.0 && row < self.squares.1;
        let before = row / 2 * self.squares.0 + (row % 2) * (self.squares.0 / 2);
        white.then_some(before + column / 2)
    }

    /// Whether a point of the board, from the outer corner of its top left square, is black.
    pub fn is_black(&self, x: f64, y: f64) -> bool {
        let (u, v) = (x / self.square, y / self.square);
        let (column, row) = (u.floor(), v.floor());
        if !(u >= 0.0 && v >= 0.0 && column < self.squares.0 as f64 && row < self.squares.1 as f64) {
            return false;
        }
        let Some(id) = self.marker_of(column as usize, row as usize) else { return true };
        let side = self.dictionary.side();
        let share = self.marker / self.square;
        let cell = |t: f64| ((t - 0.5 * (1.0 - share)) / share * (side + 2) as f64).floor();
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

/// A point of a board seen in a picture: what every finder of boards gives and a calibration takes.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct BoardPoint {
    /// Number of the point on its board: an index into the board's points.
    pub id: usize,
    /// Where it is seen, in pixels.
    pub position: Point2<f64>,
    /// Standard deviation of the position along either axis, in pixels, from how well the picture around it fits a corner. An estimate
    /// to weigh points by, not a bound.
    pub deviation: f64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn markers_and_squares_belong_together() {
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
        // Marker 0 of 4×4 as OpenCV prints it: 1011 0101 0011 0010.
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
