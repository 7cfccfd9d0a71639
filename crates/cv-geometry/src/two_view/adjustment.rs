//! Two-view bundle adjustment: points, relative pose, and unknown intrinsics.

use super::neighbors::depth_consistent_matches;
use super::{Intrinsics, MatchedViews, PLAUSIBLE_FOCAL, TwoViewError, TwoViewGeometry, TwoViewOptions};
use crate::{
    BundleOptions, BundleReport, RobustLoss, TwoViewBundle, adjust_two_views, essential_from_pose,
    jackknife_pose_deviation, normalize_matches, parallax_angle, triangulate,
};
use cv_core::{Camera, Cancelled, Correspondence, DMatch, Matrix3, Point3, Pose, Progress, median};

/// A point of a [`TwoViewReconstruction`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TwoViewPoint {
    /// Index of its match in [`TwoViewReconstruction::matches`].
    pub match_index: usize,
    /// In the first camera's frame; the unit is the baseline.
    pub position: Point3<f64>,
    /// RMS of its reprojection errors in the two images, in pixels.
    pub reprojection: f64,
    /// Parallax angle between its two rays, in radians.
    pub angle: f64,
    /// Covariance of the position, in squared baselines.
    pub covariance: Matrix3<f64>,
}

/// A reconstruction of two views: cameras, relative pose and points.
#[derive(Debug, Clone, PartialEq)]
pub struct TwoViewReconstruction {
    /// The cameras; unknown intrinsics are refined.
    pub cameras: [Camera; 2],
    /// First camera frame to second; the translation has length one.
    pub pose: Pose,
    /// Indices of the tentative matches that are inliers of the epipolar geometry, ascending.
    pub inliers: Vec<usize>,
    /// The matches of the points, by keypoint index: those of `inliers`, or those of
    /// [`TwoViewAdjustment::add_matches`].
    pub matches: Vec<DMatch>,
    /// Number of matches of [`TwoViewAdjustment::add_matches`] that are depth-consistent with their neighbors,
    /// including those of `inliers`; 0 if none were added.
    pub guided: usize,
    /// The accepted points, in the order of `matches`.
    pub points: Vec<TwoViewPoint>,
    /// RMS reprojection error of the points over both images, in pixels.
    pub reprojection_rms: f64,
    /// Median parallax angle, in radians.
    pub median_angle: f64,
    /// Standard deviations of the rotation and of the direction of the translation, in radians: the larger of the one
    /// from the residuals, including the uncertainty of the intrinsics, and the block jackknife's
    /// ([`jackknife_pose_deviation`]).
    pub pose_deviation: [f64; 2],
    /// The same conditional on the estimated focal length and radial distortion.
    pub pose_deviation_given_lens: [f64; 2],
    /// Relative standard deviation of the focal length; 0 for known cameras.
    pub focal_deviation: f64,
    /// Number of inliers of one homography relative to `inliers`.
    pub planar_ratio: f64,
}

impl TwoViewReconstruction {
    /// Computes the fundamental matrix between undistorted pixels.
    pub fn fundamental(&self) -> Matrix3<f64> {
        fundamental_of(&self.cameras, &self.pose)
    }

    /// Returns an estimated focal length, relative to the longer image side, if it is outside the plausible range (0.4
    /// to 3): an effect of weak perspective or of outliers.
    pub fn unusual_focal(&self) -> Option<f64> {
        let Camera { fx, width, height, .. } = self.cameras[0];
        let ratio = fx / width.max(height) as f64;
        let (low, high) = PLAUSIBLE_FOCAL;
        (self.focal_deviation > 0.0 && !(low..=high).contains(&ratio)).then_some(ratio)
    }
}

/// The bundle adjustment of two views: points, pose and (if unknown) focal length and radial distortion.
#[derive(Debug, Clone)]
pub struct TwoViewAdjustment<'a> {
    views: MatchedViews<'a>,
    geometry: TwoViewGeometry,
    options: TwoViewOptions,
    fit: Fit,
    jackknife_deviation: [f64; 2],
    guided: usize,
}

