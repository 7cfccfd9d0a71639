//! Points of two views, adjusted together with the pose and what is unknown of the cameras.

use super::neighbors::like_their_neighbors;
use super::{Intrinsics, MatchedViews, PLAUSIBLE_FOCAL, TwoViewError, TwoViewGeometry, TwoViewOptions};
use crate::{
    BundleOptions, BundleReport, RobustLoss, TwoViewBundle, adjust_two_views, essential_from_pose,
    jackknife_pose_deviation, normalize_matches, parallax_angle, triangulate,
};
use cv_core::{Camera, Cancelled, Correspondence, DMatch, Matrix3, Point3, Pose, Progress, median};

/// A point of a [`TwoViewReconstruction`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TwoViewPoint {
    /// Its match: index in [`TwoViewReconstruction::matches`].
    pub match_index: usize,
    /// In the first camera's frame; the unit is the distance between the cameras.
    pub position: Point3<f64>,
    /// Root mean square of its reprojection errors in the two photographs, in pixels.
    pub reprojection: f64,
    /// Angle between its two rays, in radians.
    pub angle: f64,
    /// Covariance of the position.
    pub covariance: Matrix3<f64>,
}

/// Cameras, relative pose and points of two views.
#[derive(Debug, Clone, PartialEq)]
pub struct TwoViewReconstruction {
    /// The cameras, refined where they were not known.
    pub cameras: [Camera; 2],
    /// First camera frame to second; the translation has length one.
    pub pose: Pose,
    /// Indices of the tentative matches that obey the epipolar geometry, ascending.
    pub inliers: Vec<usize>,
    /// The matches that the points are from, by index of the keypoints: those of `inliers`, or those of [`TwoViewAdjustment::add_matches`].
    pub matches: Vec<DMatch>,
    /// Matches of [`TwoViewAdjustment::add_matches`] that lie at the depth of their neighbors, those of `inliers` that came back included; 0
    /// where none were added.
    pub guided: usize,
    /// The points that were kept, in the order of `matches`.
    pub points: Vec<TwoViewPoint>,
    /// Root mean square reprojection error of the points, over both photographs, in pixels.
    pub reprojection_rms: f64,
    /// Median angle between the two rays of a point, in radians.
    pub median_angle: f64,
    /// Standard deviations of the rotation and of the direction of the translation, in radians: the larger of what the residuals say, with whatever is
    /// uncertain of the lens, and of what leaving out one part of the photograph after the other does ([`jackknife_pose_deviation`]).
    pub pose_deviation: [f64; 2],
    /// The same if focal length and radial distortion were exactly what was found: what is left is the motion's own.
    pub pose_deviation_given_lens: [f64; 2],
    /// Relative standard deviation of the focal length; 0 where the cameras were given.
    pub focal_deviation: f64,
    /// Share of the inliers that one homography explains.
    pub planar_share: f64,
}

impl TwoViewReconstruction {
    /// The fundamental matrix between undistorted pixels.
    pub fn fundamental(&self) -> Matrix3<f64> {
        fundamental_of(&self.cameras, &self.pose)
    }

    /// An estimated focal length as a share of the photograph's longer side, where it is none that photographs usually have (0.4 to 3): matches that hardly show
    /// perspective, or wrong ones, lead there.
    pub fn unusual_focal(&self) -> Option<f64> {
        let Camera { fx, width, height, .. } = self.cameras[0];
        let share = fx / width.max(height) as f64;
        let (low, high) = PLAUSIBLE_FOCAL;
        (self.focal_deviation > 0.0 && !(low..=high).contains(&share)).then_some(share)
    }
}

/// Two views whose points, pose and (where they are not known) focal length and radial distortion are adjusted to their matches.
#[derive(Debug, Clone)]
pub struct TwoViewAdjustment<'a> {
    views: MatchedViews<'a>,
    geometry: TwoViewGeometry,
    options: TwoViewOptions,
    fit: Fit,
    stability: [f64; 2],
    guided: usize,
}

