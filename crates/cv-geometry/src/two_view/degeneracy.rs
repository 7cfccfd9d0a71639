//! Simpler explanations of matches than a moving camera and a scene with depth: a plane, and a camera that only turned.

use super::{TwoViewError, TwoViewOptions};
use crate::{EstimateError, RobustOptions, estimate_homography, normalize_matches, rotation_between};
use cv_core::{Camera, Cancelled, Correspondence, Pose, Progress, Vector3};

/// How many of the matches a homography and a rotation explain.
pub(super) struct DegeneracyTest {
    /// Matches that one homography explains.
    pub(super) planar: usize,
    /// Whether the cameras are known, so that a turn can be told from a plane.
    calibrated: bool,
    /// Matches that a rotation explains, and its angle in degrees; needs cameras.
    turned: usize,
    degrees: f64,
}

impl DegeneracyTest {
    pub(super) fn new(
        pairs: &[Correspondence],
        cameras: Option<&[Camera; 2]>,
        options: &TwoViewOptions,
        progress: &dyn Progress,
    ) -> Result<Self, Cancelled> {
        // Distances in two dimensions and two photographs, where the epipolar one is in one.
        let reach = 2.0 * options.robust.threshold;
        let undistorted: Vec<Correspondence> = match cameras {
            Some([a, b]) => pairs
                .iter()
                .map(|m| Correspondence { a: a.undistort_pixel(m.a), b: b.undistort_pixel(m.b) })
                .filter(Correspondence::is_finite)
                .collect(),
            None => pairs.to_vec(),
        };
        let robust = RobustOptions { threshold: reach, ..options.robust };
        let mut found = Self { planar: 0, calibrated: cameras.is_some(), turned: 0, degrees: 0.0 };
        let h = match estimate_homography(&undistorted, &robust, progress) {
            Ok(h) => h,
            Err(EstimateError::Cancelled(stop)) => return Err(stop),
            Err(_) => return Ok(found),
        };
        found.planar = h.inliers.len();
        if let Some([a, b]) = cameras {
            let on_plane: Vec<Correspondence> = h.inliers.iter().map(|&i| undistorted[i]).collect();
            let pinhole = |c: &Camera| Camera::pinhole(c.width, c.height, c.fx, c.fy, c.cx, c.cy);
            let (normalized, unit) = normalize_matches(&on_plane, &pinhole(a), &pinhole(b));
            if let Ok((rotation, share)) = rotation_between(&normalized, reach * unit) {
                found.turned = (share * on_plane.len() as f64).round() as usize;
                found.degrees = Pose::new(rotation, Vector3::zeros()).rotation_angle().to_degrees();
            }
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
