//! Rectification, depth and scores through the public API. One binary: each further one costs a link, and in the crate's own, these tests would
//! compile the library a second time.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

mod depth;
mod evaluate;
mod rectify;
mod rectify_scene;
