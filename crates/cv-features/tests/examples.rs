//! The examples run.

#![allow(clippy::unwrap_used, reason = "an example that fails is a failed test")]

#[path = "../examples/detect_and_match.rs"]
mod detect_and_match;

#[test]
fn detect_and_match_runs() {
    detect_and_match::main().unwrap();
}
