//! The point of a track, of whose observations some may be wrong.

use crate::scene::Scene;
use cv_core::{Correspondence, Point3, Pose, Vector3};
use cv_geometry::triangulate;
use nalgebra::{Matrix2x3, Matrix3};
use rayon::prelude::*;

/// When an observation agrees with a point, and when a point is one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PointLimits {
    /// Largest reprojection error in pixels.
    pub(crate) error: f64,
    /// Smallest of the largest angle between two rays of the point, in radians.
    pub(crate) angle: f64,
}

/// Most pairs of observations that a point is tried from.
const MOST_PAIRS: usize = 24;

/// An observation of a track in a view with a pose.
struct Seen<'s> {
    observation: usize,
    pose: &'s Pose,
    /// The ray in the world, of length one.
    direction: Vector3<f64>,
}

/// Brings points and observations up to the poses: points whose observations agree stay, and take in those that agree now (completion) and
/// leave out those that no longer do (filtering); other tracks are triangulated anew (re-triangulation). O(observations) and, of a new point, a few pairs.
pub(crate) fn update_tracks(scene: &mut Scene<'_>, limits: PointLimits, tracks: &[usize]) {
    let updates: Vec<_> = tracks.par_iter().with_min_len(64).map(|&t| update(scene, t, limits)).collect();
    for (&track, update) in tracks.iter().zip(updates) {
        let range = scene.tracks.range(track);
        scene.active[range].fill(false);
        scene.points[track] = update.as_ref().map(|u| u.0);
        for observation in update.iter().flat_map(|u| &u.1) {
            scene.active[*observation] = true;
        }
    }
}

/// The point of a track and the observations that agree with it.
type Update = Option<(Point3<f64>, Vec<usize>)>;

fn update(scene: &Scene<'_>, track: usize, limits: PointLimits) -> Update {
    let seen: Vec<Seen<'_>> = scene
        .seen(track)
        .filter(|(observation, _)| scene.ray(*observation).x.is_finite())
        .map(|(observation, pose)| {
            let direction = (pose.rotation.inverse() * scene.ray(observation).to_homogeneous()).normalize();
            Seen { observation, pose, direction }
        })
        .collect();
    if seen.len() < 2 {
        return None;
    }
    if let Some(point) = scene.points[track] {
        let agreeing = agreeing(scene, &seen, &point, limits.error);
        if agreeing.len() >= 2 && 2 * agreeing.len() > seen.len() && wide(&seen, &agreeing, limits.angle) {
            return Some((point, agreeing.into_iter().map(|i| seen[i].observation).collect()));
        }
    }
    let mut best: Option<(usize, f64, Point3<f64>)> = None;
    for (i, j) in pairs(seen.len()) {
        if ray_angle(&seen[i], &seen[j]) < limits.angle {
            continue;
        }
        let m = Correspondence { a: scene.ray(seen[i].observation), b: scene.ray(seen[j].observation) };
        let Ok(local) = triangulate(&m, &Pose::relative(seen[i].pose, seen[j].pose)) else { continue };
        let point = seen[i].pose.inverse().transform(&local);
        let errors = seen.iter().map(|s| scene.error(s.observation, s.pose, &point)).filter(|e| *e <= limits.error);
        let (count, sum) = errors.fold((0, 0.0), |(n, sum), e| (n + 1, sum + e * e));
        if count >= 2 && best.is_none_or(|b| count > b.0 || count == b.0 && sum < b.1) {
            best = Some((count, sum, point));
        }
        if count == seen.len() {
            break;
        }
    }
    let (_, _, mut point) = best?;
    let mut inliers = agreeing(scene, &seen, &point, limits.error);
    if seen.len() > 2 {
        point = refine(scene, &seen, &inliers, point);
        inliers = agreeing(scene, &seen, &point, limits.error);
    }
    let fine = inliers.len() >= 2 && wide(&seen, &inliers, limits.angle);
    fine.then(|| (point, inliers.into_iter().map(|i| seen[i].observation).collect()))
}

/// Indices of the observations that agree with a point.
fn agreeing(scene: &Scene<'_>, seen: &[Seen<'_>], point: &Point3<f64>, limit: f64) -> Vec<usize> {
    (0..seen.len()).filter(|&i| scene.error(seen[i].observation, seen[i].pose, point) <= limit).collect()
}

fn ray_angle(a: &Seen<'_>, b: &Seen<'_>) -> f64 {
    a.direction.cross(&b.direction).norm().atan2(a.direction.dot(&b.direction))
}

/// Whether two of the rays are so far apart.
fn wide(seen: &[Seen<'_>], of: &[usize], angle: f64) -> bool {
    of.iter().enumerate().any(|(k, &i)| of[..k].iter().any(|&j| ray_angle(&seen[i], &seen[j]) >= angle))
}

/// Pairs of `n` observations, far ones first: neighbors in the list are often neighbors in space.
fn pairs(n: usize) -> impl Iterator<Item = (usize, usize)> {
    (1..n).rev().flat_map(move |gap| (0..n - gap).map(move |i| (i, i + gap))).take(MOST_PAIRS.max(n))
}

/// Gauss–Newton on the reprojection errors of the observations `of`.
fn refine(scene: &Scene<'_>, seen: &[Seen<'_>], of: &[usize], start: Point3<f64>) -> Point3<f64> {
    let mut point = start;
    for _ in 0..3 {
        let (mut h, mut g) = (Matrix3::zeros(), Vector3::zeros());
        for &i in of {
            let s = &seen[i];
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
