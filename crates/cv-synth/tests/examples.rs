//! The examples run without errors.

#[path = "../examples/two_views.rs"]
mod two_views;

#[test]
fn two_views_runs() {
    two_views::main().unwrap();
}
