//! What is found: cameras, poses and points of photographs that hold together.

use crate::Observation;
use crate::scene::Scene;
use cv_core::{Camera, Point3, Pose};

/// A point of a model.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SfmPoint {
    /// In the world.
    pub position: Point3<f64>,
    /// Mean reprojection error in pixels.
    pub error: f64,
    /// Where it is seen.
    pub observations: Vec<Observation>,
}

/// Cameras, poses and points of views that hold together.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SfmModel {
    /// The cameras, refined where they were not known; all that were given.
    pub cameras: Vec<Camera>,
    /// World to camera, of each view that was given; `None` where it is not in this model.
    pub poses: Vec<Option<Pose>>,
    /// The points.
    pub points: Vec<SfmPoint>,
}

impl SfmModel {
    /// What a scene holds; points of fewer than `min_views` views are left out where the scene has twice as many.
    pub(crate) fn of(scene: &Scene<'_>, min_views: usize) -> Self {
        let min_views = if scene.registered().len() >= 2 * min_views { min_views } else { 2 };
        let point = |(track, position): (usize, &Option<Point3<f64>>)| {
            let position = (*position)?;
            let active = scene.tracks.range(track).filter(|i| scene.active[*i]);
            let (mut observations, mut sum) = (Vec::new(), 0.0);
            for i in active {
                let pose = scene.poses[scene.view_of(i)].as_ref()?;
                sum += scene.error(i, pose, &position);
                observations.push(scene.tracks.observations()[i]);
            }
            let error = sum / observations.len().max(1) as f64;
            (observations.len() >= min_views).then_some(SfmPoint { position, error, observations })
        };
        let points = scene.points.iter().enumerate().filter_map(point).collect();
        Self { cameras: scene.cameras.clone(), poses: scene.poses.clone(), points }
    }

    /// Number of views that have a pose.
    pub fn registered(&self) -> usize {
        self.poses.iter().flatten().count()
    }

    /// Number of observations of all points.
    pub fn observations(&self) -> usize {
        self.points.iter().map(|p| p.observations.len()).sum()
    }

    /// Mean number of observations of a point; 0 without points.
    pub fn mean_track_length(&self) -> f64 {
        self.observations() as f64 / self.points.len().max(1) as f64
    }

    /// Mean reprojection error over all observations, in pixels (COLMAP's measure).
    pub fn mean_reprojection_error(&self) -> f64 {
        let sum: f64 = self.points.iter().map(|p| p.error * p.observations.len() as f64).sum();
        sum / self.observations().max(1) as f64
    }
}

/// What became of a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum ViewOutcome {
    /// It is in the model with this index.
    Registered {
        /// Index of the model.
        model: usize,
    },
    /// No other view shares enough matches with it.
    NoPairs,
    /// Too few of its keypoints are points of a model: this many at best.
    TooFewPoints {
        /// The most that any model had of it.
        seen: usize,
        /// How many are needed.
        needed: usize,
    },
    /// It sees points of a model, but no pose agrees with enough of them.
    NoPose {
        /// Points it sees.
        seen: usize,
        /// How many of them agreed with the best pose.
        agree: usize,
        /// How many are needed.
        needed: usize,
    },
}
