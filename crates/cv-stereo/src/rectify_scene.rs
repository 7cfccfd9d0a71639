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
