//! The examples run.

#[path = "../examples/projection_derivatives.rs"]
mod projection_derivatives;
#[path = "../examples/undistort_points.rs"]
mod undistort_points;

#[test]
fn projection_derivatives_runs() {
    projection_derivatives::main().unwrap();
}

#[test]
fn undistort_points_runs() {
    undistort_points::main().unwrap();
}
