//! Simpler explanations of matches than a moving camera and a scene with depth: a plane, and a camera that only turned.

use super::{Intrinsics, TwoViewError, TwoViewOptions};
use crate::homography::refine_on_plane;
use crate::{
    EstimateError, RobustOptions, Scorer, TukeyBiweight, estimate_homography, homography_residual, normalize_matches,
    rotation_between,
};
use cv_core::{Camera, Cancelled, Correspondence, Distortion, Matrix3, Pose, Progress, Vector3};
use rayon::prelude::*;

/// How many of the matches a homography and a rotation explain.
pub(super) struct DegeneracyTest {
    /// Matches that one homography explains.
    pub(super) planar: usize,
    /// Whether the focal lengths are known, so that a turn can be told from a plane.
    calibrated: bool,
    /// Matches that a rotation explains, and its angle in degrees; needs cameras.
    turned: usize,
    degrees: f64,
}

/// A homography between pictures whose lens is known or supposed.
struct Plane {
    /// By how much of half the diagonal the corners are displaced.
    distortion: f64,
    /// The usable matches in normalized coordinates, and pixels in them.
    matches: Vec<Correspondence>,
    unit: f64,
    homography: Matrix3<f64>,
    /// Tukey's loss of all matches.
    loss: f64,
}

/// Displacements of the corners that are tried where the lens is not known, from a strong barrel to a pincushion.
const DISTORTIONS: [f64; 5] = [-0.2, -0.13, -0.06, 0.0, 0.06];
/// Displacements that a search may end at.
const DISTORTION_RANGE: (f64, f64) = (-0.35, 0.15);
/// First and last step from the best of them, in the same unit: of a photograph of 12 megapixels the last is one pixel.
const STEPS: (f64, f64) = (0.03, 0.0004);
/// Most steps.
const MAX_STEPS: usize = 40;

impl DegeneracyTest {
    /// Where the distortion of the lenses is not known it is fitted with the homography: to a camera that only turned, or before a plane, it looks like
    /// parallax. O(matches) for each of some forty homographies, and the samples of five.
    pub(super) fn new(
        pairs: &[Correspondence],
        sizes: [(usize, usize); 2],
        cameras: Option<[Camera; 2]>,
        options: &TwoViewOptions,
        progress: &dyn Progress,
    ) -> Result<Self, Cancelled> {
        let calibrated = cameras.is_some();
        let cameras = cameras.unwrap_or_else(|| sizes.map(|(w, h)| Camera::from_focal(w, h, w.max(h) as f64)));
        // Distances in two dimensions and two photographs, where the epipolar one is in one.
        let test = Test { pairs, cameras, reach: 2.0 * options.robust.threshold, robust: &options.robust };
        let plane = match options.intrinsics {
            Intrinsics::Known(_) => test.searched(None, progress)?,
            _ => {
                let searched = |distortion: &f64| test.searched(Some(*distortion), progress);
                let all: Vec<Option<Plane>> = DISTORTIONS.par_iter().map(searched).collect::<Result<_, _>>()?;
                match all.into_iter().flatten().min_by(|a, b| a.loss.total_cmp(&b.loss)) {
                    Some(best) => Some(test.narrowed(best, progress)?),
                    None => None,
                }
            }
        };
        let mut found = Self { planar: 0, calibrated, turned: 0, degrees: 0.0 };
        let Some(plane) = plane else { return Ok(found) };
        let reach = test.reach * plane.unit;
        let on_plane = |m: &&Correspondence| homography_residual(&plane.homography, m) < reach;
        let on_plane: Vec<Correspondence> = plane.matches.iter().filter(on_plane).copied().collect();
        found.planar = on_plane.len();
        if calibrated && let Ok((rotation, share)) = rotation_between(&on_plane, reach) {
            found.turned = (share * on_plane.len() as f64).round() as usize;
            found.degrees = Pose::new(rotation, Vector3::zeros()).rotation_angle().to_degrees();
        }
        Ok(found)
    }

