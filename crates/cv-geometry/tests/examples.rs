//! The examples run.

#![allow(clippy::unwrap_used, reason = "an example that fails is a failed test")]

#[path = "../examples/essential_and_points.rs"]
mod essential_and_points;
#[path = "../examples/own_scorer.rs"]
mod own_scorer;
#[path = "../examples/robust_homography.rs"]
mod robust_homography;
#[path = "../examples/two_views_by_index.rs"]
mod two_views_by_index;

#[test]
fn essential_and_points_runs() {
    essential_and_points::main().unwrap();
}

#[test]
fn own_scorer_runs() {
    own_scorer::main().unwrap();
}

#[test]
fn robust_homography_runs() {
    robust_homography::main().unwrap();
}

#[test]
fn two_views_by_index_runs() {
    two_views_by_index::main().unwrap();
}
