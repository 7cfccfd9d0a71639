//! Verification of image pairs by a homography: rotating cameras or planar scenes (Brown & Lowe 2007, §3.2).

use crate::{EstimateError, RobustOptions, estimate_homography};
use cv_core::{Correspondence, Matrix3, Point2, Silent, Vector3};

/// Options of [`verify_pair`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VerifyOptions {
    /// Inlier threshold in pixels, above 0. Default 3 (OpenCV's `findHomography`).
    pub threshold: f64,
    /// α of the acceptance test `inliers > α + β · matches in the overlap`: an offset, for inliers by chance. Default 8
    /// (Brown & Lowe).
    pub alpha: f64,
    /// β of the acceptance test: the minimum inlier ratio in the overlap, 0 to 1. Default 0.3 (Brown & Lowe: derived
    /// from an inlier probability of 0.6 in true pairs and 0.1 in false ones, and a prior of one in a million).
    pub beta: f64,
    /// Seed of the random samples. Default 0.
    pub seed: u64,
}

impl Default for VerifyOptions {
    fn default() -> Self {
        Self { threshold: 3.0, alpha: 8.0, beta: 0.3, seed: 0 }
    }
}

/// A pair of overlapping images.
#[derive(Debug, Clone, PartialEq)]
pub struct VerifiedPair {
    /// Index of the first image.
    pub a: usize,
    /// Index of the second image.
    pub b: usize,
    /// Maps pixels of `a` to pixels of `b`.
    pub homography: Matrix3<f64>,
    /// Indices of the tentative matches that are inliers of the homography, ascending.
    pub inliers: Vec<usize>,
    /// The inliers, in pixels.
    pub matches: Vec<Correspondence>,
}

/// Why an image pair was rejected.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum PairRejection {
    /// No homography could be estimated.
    #[error("no homography: {0}")]
    NoHomography(#[from] EstimateError),
    /// The best homography has too few inliers to be significant.
    #[error(
        "{inliers} inliers of a homography, but more than {needed:.0} are needed with {in_overlap} matches in the overlap"
    )]
    #[cfg_attr(feature = "serde", serde(rename = "TooFewAgree"))]
    TooFewInliers {
        /// Number of inliers.
        #[cfg_attr(feature = "serde", serde(rename = "agree"))]
        inliers: usize,
        /// Number of matches in the overlap of the two images under the homography.
        in_overlap: usize,
        /// Bound that the number of inliers must exceed.
        needed: f64,
    },
    /// The best homography reverses orientation at an inlier or changes areas by more than a factor of 64.
    #[error("the best homography reverses orientation or changes areas too much to be a view of the same scene")]
    #[cfg_attr(feature = "serde", serde(rename = "Impossible"))]
    ImplausibleHomography,
}

/// Verifies that two images overlap, from their tentative matches.
///
/// Estimates a homography with RANSAC and accepts the pair if the number of inliers exceeds `alpha + beta · (matches in
/// the overlap)`. `a` and `b` are each an index and a size (width, height) in pixels.
///
/// # Errors
/// [`PairRejection`].
pub fn verify_pair(
    (a, size_a): (usize, (usize, usize)),
    (b, size_b): (usize, (usize, usize)),
    matches: &[Correspondence],
    options: &VerifyOptions,
) -> Result<VerifiedPair, PairRejection> {
    let robust = RobustOptions { threshold: options.threshold, seed: options.seed, ..RobustOptions::homography() };
    let estimate = estimate_homography(matches, &robust, &Silent)?;
    let h = estimate.model;
    let Some(inverse) = h.try_inverse() else { return Err(PairRejection::ImplausibleHomography) };
    let is_in_image = |m: &Matrix3<f64>, p: Point2<f64>, (w, height): (usize, usize)| {
        let q = m * Vector3::new(p.x, p.y, 1.0);
        let (x, y) = (q.x / q.z, q.y / q.z);
        q.z > 0.0 && x >= 0.0 && y >= 0.0 && x <= w as f64 && y <= height as f64
    };
    // H[2][2] = 1, so the denominator is positive in front of the camera; the sign of the inverse is chosen
    // accordingly.
    let inverse = if inverse[(2, 2)] < 0.0 { -inverse } else { inverse };
    let in_overlap =
        matches.iter().filter(|c| is_in_image(&h, c.a, size_b) && is_in_image(&inverse, c.b, size_a)).count();
    let inliers = estimate.inliers.len();
    let needed = options.alpha + options.beta * in_overlap as f64;
    if inliers as f64 <= needed {
        return Err(PairRejection::TooFewInliers { inliers, in_overlap, needed });
    }
    let inlier_matches: Vec<Correspondence> = estimate.inliers.iter().map(|&i| matches[i]).collect();
    // The Jacobian determinant at each inlier: the local change of area, positive where the orientation is preserved.
    let jacobian = |c: &Correspondence| h.determinant() / (h * Vector3::new(c.a.x, c.a.y, 1.0)).z.powi(3);
    if !inlier_matches.iter().all(|c| (1.0 / 64.0..64.0).contains(&jacobian(c))) {
        return Err(PairRejection::ImplausibleHomography);
    }
    Ok(VerifiedPair { a, b, homography: h, inliers: estimate.inliers, matches: inlier_matches })
}
