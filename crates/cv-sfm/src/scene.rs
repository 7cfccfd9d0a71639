//! The state of a reconstruction: cameras, poses, points and inlier observations.

use crate::{CameraKnowledge, SfmView, Tracks};
use cv_core::{Camera, Keypoint, Point2, Point3, Pose};
use cv_parallel::prelude::*;

/// Cameras, poses, points and inlier observations of a reconstruction.
pub(crate) struct Scene<'a> {
    pub(crate) views: &'a [SfmView<'a>],
    pub(crate) knowledge: &'a [CameraKnowledge],
    pub(crate) tracks: Tracks,
    pub(crate) cameras: Vec<Camera>,
    pub(crate) poses: Vec<Option<Pose>>,
    /// By track.
    pub(crate) points: Vec<Option<Point3<f64>>>,
    /// By observation: whether it is an inlier of the track's point.
    pub(crate) active: Vec<bool>,
    /// By observation: its pixel in normalized coordinates.
    rays: Vec<Point2<f64>>,
    /// By observation: its track.
    track_of: Vec<u32>,
    /// Start of each view's range in `by_view`, and the total length.
    start: Vec<usize>,
    /// Observations sorted by view.
    by_view: Vec<u32>,
}

impl<'a> Scene<'a> {
    pub(crate) fn new(
        views: &'a [SfmView<'a>],
        cameras: &[Camera],
        knowledge: &'a [CameraKnowledge],
        tracks: Tracks,
    ) -> Self {
        let mut scene = Self {
            views,
            knowledge,
            tracks: Tracks::default(),
            cameras: cameras.to_vec(),
            poses: vec![None; views.len()],
            points: Vec::new(),
            active: Vec::new(),
            rays: Vec::new(),
            track_of: Vec::new(),
            start: Vec::new(),
            by_view: Vec::new(),
        };
        scene.set_tracks(tracks);
        scene
    }

    /// Replaces the tracks. None has a point yet.
    pub(crate) fn set_tracks(&mut self, tracks: Tracks) {
        let observations = tracks.observations();
        self.track_of = vec![0; observations.len()];
        for t in 0..tracks.len() {
            self.track_of[tracks.range(t)].fill(t as u32);
        }
        self.start = vec![0usize; self.views.len() + 1];
        for o in observations {
            self.start[o.view as usize + 1] += 1;
        }
        for v in 0..self.views.len() {
            self.start[v + 1] += self.start[v];
        }
        let mut next = self.start.clone();
        self.by_view = vec![0; observations.len()];
        for (i, o) in observations.iter().enumerate() {
            self.by_view[next[o.view as usize]] = i as u32;
            next[o.view as usize] += 1;
        }
        self.points = vec![None; tracks.len()];
        self.active = vec![false; observations.len()];
        self.tracks = tracks;
        self.cameras_changed();
    }

    /// Recomputes the normalized coordinates. To be called when `cameras` change.
    pub(crate) fn cameras_changed(&mut self) {
        let ray = |i: usize| self.camera_of(self.tracks.observations()[i].view as usize).normalize(self.pixel(i));
        self.rays = (0..self.active.len()).into_par_iter().map(ray).collect();
    }

    /// Returns whether the intrinsics of all cameras are known.
    pub(crate) fn is_calibrated(&self) -> bool {
        self.knowledge.iter().all(CameraKnowledge::is_calibrated)
    }

    pub(crate) fn camera_of(&self, view: usize) -> &Camera {
        &self.cameras[self.views[view].camera]
    }

    /// Returns the keypoint of an observation.
    #[inline]
    pub(crate) fn keypoint(&self, observation: usize) -> &Keypoint {
        let o = self.tracks.observations()[observation];
        &self.views[o.view as usize].keypoints[o.keypoint as usize]
    }

    /// Returns the pixel of an observation.
    #[inline]
    pub(crate) fn pixel(&self, observation: usize) -> Point2<f64> {
        self.keypoint(observation).position.cast()
    }

    #[inline]
    pub(crate) fn ray(&self, observation: usize) -> Point2<f64> {
        self.rays[observation]
    }

    #[inline]
    pub(crate) fn view_of(&self, observation: usize) -> usize {
        self.tracks.observations()[observation].view as usize
    }

    #[inline]
    pub(crate) fn track_of(&self, observation: usize) -> usize {
        self.track_of[observation] as usize
    }

    /// Returns the observations of a view, ordered by track.
    pub(crate) fn view_observations(&self, view: usize) -> impl Iterator<Item = usize> + '_ {
        self.by_view[self.start[view]..self.start[view + 1]].iter().map(|i| *i as usize)
    }

    /// Returns the registered views: those that have a pose.
    pub(crate) fn registered(&self) -> Vec<usize> {
        (0..self.views.len()).filter(|v| self.poses[*v].is_some()).collect()
    }

    /// Returns the observations of a track in registered views, with their poses.
    pub(crate) fn posed_observations(&self, track: usize) -> impl Iterator<Item = (usize, &Pose)> + '_ {
        self.tracks.range(track).filter_map(|i| Some((i, self.poses[self.view_of(i)].as_ref()?)))
    }

    /// Returns for each view the number of its inliers in tracks that are inliers in `view` too. O(inliers · track length).
    pub(crate) fn shared_inliers(&self, view: usize) -> Vec<usize> {
        let mut shared = vec![0usize; self.views.len()];
        for i in self.view_observations(view).filter(|i| self.active[*i]) {
            for j in self.tracks.range(self.track_of(i)).filter(|j| self.active[*j]) {
                shared[self.view_of(j)] += 1;
            }
        }
        shared
    }

    /// Returns the reprojection error of an observation in pixels; infinite for a point behind the camera.
    #[inline]
    pub(crate) fn reprojection_error(&self, observation: usize, pose: &Pose, point: &Point3<f64>) -> f64 {
        let camera = self.camera_of(self.view_of(observation));
        camera.project(&pose.transform(point)).map_or(f64::INFINITY, |p| (p - self.pixel(observation)).norm())
    }

    /// Returns the number of points and the number of inlier observations.
    pub(crate) fn counts(&self) -> (usize, usize) {
        let points = self.points.iter().flatten().count();
        (points, self.active.iter().filter(|a| **a).count())
    }

    /// Returns the number of inliers, and of all observations in registered views of tracks that at least two such
    /// views observe.
    pub(crate) fn support(&self) -> (usize, usize) {
        let count = |track: usize| {
            let observations = self.posed_observations(track).count();
            let inliers = self.tracks.range(track).filter(|i| self.active[*i]).count();
            if observations > 1 { (inliers, observations) } else { (0, 0) }
        };
        (0..self.tracks.len()).map(count).fold((0, 0), |sum, one| (sum.0 + one.0, sum.1 + one.1))
    }

    /// Makes all observations in registered views inliers, of tracks that at least two such views observe.
    pub(crate) fn activate_all(&mut self) {
        for track in 0..self.tracks.len() {
            if self.posed_observations(track).count() < 2 {
                continue;
            }
            for i in self.tracks.range(track) {
                self.active[i] = self.poses[self.view_of(i)].is_some();
            }
        }
    }

    /// Returns a copy of the solution.
    pub(crate) fn solution(&self) -> Solution {
        let Self { tracks, cameras, poses, points, active, .. } = self;
        let (cameras, poses, points, active) = (cameras.clone(), poses.clone(), points.clone(), active.clone());
        Solution { tracks: tracks.clone(), cameras, poses, points, active }
    }

    /// Restores an earlier solution.
    pub(crate) fn restore(&mut self, solution: Solution) {
        let Solution { tracks, cameras, poses, points, active } = solution;
        (self.cameras, self.poses) = (cameras, poses);
        self.set_tracks(tracks);
        (self.points, self.active) = (points, active);
    }

    /// Resets cameras and tracks, and removes all poses and points.
    pub(crate) fn clear(&mut self, cameras: &[Camera], tracks: &Tracks) {
        self.cameras.copy_from_slice(cameras);
        self.poses.fill(None);
        self.set_tracks(tracks.clone());
    }
}

/// The variables that a [`Scene`] solves for.
pub(crate) struct Solution {
    tracks: Tracks,
    cameras: Vec<Camera>,
    poses: Vec<Option<Pose>>,
    points: Vec<Option<Point3<f64>>>,
    active: Vec<bool>,
}
