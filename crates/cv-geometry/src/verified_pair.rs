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

#[cfg(test)]
mod tests {
    use super::*;

    /// `inliers` matches of a shift by (80, 10) and `outliers` uniform ones, in images of 200 x 150.
    fn matches(inliers: usize, outliers: usize) -> Vec<Correspondence> {
        let mut state = 12345_u64;
        let mut random = |n: f64| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f64 / f64::from(1_u32 << 31) * n
        };
        let mut all: Vec<_> = (0..inliers)
            .map(|_| {
                let (x, y) = (80.0 + random(118.0), 10.0 + random(138.0));
                Correspondence::new(x, y, x - 80.0, y - 10.0)
            })
            .collect();
        all.extend(
            (0..outliers).map(|_| Correspondence::new(random(200.0), random(150.0), random(200.0), random(150.0))),
        );
        all
    }

    const SIZE: (usize, usize) = (200, 150);

    #[test]
    fn a_true_overlap_is_accepted_with_its_homography() {
        let matches = matches(60, 60);
        let pair = verify_pair((4, SIZE), (2, SIZE), &matches, &VerifyOptions::default()).unwrap();
        assert_eq!((pair.a, pair.b), (4, 2));
        assert!(pair.inliers.len() >= 60 && pair.inliers.is_sorted());
        assert_eq!(pair.inliers.iter().map(|&i| matches[i]).collect::<Vec<_>>(), pair.matches);
        // Exact matches; an outlier within 3 px by chance may bias the estimate by a fraction of that.
        assert!((pair.homography[(0, 2)] + 80.0).abs() < 0.5 && (pair.homography[(1, 2)] + 10.0).abs() < 0.5);
    }

    #[test]
    fn insignificant_support_is_rejected() {
        for matches in [matches(0, 100), matches(8, 0), matches(0, 3), matches(9, 80)] {
            assert!(verify_pair((0, SIZE), (1, SIZE), &matches, &VerifyOptions::default()).is_err());
        }
    }

    #[test]
    fn a_mirror_image_is_rejected() {
        let mirrored: Vec<_> =
            matches(80, 0).into_iter().map(|c| Correspondence::new(c.a.x, c.a.y, 200.0 - c.a.x, c.a.y)).collect();
        assert_eq!(
            verify_pair((0, SIZE), (1, SIZE), &mirrored, &VerifyOptions::default()),
            Err(PairRejection::ImplausibleHomography)
        );
    }
}
