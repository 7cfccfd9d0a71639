//! Accuracy of a sparse model against known camera poses: pose AUC, camera center error, reprojection error.

use anyhow::{Context, Result, ensure};
use cv_core::nalgebra::{Quaternion, UnitQuaternion};
use cv_core::{Point3, Pose, SparseModel, Vector3};
use cv_geometry::align_points;
use cv_synth::{direction_error, rotation_error};
use std::collections::BTreeMap;
use std::path::Path;

/// Degrees up to which the area under the recall curve is computed.
const LIMITS: [f64; 3] = [1.0, 3.0, 5.0];
/// Degrees: an image is registered correctly if the median of its relative pose errors to the other registered images is below this. The
/// median tolerates that half of the others are wrong.
const MAX_MEDIAN_ERROR_DEG: f64 = LIMITS[2];
/// Smallest baseline with a defined direction, as a fraction of the extent of the camera centers.
const MIN_BASELINE: f64 = 1e-6;

/// Poses, world to camera, by the image's file name.
pub(crate) type Poses = BTreeMap<String, Pose>;

/// Scores of a model against the ground truth.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Score {
    /// Number of images with ground truth that the model contains.
    pub(crate) registered: usize,
    /// Names of those registered correctly, see [`MAX_MEDIAN_ERROR_DEG`].
    pub(crate) correct: Vec<String>,
    /// AUC in percent up to each of [`LIMITS`], over all pairs with ground truth, of the larger of the relative rotation error and the relative
    /// translation direction error; a pair with an unregistered image has an infinite error.
    pub(crate) auc: [f64; 3],
    /// RMS error of the camera centers after a similarity alignment, over the RMS distance of the true ones from their mean; NaN if the
    /// alignment fails.
    pub(crate) centers: f64,
    pub(crate) points: usize,
    pub(crate) track_length: f64,
    /// Mean reprojection error in pixels over all observations, computed from the model's cameras, poses and points; the errors stored
    /// in its files are not used.
    pub(crate) reprojection: f64,
}

/// Reads poses from lines `name qw qx qy qz tx ty tz`; `#` begins a comment.
///
/// # Errors
///
/// If the file cannot be read or parsed, or has fewer than three poses.
pub(crate) fn read_truth(path: &Path) -> Result<Poses> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    let mut poses = Poses::new();
    for line in text.lines().filter(|line| !line.trim().is_empty() && !line.starts_with('#')) {
        let mut words = line.split_whitespace();
        let name = words.next().context("an empty line")?;
        let numbers: Vec<f64> = words.map(str::parse).collect::<Result<_, _>>().with_context(|| line.to_owned())?;
        let &[w, x, y, z, tx, ty, tz] = &numbers[..] else {
            anyhow::bail!("{}: {line}: seven numbers are needed", path.display())
        };
        let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_rotation_matrix();
        poses.insert(name.to_owned(), Pose::new(rotation, Vector3::new(tx, ty, tz)));
    }
    ensure!(poses.len() >= 3, "{}: {} poses are too few", path.display(), poses.len());
    Ok(poses)
}

/// Scores a model against `truth`.
pub(crate) fn score(model: &SparseModel, truth: &Poses) -> Score {
    let name = |path: &str| path.rsplit(['/', '\\']).next().unwrap_or(path).to_owned();
    let estimated: Poses = model.images.values().map(|image| (name(&image.name), image.pose)).collect();
    let (errors, by_name) = pair_errors(&estimated, truth);
    let registered: Vec<&String> = truth.keys().filter(|name| estimated.contains_key(*name)).collect();
    let correct =
        by_name.into_iter().filter(|(_, errors)| median(errors) < MAX_MEDIAN_ERROR_DEG).map(|(name, _)| name).collect();
    let true_centers: Vec<Point3<f64>> = registered.iter().map(|name| truth[*name].center()).collect();
    let centers: Vec<Point3<f64>> = registered.iter().map(|name| estimated[*name].center()).collect();
    let observations: usize = model.points.values().map(|point| point.track.len()).sum();
    Score {
        registered: registered.len(),
        correct,
        auc: LIMITS.map(|limit| area_under_recall(&errors, limit)),
        centers: centers_error(&centers, &true_centers),
        points: model.points.len(),
        track_length: observations as f64 / model.points.len() as f64,
        reprojection: mean_reprojection_error(model),
    }
}

/// Returns the error in degrees of each pair with ground truth, infinite if an image is not registered, and the finite ones by image.
fn pair_errors(estimated: &Poses, truth: &Poses) -> (Vec<f64>, BTreeMap<String, Vec<f64>>) {
    let mean = truth.values().map(|pose| pose.center().coords).sum::<Vector3<f64>>() / truth.len() as f64;
    let extent = truth.values().map(|pose| (pose.center().coords - mean).norm()).fold(0.0, f64::max);
    let (mut errors, mut by_name) = (Vec::new(), BTreeMap::<String, Vec<f64>>::new());
    let truths: Vec<_> = truth.iter().collect();
    for (i, (a, true_a)) in truths.iter().enumerate() {
        for (b, true_b) in &truths[i + 1..] {
            let (Some(pose_a), Some(pose_b)) = (estimated.get(*a), estimated.get(*b)) else {
                errors.push(f64::INFINITY);
                continue;
            };
            let expected = true_b.compose(&true_a.inverse());
            let relative = pose_b.compose(&pose_a.inverse());
            let mut error = rotation_error(&relative.rotation, &expected.rotation);
            if expected.translation.norm() > MIN_BASELINE * extent {
                error = error.max(direction_error(&relative.translation, &expected.translation));
            }
            let error = error.to_degrees();
            errors.push(error);
            for name in [*a, *b] {
                by_name.entry(name.clone()).or_default().push(error);
            }
        }
    }
    (errors, by_name)
}