impl<'a> TwoViewAdjustment<'a> {
    /// Triangulates the inliers of `geometry`, and adjusts.
    ///
    /// # Errors
    /// [`TwoViewError::TooFewInliers`] if no match can be triangulated; [`TwoViewError::MatchOutOfRange`];
    /// [`TwoViewError::Cancelled`].
    pub fn new(
        views: &MatchedViews<'a>,
        geometry: TwoViewGeometry,
        options: &TwoViewOptions,
        progress: &dyn Progress,
    ) -> Result<Self, TwoViewError> {
        progress.report("adjust", 0, 1)?;
        let matches: Vec<DMatch> = geometry.inliers.iter().filter_map(|&i| views.matches.get(i)).copied().collect();
        let pairs = views.correspondences(&matches)?;
        let fit = Fit::new(&matches, &pairs, geometry.cameras, geometry.pose, views, options, progress)?
            .ok_or_else(|| too_few(0, views, options))?;
        // Before guided matches are added: those are biased to the pose, along whose epipolar lines they were searched.
        let TwoViewBundle { cameras, pose, .. } = &fit.bundle;
        let (normalized, unit) = normalize_matches(&fit.observed, &cameras[0], &cameras[1]);
        let jackknife_deviation =
            jackknife_pose_deviation(pose, &normalized, options.robust.threshold * unit, progress)?;
        Ok(Self { views: *views, geometry, options: *options, fit, jackknife_deviation, guided: 0 })
    }

    /// Returns the adjusted cameras.
    pub fn cameras(&self) -> &[Camera; 2] {
        &self.fit.bundle.cameras
    }

    /// Returns the adjusted relative pose, first camera frame to second.
    pub fn pose(&self) -> &Pose {
        &self.fit.bundle.pose
    }

    /// Computes the fundamental matrix between undistorted pixels.
    pub fn fundamental(&self) -> Matrix3<f64> {
        fundamental_of(self.cameras(), self.pose())
    }

    /// Replaces the matches by guided matches (searched along the epipolar lines) and adjusts again, if more of them
    /// are depth-consistent with their neighbors than there were inliers. O(`guided` × matches).
    ///
    /// # Errors
    /// [`TwoViewError::MatchOutOfRange`]; [`TwoViewError::Cancelled`].
    pub fn add_matches(&mut self, guided: &[DMatch], progress: &dyn Progress) -> Result<(), TwoViewError> {
        let pairs = self.views.correspondences(guided)?;
        let TwoViewBundle { cameras, pose, points } = &self.fit.bundle;
        let consistent = depth_consistent_matches(&pairs, &self.fit.observed, points, cameras, pose, progress)?;
        progress.report("adjust", 0, 1)?;
        self.guided = consistent.len();
        // Fewer would contradict the first matches.
        if consistent.len() > self.geometry.inliers.len() {
            let (matches, pairs): (Vec<_>, Vec<_>) = consistent.iter().map(|&i| (guided[i], pairs[i])).unzip();
            if let Some(fit) = Fit::new(&matches, &pairs, *cameras, *pose, &self.views, &self.options, progress)? {
                self.fit = fit;
            }
        }
        Ok(())
    }

    /// Filters points by reprojection error and parallax, and rejects uncertain reconstructions.
    ///
    /// # Errors
    /// [`TwoViewError`]: too few points, low parallax, an uncertain pose.
    pub fn finish(self) -> Result<TwoViewReconstruction, TwoViewError> {
        let Self { views, geometry, options, fit, jackknife_deviation, guided } = self;
        let Fit { bundle, matches, observed, report } = fit;
        let pose_deviation = [0, 1].map(|i| jackknife_deviation[i].max(report.pose_deviation[i]));
        let pose_deviation_given_lens = [0, 1].map(|i| jackknife_deviation[i].max(report.pose_deviation_given_lens[i]));
        let focal_deviation = report.focal_deviation.max(geometry.focal_range / 2.0);
        let mut points = Vec::new();
        for (match_index, (point, m)) in bundle.points.iter().zip(&observed).enumerate() {
            let Some(errors) = reprojection_errors(&bundle, point, m) else { continue };
            let angle = parallax_angle(point, &bundle.pose);
            if angle >= options.min_angle && errors.iter().all(|e| *e <= options.max_reprojection) {
                points.push(TwoViewPoint {
                    match_index,
                    position: *point,
                    reprojection: ((errors[0] * errors[0] + errors[1] * errors[1]) / 2.0).sqrt(),
                    angle,
                    covariance: report.covariances[match_index],
                });
            }
        }
        if points.len() < options.min_inliers.max(1) {
            return Err(too_few(points.len(), &views, &options));
        }
        let mut angles: Vec<f64> = points.iter().map(|p| p.angle).collect();
        let median_angle = median(&mut angles).unwrap_or(0.0);
        if median_angle < options.min_median_angle {
            return Err(TwoViewError::LittleParallax {
                degrees: median_angle.to_degrees(),
                needed: options.min_median_angle.to_degrees(),
            });
        }
        if pose_deviation_given_lens[1] > options.max_deviation {
            return Err(TwoViewError::UncertainPose {
                degrees: pose_deviation_given_lens[1].to_degrees(),
                allowed: options.max_deviation.to_degrees(),
                inliers: points.len(),
                matches: views.matches.len().max(guided),
            });
        }
        let squares: f64 = points.iter().map(|p| p.reprojection * p.reprojection).sum();
        Ok(TwoViewReconstruction {
            cameras: bundle.cameras,
            pose: bundle.pose,
            inliers: geometry.inliers,
            matches,
            guided,
            reprojection_rms: (squares / points.len() as f64).sqrt(),
            points,
            median_angle,
            pose_deviation,
            pose_deviation_given_lens,
            focal_deviation,
            planar_ratio: geometry.planar_ratio,
        })
    }
}

