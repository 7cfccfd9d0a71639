//! The examples run.

#[path = "../examples/convert_camera.rs"]
mod convert_camera;
#[path = "../examples/pictures_and_maps.rs"]
mod pictures_and_maps;

#[test]
fn convert_camera_runs() {
    convert_camera::main().unwrap();
}

#[test]
fn pictures_and_maps_runs() {
    pictures_and_maps::main().unwrap();
}