    /// Names a camera that only turned and a scene that is one plane, beside `inliers` matches that a general motion explains.
    pub(super) fn check(&self, inliers: usize, options: &TwoViewOptions) -> Result<(), TwoViewError> {
        let share = |n: usize| (n as f64 / inliers.max(1) as f64).min(1.0);
        let enough = |n: usize| n >= options.min_inliers && share(n) >= options.degenerate_share;
        if enough(self.turned) {
            return Err(TwoViewError::PureRotation { share: share(self.turned), degrees: self.degrees });
        }
        if enough(self.planar) {
            let share = share(self.planar);
            return Err(if self.calibrated {
                TwoViewError::Planar { share }
            } else {
                TwoViewError::PlanarOrTurned { share }
            });
        }
        Ok(())
    }
}

struct Test<'a> {
    pairs: &'a [Correspondence],
    cameras: [Camera; 2],
    /// Largest distance of a match from where the homography says, in pixels.
    reach: f64,
    robust: &'a RobustOptions,
}

impl Test<'_> {
    /// The matches that a lens reaches, in normalized coordinates, and pixels in them; `distortion` in place of that of the cameras.
    fn normalized(&self, distortion: Option<f64>) -> (Vec<Correspondence>, f64) {
        let [a, b] = self.cameras.map(|camera| match distortion {
            None => camera,
            Some(share) => {
                let corner = 0.5 * (camera.width as f64).hypot(camera.height as f64) / camera.fx;
                let distortion = match share {
                    0.0 => Distortion::NONE,
                    share => Distortion::radial(share / (corner * corner), 0.0),
                };
                Camera { distortion, ..camera }
            }
        });
        let (mut matches, unit) = normalize_matches(self.pairs, &a, &b);
        matches.retain(Correspondence::is_finite);
        (matches, unit)
    }

    /// The homography of a search; `None` where there is none.
    fn searched(&self, distortion: Option<f64>, progress: &dyn Progress) -> Result<Option<Plane>, Cancelled> {
        let (matches, unit) = self.normalized(distortion);
        let robust = RobustOptions { threshold: self.reach * unit, ..*self.robust };
        match estimate_homography(&matches, &robust, progress) {
            Ok(found) => {
                let loss = self.loss(&found.model, &matches, unit);
                let distortion = distortion.unwrap_or(0.0);
                Ok(Some(Plane { distortion, matches, unit, homography: found.model, loss }))
            }
            Err(EstimateError::Cancelled(stop)) => Err(stop),
            Err(_) => Ok(None),
        }
    }

    /// The homography near another's, of another distortion.
    fn near(&self, other: &Plane, distortion: f64) -> Plane {
        let (matches, unit) = self.normalized(Some(distortion));
        let pairs: Vec<[f64; 4]> = matches.iter().map(|m| [m.a.x, m.a.y, m.b.x, m.b.y]).collect();
        let homography = refine_on_plane(&pairs, &other.homography, self.reach * unit);
        let loss = self.loss(&homography, &matches, unit);
        Plane { distortion, matches, unit, homography, loss }
    }

    /// Steps of the distortion, halved where none helps.
    fn narrowed(&self, mut best: Plane, progress: &dyn Progress) -> Result<Plane, Cancelled> {
        let mut step = STEPS.0;
        for _ in 0..MAX_STEPS {
            if step < STEPS.1 {
                break;
            }
            progress.report("plane", 0, 1)?;
            let distortions =
                [-step, step].map(|d| (best.distortion + d).clamp(DISTORTION_RANGE.0, DISTORTION_RANGE.1));
            let planes: Vec<Plane> = distortions.par_iter().map(|d| self.near(&best, *d)).collect();
            match planes.into_iter().min_by(|a, b| a.loss.total_cmp(&b.loss)) {
                Some(plane) if plane.loss < best.loss => best = plane,
                _ => step *= 0.5,
            }
        }
        Ok(best)
    }

    /// What all matches lose; those that the lens does not reach lose all.
    fn loss(&self, h: &Matrix3<f64>, matches: &[Correspondence], unit: f64) -> f64 {
        let loss = |m: &Correspondence| {
            let r = homography_residual(h, m) / (self.reach * unit);
            f64::from(TukeyBiweight.loss((r * r) as f32))
        };
        matches.iter().map(loss).sum::<f64>() + (self.pairs.len() - matches.len()) as f64
    }
}
