//! Calibration targets: geometry and detection.

mod any_board;
mod board;
mod board_error;
mod charuco;
mod chessboard;
mod dictionary;
mod dictionary_bits;
mod grid;
mod grid_finder;
mod marker;
mod marker_grid;
mod quads;
mod saddle;
mod x_corner;

pub use any_board::{BlackRectangle, Board, BoardKind, find_board};
pub use board::{BoardPoint, BoardSize, CharucoBoard};
pub use board_error::BoardError;
pub use charuco::find_charuco;
pub use chessboard::{Chessboard, ChessboardOptions, find_chessboard};
pub use dictionary::Dictionary;
pub use grid_finder::find_marker_grid;
pub use marker_grid::{GridStyle, MarkerGrid};
