//! A first lens and first poses for a camera of which nothing is known.

use crate::CalibrateError;
use crate::adjustment::{Estimate, Failure, Free, Lenses, Used, adjust};
use crate::plane_pose::{plane_homography, plane_pose, pose_from_homography};
use crate::target::{Sightings, TargetCorner};
use crate::zhang::intrinsics_from_homographies;
use cv_core::{Camera, Correspondence, Distortion, LensProjection, Matrix3, Pose, Progress, Stage, Vector3, median};
use cv_geometry::homography_from_points;
use cv_numeric::RobustLoss;
use rayon::prelude::*;

/// Views that candidates are compared on, and that the first adjustment is of.
const VIEWS: usize = 12;
/// Focal lengths that are tried: from a fifth of the picture's longer side to ten times it, a quarter more each.
const FOCALS: i32 = 18;
/// Shares by which a barrel shortens the distance of a corner of the picture from its middle.
const BARRELS: [f64; 3] = [0.0, 0.08, 0.2];

/// The least squares start: Cauchy's loss with the scale the residuals have, in pixels, but no less than this.
const LEAST_SCALE: f64 = 1.0;

/// A start of either kind of lens, of one camera.
#[derive(Debug, Clone)]
pub(crate) struct Start {
    pub(crate) estimate: Estimate,
    /// Median distance of the corners from where they should be, in pixels.
    pub(crate) error: f64,
}

/// Corners of a view that a start is made of: poses and medians of them are near enough to those of all.
const CORNERS: usize = 24;

/// So many of `n` numbers: every so many-th by the golden ratio, which is no multiple of the length of any row.
fn some(n: usize) -> Vec<usize> {
    if n <= CORNERS {
        return (0..n).collect();
    }
    let mut chosen: Vec<usize> = (0..CORNERS).map(|k| (((k as f64 * 0.618_034).fract()) * n as f64) as usize).collect();
    chosen.sort_unstable();
    chosen.dedup();
    chosen
}

fn some_corners(corners: &[TargetCorner]) -> Vec<TargetCorner> {
    some(corners.len()).into_iter().map(|i| corners[i]).collect()
}

/// No more than [`CORNERS`] of the corners of each picture that count.
pub(crate) fn thinned(used: &Used) -> Used {
    let picture = |used: &Vec<bool>| {
        let counted: Vec<usize> = (0..used.len()).filter(|i| used[*i]).collect();
        let mut out = vec![false; used.len()];
        some(counted.len()).into_iter().for_each(|i| out[counted[i]] = true);
        out
    };
    used.iter().map(|cameras| cameras.iter().map(picture).collect()).collect()
}

/// Median distances of some of the corners from where cameras and the poses by their homographies have them; infinite where more than half have none. The cameras
/// differ by their focal lengths alone, as distances in the picture go: without distortion all see the same but for its scale, so that the first one's homographies
/// serve all.
fn median_errors(cameras: &[Camera], data: &Sightings, views: &[usize]) -> Vec<f64> {
    let Some(first) = cameras.first() else { return Vec::new() };
    let views: Vec<_> = views
        .iter()
        .map(|v| {
            let corners = some_corners(&data.views[*v][0]);
            let homography = plane_homography(first, &data.target, &corners);
            (corners, homography)
        })
        .collect();
    let of = |camera: &Camera| {
        let mut errors = Vec::new();
        let scale = Vector3::new(first.fx / camera.fx, first.fy / camera.fy, 1.0);
        for (corners, homography) in &views {
            let pose = homography
                .and_then(|h| pose_from_homography(&(Matrix3::from_diagonal(&scale) * h), &data.target, corners));
            errors.extend(corners.iter().map(|c| {
                let seen = pose.and_then(|pose| camera.project(&pose.transform(&data.target.bent(c.point, [0.0; 2]))));
                seen.map_or(f64::INFINITY, |seen| (seen - c.pixel).norm())
            }));
        }
        median(&mut errors).unwrap_or(f64::INFINITY)
    };
    cameras.iter().map(of).collect()
}

/// The cameras that may be near: the principal point in the middle, and what Zhang's method says. By [`median_errors`]' groups.
fn candidates(data: &Sightings, views: &[usize], projection: LensProjection) -> Vec<Vec<Camera>> {
    let (width, height) = data.sizes[0];
    let longer = width.max(height) as f64;
    let mut barrels: [Vec<Camera>; BARRELS.len()] = Default::default();
    let mut out = Vec::new();
    for step in 0..FOCALS {
        let camera = Camera::from_focal(width, height, 0.2 * longer * 1.25f64.powi(step));
        if projection == LensProjection::Fisheye {
            out.push(vec![Camera { distortion: Distortion::fisheye4([0.0; 4]), ..camera }]);
            continue;
        }
        // Of the distance of a corner of the picture, in units of the focal length.
        let squared = ((width as f64 / 2.0).powi(2) + (height as f64 / 2.0).powi(2)) / camera.fx.powi(2);
        for (cameras, barrel) in barrels.iter_mut().zip(BARRELS) {
            let distortion = Distortion::radial_tangential4([-barrel / squared, 0.0, 0.0, 0.0]);
            cameras.push(Camera { distortion, ..camera });
        }
    }
    out.extend(barrels);
    if projection == LensProjection::Perspective {
        let plane = |v: &usize| {
            let pairs =
                data.views[*v][0].iter().map(|c| Correspondence { a: data.target.points()[c.point], b: c.pixel });
            homography_from_points(&pairs.collect::<Vec<_>>()).ok()
        };
        let homographies: Vec<_> = views.iter().filter_map(plane).collect();
        let zhang = intrinsics_from_homographies(&homographies, data.sizes[0]);
        out.extend(zhang.map(|camera| vec![Camera { distortion: Distortion::radial_tangential4([0.0; 4]), ..camera }]));
    }
    out
}

