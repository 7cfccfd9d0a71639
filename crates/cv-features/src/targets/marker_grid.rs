//! Grids of square markers with nothing but white, or small black squares, between them: their geometry.

use super::board_error::BoardError;
use super::dictionary::Dictionary;
use cv_core::Point2;

/// How the markers of a grid are laid out and framed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum GridStyle {
    /// As OpenCV's `GridBoard`: numbers row by row from the top left, a frame of one cell, white between the markers.
    Aruco,
    /// As Kalibr's AprilGrid: numbers row by row from the bottom left, a frame of two cells, a black square in every gap between four tags and around
    /// the rim, so that every corner of a tag is one between two black and two white squares.
    AprilGrid,
}

/// A grid of markers: those of a dictionary from the first on.
///
/// Points are the corners of the markers, four of each: point `4·m + k` is corner `k`, clockwise from the top left of the sheet, of marker `m`. The origin is
/// the outer corner of the marker at the top left, in the unit of `marker`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct MarkerGrid {
    /// Columns and rows of markers.
    pub markers: (usize, usize),
    /// Side of a marker with its black frame.
    pub marker: f64,
    /// Gap between two markers as a share of their side (Kalibr's `tagSpacing`); 0.05 to 1.
    pub spacing: f64,
    /// Where the markers are from.
    pub dictionary: Dictionary,
    /// Layout.
    pub style: GridStyle,
}

impl MarkerGrid {
    /// What is wrong with it, if anything.
    ///
    /// # Errors
    /// [`BoardError::Layout`], [`BoardError::TooManyMarkers`].
    pub fn check(&self) -> Result<(), BoardError> {
        let (columns, rows) = self.markers;
        let sized = self.marker > 0.0 && self.marker.is_finite() && (0.05..=1.0).contains(&self.spacing);
        if columns == 0 || rows == 0 || !sized {
            return Err(BoardError::Layout { columns, rows, share: self.spacing });
        }
        BoardError::check_markers(self.count(), self.dictionary)
    }

    /// Number of markers. Saturates.
    pub fn count(&self) -> usize {
        self.markers.0.saturating_mul(self.markers.1)
    }

    /// Cells of the black frame.
    pub(super) fn frame(&self) -> usize {
        match self.style {
            GridStyle::Aruco => 1,
            GridStyle::AprilGrid => 2,
        }
    }

    /// From one marker to the next.
    fn pitch(&self) -> f64 {
        self.marker * (1.0 + self.spacing)
    }

    /// The gap between two markers.
    pub(super) fn gap(&self) -> f64 {
        self.marker * self.spacing
    }

    /// Column, and row from the top, of a marker.
    pub(super) fn cell(&self, id: usize) -> (usize, usize) {
        let (columns, rows) = (self.markers.0.max(1), self.markers.1);
        let (column, row) = (id % columns, id / columns);
        match self.style {
            GridStyle::Aruco => (column, row),
            GridStyle::AprilGrid => (column, (rows - 1).saturating_sub(row)),
        }
    }

    /// The top left corner of a marker.
    pub(super) fn origin(&self, id: usize) -> Point2<f64> {
        let (column, row) = self.cell(id);
        Point2::new(column as f64 * self.pitch(), row as f64 * self.pitch())
    }

    /// By how many quarter turns clockwise markers stand on the sheet, against the dictionary: the tags of an AprilGrid stand as AprilTag draws them, which is
    /// upside down in OpenCV's dictionary.
    pub(super) fn turns(&self) -> usize {
        match self.style {
            GridStyle::Aruco => 0,
            GridStyle::AprilGrid => 2,
        }
    }

    /// Point `index`.
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
