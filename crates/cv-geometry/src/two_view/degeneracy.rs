//! Detection of degenerate configurations: planar scenes and pure rotations.

use super::{Intrinsics, TwoViewError, TwoViewOptions};
use crate::homography::refine_robustly;
use crate::match_blocks::PairBlocks;
use crate::{
    EstimateError, RobustOptions, Scorer, TukeyBiweight, estimate_homography, estimate_rotation, homography_residual,
    normalize_matches,
};
use cv_core::{Camera, Cancelled, Correspondence, Distortion, Matrix3, Pose, Progress, Vector3};
use cv_parallel::prelude::*;

/// Numbers of inliers of a homography and of a rotation.
pub(super) struct DegeneracyTest {
    /// Number of inliers of the homography.
    pub(super) planar: usize,
    /// Whether the focal lengths are known, so that a pure rotation can be distinguished from a plane.
    is_calibrated: bool,
    /// Number of inliers of the rotation, and its angle in degrees; 0 without focal lengths.
    rotated: usize,
    degrees: f64,
}

/// A homography between images with a given or hypothetical distortion.
struct PlaneHypothesis {
    /// Relative displacement of the image corners by radial distortion.
    distortion: f64,
    /// The matches with valid normalized coordinates, and the size of a pixel in these.
    matches: Vec<Correspondence>,
    unit: f64,
    homography: Matrix3<f64>,
    /// Tukey's biweight loss of all matches.
    loss: f64,
}

/// Grid of relative corner displacements for an unknown lens, from strong barrel to pincushion distortion.
const DISTORTION_GRID: [f64; 5] = [-0.2, -0.13, -0.06, 0.0, 0.06];
/// Bounds of the relative corner displacement.
const DISTORTION_RANGE: (f64, f64) = (-0.35, 0.15);
/// First and last step of the line search from the best grid point; the last is one pixel of a 12-megapixel image.
const STEP_RANGE: (f64, f64) = (0.03, 0.0004);
/// Maximum number of steps of the line search.
const MAX_STEPS: usize = 40;

impl DegeneracyTest {
    /// Estimates a homography, and a rotation if the focal lengths are known. Unknown distortion is estimated with the
    /// homography, since it would look like parallax. O(matches) for each of about forty homographies and for the
    /// samples of five RANSAC runs.
    pub(super) fn new(
        pairs: &[Correspondence],
        sizes: [(usize, usize); 2],
        cameras: Option<[Camera; 2]>,
        options: &TwoViewOptions,
        progress: &dyn Progress,
    ) -> Result<Self, Cancelled> {
        let is_calibrated = cameras.is_some();
        let cameras = cameras.unwrap_or_else(|| sizes.map(|(w, h)| Camera::from_focal(w, h, w.max(h) as f64)));
        // The residual is two-dimensional, the epipolar distance one-dimensional.
        let search = PlaneSearch { pairs, cameras, threshold: 2.0 * options.robust.threshold, robust: &options.robust };
        let plane = match options.intrinsics {
            Intrinsics::Known(_) => search.search(None, progress)?,
            _ => {
                let search_distortion = |distortion: &f64| search.search(Some(*distortion), progress);
                let all: Vec<Option<PlaneHypothesis>> =
                    DISTORTION_GRID.par_iter().map(search_distortion).try_collect()?;
                match all.into_iter().flatten().min_by(|a, b| a.loss.total_cmp(&b.loss)) {
                    Some(best) => Some(search.refine_distortion(best, progress)?),
                    None => None,
                }
            }
        };
        let mut result = Self { planar: 0, is_calibrated, rotated: 0, degrees: 0.0 };
        let Some(plane) = plane else { return Ok(result) };
        let threshold = search.threshold * plane.unit;
        let on_plane = |m: &&Correspondence| homography_residual(&plane.homography, m) < threshold;
        let on_plane: Vec<Correspondence> = plane.matches.iter().filter(on_plane).copied().collect();
        result.planar = on_plane.len();
        if is_calibrated && let Ok((rotation, inlier_ratio)) = estimate_rotation(&on_plane, threshold) {
            result.rotated = (inlier_ratio * on_plane.len() as f64).round() as usize;
            result.degrees = Pose::new(rotation, Vector3::zeros()).rotation_angle().to_degrees();
        }
        Ok(result)
    }