/// `most` of the views, evenly.
fn spread(views: &[usize], most: usize) -> Vec<usize> {
    let n = views.len().min(most);
    (0..n).map(|i| views[i * views.len() / n]).collect()
}

/// Cauchy's loss for corners that are typically so far off.
pub(crate) fn cauchy(typical: f64) -> RobustLoss {
    RobustLoss::Cauchy { scale: (2.0 * typical).max(LEAST_SCALE) }
}

/// A start for the only camera of `data` from the views that can be used. A perspective lens with two radial and two tangential parameters, or a fisheye.
///
/// # Errors
/// [`CalibrateError::NoStart`] where no candidate fits, and [`CalibrateError::Cancelled`].
pub(crate) fn start(
    data: &Sightings,
    usable: &[usize],
    projection: LensProjection,
    progress: &dyn Progress,
) -> Result<Start, CalibrateError> {
    let few = spread(usable, VIEWS);
    let candidates = candidates(data, &few, projection);
    let stage = Stage::new(progress, "start", candidates.len())?;
    let compared = spread(usable, VIEWS / 2);
    let errors: Result<Vec<Vec<f64>>, _> = candidates
        .par_iter()
        .map(|cameras| {
            stage.add(1)?;
            Ok::<_, CalibrateError>(median_errors(cameras, data, &compared))
        })
        .collect();
    let mut ranked: Vec<(f64, Camera)> =
        errors?.concat().into_iter().zip(candidates.concat()).filter(|(e, _)| e.is_finite()).collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
    let model = match projection {
        LensProjection::Perspective => cv_core::DistortionModel::RadialTangential4,
        LensProjection::Fisheye => cv_core::DistortionModel::Fisheye4,
    };
    let mut best: Option<Start> = None;
    // The nearest two, as the nearest may lead to another minimum.
    for (error, camera) in ranked.iter().take(2) {
        match refine(data, &few, camera, *error, progress) {
            Ok(found) if best.as_ref().is_none_or(|b| found.error < b.error) => best = Some(found),
            Err(Failure::Cancelled) => return Err(cv_core::Cancelled.into()),
            _ => {}
        }
    }
    let no_start =
        CalibrateError::NoStart { camera: 0, model, error_px: ranked.first().map_or(f64::INFINITY, |r| r.0) };
    let mut best = best.ok_or(no_start)?;
    // The poses of the views that had no part in it.
    best.estimate.poses = poses(data, usable, &best.estimate.cameras[0]);
    Ok(best)
}

/// The poses of views by the homographies of some of their corners.
pub(crate) fn poses(data: &Sightings, usable: &[usize], camera: &Camera) -> Vec<Option<Pose>> {
    let mut poses = vec![None; data.views.len()];
    for &v in usable {
        poses[v] = plane_pose(camera, &data.target, &some_corners(&data.views[v][0]));
    }
    poses
}

/// All corners of the usable views.
pub(crate) fn all_corners(data: &Sightings, usable: &[usize]) -> Used {
    let mut used: Used = data
        .views
        .iter()
        .map(|cameras| cameras.iter().map(|c: &Vec<TargetCorner>| vec![false; c.len()]).collect())
        .collect();
    for &v in usable {
        used[v].iter_mut().flatten().for_each(|u| *u = true);
    }
    used
}

fn refine(
    data: &Sightings,
    views: &[usize],
    camera: &Camera,
    error: f64,
    progress: &dyn Progress,
) -> Result<Start, Failure> {
    let few = data.subset(views);
    let all: Vec<usize> = (0..views.len()).collect();
    let mut estimate = Estimate {
        cameras: vec![*camera],
        mounts: vec![Pose::identity()],
        poses: poses(&few, &all, camera),
        shape: [0.0; 2],
    };
    let used = thinned(&all_corners(&few, &all));
    let coarse = Free { lenses: Lenses::Coarse, shape: false, mounts: false };
    adjust(&few, &mut estimate, &used, (coarse, cauchy(error)), (30, 1e-3), progress)?;
    let free = Free { lenses: Lenses::All, shape: false, mounts: false };
    let typical = |estimate: &Estimate| {
        let residuals = (0..views.len()).flat_map(|v| estimate.residuals(&few, v, 0));
        let mut errors: Vec<f64> = residuals.map(|r| r.map_or(f64::INFINITY, |r| r.norm())).collect();
        median(&mut errors).unwrap_or(f64::INFINITY)
    };
    let mut last = None;
    for _ in 0..2 {
        let loss = cauchy(typical(&estimate).min(error.max(LEAST_SCALE)));
        if last.replace(loss) == Some(loss) {
            break;
        }
        adjust(&few, &mut estimate, &used, (free, loss), (50, 1e-3), progress)?;
    }
    let error = typical(&estimate);
    Ok(Start { estimate, error })
}
