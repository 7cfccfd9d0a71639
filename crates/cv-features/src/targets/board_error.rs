//! Why a picture gave no board.

use super::board::BoardSize;
use super::dictionary::Dictionary;
use crate::error::FeatureError;
use cv_core::{Cancelled, OptionError};

/// Why a picture gave no board, or why there is no such board.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum BoardError {
    /// The size that was asked for is no size of a chessboard.
    #[error("a board of {asked} inner corners: each side takes {} to {}", BoardSize::LEAST, BoardSize::MOST)]
    Size {
        /// The size.
        asked: BoardSize,
    },
    /// No board of markers has such sides, or markers of this size.
    #[error("no board has {columns}×{rows} squares or markers with markers, or gaps, of {share:.2} of a side")]
    Layout {
        /// Columns of squares or markers.
        columns: usize,
        /// Rows of them.
        rows: usize,
        /// Side of a marker as a share of a square (0.3 to 0.9), or gap as a share of a marker (0.05 to 1).
        share: f64,
    },
    /// The dictionary has too few markers for the board.
    #[error("the board takes {needed} markers, and {dictionary} has {}", dictionary.markers())]
    TooManyMarkers {
        /// Markers on the board.
        needed: usize,
        /// Where they should be from.
        dictionary: Dictionary,
    },
    /// Nothing in the picture is a chessboard.
    #[error("no chessboard among the {corners} corners where black and white squares meet")]
    NoBoard {
        /// Corners between black and white squares that were seen, in a board or not.
        corners: usize,
    },
    /// No marker of the board can be read.
    #[error("no marker of {dictionary} among {seen} places that look like one")]
    NoMarkers {
        /// What was asked for.
        dictionary: Dictionary,
        /// White squares of a chessboard, or black quadrilaterals.
        seen: usize,
    },
    /// There are markers, of another dictionary.
    #[error("saw {markers} markers of {seen}, none of {asked}")]
    OtherDictionary {
        /// What was seen. Of dictionaries that begin alike, the largest.
        seen: Dictionary,
        /// How many of its markers.
        markers: usize,
        /// What was asked for.
        asked: Dictionary,
    },
    /// The markers are those of the board, mirrored.
    #[error("shows {markers} markers of {dictionary}, mirrored")]
    Mirrored {
        /// How many.
        markers: usize,
        /// Their dictionary.
        dictionary: Dictionary,
    },
    /// There are markers of the dictionary, and they do not lie as they do on the board.
    #[error("saw {markers} markers, which do not lie as on the board that was asked for")]
    OtherLayout {
        /// Markers read.
        markers: usize,
    },
    /// There is a chessboard, and it has another size.
    #[error("saw a board of {seen}, not {asked} inner corners")]
    OtherSize {
        /// Size of the board in the picture.
        seen: BoardSize,
        /// Size that was asked for.
        asked: BoardSize,
    },
    /// A part of a board: it is cut off by the frame, covered, or burnt out.
    #[error("saw {found} of the {} corners of a {asked} board, {seen} where they are whole", asked.corners())]
    Partial {
        /// Corners found.
        found: usize,
        /// Largest whole grid among them.
        seen: BoardSize,
        /// Size that was asked for.
        asked: BoardSize,
        /// Whether the board reaches the frame of the picture, so that the rest may lie outside.
        cut_off: bool,
    },
    /// The board is there more than once.
    #[error("saw the board {boards} times")]
    SeveralBoards {
        /// How often.
        boards: usize,
    },
    /// The picture cannot be worked on, or an option is out of range, or the job was stopped.
    #[error(transparent)]
    Feature(#[from] FeatureError),
}

impl BoardError {
    pub(super) fn check_markers(needed: usize, dictionary: Dictionary) -> Result<(), Self> {
        if needed > dictionary.markers() { Err(Self::TooManyMarkers { needed, dictionary }) } else { Ok(()) }
    }
}

impl From<Cancelled> for BoardError {
    fn from(cancelled: Cancelled) -> Self {
        Self::Feature(cancelled.into())
    }
}

impl From<OptionError> for BoardError {
    fn from(error: OptionError) -> Self {
        Self::Feature(error.into())
    }
}
