//! The examples run.

#[path = "../examples/page.rs"]
mod page;

#[test]
fn page_runs() {
    page::main().unwrap();
}
