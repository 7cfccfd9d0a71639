//! Homography, epipolar geometry, pose, triangulation, and the one RANSAC driver.
//!
//! Takes matches, never images. Robust estimators come in pairs with the plain solvers that they are made of:
//!
//! ```
//! use cv_core::Correspondence;
//! use cv_geometry::{RobustOptions, estimate_homography, homography_from_points};
//!
//! let corners = [(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0), (50.0, 20.0), (30.0, 70.0)];
//! let matches = corners.map(|(x, y)| Correspondence::new(x, y, 2.0 * x + 5.0, 2.0 * y));
//! let exact = homography_from_points(&matches)?;
//! let robust = estimate_homography(&matches, &RobustOptions::homography())?;
//! assert!((exact - robust.model).norm() < 1e-6 && (exact[(0, 0)] - 2.0).abs() < 1e-9);
//! # Ok::<(), cv_geometry::EstimateError>(())
//! ```
//!
//! # Conventions
//!
//! * A homography maps the first image to the second, `b ~ H a`, scaled to `H[2][2] = 1`.
//! * Thresholds and residuals are in the unit of the matches, that is, pixels.
//! * A robust estimate is refused where chance would support a model as well (`RobustModel::log_nfa`, the number of false alarms).
//! * The same matches, options and seed give the same bytes on any number of threads and with any vector unit.

mod absolute;
mod basis;
mod bundle;
mod epipolar;
mod error;
mod essential;
mod fundamental;
mod homography;
mod pairs;
mod ransac;
mod robust;
mod rotation;
mod six_point;
#[cfg(test)]
mod testing;
mod triangulation;
mod two_view;
mod unknown_focal;

pub use absolute::{
    Similarity, WorldMatch, align_points, estimate_pose, pose_from_points, pose_three_points, refine_pose,
};
pub use bundle::{BundleOptions, BundleReport, TwoViewBundle, adjust_two_views};
pub use cv_numeric::RobustLoss;
pub use epipolar::sampson;
pub use error::{Degeneracy, EstimateError};
pub use essential::{
    RecoveredPose, decompose_essential, essential_five_point, essential_from_fundamental, essential_from_pose,
    estimate_essential, estimate_relative_pose, normalize_matches, pose_difference, pose_stability, poses_are_rivals,
    recover_pose, refine_relative_pose, rotation_between,
};
pub use fundamental::{estimate_fundamental, fundamental_eight_point, fundamental_seven_point};
pub use homography::{
    estimate_homography, homography_four_point, homography_from_points, homography_residual, refine_homography,
};
pub use pairs::{LANES, PairBlock};
pub use ransac::{
    Consensus, Estimator, Marginal, Msac, Prosac, RobustOptions, Sampler, Sampling, Score, Scorer, Scoring, Uniform,
    ransac,
};
pub use robust::RobustModel;
pub use six_point::fundamental_six_point;
pub use triangulation::{TriangulationError, correct_match, parallax_angle, triangulate, triangulate_linear};
pub use two_view::{
    Intrinsics, MatchedViews, TwoViewAdjustment, TwoViewError, TwoViewGeometry, TwoViewOptions, TwoViewPoint,
    TwoViewReconstruction, estimate_two_view_geometry, reconstruct_two_views,
};
pub use unknown_focal::{FocalPose, estimate_focal_pose, refine_focal_pose};