fn median(values: &[f64]) -> f64 {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::INFINITY)
}

/// Computes the area under the recall curve from 0 to `limit`, over `limit`, in percent.
fn area_under_recall(errors: &[f64], limit: f64) -> f64 {
    100.0 * errors.iter().map(|error| (limit - error).max(0.0)).sum::<f64>() / (limit * errors.len() as f64)
}

fn centers_error(centers: &[Point3<f64>], truth: &[Point3<f64>]) -> f64 {
    let Ok(similarity) = align_points(centers, truth, true) else { return f64::NAN };
    let mean = truth.iter().map(|p| p.coords).sum::<Vector3<f64>>() / truth.len() as f64;
    let spread: f64 = truth.iter().map(|p| (p.coords - mean).norm_squared()).sum();
    let squares: f64 = centers.iter().zip(truth).map(|(p, q)| (similarity.transform(p) - q).norm_squared()).sum();
    (squares / spread).sqrt()
}

fn mean_reprojection_error(model: &SparseModel) -> f64 {
    let (mut sum, mut count) = (0.0, 0);
    for point in model.points.values() {
        for (image, index) in &point.track {
            let error = model.images.get(image).and_then(|image| {
                let camera = model.cameras.get(&image.camera)?;
                let pixel = camera.project(&image.pose.transform(&point.position))?;
                Some((pixel - image.points.get(*index as usize)?.0).norm())
            });
            // An observation that cannot be projected is an error of the model: the mean becomes NaN, which meets no target.
            sum += error.unwrap_or(f64::NAN);
            count += 1;
        }
    }
    sum / f64::from(count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Camera, ModelImage, ModelPoint, Rotation3};

    /// Cameras on a circle of radius 5 that look at its center, and a point there, visible in all.
    fn ring(count: u32) -> (SparseModel, Poses) {
        let camera = Camera::from_focal(640, 480, 500.0);
        let (mut model, mut truth) = (SparseModel::default(), Poses::new());
        for i in 0..count {
            let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), 0.3 * f64::from(i));
            let pose = Pose::new(turn, Vector3::new(0.0, 0.0, 5.0));
            let at = camera.project(&pose.transform(&Point3::origin())).unwrap();
            let name = format!("{i}.jpg");
            truth.insert(name.clone(), pose);
            model
                .images
                .insert(i, ModelImage { name: format!("in/{name}"), camera: 1, pose, points: vec![(at, Some(1))] });
        }
        model.cameras.insert(1, camera);
        let track = (0..count).map(|i| (i, 0)).collect();
        model.points.insert(1, ModelPoint { position: Point3::origin(), color: [0; 3], error: 9.0, track });
        (model, truth)
    }

    #[test]
    fn the_ground_truth_after_a_similarity_scores_perfectly() {
        let (mut model, truth) = ring(5);
        // The same cameras in a rotated, translated and scaled world.
        let world = Pose::new(Rotation3::from_euler_angles(0.3, -1.0, 2.0), Vector3::new(3.0, 1.0, -2.0));
        for image in model.images.values_mut() {
            image.pose = image.pose.compose(&world);
            image.pose.translation *= 2.0;
        }
        for point in model.points.values_mut() {
            point.position = Point3::from(world.inverse().transform(&point.position).coords * 2.0);
        }
        let score = score(&model, &truth);
        assert_eq!((score.registered, score.correct.len(), score.points, score.track_length), (5, 5, 1, 5.0));
        // Only rounding errors remain.
        assert!(score.auc.iter().all(|auc| (auc - 100.0).abs() < 1e-9), "{score:?}");
        assert!(score.centers < 1e-12 && score.reprojection < 1e-9, "{score:?}");
    }

    #[test]
    fn the_auc_of_a_camera_rotated_by_two_degrees_follows_its_definition() {
        let (mut model, truth) = ring(3);
        let turned = Rotation3::from_axis_angle(&Vector3::z_axis(), 2f64.to_radians());
        let image = model.images.get_mut(&1).unwrap();
        // About its own center: the rotation errors of its two pairs are exactly 2 degrees, and so are the direction errors in the frame of camera 1.
        image.pose = Pose::new(turned, Vector3::zeros()).compose(&image.pose);
        let score = score(&model, &truth);
        // Two of three pairs: nothing up to 1 degree; a third of the area up to 3 and three fifths of that up to 5.
        let expected = [100.0 / 3.0, (100.0 + 2.0 * 100.0 / 3.0) / 3.0, (100.0 + 2.0 * 60.0) / 3.0];
        assert!(score.auc.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{score:?}");
        assert_eq!(score.correct.len(), 3);
        assert!(score.centers < 1e-12);
    }

    #[test]
    fn a_missing_or_misplaced_camera_is_not_registered_correctly() {
        let (mut model, truth) = ring(5);
        model.images.remove(&0);
        model.points.clear();
        // Rotated by 180° about the world's y axis.
        let image = model.images.get_mut(&3).unwrap();
        image.pose.rotation *= Rotation3::from_axis_angle(&Vector3::y_axis(), std::f64::consts::PI);
        let score = score(&model, &truth);
        assert_eq!((score.registered, &score.correct[..]), (4, &["1.jpg", "2.jpg", "4.jpg"].map(String::from)[..]));
        // Three pairs of ten remain.
        assert!((score.auc[0] - 30.0).abs() < 1e-9, "{score:?}");
        assert!(score.reprojection.is_nan());
    }
}
