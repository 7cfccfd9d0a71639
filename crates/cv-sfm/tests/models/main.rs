//! Models of generated views against ground truth, in one binary.

mod align;
mod covariance;
mod generated;
mod known_poses;
mod repeated;
