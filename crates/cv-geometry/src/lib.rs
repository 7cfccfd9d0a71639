//! Multiple-view geometry: homography, epipolar geometry, absolute and relative pose, triangulation, and RANSAC.
//!
//! The input is correspondences, never images. Each robust estimator (`estimate_…`) has a non-robust counterpart:
//!
//! ```
//! use cv_core::{Correspondence, Silent};
//! use cv_geometry::{RobustOptions, estimate_homography, homography_from_points};
//!
//! let corners = [(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0), (50.0, 20.0), (30.0, 70.0)];
//! let matches = corners.map(|(x, y)| Correspondence::new(x, y, 2.0 * x + 5.0, 2.0 * y));
//! let exact = homography_from_points(&matches)?;
//! let robust = estimate_homography(&matches, &RobustOptions::homography(), &Silent)?;
//! assert!((exact - robust.model).norm() < 1e-6 && (exact[(0, 0)] - 2.0).abs() < 1e-9);
//! # Ok::<(), cv_geometry::EstimateError>(())
//! ```
//!
//! # Conventions
//!
//! * A homography maps the first image to the second, `b ~ H a`, scaled to `H[2][2] = 1`.
//! * Thresholds and residuals are in the unit of the matches: pixels, or normalized coordinates where stated.
//! * A robust estimate is rejected if its number of false alarms (NFA) is 0.01 or more (`RobustModel::log_nfa`).
//! * The same matches, options and seed give bit-identical results for any number of threads and any SIMD instruction
//!   set.

mod absolute;
mod bundle;
mod epipolar;
mod error;
mod essential;
mod fundamental;
mod homography;
mod match_blocks;
mod null_space_basis;
mod pair_graph;
mod ransac;
mod robust;
mod rotation;
mod shared_focal;
mod six_point;
#[cfg(test)]
mod testing;
mod triangulation;
mod two_view;
mod verified_pair;

pub use absolute::{
    Similarity, SimilarityFreedom, WorldMatch, align_points, estimate_pose, estimate_similarity, pose_from_points,
    pose_three_points, refine_pose,
};
pub use bundle::{BundleOptions, BundleReport, FocalPrior, TwoViewBundle, adjust_two_views};
pub use cv_numeric::RobustLoss;
pub use epipolar::sampson;
pub use error::{Degeneracy, EstimateError};
pub use essential::{
    RecoveredPose, decompose_essential, essential_five_point, essential_from_fundamental, essential_from_pose,
    estimate_essential, estimate_relative_pose, estimate_rotation, jackknife_pose_deviation, normalize_matches,
    pose_difference, poses_are_indistinguishable, recover_pose, refine_relative_pose,
};
pub use fundamental::{estimate_fundamental, fundamental_eight_point, fundamental_seven_point};
pub use homography::{
    estimate_homography, homography_four_point, homography_from_points, homography_residual, refine_homography,
};
pub use match_blocks::{LANES, MatchBlock};
pub use pair_graph::{NoSuchNode, PairEdge, PairGraph, TreeStep};
pub use ransac::{
    Consensus, Estimator, LocalOptimization, Msac, Prosac, RansacData, RobustOptions, Sampler, Sampling, Score, Scorer,
    Scoring, TukeyBiweight, Uniform, ransac,
};
pub use robust::RobustModel;
pub use shared_focal::{SharedFocalPose, estimate_shared_focal_pose, refine_shared_focal_pose};
pub use six_point::fundamental_six_point;
pub use triangulation::{TriangulationError, correct_match, parallax_angle, triangulate, triangulate_linear};
pub use two_view::{
    EXIF_FOCAL_DEVIATION, Intrinsics, MatchedViews, PLAUSIBLE_FOCAL, TwoViewAdjustment, TwoViewError, TwoViewGeometry,
    TwoViewOptions, TwoViewPoint, TwoViewReconstruction, estimate_two_view_geometry, reconstruct_two_views,
};
pub use verified_pair::{PairRejection, VerifiedPair, VerifyOptions, verify_pair};
