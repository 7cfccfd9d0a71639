//! The pose of a planar target from one image.

use crate::target::{TargetCorner, TargetPoints};
use cv_core::{Camera, Correspondence, Matrix3, Pose, Vector3};
use cv_geometry::homography_from_points;
use cv_numeric::svd3;

/// Returns whether an image shows the target mirrored, by the best affine map; `None` for too few or collinear corners.
pub(crate) fn is_mirrored(target: &TargetPoints, corners: &[TargetCorner]) -> Option<bool> {
    let n = corners.len() as f64;
    let position = |c: &TargetCorner| target.points()[c.point].coords;
    let target_mean = corners.iter().map(position).sum::<nalgebra::Vector2<f64>>() / n;
    let image_mean = corners.iter().map(|c| c.pixel.coords).sum::<nalgebra::Vector2<f64>>() / n;
    let (mut aa, mut ba) = (nalgebra::Matrix2::zeros(), nalgebra::Matrix2::zeros());
    for c in corners {
        let (a, b) = (position(c) - target_mean, c.pixel.coords - image_mean);
        aa += a * a.transpose();
        ba += b * a.transpose();
    }
    let map = ba * aa.try_inverse()?;
    // The determinant is far below the product of the lengths for a target seen edge-on.
    let min_determinant = 1e-3 * map.norm_squared();
    (map.determinant().abs() > min_determinant && aa.determinant() > 1e-9 * aa.norm_squared())
        .then(|| map.determinant() < 0.0)
}

/// Estimates the pose, target to camera, from the homography of the target plane to normalized coordinates. `None` with
/// fewer than four usable corners, for collinear corners, or if some are behind the camera.
pub(crate) fn plane_pose(camera: &Camera, target: &TargetPoints, corners: &[TargetCorner]) -> Option<Pose> {
    pose_from_homography(&plane_homography(camera, target, corners)?, target, corners)
}

/// Estimates the homography from the target plane to normalized coordinates.
pub(crate) fn plane_homography(
    camera: &Camera,
    target: &TargetPoints,
    corners: &[TargetCorner],
) -> Option<Matrix3<f64>> {
    let matches: Vec<Correspondence> = corners
        .iter()
        .map(|c| Correspondence { a: target.points()[c.point], b: camera.normalize(c.pixel) })
        .filter(|m| m.b.x.is_finite() && m.b.y.is_finite())
        .collect();
    homography_from_points(&matches).ok()
}

/// Decomposes a homography: the rotation nearest to its scaled first columns, the translation by their scale. `None` if
/// some corners are behind the camera.
pub(crate) fn pose_from_homography(h: &Matrix3<f64>, target: &TargetPoints, corners: &[TargetCorner]) -> Option<Pose> {
    let points = || corners.iter().map(|c| target.points()[c.point]);
    let depth: f64 = points().map(|p| (h * p.to_homogeneous()).z.signum()).sum();
    let scale = depth.signum() * 2.0 / (h.column(0).norm() + h.column(1).norm());
    let (a, b, t): (Vector3<f64>, Vector3<f64>, Vector3<f64>) =
        ((h.column(0) * scale), (h.column(1) * scale), (h.column(2) * scale));
    let rotation = svd3(&Matrix3::from_columns(&[a, b, a.cross(&b)])).ok()?.nearest_rotation();
    let pose = Pose::new(rotation, t);
    let in_front = points().all(|p| pose.transform(&nalgebra::Point3::new(p.x, p.y, 0.0)).z > 0.0);
    (t.iter().all(|v| v.is_finite()) && in_front).then_some(pose)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Distortion, Point2, Rotation3};

    fn project_target(camera: &Camera, target: &TargetPoints, pose: &Pose) -> Vec<TargetCorner> {
        let pixel = |point| camera.project(&pose.transform(&target.bent(point, [0.0; 2]))).unwrap();
        (0..target.points().len()).map(|point| TargetCorner { point, pixel: pixel(point) }).collect()
    }

    #[test]
    fn exact_corners_determine_the_pose() {
        let target = TargetPoints::grid(9, 6, 1.0).unwrap();
        for distortion in [Distortion::NONE, Distortion::fisheye4([0.05, 0.0, 0.0, 0.0])] {
            let camera = Camera { distortion, ..Camera::from_focal(640, 480, 500.0) };
            let pose = Pose::new(Rotation3::new(Vector3::new(0.4, -0.3, 2.0)), Vector3::new(1.0, -2.0, 11.0));
            let corners = project_target(&camera, &target, &pose);
            let estimated = plane_pose(&camera, &target, &corners).unwrap();
            // The direct linear transform squares the matrix, which leaves eight digits of numbers of order ten.
            assert!((estimated.matrix() - pose.matrix()).norm() < 1e-6, "{estimated:?}");
            assert_eq!(is_mirrored(&target, &corners), Some(false));
        }
    }

    #[test]
    fn mirrored_targets_and_collinear_corners_are_detected() {
        let target = TargetPoints::grid(9, 6, 1.0).unwrap();
        let corner = |point: usize, x: f64, y: f64| TargetCorner { point, pixel: Point2::new(x, y) };
        let p = |i: usize| target.points()[i];
        let mirrored: Vec<_> = (0..54).map(|i| corner(i, 500.0 - 30.0 * p(i).x, 30.0 * p(i).y)).collect();
        assert_eq!(is_mirrored(&target, &mirrored), Some(true));
        let line: Vec<_> = (0..9).map(|i| corner(i, 30.0 * p(i).x, 10.0 * p(i).x)).collect();
        assert_eq!(is_mirrored(&target, &line), None);
        assert_eq!(plane_pose(&Camera::from_focal(640, 480, 500.0), &target, &line), None);
        assert_eq!(is_mirrored(&target, &[]), None);
    }
}
