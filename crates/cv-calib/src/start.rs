//! Initial intrinsics and target poses of a single camera without prior knowledge.

use crate::CalibrateError;
use crate::adjustment::{Estimate, Failure, FreeIntrinsics, FreeParameters, InlierMask, adjust};
use crate::plane_pose::{plane_homography, plane_pose, pose_from_homography};
use crate::target::{TargetCorner, TargetObservations};
use crate::zhang::intrinsics_from_homographies;
use cv_core::{Camera, Correspondence, Distortion, LensProjection, Matrix3, Pose, Progress, Stage, Vector3, median};
use cv_geometry::homography_from_points;
use cv_numeric::RobustLoss;
use cv_parallel::prelude::*;

/// Maximum number of views of the initial adjustment; half as many rank the candidates.
const INITIAL_VIEWS: usize = 12;
/// Number of candidate focal lengths: from 0.2 times the longer image side, in steps of 25 %.
const FOCAL_CANDIDATES: i32 = 18;
/// Candidate barrel distortions: relative displacement of the image corner towards the center.
const BARREL_DISPLACEMENTS: [f64; 3] = [0.0, 0.08, 0.2];

/// Lower bound of the scale of the Cauchy loss, in pixels.
const MIN_LOSS_SCALE: f64 = 1.0;

/// Initial values of one camera with a perspective or fisheye lens.
#[derive(Debug, Clone)]
pub(crate) struct InitialValues {
    pub(crate) estimate: Estimate,
    /// Median reprojection error of the corners, in pixels.
    pub(crate) error: f64,
}

/// Maximum number of corners of a view for initial values: enough for poses and medians.
const SAMPLED_CORNERS: usize = 24;

/// Returns at most that many of `n` indices, spread by the golden ratio, which is no multiple of a row's length.
fn sample_indices(n: usize) -> Vec<usize> {
    if n <= SAMPLED_CORNERS {
        return (0..n).collect();
    }
    let mut indices: Vec<usize> =
        (0..SAMPLED_CORNERS).map(|k| (((k as f64 * 0.618_034).fract()) * n as f64) as usize).collect();
    indices.sort_unstable();
    indices.dedup();
    indices
}

/// Returns a sample of the corners.
fn sample_corners(corners: &[TargetCorner]) -> Vec<TargetCorner> {
    sample_indices(corners.len()).into_iter().map(|i| corners[i]).collect()
}

/// Returns a mask with at most [`SAMPLED_CORNERS`] corners of each image.
pub(crate) fn sample_mask(used: &InlierMask) -> InlierMask {
    let sample_image = |used: &Vec<bool>| {
        let set_indices: Vec<usize> = (0..used.len()).filter(|i| used[*i]).collect();
        let mut out = vec![false; used.len()];
        sample_indices(set_indices.len()).into_iter().for_each(|i| out[set_indices[i]] = true);
        out
    };
    used.iter().map(|cameras| cameras.iter().map(sample_image).collect()).collect()
}

/// Returns the median reprojection error of sampled corners for each camera, with target poses from homographies;
/// infinite where more than half do not project. The cameras must differ only in focal length, with the same distortion
/// in pixels: their homographies are then equal up to scale, and are computed once.
fn median_errors(cameras: &[Camera], data: &TargetObservations, views: &[usize]) -> Vec<f64> {
    let Some(first) = cameras.first() else { return Vec::new() };
    let views: Vec<_> = views
        .iter()
        .map(|v| {
            let corners = sample_corners(&data.views[*v][0]);
            let homography = plane_homography(first, &data.target, &corners);
            (corners, homography)
        })
        .collect();
    let median_error = |camera: &Camera| {
        let mut errors = Vec::new();
        let scale = Vector3::new(first.fx / camera.fx, first.fy / camera.fy, 1.0);
        for (corners, homography) in &views {
            let pose = homography
                .and_then(|h| pose_from_homography(&(Matrix3::from_diagonal(&scale) * h), &data.target, corners));
            errors.extend(corners.iter().map(|c| {
                let projection =
                    pose.and_then(|pose| camera.project(&pose.transform(&data.target.bent(c.point, [0.0; 2]))));
                projection.map_or(f64::INFINITY, |projection| (projection - c.pixel).norm())
            }));
        }
        median(&mut errors).unwrap_or(f64::INFINITY)
    };
    cameras.iter().map(median_error).collect()
}

