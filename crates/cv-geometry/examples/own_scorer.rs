//! A custom loss for the robust estimators: `cargo run -p cv-geometry --example own_scorer`.

use cv_core::{Correspondence, Silent};
use cv_geometry::{RobustOptions, Scorer, Scoring, estimate_fundamental};

/// The truncated absolute residual.
#[derive(Debug)]
struct L1;

impl Scorer for L1 {
    fn loss(&self, u: f32) -> f32 {
        u.sqrt().min(1.0)
    }
    fn weight(&self, u: f64) -> f64 {
        if u < 1.0 { 1e-3 / u.sqrt().max(1e-3) } else { 0.0 }
    }
    fn cutoff(&self) -> f64 {
        1.0
    }
}

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let modulo = |i: u32, n: u32| f64::from(i % n);
    let position_and_disparity = |i: u32| (modulo(37 * i, 600), modulo(53 * i, 400), 5.0 + modulo(i * i, 23));
    let matches: Vec<_> =
        (0..60).map(position_and_disparity).map(|(x, y, d)| Correspondence::new(x, y, x - d, y)).collect();
    let options = RobustOptions { scoring: Scoring::Other(&L1), ..RobustOptions::fundamental() };
    let found = estimate_fundamental(&matches, &options, &Silent)?;
    if found.inliers.len() == 60 { Ok(()) } else { Err("inliers are missing".into()) }
}
