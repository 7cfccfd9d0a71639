//! Features and calibration targets through the public API. One binary: in the crate's own, these tests would compile the library a second time.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod anms;
mod asift;
mod byte_descriptors;
mod charuco;
mod chessboard;
mod grid_finder;
mod guided;
mod matching;
mod mops;
mod patch;
mod sift;
mod square_covering;
mod vlad;