/// Returns candidate cameras in groups for [`median_errors`]: with a centered principal point, and by Zhang's method.
fn candidate_cameras(data: &TargetObservations, views: &[usize], projection: LensProjection) -> Vec<Vec<Camera>> {
    let (width, height) = data.sizes[0];
    let longer_side = width.max(height) as f64;
    let mut groups: [Vec<Camera>; BARREL_DISPLACEMENTS.len()] = Default::default();
    let mut out = Vec::new();
    for step in 0..FOCAL_CANDIDATES {
        let camera = Camera::from_focal(width, height, 0.2 * longer_side * 1.25f64.powi(step));
        if projection == LensProjection::Fisheye {
            out.push(vec![Camera { distortion: Distortion::fisheye4([0.0; 4]), ..camera }]);
            continue;
        }
        // Squared distance of the image corner, in focal lengths.
        let squared = ((width as f64 / 2.0).powi(2) + (height as f64 / 2.0).powi(2)) / camera.fx.powi(2);
        for (cameras, displacement) in groups.iter_mut().zip(BARREL_DISPLACEMENTS) {
            let distortion = Distortion::radial_tangential4([-displacement / squared, 0.0, 0.0, 0.0]);
            cameras.push(Camera { distortion, ..camera });
        }
    }
    out.extend(groups);
    if projection == LensProjection::Perspective {
        let homography = |v: &usize| {
            let pairs =
                data.views[*v][0].iter().map(|c| Correspondence { a: data.target.points()[c.point], b: c.pixel });
            homography_from_points(&pairs.collect::<Vec<_>>()).ok()
        };
        let homographies: Vec<_> = views.iter().filter_map(homography).collect();
        let zhang = intrinsics_from_homographies(&homographies, data.sizes[0]);
        out.extend(zhang.map(|camera| vec![Camera { distortion: Distortion::radial_tangential4([0.0; 4]), ..camera }]));
    }
    out
}

/// Returns at most `max` views, evenly sampled.
fn sample_views(views: &[usize], max: usize) -> Vec<usize> {
    let n = views.len().min(max);
    (0..n).map(|i| views[i * views.len() / n]).collect()
}

/// Returns the Cauchy loss for a median error in pixels.
pub(crate) fn cauchy(median_error: f64) -> RobustLoss {
    RobustLoss::Cauchy { scale: (2.0 * median_error).max(MIN_LOSS_SCALE) }
}

