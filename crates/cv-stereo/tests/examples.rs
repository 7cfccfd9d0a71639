//! The examples run.

#[path = "../examples/depth_of_room.rs"]
mod depth_of_room;

#[test]
fn depth_of_room_runs() {
    depth_of_room::main().unwrap();
}

#[path = "../examples/rectify_rig.rs"]
mod rectify_rig;

#[test]
fn rectify_rig_runs() {
    rectify_rig::main().unwrap();
}
