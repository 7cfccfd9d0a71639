//! Alignment, compositing and blending by the public API against known scenes. One binary: each further one takes as long to
//! link as its tests run. Tests that need the whole renderer are here and not in the library, which would be compiled twice for
//! them.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod align;
mod blend;
mod masks;
mod render;
mod stopping;
mod stream;
#[path = "../../src/testing.rs"]
mod testing;

// What `testing` has from the root of the crate.
use cv_panorama::{Bounds, View, WarpedPhoto};