/// Estimates initial values for the single camera of `data` from the usable views: a perspective lens with two radial
/// and two tangential coefficients, or a fisheye lens.
///
/// # Errors
/// [`CalibrateError::NoStart`] if no candidate fits, and [`CalibrateError::Cancelled`].
pub(crate) fn estimate_initial_values(
    data: &TargetObservations,
    usable: &[usize],
    projection: LensProjection,
    progress: &dyn Progress,
) -> Result<InitialValues, CalibrateError> {
    let sampled = sample_views(usable, INITIAL_VIEWS);
    let candidates = candidate_cameras(data, &sampled, projection);
    let stage = Stage::new(progress, "start", candidates.len())?;
    let ranking_views = sample_views(usable, INITIAL_VIEWS / 2);
    let errors = candidates
        .par_iter()
        .map(|cameras| {
            stage.add(1)?;
            Ok(median_errors(cameras, data, &ranking_views))
        })
        .try_collect::<_, CalibrateError>()?;
    let mut ranked: Vec<(f64, Camera)> =
        errors.concat().into_iter().zip(candidates.concat()).filter(|(e, _)| e.is_finite()).collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
    let model = match projection {
        LensProjection::Perspective => cv_core::DistortionModel::RadialTangential4,
        LensProjection::Fisheye => cv_core::DistortionModel::Fisheye4,
    };
    let mut best: Option<InitialValues> = None;
    // The best two candidates: the best one may lead to a worse local minimum.
    for (error, camera) in ranked.iter().take(2) {
        match adjust_candidate(data, &sampled, camera, *error, progress) {
            Ok(adjusted) if best.as_ref().is_none_or(|b| adjusted.error < b.error) => best = Some(adjusted),
            Err(Failure::Cancelled) => return Err(cv_core::Cancelled.into()),
            _ => {}
        }
    }
    let no_start =
        CalibrateError::NoStart { camera: 0, model, error_px: ranked.first().map_or(f64::INFINITY, |r| r.0) };
    let mut best = best.ok_or(no_start)?;
    // Poses of the views that were not sampled.
    best.estimate.poses = poses_from_homographies(data, usable, &best.estimate.cameras[0]);
    Ok(best)
}

/// Estimates the target poses of views from the homographies of sampled corners.
pub(crate) fn poses_from_homographies(
    data: &TargetObservations,
    usable: &[usize],
    camera: &Camera,
) -> Vec<Option<Pose>> {
    let mut poses = vec![None; data.views.len()];
    for &v in usable {
        poses[v] = plane_pose(camera, &data.target, &sample_corners(&data.views[v][0]));
    }
    poses
}

/// Returns the mask of all corners of the usable views.
pub(crate) fn mask_of_views(data: &TargetObservations, usable: &[usize]) -> InlierMask {
    let mut used: InlierMask = data
        .views
        .iter()
        .map(|cameras| cameras.iter().map(|c: &Vec<TargetCorner>| vec![false; c.len()]).collect())
        .collect();
    for &v in usable {
        used[v].iter_mut().flatten().for_each(|u| *u = true);
    }
    used
}

/// Adjusts a candidate, first the focal lengths and the first two distortion coefficients, then all intrinsics.
fn adjust_candidate(
    data: &TargetObservations,
    views: &[usize],
    camera: &Camera,
    error: f64,
    progress: &dyn Progress,
) -> Result<InitialValues, Failure> {
    let sampled = data.subset(views);
    let all: Vec<usize> = (0..views.len()).collect();
    let mut estimate = Estimate {
        cameras: vec![*camera],
        rig_poses: vec![Pose::identity()],
        poses: poses_from_homographies(&sampled, &all, camera),
        shape: [0.0; 2],
    };
    let used = sample_mask(&mask_of_views(&sampled, &all));
    let coarse = FreeParameters { intrinsics: FreeIntrinsics::Coarse, shape: false, rig_poses: false };
    adjust(&sampled, &mut estimate, &used, (coarse, cauchy(error)), (30, 1e-3), progress)?;
    let free = FreeParameters { intrinsics: FreeIntrinsics::All, shape: false, rig_poses: false };
    let median_error = |estimate: &Estimate| {
        let residuals = (0..views.len()).flat_map(|v| estimate.residuals(&sampled, v, 0));
        let mut errors: Vec<f64> = residuals.map(|r| r.map_or(f64::INFINITY, |r| r.norm())).collect();
        median(&mut errors).unwrap_or(f64::INFINITY)
    };
    let mut previous = None;
    for _ in 0..2 {
        let loss = cauchy(median_error(&estimate).min(error.max(MIN_LOSS_SCALE)));
        if previous.replace(loss) == Some(loss) {
            break;
        }
        adjust(&sampled, &mut estimate, &used, (free, loss), (50, 1e-3), progress)?;
    }
    let error = median_error(&estimate);
    Ok(InitialValues { estimate, error })
}
