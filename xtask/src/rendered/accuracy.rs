//! Pose errors of structure from motion on walks, with known and unknown intrinsics.

use super::Walk;
use crate::checks::Check;
use anyhow::{Context, Result};
use cv_core::{Camera, Correspondence, Point2, Point3, Pose, Vector3, quantile};
use cv_geometry::{align_points, triangulate};
use cv_pipeline::many_views::{CameraKnowledge, Observation, SfmModel};
use cv_pipeline::{SfmCamera, SfmJobOptions, SfmPhoto, Silent, sfm};
use cv_synth::{Scene, rotation_error};
use nalgebra::Matrix3;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// Largest error of a camera center after a similarity alignment, as a fraction of the scene's longest side.
const MAX_CENTER_ERROR: f64 = 1e-3;
/// Largest rotation error after alignment by the mean rotation, in degrees.
const MAX_ROTATION_ERROR_DEG: f64 = 0.02;

/// Largest error of a camera center of a model without wrong joints, in meters: a quarter of the distance between
/// neighbors.
const MAX_MISPLACEMENT: f64 = 0.5;
/// Minimum percentage of photographs that are registered.
const MIN_REGISTERED: f64 = 95.0;

pub(super) fn room_12() -> Result<Vec<Check>> {
    check_walk(&Walk::new(Scene::room(1), Scene::room_walk(12)), 9.0)
}

pub(super) fn room_50() -> Result<Vec<Check>> {
    check_walk(&Walk::new(Scene::room(1), Scene::room_walk(50)), 9.0)
}

pub(super) fn street_12() -> Result<Vec<Check>> {
    check_walk(&Walk::new(Scene::street(1, 5, 0), Scene::street_walk(5, 12)), 30.0)
}

pub(super) fn street_50() -> Result<Vec<Check>> {
    check_walk(&street_50_walk(), 108.0)
}

pub(super) fn street_200() -> Result<Vec<Check>> {
    check_walk(&Walk::new(Scene::street(1, 60, 0), Scene::street_walk(60, 200)), 360.0)
}

fn street_50_walk() -> Walk {
    Walk::new(Scene::street(1, 18, 0), Scene::street_walk(18, 50))
}

/// Random subsets of a walk along a street, with a known camera: many views lack their neighbors, and facades look alike.
/// Views that overlap with no other may be left out, or make a model of their own, but no model may join places that are
/// apart.
pub(super) fn street_gaps() -> Result<Vec<Check>> {
    let walk = street_50_walk();
    let known = SfmCamera { camera: walk.camera, knowledge: CameraKnowledge::Known };
    let photos = walk.photos(&SfmJobOptions::default())?;
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let (mut wrong, mut registered, mut views) = (0, 0, 0);
    for (subset, share) in [0.35, 0.5, 0.7].into_iter().cycle().take(12).enumerate() {
        let kept: Vec<usize> =
            (0..photos.len()).filter(|_| f64::from(random.next_u32()) < share * f64::from(u32::MAX)).collect();
        let truth: Vec<Pose> = kept.iter().map(|v| walk.poses[*v]).collect();
        let photos: Vec<SfmPhoto> = kept.iter().map(|v| photos[*v].clone()).collect();
        let result = sfm(&photos, &[known], &SfmJobOptions::default(), &Silent)?;
        let mut errors = Vec::new();
        for model in &result.models {
            errors.push(PoseErrors::of(model, &truth)?.center);
            registered += model.registered();
        }
        views += kept.len();
        wrong += errors.iter().filter(|error| **error > MAX_MISPLACEMENT).count();
        println!("subset {subset}: {} photographs, largest center error of each model, m: {errors:.3?}", kept.len());
    }
    Ok(vec![
        Check::at_most("models that join different places", wrong as f64, 0.0),
        Check::at_least("photographs registered, %", 100.0 * registered as f64 / views as f64, MIN_REGISTERED),
    ])
}

/// Checks a walk with known and with unknown intrinsics; `side` is the scene's longest side in meters.
fn check_walk(walk: &Walk, side: f64) -> Result<Vec<Check>> {
    let options = SfmJobOptions::default();
    let photos = walk.photos(&options)?;
    let known = SfmCamera { camera: walk.camera, knowledge: CameraKnowledge::Known };
    let mut checks = Vec::new();
    for (name, camera) in [("camera known", known), ("camera unknown", walk.unknown_camera())] {
        let result = sfm(&photos, &[camera], &options, &Silent)?;
        let model = result.models.first().context("no model")?;
        let errors = PoseErrors::of(model, &walk.poses)?;
        println!(
            "{name}: {} of {} photographs, largest center error {:.1} mm, largest rotation error {:.4}°; {} points, {:?}, {:.1} s",
            model.registered(),
            walk.poses.len(),
            1e3 * errors.center,
            errors.rotation,
            model.points.len(),
            model.cameras[0],
            result.stages.iter().map(|s| s.1).sum::<f64>(),
        );
        print_localization_errors(&model.points.iter().map(|p| &p.observations[..]).collect::<Vec<_>>(), &photos, walk);
        let name = |what: &str| format!("{name}: {what}");
        checks.extend([
            Check::at_least(name("photographs registered"), model.registered() as f64, walk.poses.len() as f64),
            Check::at_most(name("centers, % of the scene"), 100.0 * errors.center / side, 100.0 * MAX_CENTER_ERROR),
            Check::at_most(name("rotations, degrees"), errors.rotation, MAX_ROTATION_ERROR_DEG),
        ]);
    }
    Ok(checks)
}

