//! The result: cameras, poses and points of the views of one model.

use crate::Observation;
use crate::scene::Scene;
use cv_core::{Camera, Point3, Pose};

/// A point of a model.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SfmPoint {
    /// In the world frame.
    pub position: Point3<f64>,
    /// Mean reprojection error in pixels.
    pub error: f64,
    /// The observations that agree with it.
    pub observations: Vec<Observation>,
}

/// Cameras, poses and points of views that are registered in one frame.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SfmModel {
    /// All cameras of the input, refined where they were not known.
    pub cameras: Vec<Camera>,
    /// World to camera, for each view of the input; `None` where it is not registered in this model.
    pub poses: Vec<Option<Pose>>,
    /// The points.
    pub points: Vec<SfmPoint>,
}

impl SfmModel {
    /// Creates the model of a scene. Points observed by fewer than `min_views` views are left out if the scene has at
    /// least twice as many views.
    pub(crate) fn from_scene(scene: &Scene<'_>, min_views: usize) -> Self {
        let min_views = if scene.registered().len() >= 2 * min_views { min_views } else { 2 };
        let point = |(track, position): (usize, &Option<Point3<f64>>)| {
            let position = (*position)?;
            let active = scene.tracks.range(track).filter(|i| scene.active[*i]);
            let (mut observations, mut sum) = (Vec::new(), 0.0);
            for i in active {
                let pose = scene.poses[scene.view_of(i)].as_ref()?;
                sum += scene.reprojection_error(i, pose, &position);
                observations.push(scene.tracks.observations()[i]);
            }
            let error = sum / observations.len().max(1) as f64;
            (observations.len() >= min_views).then_some(SfmPoint { position, error, observations })
        };
        let points = scene.points.iter().enumerate().filter_map(point).collect();
        Self { cameras: scene.cameras.clone(), poses: scene.poses.clone(), points }
    }

    /// Returns the number of registered views.
    pub fn registered(&self) -> usize {
        self.poses.iter().flatten().count()
    }

    /// Returns the number of observations of all points.
    pub fn observations(&self) -> usize {
        self.points.iter().map(|p| p.observations.len()).sum()
    }

    /// Returns the mean number of observations of a point; 0 without points.
    pub fn mean_track_length(&self) -> f64 {
        self.observations() as f64 / self.points.len().max(1) as f64
    }

    /// Returns the mean reprojection error over all observations, in pixels, as COLMAP computes it.
    pub fn mean_reprojection_error(&self) -> f64 {
        let sum: f64 = self.points.iter().map(|p| p.error * p.observations.len() as f64).sum();
        sum / self.observations().max(1) as f64
    }
}

/// Outcome of the registration of a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum ViewOutcome {
    /// It is registered in the model with this index.
    Registered {
        /// Index of the model.
        model: usize,
    },
    /// No other view shares enough matches with it.
    NoPairs,
    /// Too few of its keypoints are observations of points of a model.
    TooFewPoints {
        /// Largest number of visible points over the models.
        seen: usize,
        /// Number that is needed.
        needed: usize,
    },
    /// It observes points of a model, but no pose has enough inliers.
    NoPose {
        /// Number of visible points.
        seen: usize,
        /// Inliers of the best pose.
        agree: usize,
        /// Number that is needed.
        needed: usize,
    },
    /// It was registered by some matches, but most other observations contradict its pose: it, or its part of the model,
    /// shows another place that looks alike.
    Contradicted {
        /// Observations that agree: points in its field of view that it observes, or tracks shared with the rest of the
        /// model that are inliers in both.
        agree: usize,
        /// All of these points or tracks.
        of: usize,
    },
}
