//! The examples run.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

#[path = "../examples/alignment.rs"]
mod alignment;
#[path = "../examples/custom_blender.rs"]
mod custom_blender;
#[path = "../examples/stitch.rs"]
mod stitch;

#[test]
fn alignment_runs() {
    alignment::main().unwrap();
}

#[test]
fn custom_blender_runs() {
    custom_blender::main().unwrap();
}

#[test]
fn stitch_runs() {
    stitch::main().unwrap();
}