fn too_few(inliers: usize, views: &MatchedViews<'_>, options: &TwoViewOptions) -> TwoViewError {
    TwoViewError::TooFewInliers { inliers, matches: views.matches.len(), needed: options.min_inliers }
}

/// Computes the fundamental matrix between undistorted pixels.
fn fundamental_of([a, b]: &[Camera; 2], pose: &Pose) -> Matrix3<f64> {
    b.inverse_matrix().transpose() * essential_from_pose(pose) * a.inverse_matrix()
}

/// An adjusted bundle with its observations and report.
#[derive(Debug, Clone)]
struct Fit {
    bundle: TwoViewBundle,
    /// The matches of the points, and their coordinates in pixels.
    matches: Vec<DMatch>,
    observed: Vec<Correspondence>,
    report: BundleReport,
}

impl Fit {
    /// Triangulates and adjusts; `None` if no match can be triangulated.
    fn new(
        matches: &[DMatch],
        pairs: &[Correspondence],
        cameras: [Camera; 2],
        pose: Pose,
        views: &MatchedViews<'_>,
        options: &TwoViewOptions,
        progress: &dyn Progress,
    ) -> Result<Option<Self>, Cancelled> {
        let settings = BundleOptions {
            focal: options.intrinsics.focal_prior(views.sizes),
            refine_radial: !matches!(options.intrinsics, Intrinsics::Known(_)),
            ..BundleOptions::default()
        };
        let (normalized, _) = normalize_matches(pairs, &cameras[0], &cameras[1]);
        let (mut triangulated, mut observed, mut points) = (Vec::new(), Vec::new(), Vec::new());
        for ((m, pair), n) in matches.iter().zip(pairs).zip(&normalized) {
            if let Ok(point) = triangulate(n, &pose) {
                triangulated.push(*m);
                observed.push(*pair);
                points.push(point);
            }
        }
        let mut bundle = TwoViewBundle { cameras, pose, points };
        let Some(mut report) = adjust_two_views(&mut bundle, &observed, &settings, progress)? else { return Ok(None) };
        if settings.focal.is_some() {
            // A second adjustment with the scale of the loss set to the estimated noise: with too wide a loss, outliers
            // with small residuals bias the focal length.
            let errors = bundle.points.iter().zip(&observed).filter_map(|(x, m)| reprojection_errors(&bundle, x, m));
            let mut errors: Vec<f64> = errors.flatten().collect();
            let median = median(&mut errors).unwrap_or(1.0);
            // For normal errors, the median absolute error is 0.6745 σ, and Cauchy's loss has 95 % efficiency at a
            // scale of 2.385 σ (Huber & Ronchetti, "Robust statistics", 2009).
            let loss = RobustLoss::Cauchy { scale: (2.385 / 0.6745 * median).clamp(0.1, 1.0) };
            let rescaled = BundleOptions { loss, ..settings };
            report = match adjust_two_views(&mut bundle, &observed, &rescaled, progress)? {
                Some(report) => report,
                None => return Ok(None),
            };
        }
        Ok(Some(Self { bundle, matches: triangulated, observed, report }))
    }
}

/// Computes the reprojection errors in both images, in pixels; `None` behind a camera.
fn reprojection_errors(bundle: &TwoViewBundle, point: &Point3<f64>, m: &Correspondence) -> Option<[f64; 2]> {
    let first = bundle.cameras[0].project(point)?;
    let second = bundle.cameras[1].project(&bundle.pose.transform(point))?;
    Some([(first - m.a).norm(), (second - m.b).norm()])
}
