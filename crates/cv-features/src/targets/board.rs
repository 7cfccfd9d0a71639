//! The geometry of calibration boards: where their corners lie and which squares are black. The one place for it.
//!
//! A board lies in its own plane: x along its columns, y along its rows, in the unit of its squares (millimeters, meters: the caller's), z away
//! from whoever looks at it. So x right, y down, z forward, as in a camera's frame.

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
