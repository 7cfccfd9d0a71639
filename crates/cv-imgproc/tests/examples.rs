//! The examples run.

#[path = "../examples/edges.rs"]
mod edges;

#[test]
fn edges_runs() {
    edges::main().unwrap();
}

#[path = "../examples/turn.rs"]
mod turn;

#[test]
fn turn_runs() {
    turn::main().unwrap();
}
