//! Calibration targets: their geometry, and finding them in pictures.

mod board;
mod chessboard;

pub use board::{BoardPoint, BoardSize};
pub use chessboard::{Chessboard, ChessboardError, ChessboardOptions, find_chessboard};