    /// Rejects pure rotations and planar scenes, given the number of inliers of a general motion.
    pub(super) fn check(&self, inliers: usize, options: &TwoViewOptions) -> Result<(), TwoViewError> {
        let inlier_fraction = |n: usize| (n as f64 / inliers.max(1) as f64).min(1.0);
        let is_degenerate = |n: usize| n >= options.min_inliers && inlier_fraction(n) >= options.degenerate_ratio;
        if is_degenerate(self.rotated) {
            return Err(TwoViewError::PureRotation { fraction: inlier_fraction(self.rotated), degrees: self.degrees });
        }
        if is_degenerate(self.planar) {
            let fraction = inlier_fraction(self.planar);
            return Err(if self.is_calibrated {
                TwoViewError::Planar { fraction }
            } else {
                TwoViewError::PlanarOrPureRotation { fraction }
            });
        }
        Ok(())
    }
}

struct PlaneSearch<'a> {
    pairs: &'a [Correspondence],
    cameras: [Camera; 2],
    /// Inlier threshold of the symmetric transfer error, in pixels.
    threshold: f64,
    robust: &'a RobustOptions,
}

impl PlaneSearch<'_> {
    /// Returns the matches with valid normalized coordinates, and the size of a pixel in these; `distortion` replaces
    /// that of the cameras.
    fn normalized(&self, distortion: Option<f64>) -> (Vec<Correspondence>, f64) {
        let [a, b] = self.cameras.map(|camera| match distortion {
            None => camera,
            Some(displacement) => {
                let corner = 0.5 * (camera.width as f64).hypot(camera.height as f64) / camera.fx;
                let distortion = match displacement {
                    0.0 => Distortion::NONE,
                    _ => Distortion::radial(displacement / (corner * corner), 0.0),
                };
                Camera { distortion, ..camera }
            }
        });
        let (mut matches, unit) = normalize_matches(self.pairs, &a, &b);
        matches.retain(Correspondence::is_finite);
        (matches, unit)
    }

    /// Searches a homography; `None` if there is none.
    fn search(&self, distortion: Option<f64>, progress: &dyn Progress) -> Result<Option<PlaneHypothesis>, Cancelled> {
        let (matches, unit) = self.normalized(distortion);
        let robust = RobustOptions { threshold: self.threshold * unit, ..*self.robust };
        match estimate_homography(&matches, &robust, progress) {
            Ok(found) => {
                let loss = self.loss(&found.model, &matches, unit);
                let distortion = distortion.unwrap_or(0.0);
                Ok(Some(PlaneHypothesis { distortion, matches, unit, homography: found.model, loss }))
            }
            Err(EstimateError::Cancelled(stop)) => Err(stop),
            Err(_) => Ok(None),
        }
    }

    /// Refines a homography with another distortion.
    fn refine_with_distortion(&self, other: &PlaneHypothesis, distortion: f64) -> PlaneHypothesis {
        let (matches, unit) = self.normalized(Some(distortion));
        let pairs: Vec<[f64; 4]> = matches.iter().map(|m| [m.a.x, m.a.y, m.b.x, m.b.y]).collect();
        let homography = refine_robustly(&PairBlocks::new(&pairs), &other.homography, self.threshold * unit);
        let loss = self.loss(&homography, &matches, unit);
        PlaneHypothesis { distortion, matches, unit, homography, loss }
    }

    /// Refines the distortion by a line search, whose step is halved when neither direction improves.
    fn refine_distortion(
        &self,
        mut best: PlaneHypothesis,
        progress: &dyn Progress,
    ) -> Result<PlaneHypothesis, Cancelled> {
        let mut step = STEP_RANGE.0;
        for _ in 0..MAX_STEPS {
            if step < STEP_RANGE.1 {
                break;
            }
            progress.report("plane", 0, 1)?;
            let distortions =
                [-step, step].map(|d| (best.distortion + d).clamp(DISTORTION_RANGE.0, DISTORTION_RANGE.1));
            let planes: Vec<PlaneHypothesis> =
                distortions.par_iter().map(|d| self.refine_with_distortion(&best, *d)).collect();
            match planes.into_iter().min_by(|a, b| a.loss.total_cmp(&b.loss)) {
                Some(plane) if plane.loss < best.loss => best = plane,
                _ => step *= 0.5,
            }
        }
        Ok(best)
    }

    /// Computes the total loss; matches without valid normalized coordinates have a loss of 1.
    fn loss(&self, h: &Matrix3<f64>, matches: &[Correspondence], unit: f64) -> f64 {
        let loss = |m: &Correspondence| {
            let r = homography_residual(h, m) / (self.threshold * unit);
            f64::from(TukeyBiweight.loss((r * r) as f32))
        };
        matches.iter().map(loss).sum::<f64>() + (self.pairs.len() - matches.len()) as f64
    }
}
