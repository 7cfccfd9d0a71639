//! Rectification of two general views, around known scene points.
//!
//! A stereo rig has parallel cameras, and both rectified views share one camera ([`Rectification::new`]). Two hand-held views converge on
//! the scene: their common field of view is then at different places of the rectified image planes, and each view has its own principal
//! point.

use crate::rectify::{
    Rectification, RectifiedView, RectifyError, baseline_direction, bounding_box, common_rotations, field_of_view,
};
use crate::{StereoGeometry, StereoOptions};
use cv_core::{Camera, Point3, StereoRig};

/// Two rectified views, and the search range of their disparities.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SceneRectification {
    /// Both views. Never rotated by 90° ([`Rectification::vertical`] is false): their rows run along the baseline, whatever its direction in
    /// the originals.
    pub views: Rectification,
    /// Smallest disparity of the scene in px, and the number of disparities.
    pub disparities: (i32, usize),
}

/// Fraction of the points at either end of the depths that are treated as outliers.
const OUTLIER_FRACTION: f64 = 0.01;

/// Maximum angle from the optical axis of a rectified view: beyond, a perspective image needs ten times the pixels.
const MAX_FIELD_DEGREES: f64 = 70.0;

impl SceneRectification {
    /// Rectifies two views of a scene of which `points` (in the left camera's frame, in the unit of the rig) are known.
    ///
    /// `left` is the first view; it may be on any side of the other, above it or below it. The rectified views cover the common field of view
    /// at the depths of the points, at about the resolution of the originals there. The search range is that of the points without one
    /// percent at either end, extended by a quarter of itself and 4 px at both ends, and never beyond infinity.
    ///
    /// # Errors
    /// [`RectifyError`] with the reason: [`RectifyError::TooFarTurned`] for motion along the optical axis, [`RectifyError::NoOverlap`] if no
    /// point is in front of both rectified cameras.
    pub fn new(rig: &StereoRig, points: &[Point3<f64>]) -> Result<Self, RectifyError> {
        let (x, baseline) = baseline_direction(rig)?;
        let pose = &rig.right_from_left;
        let rotations = common_rotations(x, &pose.rotation)?;

        // Of each point the inverse depth, and the scale of the rectified views relative to the originals.
        let mut inverse = Vec::new();
        let mut growth = Vec::new();
        for p in points {
            let q = pose.transform(p);
            let common = rotations[0] * p;
            if !(p.z > 0.0 && q.z > 0.0 && common.z > 0.0) {
                continue;
            }
            inverse.push(1.0 / common.z);
            // A perspective projection maps a solid angle at the angle θ from its axis to an area of 1 / cos³ θ; the distance of the point cancels.
            growth.push((p.z / common.z).powi(3).sqrt() / rig.left.fx);
            growth.push((q.z / common.z).powi(3).sqrt() / rig.right.fx);
        }
        if inverse.is_empty() {
            return Err(RectifyError::NoOverlap);
        }
        inverse.sort_unstable_by(f64::total_cmp);
        growth.sort_unstable_by(f64::total_cmp);
        let focal = 1.0 / growth[growth.len() / 2];
        let at = |fraction: f64| inverse[((inverse.len() - 1) as f64 * fraction).round() as usize];
        // Normalized disparities: baseline over depth.
        let (low, high) = (baseline * at(OUTLIER_FRACTION), baseline * at(1.0 - OUTLIER_FRACTION));
        let margin = 0.25 * (high - low) + 4.0 / focal;
        let (low, high) = ((low - margin).max(0.0), high + margin);

        let max_tangent = MAX_FIELD_DEGREES.to_radians().tan();
        let [a, b] = [(&rig.left, &rotations[0]), (&rig.right, &rotations[1])]
            .map(|(camera, rotation)| bounding_box(&field_of_view(camera, rotation)));
        let clip = |v: f64| v.clamp(-max_tangent, max_tangent);
        let (top, bottom) = (clip(a.top.max(b.top)), clip(a.bottom.min(b.bottom)));
        // A point at x in the left view is at x − d in the right one.
        let (left_a, right_a) = (clip(a.left.max(b.left + low)), clip(a.right.min(b.right + high)));
        let (left_b, right_b) = (clip(b.left.max(a.left - high)), clip(b.right.min(a.right - low)));
        let span = (right_a - left_a).max(right_b - left_b);
        if !(right_a > left_a && right_b > left_b && bottom > top && focal.is_finite()) {
            return Err(RectifyError::NoOverlap);
        }
        let pixels = |span: f64| (span * focal).round() as usize + 1;
        let (width, height) = (pixels(span), pixels(bottom - top));
        let camera = |left: f64| Camera::pinhole(width, height, focal, focal, -left * focal, -top * focal);
        let view = |source, left, rotation| RectifiedView { source, camera: camera(left), rotation };
        let left = view(rig.left, left_a, rotations[0]);
        let right = view(rig.right, left_b, rotations[1]);
        let offset = right.camera.cx - left.camera.cx;
        let geometry = StereoGeometry { focal, cx: left.camera.cx, cy: left.camera.cy, baseline, offset };
        let first = (focal * low - offset).floor();
        let last = (focal * high - offset).ceil();
        let views = Rectification { left, right, geometry, vertical: false };
        Ok(Self { views, disparities: (first as i32, (last - first) as usize + 1) })
    }

