//! Geometry of marker grids: ArUco grid boards and AprilGrids.

use super::board_error::BoardError;
use super::dictionary::Dictionary;
use cv_core::Point2;

/// The layout and border of the markers of a grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum GridStyle {
    /// OpenCV's `GridBoard`: ids row by row from the top left, a border of one cell, white gaps between the markers.
    Aruco,
    /// Kalibr's AprilGrid: ids row by row from the bottom left, a border of two cells, and a black square in every gap
    /// between four tags and along the boundary, so that every tag corner is an X-corner.
    AprilGrid,
}

/// A grid of markers, with the first markers of a dictionary.
///
/// Points are the four corners of each marker: point `4·m + k` is corner `k` of marker `m`, clockwise from the top left
/// of the sheet. The origin is the outer corner of the top left marker; the unit is that of `marker`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct MarkerGrid {
    /// Columns and rows of markers.
    pub markers: (usize, usize),
    /// Side of a marker including its black border.
    pub marker: f64,
    /// Gap between two markers relative to their side (Kalibr's `tagSpacing`); 0.05 to 1.
    pub spacing: f64,
    /// Dictionary of the markers.
    pub dictionary: Dictionary,
    /// Layout.
    pub style: GridStyle,
}

impl MarkerGrid {
    /// Validates the parameters.
    ///
    /// # Errors
    /// [`BoardError::Layout`], [`BoardError::TooManyMarkers`].
    pub fn check(&self) -> Result<(), BoardError> {
        let (columns, rows) = self.markers;
        let is_valid = self.marker > 0.0 && self.marker.is_finite() && (0.05..=1.0).contains(&self.spacing);
        if columns == 0 || rows == 0 || !is_valid {
            return Err(BoardError::Layout { columns, rows, share: self.spacing });
        }
        BoardError::check_markers(self.count(), self.dictionary)
    }

    /// Returns the number of markers (saturating).
    pub fn count(&self) -> usize {
        self.markers.0.saturating_mul(self.markers.1)
    }

    /// Returns the width of the black border in cells.
    pub(super) fn border(&self) -> usize {
        match self.style {
            GridStyle::Aruco => 1,
            GridStyle::AprilGrid => 2,
        }
    }

    /// Returns the distance from one marker to the next.
    fn pitch(&self) -> f64 {
        self.marker * (1.0 + self.spacing)
    }

    /// Returns the gap between two markers.
    pub(super) fn gap(&self) -> f64 {
        self.marker * self.spacing
    }

    /// Returns column, and row from the top, of a marker.
    pub(super) fn cell(&self, id: usize) -> (usize, usize) {
        let (columns, rows) = (self.markers.0.max(1), self.markers.1);
        let (column, row) = (id % columns, id / columns);
        match self.style {
            GridStyle::Aruco => (column, row),
            GridStyle::AprilGrid => (column, (rows - 1).saturating_sub(row)),
        }
    }

    /// Returns the top left corner of a marker.
    pub(super) fn origin(&self, id: usize) -> Point2<f64> {
        let (column, row) = self.cell(id);
        Point2::new(column as f64 * self.pitch(), row as f64 * self.pitch())
    }

    /// Returns the rotation of the markers on the sheet relative to the dictionary, in clockwise quarter turns.
    /// OpenCV's dictionary has AprilTags upside down.
    pub(super) fn quarter_turns(&self) -> usize {
        match self.style {
            GridStyle::Aruco => 0,
            GridStyle::AprilGrid => 2,
        }
    }

    /// Returns point `index`.
    pub fn point(&self, index: usize) -> Point2<f64> {
        let (o, s) = (self.origin(index / 4), self.marker);
        match index % 4 {
            0 => o,
            1 => Point2::new(o.x + s, o.y),
            2 => Point2::new(o.x + s, o.y + s),
            _ => Point2::new(o.x, o.y + s),
        }
    }
}
