//! The examples run.

#[path = "../examples/find_ball.rs"]
mod find_ball;

#[test]
fn find_ball_runs() {
    find_ball::main().unwrap();
}
