//! Jobs on generated scenes against ground truth. One binary: each further one takes as long to compile as its tests run.

mod adapted;
mod borders;
mod brackets;
mod dense;
mod filled;
mod flat_map;
mod generated;
mod masks;
mod panorama;
mod reconstruct;
mod refusals;
mod sequence;
mod serde;
mod stereo;
mod tracks;
mod uncertainty;
