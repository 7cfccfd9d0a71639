//! Jobs on generated scenes against ground truth. One binary: each further one takes as long to compile as its tests run.

mod adapted;
mod asift;
mod borders;
mod brackets;
mod calibrate;
mod dense;
mod depth;
mod disparity_range;
mod filled;
mod flat_map;
mod generated;
mod masks;
mod matching;
mod panorama;
mod reconstruct;
mod rectify;
mod refusals;
mod rig_depth;
mod segment;
mod sequence;
mod serde;
mod stereo;
mod tracks;
mod uncertainty;
