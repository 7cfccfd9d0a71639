//! Whole calibrations. They are here and not in the library, which would be compiled twice for them.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod studio;
mod synthetic_views;
