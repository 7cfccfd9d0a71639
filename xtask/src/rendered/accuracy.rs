//! How near the poses of walks are to the truth, with the camera known and not.

use super::Walk;
use crate::checks::Check;
use anyhow::{Context, Result};
use cv_core::{Camera, Correspondence, Distortion, Point2, Point3, Pose, Vector3, quantile};
use cv_geometry::{align_points, triangulate};
use cv_pipeline::many_views::{CameraKnowledge, Observation, SfmModel};
use cv_pipeline::{SfmCamera, SfmJobOptions, SfmPhoto, Silent, sfm};
use cv_synth::{Scene, rotation_error};
use nalgebra::Matrix3;

/// Largest distance of a camera's center from the truth after a similarity, as a share of the scene's longest side, and largest rotation from it after the mean one, in degrees.
const CENTERS: f64 = 1e-3;
const ROTATION: f64 = 0.02;

pub(super) fn room_12() -> Result<Vec<Check>> {
    judge(&Walk::new(Scene::room(1), Scene::room_walk(12)), 9.0)
}

pub(super) fn room_50() -> Result<Vec<Check>> {
    judge(&Walk::new(Scene::room(1), Scene::room_walk(50)), 9.0)
}

pub(super) fn street_12() -> Result<Vec<Check>> {
    judge(&Walk::new(Scene::street(1, 5, 0), Scene::street_walk(5, 12)), 30.0)
}

pub(super) fn street_50() -> Result<Vec<Check>> {
    judge(&Walk::new(Scene::street(1, 18, 0), Scene::street_walk(18, 50)), 108.0)
}

pub(super) fn street_200() -> Result<Vec<Check>> {
    judge(&Walk::new(Scene::street(1, 60, 0), Scene::street_walk(60, 200)), 360.0)
}

/// Both ways to know the camera; `side` is the scene's longest side in meters.
fn judge(walk: &Walk, side: f64) -> Result<Vec<Check>> {
    let options = SfmJobOptions::default();
    let photos = walk.photos(&options)?;
    let lens = |focal: f64| Camera {
        distortion: Distortion::radial(0.0, 0.0),
        ..Camera::from_focal(walk.camera.width, walk.camera.height, focal)
    };
    let known = SfmCamera { camera: walk.camera, knowledge: CameraKnowledge::Known };
    // As the program begins where nothing tells a focal length.
    let unknown = SfmCamera { camera: lens(1.2 * walk.camera.width as f64), knowledge: CameraKnowledge::Unknown };
    let mut checks = Vec::new();
    for (name, camera) in [("camera known", known), ("camera not known", unknown)] {
        let result = sfm(&photos, &[camera], &options, &Silent)?;
        let model = result.models.first().context("no model")?;
        let off = Off::of(model, &walk.poses)?;
        println!(
            "{name}: {} of {} photographs, centers off by {:.1} mm at the most, rotations by {:.4}°; {} points, {:?}, {:.1} s",
            model.registered(),
            walk.poses.len(),
            1e3 * off.center,
            off.rotation,
            model.points.len(),
            model.cameras[0],
            result.stages.iter().map(|s| s.1).sum::<f64>(),
        );
        places(&model.points.iter().map(|p| &p.observations[..]).collect::<Vec<_>>(), &photos, walk);
        let name = |what: &str| format!("{name}: {what}");
        checks.extend([
            Check::at_least(name("photographs registered"), model.registered() as f64, walk.poses.len() as f64),
            Check::at_most(name("centers, % of the scene"), 100.0 * off.center / side, 100.0 * CENTERS),
            Check::at_most(name("rotations, degrees"), off.rotation, ROTATION),
        ]);
    }
    Ok(checks)
}

/// Of the photographs of a model: the largest distance of a center from the truth in meters, and the largest rotation from it in degrees.
struct Off {
    center: f64,
    rotation: f64,
}

impl Off {
    fn of(model: &SfmModel, truth: &[Pose]) -> Result<Self> {
        let both: Vec<(&Pose, &Pose)> =
            model.poses.iter().zip(truth).filter_map(|(found, truth)| Some((found.as_ref()?, truth))).collect();
        let (found, true_centers): (Vec<Point3<f64>>, Vec<Point3<f64>>) =
            both.iter().map(|(f, t)| (f.center(), t.center())).unzip();
        let to_truth = align_points(&found, &true_centers, true)?;
        let center =
            found.iter().zip(&true_centers).map(|(f, t)| (to_truth.transform(f) - t).norm()).fold(0.0, f64::max);
        // From the frame of the truth to the model's, by each photograph, and the rotation nearest to all of them: centers on a line do not tell it.
        let turns: Vec<_> = both.iter().map(|(f, t)| f.rotation.inverse() * t.rotation).collect();
        let sum: Matrix3<f64> = turns.iter().map(|r| *r.matrix()).sum();
        let mean = nalgebra::Rotation3::from_matrix(&sum);
        let rotation = turns.iter().map(|r| rotation_error(r, &mean).to_degrees()).fold(0.0, f64::max);
        Ok(Self { center, rotation })
    }
}

