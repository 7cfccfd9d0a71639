//! Errors of board detection.

use super::board::BoardSize;
use super::dictionary::Dictionary;
use crate::error::FeatureError;
use cv_core::{Cancelled, OptionError};

/// Why a board was not detected, or its parameters are invalid.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum BoardError {
    /// The requested chessboard size is out of range.
    #[error(
        "chessboard of {asked} inner corners: each side must have {} to {}",
        BoardSize::MIN_SIDE,
        BoardSize::MAX_SIDE
    )]
    Size {
        /// Requested size.
        asked: BoardSize,
    },
    /// The layout of a marker board is out of range.
    #[error("invalid board layout: {columns}×{rows}, relative size of markers or gaps {share:.2}")]
    Layout {
        /// Number of columns of squares or markers.
        columns: usize,
        /// Number of rows.
        rows: usize,
        /// Side of a marker relative to a square (0.3 to 0.9), or gap relative to a marker (0.05 to 1).
        share: f64,
    },
    /// The dictionary has too few markers for the board.
    #[error("the board takes {needed} markers, and {dictionary} has {}", dictionary.markers())]
    TooManyMarkers {
        /// Number of markers of the board.
        needed: usize,
        /// Its dictionary.
        dictionary: Dictionary,
    },
    /// No chessboard was detected.
    #[error("no chessboard detected among {corners} candidate corners")]
    NoBoard {
        /// Number of X-corners detected.
        corners: usize,
    },
    /// No marker of the board could be decoded.
    #[error("no marker of {dictionary} decoded among {seen} candidates")]
    NoMarkers {
        /// Requested dictionary.
        dictionary: Dictionary,
        /// Number of candidates: white squares of a chessboard, or black quadrilaterals.
        seen: usize,
    },
    /// The markers are of another dictionary.
    #[error("detected {markers} markers of {seen}, none of {asked}")]
    OtherDictionary {
        /// Detected dictionary, the largest of its family.
        seen: Dictionary,
        /// Number of its markers.
        markers: usize,
        /// Requested dictionary.
        asked: Dictionary,
    },
    /// The markers are those of the board, mirrored.
    #[error("detected {markers} markers of {dictionary}, mirrored")]
    Mirrored {
        /// Number of mirrored markers.
        markers: usize,
        /// Their dictionary.
        dictionary: Dictionary,
    },
    /// The markers are of the dictionary, but in another layout.
    #[error("detected {markers} markers, but not in the layout of the requested board")]
    OtherLayout {
        /// Number of decoded markers.
        markers: usize,
    },
    /// The chessboard has another size.
    #[error("detected a board of {seen}, not {asked} inner corners")]
    OtherSize {
        /// Detected size.
        seen: BoardSize,
        /// Requested size.
        asked: BoardSize,
    },
    /// The board is only partly visible: truncated by the image border, occluded, or overexposed.
    #[error("detected {found} of the {} corners of a {asked} board, the largest complete part is {seen}", asked.corners())]
    Partial {
        /// Number of corners detected.
        found: usize,
        /// Largest complete grid among them.
        seen: BoardSize,
        /// Requested size.
        asked: BoardSize,
        /// Whether the board extends to the image border, so that the rest may be outside.
        cut_off: bool,
    },
    /// The board was detected more than once.
    #[error("detected the board {boards} times")]
    SeveralBoards {
        /// Number of boards.
        boards: usize,
    },
    /// The image is unsuitable, an option is out of range, or the job was stopped.
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
