//! Calibration targets: their geometry, and finding them in pictures.

mod board;
mod charuco;
mod chessboard;
mod dictionary;
mod dictionary_bits;
mod grid;
mod saddle;
mod x_corner;

pub use board::{BoardPoint, BoardSize, CharucoBoard};
pub use charuco::find_charuco;
pub use chessboard::{Chessboard, ChessboardError, ChessboardOptions, find_chessboard};
pub use dictionary::Dictionary;
