//! Verification of image pairs by a homography: rotating cameras or planar scenes (Brown & Lowe 2007, §3.2).

use crate::homography::{Division, RadialHomography, estimate_radial_homography};
use crate::{EstimateError, RobustOptions, estimate_homography};
use cv_core::{Correspondence, Matrix3, Point2, Silent};

/// Minimum ratio of the inliers with distortion to those without, at which images are taken as distorted: parallax of a
/// hand-held camera can gain a quarter, lenses whose panoramas fail without distortion gain two fifths at least.
const MIN_DISTORTED_RATIO: f64 = 1.35;

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
    /// Maps pixels of `a` to pixels of `b`, both undistorted by `distortion`.
    pub homography: Matrix3<f64>,
    /// Coefficient λ of radial distortion by the division model: an undistorted pixel is `c + d / (1 + λ r²)` for a pixel
    /// `c + d`, with c the image center and r = |d| relative to half the diagonal; negative for barrel distortion. 0 where the
    /// matches agree without.
    pub distortion: f64,
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
/// Estimates a homography with RANSAC, and radial distortion where it explains significantly more matches, and accepts the
/// pair if the number of inliers exceeds `alpha + beta · (matches in the overlap)`. `a` and `b` are each an index and a
/// size (width, height) in pixels.
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
    let sizes = [size_a, size_b];
    let mut model = RadialHomography::new(estimate.model, sizes.map(|size| Division::new(size, 0.0)))
        .ok_or(PairRejection::ImplausibleHomography)?;
    let mut inliers = estimate.inliers;
    if let Some((distorted, more)) = estimate_radial_homography(matches, sizes, &inliers, options.threshold)
        && more.len() as f64 > MIN_DISTORTED_RATIO * inliers.len() as f64
    {
        (model, inliers) = (distorted, more);
    }
    let is_in_image = |p: Option<Point2<f64>>, (w, height): (usize, usize)| {
        p.is_some_and(|p| p.x >= 0.0 && p.y >= 0.0 && p.x <= w as f64 && p.y <= height as f64)
    };
    let in_overlap = matches
        .iter()
        .filter(|c| is_in_image(model.transfer(c.a), size_b) && is_in_image(model.transfer_back(c.b), size_a))
        .count();
    let needed = options.alpha + options.beta * in_overlap as f64;
    if inliers.len() as f64 <= needed {
        return Err(PairRejection::TooFewInliers { inliers: inliers.len(), in_overlap, needed });
    }
    let inlier_matches: Vec<Correspondence> = inliers.iter().map(|&i| matches[i]).collect();
    // The Jacobian determinant at each inlier: the local change of area, positive where the orientation is preserved.
    let h = model.matrix;
    let jacobian =
        |c: &Correspondence| h.determinant() / (h * model.lenses[0].undistort(c.a).to_homogeneous()).z.powi(3);
    if !inlier_matches.iter().all(|c| (1.0 / 64.0..64.0).contains(&jacobian(c))) {
        return Err(PairRejection::ImplausibleHomography);
    }
    Ok(VerifiedPair { a, b, homography: h, distortion: model.lenses[0].coefficient, inliers, matches: inlier_matches })
}
