//! The program as a black box: one test program for all commands, since each would link the libraries anew.
//!
//! What measures time is in `tests/stop.rs`, which runs alone.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod calibrate;
mod calibrate_outcomes;
mod calibrations;
mod config;
mod corrupt;
mod depth;
mod estimate;
mod faults;
mod frame;
mod guides;
mod image_files;
mod inputs;
mod matching;
mod metadata;
mod outputs;
mod panorama;
mod reconstruct;
mod rectify;
mod reports;
mod segment;
mod sfm;
#[path = "../support/mod.rs"]
mod support;
