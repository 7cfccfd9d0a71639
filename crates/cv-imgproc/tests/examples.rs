//! The examples run.

#[path = "../examples/gradient_edges.rs"]
mod gradient_edges;

#[test]
fn gradient_edges_runs() {
    gradient_edges::main().unwrap();
}

#[path = "../examples/rotate_image.rs"]
mod rotate_image;

#[test]
fn rotate_image_runs() {
    rotate_image::main().unwrap();
}
