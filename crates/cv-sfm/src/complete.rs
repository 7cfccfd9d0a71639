//! Observations that matching missed: where a point must be in the other views.

use crate::scene::Scene;
use crate::tracks::TrackJoiner;
use crate::{Observation, Tracks};
use cv_core::{Keypoint, Point2, Point3, Pose, Vector3};
use rayon::prelude::*;

/// How alike features are.
pub trait FeatureDistance: Sync {
    /// The distance between the descriptors of two keypoints, as a share of the largest that is a match.
    fn distance(&self, a: Observation, b: Observation) -> f32;
}

/// How far from its projection a point is looked for, in pixels.
const REACH: f64 = 2.0;
/// Largest angle between two rays of a point at which a feature still looks alike, in radians (Mikolajczyk & Schmid, "A performance evaluation of local descriptors", PAMI 2005: half of the
/// matches are lost at about 50 degrees).
const ALIKE: f64 = 0.8;
/// Largest ratio of the size at which a feature is seen to that at which it should be.
const SIZE: f64 = 1.6;

/// Keypoints of a view by cells.
struct Grid {
    columns: usize,
    rows: usize,
    start: Vec<u32>,
    items: Vec<u32>,
}

/// Side of a cell in pixels.
const CELL: f32 = 8.0;

impl Grid {
    fn new(keypoints: &[Keypoint], width: usize, height: usize) -> Self {
        let (columns, rows) = ((width as f32 / CELL) as usize + 1, (height as f32 / CELL) as usize + 1);
        let cell = |k: &Keypoint| Self::index(k.position.y, rows) * columns + Self::index(k.position.x, columns);
        let mut start = vec![0u32; columns * rows + 1];
        keypoints.iter().for_each(|k| start[cell(k) + 1] += 1);
        for c in 0..columns * rows {
            start[c + 1] += start[c];
        }
        let mut next = start.clone();
        let mut items = vec![0; keypoints.len()];
        for (i, k) in keypoints.iter().enumerate() {
            let at = &mut next[cell(k)];
            items[*at as usize] = i as u32;
            *at += 1;
        }
        Self { columns, rows, start, items }
    }

    fn index(v: f32, n: usize) -> usize {
        // Negative numbers and NaN become 0.
        ((v / CELL) as usize).min(n - 1)
    }

    /// Keypoints in the cells that a square around a place touches.
    fn around(&self, p: Point2<f32>, reach: f32) -> impl Iterator<Item = u32> + '_ {
        let (x0, x1) = (Self::index(p.x - reach, self.columns), Self::index(p.x + reach, self.columns));
        let (y0, y1) = (Self::index(p.y - reach, self.rows), Self::index(p.y + reach, self.rows));
        let cells = (y0..=y1).flat_map(move |y| (x0..=x1).map(move |x| y * self.columns + x));
        cells.flat_map(|c| &self.items[self.start[c] as usize..self.start[c + 1] as usize]).copied()
    }
}

/// Tracks with what can be found of their points in views that lack them, joined where two turn out to be one.
/// O(points · views).
pub(crate) fn complete(scene: &Scene<'_>, alike: &dyn FeatureDistance) -> Tracks {
    let keypoints: Vec<&[Keypoint]> = scene.views.iter().map(|v| v.keypoints).collect();
    let registered = scene.registered();
    let grid = |view: &usize| {
        let camera = scene.camera_of(*view);
        (*view, Grid::new(keypoints[*view], camera.width, camera.height))
    };
    let grids: Vec<(usize, Grid)> = registered.par_iter().map(grid).collect();
    let found: Vec<Vec<(f32, Observation, Observation)>> =
        (0..scene.tracks.len()).into_par_iter().with_min_len(64).map(|t| look_for(scene, t, &grids, alike)).collect();
    let mut joiner = TrackJoiner::new(&keypoints);
    let mut own = Vec::new();
    let observations = scene.tracks.observations();
    for t in 0..scene.tracks.len() {
        let range = scene.tracks.range(t);
        let mut chain = |of: &dyn Fn(usize) -> bool| {
            let list: Vec<Observation> = range.clone().filter(|i| of(*i)).map(|i| observations[i]).collect();
            own.extend(list.windows(2).map(|w| (0.0, w[0], w[1])));
        };
        if scene.points[t].is_some() {
            chain(&|i| scene.active[i]);
        } else {
            chain(&|_| true);
        }
    }
    joiner.join(&own);
    joiner.join(&found.concat());
    joiner.finish()
}

/// Keypoints of other views where a point must be that look like it: each beside the observation it looks like.
fn look_for(
    scene: &Scene<'_>,
    track: usize,
    grids: &[(usize, Grid)],
    alike: &dyn FeatureDistance,
) -> Vec<(f32, Observation, Observation)> {
    let Some(point) = scene.points[track] else { return Vec::new() };
    let observations = scene.tracks.observations();
    let seen: Vec<Seen> = scene
        .seen(track)
        .filter(|(i, _)| scene.active[*i])
        .map(|(i, pose)| Seen::new(observations[i], pose, &point))
        .collect();
    let mut found = Vec::new();
    for (view, grid) in grids {
        let Some(pose) = scene.poses[*view].as_ref().filter(|_| !seen.iter().any(|s| s.at.view as usize == *view))
        else {
            continue;
        };
        let camera = scene.camera_of(*view);
        let local = pose.transform(&point);
        let ideal = Point2::new(local.x / local.z, local.y / local.z);
        let Some(pixel) = camera.denormalize_in_range(ideal).filter(|_| local.z > 0.0) else { continue };
        let inside = |v: f64, n: usize| (-0.5..n as f64 - 0.5).contains(&v);
        if !inside(pixel.x, camera.width) || !inside(pixel.y, camera.height) {
            continue;
        }
        // The observation from the most similar direction.
        let ray = (point - pose.center()).normalize();
        let Some(like) = seen.iter().max_by(|a, b| a.ray.dot(&ray).total_cmp(&b.ray.dot(&ray))) else { continue };
        if like.ray.dot(&ray) < ALIKE.cos() {
            continue;
        }
        let reference = &scene.views[like.at.view as usize].keypoints[like.at.keypoint as usize];
        let focal = camera.fx / scene.camera_of(like.at.view as usize).fx;
        let size = f64::from(reference.scale) * focal * like.depth / local.z;
        let near = |k: &u32| {
            let keypoint = &scene.views[*view].keypoints[*k as usize];
            let size_off = (f64::from(keypoint.scale) / size).ln().abs();
            (keypoint.position.cast::<f64>() - pixel).norm() <= REACH && size_off <= SIZE.ln()
        };
        let candidates = grid.around(pixel.cast::<f32>(), REACH as f32).filter(near).map(|keypoint| {
            let at = Observation { view: *view as u32, keypoint };
            (alike.distance(like.at, at), at)
        });
        let best = candidates.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        if let Some((distance, at)) = best.filter(|b| b.0 <= 1.0) {
            found.push((distance, like.at, at));
        }
    }
    found
}

/// An observation of a point.
struct Seen {
    at: Observation,
    /// From the camera to the point, of length one.
    ray: Vector3<f64>,
    depth: f64,
}

impl Seen {
    fn new(at: Observation, pose: &Pose, point: &Point3<f64>) -> Self {
        Self { at, ray: (point - pose.center()).normalize(), depth: pose.transform(point).z }
    }
}
