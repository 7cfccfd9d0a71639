//! Robust triangulation of tracks.

use crate::scene::Scene;
use cv_core::{Correspondence, Point3, Pose, Vector3};
use cv_geometry::triangulate;
use cv_parallel::prelude::*;
use nalgebra::{Matrix2x3, Matrix3};

/// When an observation is an inlier of a point, and when a point is valid.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PointLimits {
    /// Largest reprojection error in pixels.
    pub(crate) error: f64,
    /// Smallest value of the largest triangulation angle of the point, in radians.
    pub(crate) angle: f64,
}

/// Maximum number of pairs of observations that hypotheses are triangulated from.
const MAX_PAIRS: usize = 24;

/// An observation of a track in a registered view.
struct PosedObservation<'s> {
    observation: usize,
    pose: &'s Pose,
    /// Unit ray in the world frame.
    direction: Vector3<f64>,
}

/// Updates points and inliers to the poses. A point that most observations still support is kept; observations that now
/// agree are added (completion), others removed (filtering). Other tracks are triangulated again. O(observations), plus
/// a few pairs for each new point.
pub(crate) fn update_tracks(scene: &mut Scene<'_>, limits: PointLimits, tracks: &[usize]) {
    let updates: Vec<_> = tracks.par_iter().with_min_len(64).map(|&t| update_track(scene, t, limits)).collect();
    for (&track, update) in tracks.iter().zip(updates) {
        let range = scene.tracks.range(track);
        scene.active[range].fill(false);
        scene.points[track] = update.as_ref().map(|u| u.0);
        for observation in update.iter().flat_map(|u| &u.1) {
            scene.active[*observation] = true;
        }
    }
}

/// The point of a track and its inliers.
type Update = Option<(Point3<f64>, Vec<usize>)>;

fn update_track(scene: &Scene<'_>, track: usize, limits: PointLimits) -> Update {
    let observations: Vec<PosedObservation<'_>> = scene
        .posed_observations(track)
        .filter(|(observation, _)| scene.ray(*observation).x.is_finite())
        .map(|(observation, pose)| {
            let direction = (pose.rotation.inverse() * scene.ray(observation).to_homogeneous()).normalize();
            PosedObservation { observation, pose, direction }
        })
        .collect();
    if observations.len() < 2 {
        return None;
    }
    if let Some(point) = scene.points[track] {
        let inliers = inliers_of(scene, &observations, &point, limits.error);
        if inliers.len() >= 2
            && 2 * inliers.len() > observations.len()
            && has_parallax(&observations, &inliers, limits.angle)
        {
            return Some((point, inliers.into_iter().map(|i| observations[i].observation).collect()));
        }
    }
    let mut best: Option<(usize, f64, Point3<f64>)> = None;
    for (i, j) in observation_pairs(observations.len()) {
        if ray_angle(&observations[i], &observations[j]) < limits.angle {
            continue;
        }
        let m = Correspondence { a: scene.ray(observations[i].observation), b: scene.ray(observations[j].observation) };
        let Ok(local) = triangulate(&m, &Pose::relative(observations[i].pose, observations[j].pose)) else { continue };
        let point = observations[i].pose.inverse().transform(&local);
        let errors = observations
            .iter()
            .map(|s| scene.reprojection_error(s.observation, s.pose, &point))
            .filter(|e| *e <= limits.error);
        let (count, sum) = errors.fold((0, 0.0), |(n, sum), e| (n + 1, sum + e * e));
        if count >= 2 && best.is_none_or(|b| count > b.0 || count == b.0 && sum < b.1) {
            best = Some((count, sum, point));
        }
        if count == observations.len() {
            break;
        }
    }
    let (_, _, mut point) = best?;
    let mut inliers = inliers_of(scene, &observations, &point, limits.error);
    if observations.len() > 2 {
        point = refine(scene, &observations, &inliers, point);
        inliers = inliers_of(scene, &observations, &point, limits.error);
    }
    let is_valid = inliers.len() >= 2 && has_parallax(&observations, &inliers, limits.angle);
    is_valid.then(|| (point, inliers.into_iter().map(|i| observations[i].observation).collect()))
}

/// Returns the indices of the inliers of a point.
fn inliers_of(scene: &Scene<'_>, observations: &[PosedObservation<'_>], point: &Point3<f64>, limit: f64) -> Vec<usize> {
    (0..observations.len())
        .filter(|&i| scene.reprojection_error(observations[i].observation, observations[i].pose, point) <= limit)
        .collect()
}

fn ray_angle(a: &PosedObservation<'_>, b: &PosedObservation<'_>) -> f64 {
    a.direction.cross(&b.direction).norm().atan2(a.direction.dot(&b.direction))
}

/// Returns whether two of the rays have at least the given angle.
fn has_parallax(observations: &[PosedObservation<'_>], inliers: &[usize], angle: f64) -> bool {
    inliers
        .iter()
        .enumerate()
        .any(|(k, &i)| inliers[..k].iter().any(|&j| ray_angle(&observations[i], &observations[j]) >= angle))
}

/// Returns pairs of `n` observations, distant ones first: neighbors in the list are often neighbors in space.
fn observation_pairs(n: usize) -> impl Iterator<Item = (usize, usize)> {
    (1..n).rev().flat_map(move |gap| (0..n - gap).map(move |i| (i, i + gap))).take(MAX_PAIRS.max(n))
}

/// Refines a point by Gauss-Newton on the reprojection errors of the inliers.
fn refine(
    scene: &Scene<'_>,
    observations: &[PosedObservation<'_>],
    inliers: &[usize],
    start: Point3<f64>,
) -> Point3<f64> {
    let mut point = start;
    for _ in 0..3 {
        let (mut h, mut g) = (Matrix3::zeros(), Vector3::zeros());
        for &i in inliers {
            let s = &observations[i];
            let p = s.pose.transform(&point);
            if p.z <= 0.0 {
                return start;
            }
            let (x, y) = (p.x / p.z, p.y / p.z);
            let focal = scene.camera_of(scene.view_of(s.observation)).fx;
            let ray = scene.ray(s.observation);
            let by_point = Matrix2x3::new(1.0, 0.0, -x, 0.0, 1.0, -y) * (focal / p.z) * s.pose.rotation.matrix();
            let r = (cv_core::Point2::new(x, y) - ray) * focal;
            h += by_point.transpose() * by_point;
            g += by_point.transpose() * r;
        }
        let Some(step) = h.cholesky().map(|c| c.solve(&g)) else { return start };
        point -= step;
        if step.norm() < 1e-9 * point.coords.norm() {
            break;
        }
    }
    if point.coords.iter().all(|v| v.is_finite()) { point } else { start }
}
