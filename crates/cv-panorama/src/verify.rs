//! Which pairs of photographs really overlap (Brown & Lowe 2007, §3.2).

use cv_core::{Correspondence, Matrix3};

/// A pair of photographs that overlap.
#[derive(Debug, Clone, PartialEq)]
pub struct VerifiedPair {
    /// First photograph.
    pub a: usize,
    /// Second photograph.
    pub b: usize,
    /// Pixels of `a` to pixels of `b`.
    pub homography: Matrix3<f64>,
    /// The matches that agree with the homography.
    pub inliers: Vec<Correspondence>,
}