/// How exact the places of features are: distances from where the true cameras see the point that they agree on best.
fn places(tracks: &[&[Observation]], photos: &[SfmPhoto], walk: &Walk) {
    let mut all: Vec<(f64, Vector3<f64>, Point2<f64>)> = Vec::new();
    for track in tracks {
        let keypoint = |o: &Observation| &photos[o.view as usize].keypoints[o.keypoint as usize];
        let rays: Vec<(&Pose, Point2<f64>)> =
            track.iter().map(|o| (&walk.poses[o.view as usize], keypoint(o).position.cast())).collect();
        let Some(point) = point_of(&rays, &walk.camera) else { continue };
        for ((pose, at), o) in rays.iter().zip(*track) {
            if let Some(p) = walk.camera.project(&pose.transform(&point)) {
                all.push((f64::from(keypoint(o).scale), Vector3::new(at.x - p.x, at.y - p.y, (at - p).norm()), *at));
            }
        }
    }
    for (from, to) in [(0.0, 1.0), (1.0, 1.5), (1.5, 2.0), (2.0, 3.0), (3.0, 5.0), (5.0, 1e9)] {
        let of: Vec<&(f64, Vector3<f64>, Point2<f64>)> = all.iter().filter(|a| a.0 >= from && a.0 < to).collect();
        let q = |share: f64| quantile(&mut of.iter().map(|a| a.1.z).collect::<Vec<_>>(), share).unwrap_or(f64::NAN);
        let [dx, dy] =
            [0, 1].map(|k| quantile(&mut of.iter().map(|a| a.1[k]).collect::<Vec<_>>(), 0.5).unwrap_or(f64::NAN));
        println!(
            "  σ {from} to {to}: {} observations, off by {:.3} (median), {:.3} (90 %) px; bias {dx:.4} {dy:.4}",
            of.len(),
            q(0.5),
            q(0.9)
        );
    }
    let (width, height) = (walk.camera.width as f64, walk.camera.height as f64);
    for row in 0..3 {
        let line: Vec<String> = (0..4)
            .map(|column| {
                let inside =
                    |p: &Point2<f64>| (4.0 * p.x / width) as usize == column && (3.0 * p.y / height) as usize == row;
                let of: Vec<_> = all.iter().filter(|a| inside(&a.2)).collect();
                let [dx, dy] = [0, 1]
                    .map(|k| quantile(&mut of.iter().map(|a| a.1[k]).collect::<Vec<_>>(), 0.5).unwrap_or(f64::NAN));
                format!("{dx:+.3} {dy:+.3}")
            })
            .collect();
        println!("  {}", line.join(" | "));
    }
}

/// The point that known cameras see at given places, by least squares of their distances in pixels, those beyond a pixel weighed down (Cauchy).
fn point_of(seen: &[(&Pose, Point2<f64>)], camera: &Camera) -> Option<Point3<f64>> {
    let (first, last) = (seen.first()?, seen.last()?);
    let m = Correspondence { a: camera.normalize(first.1), b: camera.normalize(last.1) };
    let local = triangulate(&m, &Pose::relative(first.0, last.0)).ok()?;
    let mut point = first.0.inverse().transform(&local);
    for _ in 0..10 {
        let (mut h, mut g) = (Matrix3::zeros(), Vector3::zeros());
        for (pose, at) in seen {
            let p = pose.transform(&point);
            if p.z <= 0.0 {
                return None;
            }
            let (x, y) = (p.x / p.z, p.y / p.z);
            let j = nalgebra::Matrix2x3::new(1.0, 0.0, -x, 0.0, 1.0, -y) * (camera.fx / p.z) * pose.rotation.matrix();
            let r = camera.denormalize(Point2::new(x, y)) - at;
            let w = 1.0 / (1.0 + r.norm_squared());
            h += j.transpose() * j * w;
            g += j.transpose() * r * w;
        }
        point -= h.cholesky()?.solve(&g);
    }
    Some(point)
}
