//! Calibration targets: their geometry, and finding them in pictures.

mod board;
mod chessboard;
mod grid;
mod saddle;
mod x_corner;

pub use board::{BoardPoint, BoardSize};
pub use chessboard::{Chessboard, ChessboardError, ChessboardOptions, find_chessboard};
