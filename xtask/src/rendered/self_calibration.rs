//! Self-calibration of one camera with an unknown focal length, where two views alone do not determine it or the lens is
//! far from the initial value; and a rotating camera, of which there is no model.

use super::Walk;
use super::accuracy::PoseErrors;
use crate::checks::Check;
use anyhow::{Context, Result};
use cv_core::{Camera, Distortion, Point3, Pose, Vector3};
use cv_pipeline::many_views::CameraKnowledge;
use cv_pipeline::{SfmCamera, SfmJobOptions, Silent, sfm};
use cv_synth::Scene;
use std::f64::consts::TAU;

/// Largest error of a camera center, as a percentage of the extent of the centers, and of a rotation in degrees. With a
/// wrong focal length they are tens of times as large; what remains is the keypoint noise in the direction in which
/// focal length, poses and points are nearly interchangeable.
const MAX_CENTER_ERROR: f64 = 0.5;
const MAX_ROTATION_ERROR_DEG: f64 = 0.5;

pub(super) fn self_calibration() -> Result<Vec<Check>> {
    let mut checks = Vec::new();
    for (name, walk) in
        [("around a table", table()?), ("forth and back", forth_and_back()?), ("wide lens", wide_lens())]
    {
        let options = SfmJobOptions::default();
        let photos = walk.photos(&options)?;
        for camera in [walk.unknown_camera(), approximate(&walk)] {
            let result = sfm(&photos, &[camera], &options, &Silent)?;
            let model = result.models.first().context("no model")?;
            let errors = PoseErrors::of(model, &walk.poses)?;
            let centers: Vec<Point3<f64>> = walk.poses.iter().map(Pose::center).collect();
            let distances = centers.iter().flat_map(|a| centers.iter().map(move |b| (a - b).norm()));
            let extent = distances.fold(0.0, f64::max);
            let name = match camera.knowledge {
                CameraKnowledge::Unknown => format!("{name}, focal length unknown"),
                _ => format!("{name}, focal length 4 % off"),
            };
            println!("{name}: {:?} for {:?}", model.cameras[0], walk.camera);
            let name = |what: &str| format!("{name}: {what}");
            checks.extend([
                Check::at_least(name("photographs registered"), model.registered() as f64, walk.poses.len() as f64),
                Check::at_most(name("centers, % of the extent"), 100.0 * errors.center / extent, MAX_CENTER_ERROR),
                Check::at_most(name("rotations, degrees"), errors.rotation, MAX_ROTATION_ERROR_DEG),
            ]);
        }
    }
    let walk = rotation()?;
    let options = SfmJobOptions::default();
    let photos = walk.photos(&options)?;
    for (name, camera) in [("unknown", walk.unknown_camera()), ("4 % off", approximate(&walk))] {
        let models = sfm(&photos, &[camera], &options, &Silent).map_or(0, |result| result.models.len());
        checks.push(Check::at_most(format!("rotation only, focal length {name}: models"), models as f64, 0.0));
    }
    Ok(checks)
}

/// A focal length as EXIF has it.
fn approximate(walk: &Walk) -> SfmCamera {
    let focal = 1.04 * walk.camera.fx;
    SfmCamera { camera: walk.undistorted_camera(focal), knowledge: CameraKnowledge::Focal { focal, deviation: 0.05 } }
}

/// Twelve views around a table, from one height and distance: two views whose optical axes intersect do not determine the
/// focal length (Sturm, "On focal length calibration from two views", CVPR 2001).
fn table() -> Result<Walk> {
    let pose = |i: usize| {
        let (sin, cos) = (0.2 * (i as f64 - 5.5)).sin_cos();
        look_at(Point3::new(1.5 * sin, -0.7, 0.3 - 1.5 * cos), Point3::new(0.0, -0.12, 0.3))
    };
    Ok(Walk::new(Scene::tabletop(1), (0..12).map(pose).collect::<Result<_>>()?))
}

/// Twelve views along a street and twelve on the way back, each way without a rotation, for which focal length and depth
/// are interchangeable.
fn forth_and_back() -> Result<Walk> {
    let pose = |i: usize| {
        let (step, ahead) = if i < 12 { (i, 1.0) } else { (23 - i, -1.0) };
        let eye = Point3::new(-ahead, -1.6, 8.0 + 1.8 * step as f64);
        look_at(eye, eye + Vector3::new(0.8, -0.1, ahead))
    };
    Ok(Walk::new(Scene::street(5, 8, 0), (0..24).map(pose).collect::<Result<_>>()?))
}

/// A walk along a street with a field of view of 90° and more than 20 % of barrel distortion in the corners.
fn wide_lens() -> Walk {
    let walk = Walk::new(Scene::street(8, 5, 0), Scene::street_walk(5, 14));
    let camera = Camera { distortion: Distortion::radial(-0.2, 0.03), ..Camera::from_focal(1200, 900, 600.0) };
    Walk { camera, ..walk }
}

/// A camera on a tripod.
fn rotation() -> Result<Walk> {
    let eye = Point3::new(0.0, -1.5, 2.0);
    let pose = |i: usize| {
        let (sin, cos) = (TAU * (i as f64 - 4.5) / 32.0).sin_cos();
        look_at(eye, eye + Vector3::new(sin, 0.05, cos))
    };
    Ok(Walk::new(Scene::room(5), (0..10).map(pose).collect::<Result<_>>()?))
}

fn look_at(eye: Point3<f64>, target: Point3<f64>) -> Result<Pose> {
    Pose::look_at(eye, target, Vector3::y()).context("no direction")
}