    /// Returns options of a matcher for these views: the search range, without filling.
    pub fn stereo_options(&self) -> StereoOptions {
        let (min_disparity, disparities) = self.disparities;
        StereoOptions { min_disparity, disparities, fill: false, ..StereoOptions::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Distortion, Pose, Rotation3, Vector3};
    use proptest::prelude::*;

    fn rig(angles: [f64; 3], center: Vector3<f64>) -> StereoRig {
        let mut left = Camera::pinhole(640, 480, 520.0, 515.0, 322.0, 236.0);
        left.distortion = Distortion::radial(-0.1, 0.02);
        let right = Camera::pinhole(600, 500, 530.0, 533.0, 310.0, 245.0);
        let rotation = Rotation3::from_euler_angles(angles[0], angles[1], angles[2]);
        StereoRig { left, right, right_from_left: Pose::new(rotation, -(rotation * center)) }
    }

    /// Points visible in both cameras.
    fn points(rig: &StereoRig) -> Vec<Point3<f64>> {
        let inside = |camera: &Camera, p: &Point3<f64>| {
            camera.project(p).is_some_and(|q| {
                q.x > 0.0 && q.y > 0.0 && q.x < camera.width as f64 - 1.0 && q.y < camera.height as f64 - 1.0
            })
        };
        let grid = (0..1000).map(|i| {
            let at = |step: usize| ((i * step) % 997) as f64 / 997.0 - 0.5;
            let z = 5.0 + 4.0 * at(389);
            Point3::new(1.2 * z * at(101), z * at(211), z)
        });
        grid.filter(|p| inside(&rig.left, p) && inside(&rig.right, &rig.right_from_left.transform(p))).collect()
    }

    proptest! {
        #[test]
        fn scene_points_have_the_same_row_and_the_disparity_of_their_depth(
            angles in (-0.1..0.1f64, -0.1..0.1f64, -1.5..1.5f64), way in 0.0..std::f64::consts::TAU, ahead in -0.3..0.3f64,
        ) {
            // Any direction of the baseline across the optical axis, and any rotation.
            let rig = rig([angles.0, angles.1, angles.2], Vector3::new(way.cos(), way.sin(), ahead));
            let points = points(&rig);
            prop_assume!(points.len() > 200);
            let found = SceneRectification::new(&rig, &points).unwrap();
            let (min, n) = found.disparities;
            let views = &found.views;
            let mut outside = 0;
            for p in &points {
                let a = rig.left.project(p).and_then(|a| views.left.rectified_pixel(a)).unwrap();
                let b = rig.right.project(&rig.right_from_left.transform(p)).and_then(|b| views.right.rectified_pixel(b)).unwrap();
                // Undistorting stops at 1e-13 of the focal length; a thousand pixels lose three digits more.
                prop_assert!((a.y - b.y).abs() < 1e-8, "rows {} and {}", a.y, b.y);
                let depth = (views.left.rotation * p).z;
                prop_assert!((a.x - b.x - views.geometry.disparity(depth)).abs() < 1e-8);
                let shown = |q: cv_core::Point2<f64>, c: &Camera| {
                    q.x > -1.0 && q.y > -1.0 && q.x < c.width as f64 && q.y < c.height as f64
                };
                let d = a.x - b.x - f64::from(min);
                outside += usize::from(!(shown(a, &views.left.camera) && shown(b, &views.right.camera) && d >= 0.0 && d < n as f64));
            }
            // All but one percent at either end are inside, and the margins contain most of those.
            prop_assert!(outside <= points.len() / 50, "{outside} of {}", points.len());
        }
    }

    #[test]
    fn the_scale_of_the_views_is_that_of_the_originals() {
        let rig = rig([0.0, 0.3, 0.0], Vector3::new(-1.0, 0.2, 0.1));
        let all = points(&rig);
        let found = SceneRectification::new(&rig, &all).unwrap();
        let area = |camera: &dyn Fn(&Point3<f64>) -> cv_core::Point2<f64>, p: &Point3<f64>| {
            let h = 1e-4;
            // Along two directions perpendicular to the ray.
            let across = p.coords.cross(&Vector3::y()).normalize();
            let other = p.coords.cross(&across).normalize();
            let (u, v) = (camera(&(p + across * h)) - camera(p), camera(&(p + other * h)) - camera(p));
            (u.x * v.y - u.y * v.x).abs()
        };
        let mut ratios: Vec<f64> = all
            .iter()
            .map(|p| {
                let photo = area(&|q| rig.left.project(q).unwrap(), p);
                let view = area(&|q| found.views.left.camera.project(&(found.views.left.rotation * q)).unwrap(), p);
                (view / photo).sqrt()
            })
            .collect();
        ratios.sort_by(f64::total_cmp);
        // The median over both views is one; that of the left one differs by the viewing directions and the distortion.
        let median = ratios[ratios.len() / 2];
        assert!((0.8..1.25).contains(&median), "{median}");
    }

    #[test]
    fn invalid_scenes_are_refused_with_the_reason() {
        let get = |center, points: &[Point3<f64>]| SceneRectification::new(&rig([0.0; 3], center), points).unwrap_err();
        let point = [Point3::new(0.0, 0.0, 5.0)];
        assert!(
            matches!(get(Vector3::new(0.1, 0.0, 1.0), &point), RectifyError::TooFarTurned { degrees, .. } if degrees > 80.0)
        );
        assert!(matches!(get(Vector3::z(), &point), RectifyError::TooFarTurned { degrees: 90.0, .. }));
        assert!(matches!(get(Vector3::zeros(), &point), RectifyError::NoBaseline { .. }));
        assert!(matches!(get(Vector3::x(), &[]), RectifyError::NoOverlap));
        assert!(matches!(get(Vector3::x(), &[Point3::new(0.0, 0.0, -5.0)]), RectifyError::NoOverlap));
        assert!(matches!(get(Vector3::x(), &[Point3::new(f64::NAN, 0.0, f64::NAN)]), RectifyError::NoOverlap));
        // One point has an empty range: only the margin remains.
        let found = SceneRectification::new(&rig([0.0; 3], Vector3::x()), &point).unwrap();
        assert!((9..=12).contains(&found.disparities.1), "{:?}", found.disparities);
    }
}
