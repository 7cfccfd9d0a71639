//! The examples run.

#[path = "../examples/fit_curve.rs"]
mod fit_curve;
#[path = "../examples/level_heights.rs"]
mod level_heights;

#[test]
fn fit_curve_runs() {
    fit_curve::main().unwrap();
}

#[test]
fn level_heights_runs() {
    level_heights::main().unwrap();
}
