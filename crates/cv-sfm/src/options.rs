//! Settings of a reconstruction.

use crate::scene::Scene;
use cv_core::OptionError;

/// How poses are estimated. Triangulation, adjustment, completion and the registration of remaining views are the same
/// for both.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Solver {
    /// Global where all cameras are calibrated; incremental where they are not, or where the global model has fewer
    /// than half of the views. On fountain-P11, templeRing and kitti-2 with calibrated cameras, the global AUC at 1
    /// degree is equal or better in 0.7 to 0.8 of the time. With approximate focal lengths it gains nothing, and it
    /// fails on planar scenes with an unknown one.
    #[default]
    Auto,
    /// One view after the other, from an initial pair.
    Incremental,
    /// All at once: rotation averaging over the view graph, then positions. Needs at least three views with common
    /// points.
    Global,
}

cv_core::named!(Solver {
    Auto = "auto": "global where the cameras are known and it holds, else incremental",
    Incremental = "incremental": "one view after the other, from two on",
    Global = "global": "all poses at once from those of the pairs",
});

/// Settings of [`reconstruct_views`](crate::reconstruct_views).
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct SfmOptions {
    /// Largest reprojection error of an inlier observation, in pixels; while the model grows twice that, or four times
    /// where cameras are not calibrated. Default 2.5 (COLMAP: 4), at which the mean errors of fountain-P11, templeRing
    /// and kitti-2 are below COLMAP's and no AUC is lower than at 4.
    pub max_error: f64,
    /// Smallest triangulation angle of a point, in radians. Default 1.5 degrees, COLMAP's.
    pub min_angle: f64,
    /// Minimum number of inliers of a view's pose. Default 20 (COLMAP: 30).
    pub min_pose_inliers: usize,
    /// Minimum inlier ratio of a view's pose among its visible points, 0 to 1. Default 0.25, COLMAP's.
    #[cfg_attr(feature = "serde", serde(rename = "min_pose_share"))]
    pub min_pose_inlier_ratio: f64,
    /// Minimum track length, 2 or more, for models with at least twice as many views; 2 for smaller ones. Default 3
    /// (GLOMAP's): a track of two views is confirmed by one residual only, the distance from the epipolar line.
    pub min_point_views: usize,
    /// Minimum number of views of a model. Default 3.
    pub min_model_size: usize,
    /// Growth factor of the number of views after which all points are adjusted again. Above 1; default 1.2.
    pub growth: f64,
    /// How poses are estimated. Default [`Solver::Auto`].
    pub solver: Solver,
    /// Seed of the random samples. Default 0.
    pub seed: u64,
}

impl Default for SfmOptions {
    fn default() -> Self {
        Self {
            max_error: 2.5,
            min_angle: 1.5f64.to_radians(),
            min_pose_inliers: 20,
            min_pose_inlier_ratio: 0.25,
            min_point_views: 3,
            min_model_size: 3,
            growth: 1.2,
            solver: Solver::Auto,
            seed: 0,
        }
    }
}

impl SfmOptions {
    /// Returns the inlier threshold of poses that are not yet adjusted, in pixels.
    pub(crate) fn initial_error(&self) -> f64 {
        2.0 * self.max_error
    }

    /// Returns the largest reprojection error while an incremental model grows, in pixels: observations that contradict
    /// wrong intrinsics must remain inliers to correct them.
    pub(crate) fn growing_error(&self, scene: &Scene<'_>) -> f64 {
        self.max_error * if scene.is_calibrated() { 2.0 } else { 4.0 }
    }

    /// Checks the ranges.
    ///
    /// # Errors
    /// [`OptionError`]: the option that is outside.
    pub(crate) fn validate(&self) -> Result<(), OptionError> {
        OptionError::check("max_error", self.max_error, "above 0 and finite", |v| v > 0.0 && v.is_finite())?;
        OptionError::check("min_angle", self.min_angle, "from 0 to 1 radian", |v| (0.0..=1.0).contains(&v))?;
        OptionError::check("min_point_views", self.min_point_views as f64, "2 or more", |v| v >= 2.0)?;
        OptionError::check("growth", self.growth, "above 1 and finite", |v| v > 1.0 && v.is_finite())
    }
}