impl<'a> TwoViewAdjustment<'a> {
    /// Triangulates the matches that agree with `geometry`, and adjusts.
    ///
    /// # Errors
    /// [`TwoViewError::TooFewInliers`] where nothing can be triangulated; [`TwoViewError::MatchOutOfRange`]; [`TwoViewError::Cancelled`].
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
        // Before further matches: those agree with the pose because they were looked for where it says.
        let TwoViewBundle { cameras, pose, .. } = &fit.bundle;
        let (normalized, unit) = normalize_matches(&fit.observed, &cameras[0], &cameras[1]);
        let stability = jackknife_pose_deviation(pose, &normalized, options.robust.threshold * unit, progress)?;
        Ok(Self { views: *views, geometry, options: *options, fit, stability, guided: 0 })
    }

    /// The cameras as adjusted.
    pub fn cameras(&self) -> &[Camera; 2] {
        &self.fit.bundle.cameras
    }

    /// First camera frame to second, as adjusted.
    pub fn pose(&self) -> &Pose {
        &self.fit.bundle.pose
    }

    /// The fundamental matrix between undistorted pixels.
    pub fn fundamental(&self) -> Matrix3<f64> {
        fundamental_of(self.cameras(), self.pose())
    }

    /// Takes matches that were looked for along the epipolar lines (guided matching) in place of the ones so far, where more of them lie at the depth of their
    /// neighbors than there were inliers, and adjusts again. O(more · matches).
    ///
    /// # Errors
    /// [`TwoViewError::MatchOutOfRange`]; [`TwoViewError::Cancelled`].
    pub fn add_matches(&mut self, more: &[DMatch], progress: &dyn Progress) -> Result<(), TwoViewError> {
        let pairs = self.views.correspondences(more)?;
        let TwoViewBundle { cameras, pose, points } = &self.fit.bundle;
        let kept = like_their_neighbors(&pairs, &self.fit.observed, points, cameras, pose, progress)?;
        progress.report("adjust", 0, 1)?;
        self.guided = kept.len();
        // Fewer would mean that the first matches were not what the lines say.
        if kept.len() > self.geometry.inliers.len() {
            let (matches, pairs): (Vec<_>, Vec<_>) = kept.iter().map(|&i| (more[i], pairs[i])).unzip();
            if let Some(better) = Fit::new(&matches, &pairs, *cameras, *pose, &self.views, &self.options, progress)? {
                self.fit = better;
            }
        }
        Ok(())
    }

    /// Leaves out points that are wrong or far, and refuses what is too uncertain.
    ///
    /// # Errors
    /// [`TwoViewError`]: a focal length that cannot be told, too few points, little parallax, an uncertain pose.
    pub fn finish(self) -> Result<TwoViewReconstruction, TwoViewError> {
        let Self { views, geometry, options, fit, stability, guided } = self;
        let Fit { bundle, matches, observed, report } = fit;
        let pose_deviation = [0, 1].map(|i| stability[i].max(report.pose_deviation[i]));
        let pose_deviation_given_lens = [0, 1].map(|i| stability[i].max(report.pose_deviation_given_lens[i]));
        let focal_deviation = report.focal_deviation.max(geometry.focal_range / 2.0);
        let mut points = Vec::new();
        for (match_index, (point, m)) in bundle.points.iter().zip(&observed).enumerate() {
            let Some(errors) = reprojection(&bundle, point, m) else { continue };
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
            planar_share: geometry.planar_share,
        })
    }
}

fn too_few(inliers: usize, views: &MatchedViews<'_>, options: &TwoViewOptions) -> TwoViewError {
    TwoViewError::TooFewInliers { inliers, matches: views.matches.len(), needed: options.min_inliers }
}

/// The fundamental matrix between undistorted pixels.
fn fundamental_of([a, b]: &[Camera; 2], pose: &Pose) -> Matrix3<f64> {
    b.inverse_matrix().transpose() * essential_from_pose(pose) * a.inverse_matrix()
}

/// A bundle, what it was fitted to, and how well.
#[derive(Debug, Clone)]
struct Fit {
    bundle: TwoViewBundle,
    /// The matches of the points, and their pixels.
    matches: Vec<DMatch>,
    observed: Vec<Correspondence>,
    report: BundleReport,
}

impl Fit {
    /// Triangulates and adjusts; `None` where nothing can be triangulated.
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
        let (mut seen, mut observed, mut points) = (Vec::new(), Vec::new(), Vec::new());
        for ((m, pair), n) in matches.iter().zip(pairs).zip(&normalized) {
            if let Ok(point) = triangulate(n, &pose) {
                seen.push(*m);
                observed.push(*pair);
                points.push(point);
            }
        }
        let mut bundle = TwoViewBundle { cameras, pose, points };
        let Some(mut report) = adjust_two_views(&mut bundle, &observed, &settings, progress)? else { return Ok(None) };
        if settings.focal.is_some() {
            // Once more with the noise that these matches have, for which a pixel may be wide: what is near but wrong shows in the focal length first.
            let errors = bundle.points.iter().zip(&observed).filter_map(|(x, m)| reprojection(&bundle, x, m));
            let mut errors: Vec<f64> = errors.flatten().collect();
            let median = median(&mut errors).unwrap_or(1.0);
            // The median of an absolute normal error is 0.6745 deviations; Cauchy's loss is 95 % as good as least squares on such errors at 2.385 of them (Huber & Ronchetti,
            // "Robust statistics", 2009).
            let loss = RobustLoss::Cauchy { scale: (2.385 / 0.6745 * median).clamp(0.1, 1.0) };
            let again = BundleOptions { loss, ..settings };
            report = match adjust_two_views(&mut bundle, &observed, &again, progress)? {
                Some(report) => report,
                None => return Ok(None),
            };
        }
        Ok(Some(Self { bundle, matches: seen, observed, report }))
    }
}

/// Reprojection errors in pixels in both photographs; `None` behind a camera.
fn reprojection(bundle: &TwoViewBundle, point: &Point3<f64>, m: &Correspondence) -> Option<[f64; 2]> {
    let first = bundle.cameras[0].project(point)?;
    let second = bundle.cameras[1].project(&bundle.pose.transform(point))?;
    Some([(first - m.a).norm(), (second - m.b).norm()])
}
