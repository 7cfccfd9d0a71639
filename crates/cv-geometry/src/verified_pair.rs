//! Which pairs of photographs really overlap, taken from one place or of something flat (Brown & Lowe 2007, §3.2).

use crate::{EstimateError, RobustOptions, estimate_homography};
use cv_core::{Correspondence, Matrix3, Point2, Silent, Vector3};

/// Options of [`verify_pair`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VerifyOptions {
    /// Largest error of a match that agrees, in pixels, above 0. Default 3 (OpenCV's `findHomography`).
    pub threshold: f64,
    /// Matches that agree by chance. Default 8 (Brown & Lowe).
    pub chance: f64,
    /// Share of the matches in the overlap that must agree beyond those, 0 to 1. Default 0.3 (Brown & Lowe: derived from an inlier
    /// probability of 0.6 in true pairs and 0.1 in false ones, and a prior of one in a million).
    pub share: f64,
    /// Seed of the random samples. Default 0.
    pub seed: u64,
}

impl Default for VerifyOptions {
    fn default() -> Self {
        Self { threshold: 3.0, chance: 8.0, share: 0.3, seed: 0 }
    }
}

/// A pair of photographs that overlap.
#[derive(Debug, Clone, PartialEq)]
pub struct VerifiedPair {
    /// First photograph.
    pub a: usize,
    /// Second photograph.
    pub b: usize,
    /// Pixels of `a` to pixels of `b`.
    pub homography: Matrix3<f64>,
    /// Indices of the tentative matches that agree with the homography, ascending.
    pub inliers: Vec<usize>,
    /// Those matches, in pixels.
    pub matches: Vec<Correspondence>,
}

/// Why a pair of photographs is taken not to overlap.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum NotAPair {
    /// No homography fits the matches.
    #[error("no homography: {0}")]
    NoHomography(#[from] EstimateError),
    /// Too few matches agree with the best homography for it to be more than chance.
    #[error("{agree} of {in_overlap} matches in the overlap agree, more than {needed:.0} are needed")]
    TooFewAgree {
        /// Matches that agree.
        agree: usize,
        /// Matches where the two photographs overlap by the homography.
        in_overlap: usize,
        /// The least number that is not chance.
        needed: f64,
    },
    /// The best homography mirrors the picture, folds it or shrinks it to nothing.
    #[error("the best homography is no view of the same scene")]
    Impossible,
}

/// Decides whether two photographs overlap, from the tentative matches of their features.
///
/// RANSAC finds the homography that most matches agree with; the pair is accepted where the number of those exceeds
/// `chance + share · (matches in the overlap)`.
///
/// # Errors
/// [`NotAPair`] with the reason.
pub fn verify_pair(
    (a, size_a): (usize, (usize, usize)),
    (b, size_b): (usize, (usize, usize)),
    matches: &[Correspondence],
    options: &VerifyOptions,
) -> Result<VerifiedPair, NotAPair> {
    let robust = RobustOptions { threshold: options.threshold, seed: options.seed, ..RobustOptions::homography() };
    let found = estimate_homography(matches, &robust, &Silent)?;
    let h = found.model;
    let Some(inverse) = h.try_inverse() else { return Err(NotAPair::Impossible) };
    let sees = |m: &Matrix3<f64>, p: Point2<f64>, (w, height): (usize, usize)| {
        let q = m * Vector3::new(p.x, p.y, 1.0);
        let (x, y) = (q.x / q.z, q.y / q.z);
        q.z > 0.0 && x >= 0.0 && y >= 0.0 && x <= w as f64 && y <= height as f64
    };
    // Entry (3, 3) is 1, which is positive where the origin is in front; the inverse takes its sign from there.
    let inverse = if inverse[(2, 2)] < 0.0 { -inverse } else { inverse };
    let in_overlap = matches.iter().filter(|c| sees(&h, c.a, size_b) && sees(&inverse, c.b, size_a)).count();
    let agree = found.inliers.len();
    let needed = options.chance + options.share * in_overlap as f64;
    if agree as f64 <= needed {
        return Err(NotAPair::TooFewAgree { agree, in_overlap, needed });
    }
    let agreeing: Vec<Correspondence> = found.inliers.iter().map(|&i| matches[i]).collect();
    // How much area grows at each match: positive where nothing is mirrored, within what lenses and zooms do.
    let growth = |c: &Correspondence| h.determinant() / (h * Vector3::new(c.a.x, c.a.y, 1.0)).z.powi(3);
    if !agreeing.iter().all(|c| (1.0 / 64.0..64.0).contains(&growth(c))) {
        return Err(NotAPair::Impossible);
    }
    Ok(VerifiedPair { a, b, homography: h, inliers: found.inliers, matches: agreeing })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `good` matches of a shift by (80, 10) and `bad` ones anywhere, in photographs of 200 x 150.
    fn matches(good: usize, bad: usize) -> Vec<Correspondence> {
        let mut state = 12345_u64;
        let mut random = |n: f64| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as f64 / f64::from(1_u32 << 31) * n
        };
        let mut all: Vec<_> = (0..good)
            .map(|_| {
                let (x, y) = (80.0 + random(118.0), 10.0 + random(138.0));
                Correspondence::new(x, y, x - 80.0, y - 10.0)
            })
            .collect();
        all.extend((0..bad).map(|_| Correspondence::new(random(200.0), random(150.0), random(200.0), random(150.0))));
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
        // Exact matches; the chance agreement of a random one within 3 px may pull by a fraction of that.
        assert!((pair.homography[(0, 2)] + 80.0).abs() < 0.5 && (pair.homography[(1, 2)] + 10.0).abs() < 0.5);
    }

    #[test]
    fn chance_agreement_is_not_an_overlap() {
        for matches in [matches(0, 100), matches(8, 0), matches(0, 3), matches(9, 80)] {
            assert!(verify_pair((0, SIZE), (1, SIZE), &matches, &VerifyOptions::default()).is_err());
        }
    }

    #[test]
    fn a_mirror_image_is_no_view_of_the_scene() {
        let mirrored: Vec<_> =
            matches(80, 0).into_iter().map(|c| Correspondence::new(c.a.x, c.a.y, 200.0 - c.a.x, c.a.y)).collect();
        assert_eq!(verify_pair((0, SIZE), (1, SIZE), &mirrored, &VerifyOptions::default()), Err(NotAPair::Impossible));
    }
}
