//! Estimators on generated matches against ground truth. One binary: each further one takes as long to link as its tests
//! run. Tests that need whole estimators are here and not in the library, which would be compiled twice for them.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod absolute;
mod bundle;
mod essential;
mod false_alarms;
mod fundamental;
mod homography;
mod jackknife;
mod p3p;
mod pair_graph;
mod regular;
mod shared_focal;
mod similarity;
mod six_point;
#[path = "../../src/testing.rs"]
mod testing;
mod triangulation;
mod two_view;
mod umeyama;
mod verified_pair;
