//! Track completion: observations that matching missed, searched around the projections of points in the other views.

use crate::scene::Scene;
use crate::tracks::TrackMerger;
use crate::{Observation, Tracks};
use cv_core::{Keypoint, Point2, Point3, Pose, Vector3};
use cv_parallel::prelude::*;

/// A distance between feature descriptors.
pub trait FeatureDistance: Sync {
    /// Returns the distance between the descriptors of two keypoints, as a ratio of the largest distance of a match.
    fn distance(&self, a: Observation, b: Observation) -> f32;
}

/// Search radius around the projection of a point, in pixels.
const SEARCH_RADIUS_PX: f64 = 2.0;
/// Largest angle between two rays of a point at which descriptors still match, in radians (Mikolajczyk & Schmid, "A
/// performance evaluation of local descriptors", PAMI 2005: half of the matches are lost at about 50 degrees).
const MAX_VIEW_ANGLE: f64 = 0.8;
/// Largest ratio of the keypoint's scale to the predicted scale.
const MAX_SCALE_RATIO: f64 = 1.6;

/// Keypoints of a view in a grid of square cells.
struct KeypointGrid {
    columns: usize,
    rows: usize,
    start: Vec<u32>,
    items: Vec<u32>,
}

/// Side of a cell in pixels.
const CELL_PX: f32 = 8.0;

impl KeypointGrid {
    fn new(keypoints: &[Keypoint], width: usize, height: usize) -> Self {
        let (columns, rows) = ((width as f32 / CELL_PX) as usize + 1, (height as f32 / CELL_PX) as usize + 1);
        let cell =
            |k: &Keypoint| Self::cell_index(k.position.y, rows) * columns + Self::cell_index(k.position.x, columns);
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

    fn cell_index(v: f32, n: usize) -> usize {
        // Negative numbers and NaN become 0.
        ((v / CELL_PX) as usize).min(n - 1)
    }

    /// Returns the keypoints of all cells that intersect a square window of half side `radius` around a pixel.
    fn in_window(&self, p: Point2<f32>, radius: f32) -> impl Iterator<Item = u32> + '_ {
        let (x0, x1) = (Self::cell_index(p.x - radius, self.columns), Self::cell_index(p.x + radius, self.columns));
        let (y0, y1) = (Self::cell_index(p.y - radius, self.rows), Self::cell_index(p.y + radius, self.rows));
        let cells = (y0..=y1).flat_map(move |y| (x0..=x1).map(move |x| y * self.columns + x));
        cells.flat_map(|c| &self.items[self.start[c] as usize..self.start[c + 1] as usize]).copied()
    }
}

/// Returns the tracks with the observations found by projection, merged where two tracks share a keypoint. O(points ·
/// views).
pub(crate) fn complete_tracks(scene: &Scene<'_>, feature_distance: &dyn FeatureDistance) -> Tracks {
    let keypoints: Vec<&[Keypoint]> = scene.views.iter().map(|v| v.keypoints).collect();
    let registered = scene.registered();
    let grid = |view: &usize| {
        let camera = scene.camera_of(*view);
        (*view, KeypointGrid::new(keypoints[*view], camera.width, camera.height))
    };
    let grids: Vec<(usize, KeypointGrid)> = registered.par_iter().map(grid).collect();
    let proposals: Vec<Vec<(f32, Observation, Observation)>> = (0..scene.tracks.len())
        .into_par_iter()
        .with_min_len(64)
        .map(|t| find_observations(scene, t, &grids, feature_distance))
        .collect();
    let mut merger = TrackMerger::new(&keypoints);
    let mut track_links = Vec::new();
    let observations = scene.tracks.observations();
    for t in 0..scene.tracks.len() {
        let range = scene.tracks.range(t);
        let mut add_chain = |of: &dyn Fn(usize) -> bool| {
            let list: Vec<Observation> = range.clone().filter(|i| of(*i)).map(|i| observations[i]).collect();
            track_links.extend(list.windows(2).map(|w| (0.0, w[0], w[1])));
        };
        if scene.points[t].is_some() {
            add_chain(&|i| scene.active[i]);
        } else {
            add_chain(&|_| true);
        }
    }
    merger.merge(&track_links);
    merger.merge(&proposals.concat());
    merger.into_tracks()
}

/// Returns keypoints of other views near the projection of a track's point with a similar descriptor, each with the
/// observation that it matches and its distance.
fn find_observations(
    scene: &Scene<'_>,
    track: usize,
    grids: &[(usize, KeypointGrid)],
    feature_distance: &dyn FeatureDistance,
) -> Vec<(f32, Observation, Observation)> {
    let Some(point) = scene.points[track] else { return Vec::new() };
    let observations = scene.tracks.observations();
    let visible: Vec<ActiveObservation> = scene
        .posed_observations(track)
        .filter(|(i, _)| scene.active[*i])
        .map(|(i, pose)| ActiveObservation::new(observations[i], pose, &point))
        .collect();
    let mut proposals = Vec::new();
    for (view, grid) in grids {
        let Some(pose) =
            scene.poses[*view].as_ref().filter(|_| !visible.iter().any(|s| s.observation.view as usize == *view))
        else {
            continue;
        };
        let camera = scene.camera_of(*view);
        let local = pose.transform(&point);
        let normalized = Point2::new(local.x / local.z, local.y / local.z);
        let Some(pixel) = camera.denormalize_in_range(normalized).filter(|_| local.z > 0.0) else { continue };
        let inside = |v: f64, n: usize| (-0.5..n as f64 - 0.5).contains(&v);
        if !inside(pixel.x, camera.width) || !inside(pixel.y, camera.height) {
            continue;
        }
        // The observation from the most similar direction.
        let ray = (point - pose.center()).normalize();
        let Some(reference) = visible.iter().max_by(|a, b| a.ray.dot(&ray).total_cmp(&b.ray.dot(&ray))) else {
            continue;
        };
        if reference.ray.dot(&ray) < MAX_VIEW_ANGLE.cos() {
            continue;
        }
        let reference_keypoint =
            &scene.views[reference.observation.view as usize].keypoints[reference.observation.keypoint as usize];
        let focal = camera.fx / scene.camera_of(reference.observation.view as usize).fx;
        let predicted_scale = f64::from(reference_keypoint.scale) * focal * reference.depth / local.z;
        let is_candidate = |k: &u32| {
            let keypoint = &scene.views[*view].keypoints[*k as usize];
            let log_ratio = (f64::from(keypoint.scale) / predicted_scale).ln().abs();
            (keypoint.position.cast::<f64>() - pixel).norm() <= SEARCH_RADIUS_PX && log_ratio <= MAX_SCALE_RATIO.ln()
        };
        let candidates =
            grid.in_window(pixel.cast::<f32>(), SEARCH_RADIUS_PX as f32).filter(is_candidate).map(|keypoint| {
                let observation = Observation { view: *view as u32, keypoint };
                (feature_distance.distance(reference.observation, observation), observation)
            });
        let best = candidates.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        if let Some((distance, observation)) = best.filter(|b| b.0 <= 1.0) {
            proposals.push((distance, reference.observation, observation));
        }
    }
    proposals
}

/// An inlier observation of a point.
struct ActiveObservation {
    observation: Observation,
    /// Unit vector from the camera center to the point.
    ray: Vector3<f64>,
    depth: f64,
}

impl ActiveObservation {
    fn new(observation: Observation, pose: &Pose, point: &Point3<f64>) -> Self {
        Self { observation, ray: (point - pose.center()).normalize(), depth: pose.transform(point).z }
    }
}
