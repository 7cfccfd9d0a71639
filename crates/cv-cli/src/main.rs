//! The program `cv`: arguments, files and reports.

fn main() {}
