//! The examples run.

#[path = "../examples/convert_camera.rs"]
mod convert_camera;
#[path = "../examples/images_and_maps.rs"]
mod images_and_maps;

#[test]
fn convert_camera_runs() {
    convert_camera::main().unwrap();
}

#[test]
fn images_and_maps_runs() {
    images_and_maps::main().unwrap();
}
