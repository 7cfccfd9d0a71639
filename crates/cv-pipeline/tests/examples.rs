//! The examples run without errors.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[path = "../examples/depth.rs"]
mod depth;
#[path = "../examples/depth_by_rig.rs"]
mod depth_by_rig;
#[path = "../examples/match_photos.rs"]
mod match_photos;
#[path = "../examples/panorama.rs"]
mod panorama;
#[path = "../examples/reconstruct.rs"]
mod reconstruct;
#[path = "../examples/segment.rs"]
mod segment;

#[test]
fn depth_runs() {
    depth::main().unwrap();
}

#[test]
fn depth_by_rig_runs() {
    depth_by_rig::main().unwrap();
}

#[test]
fn match_photos_runs() {
    match_photos::main().unwrap();
}

#[test]
fn panorama_runs() {
    panorama::main().unwrap();
}

#[test]
fn reconstruct_runs() {
    reconstruct::main().unwrap();
}

#[test]
fn segment_runs() {
    segment::main().unwrap();
}