/// Largest errors over the images of a model: of the camera center in meters, of the rotation in degrees.
pub(super) struct PoseErrors {
    pub(super) center: f64,
    pub(super) rotation: f64,
}

impl PoseErrors {
    pub(super) fn of(model: &SfmModel, truth: &[Pose]) -> Result<Self> {
        let both: Vec<(&Pose, &Pose)> =
            model.poses.iter().zip(truth).filter_map(|(found, truth)| Some((found.as_ref()?, truth))).collect();
        let (found, true_centers): (Vec<Point3<f64>>, Vec<Point3<f64>>) =
            both.iter().map(|(f, t)| (f.center(), t.center())).unzip();
        let to_truth = align_points(&found, &true_centers, true)?;
        let center =
            found.iter().zip(&true_centers).map(|(f, t)| (to_truth.transform(f) - t).norm()).fold(0.0, f64::max);
        // The rotation between the frames is the mean over the images: from centers on a line it is undetermined.
        let rotations: Vec<_> = both.iter().map(|(f, t)| f.rotation.inverse() * t.rotation).collect();
        let sum: Matrix3<f64> = rotations.iter().map(|r| *r.matrix()).sum();
        let mean = nalgebra::Rotation3::from_matrix(&sum);
        let rotation = rotations.iter().map(|r| rotation_error(r, &mean).to_degrees()).fold(0.0, f64::max);
        Ok(Self { center, rotation })
    }
}

/// Prints the localization errors of features: reprojection errors in the true cameras of points triangulated robustly from them.
fn print_localization_errors(tracks: &[&[Observation]], photos: &[SfmPhoto], walk: &Walk) {
    let mut all: Vec<(f64, Vector3<f64>, Point2<f64>)> = Vec::new();
    for track in tracks {
        let keypoint = |o: &Observation| &photos[o.view as usize].keypoints[o.keypoint as usize];
        let rays: Vec<(&Pose, Point2<f64>)> =
            track.iter().map(|o| (&walk.poses[o.view as usize], keypoint(o).position.cast())).collect();
        let Some(point) = triangulate_robustly(&rays, &walk.camera) else { continue };
        for ((pose, at), o) in rays.iter().zip(*track) {
            if let Some(p) = walk.camera.project(&pose.transform(&point)) {
                all.push((f64::from(keypoint(o).scale), Vector3::new(at.x - p.x, at.y - p.y, (at - p).norm()), *at));
            }
        }
    }
    for (from, to) in [(0.0, 1.0), (1.0, 1.5), (1.5, 2.0), (2.0, 3.0), (3.0, 5.0), (5.0, 1e9)] {
        let in_range: Vec<&(f64, Vector3<f64>, Point2<f64>)> = all.iter().filter(|a| a.0 >= from && a.0 < to).collect();
        let q = |p: f64| quantile(&mut in_range.iter().map(|a| a.1.z).collect::<Vec<_>>(), p).unwrap_or(f64::NAN);
        let [dx, dy] =
            [0, 1].map(|k| quantile(&mut in_range.iter().map(|a| a.1[k]).collect::<Vec<_>>(), 0.5).unwrap_or(f64::NAN));
        println!(
            "  σ {from} to {to}: {} observations, error {:.3} (median), {:.3} (90th percentile) px; bias {dx:.4} {dy:.4}",
            in_range.len(),
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
                let in_cell: Vec<_> = all.iter().filter(|a| inside(&a.2)).collect();
                let [dx, dy] = [0, 1].map(|k| {
                    quantile(&mut in_cell.iter().map(|a| a.1[k]).collect::<Vec<_>>(), 0.5).unwrap_or(f64::NAN)
                });
                format!("{dx:+.3} {dy:+.3}")
            })
            .collect();
        println!("  {}", line.join(" | "));
    }
}

/// Triangulates a point from known cameras by minimizing the reprojection error in pixels with a Cauchy loss of scale 1 px.
fn triangulate_robustly(observations: &[(&Pose, Point2<f64>)], camera: &Camera) -> Option<Point3<f64>> {
    let (first, last) = (observations.first()?, observations.last()?);
    let m = Correspondence { a: camera.normalize(first.1), b: camera.normalize(last.1) };
    let local = triangulate(&m, &Pose::relative(first.0, last.0)).ok()?;
    let mut point = first.0.inverse().transform(&local);
    for _ in 0..10 {
        let (mut h, mut g) = (Matrix3::zeros(), Vector3::zeros());
        for (pose, at) in observations {
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
